"""Colours of robots and map features, shared by pictures, RViz and the page."""

from collections.abc import Iterable

FOUND, POTENTIAL, SEEN, AWAY = '#009E73', '#E69F00', '#CC79A7', '#8B929B'
KEEP_OUT = '#8F9900'  # of no robot
# Cuboids of buildings, to visit and visited; sightings of persons.
OPEN, VISITED, SIGHTED = '#D55E00', '#56B4E9', '#C7417B'
# By the order of the robots' names, and for robots named after a colour.
ROBOTS = ('#0072B2', '#B54800', '#6A3D9A', '#7A4A00', '#00707F', '#A02C6D')
NAMED = {'purple': '#7B3294', 'red': '#D62728', 'green': '#1F7A1F', 'blue': '#0072B2'}


def robot_colours(names: Iterable[str]) -> dict[str, str]:
    """Return a colour for each robot of a team; a robot named after a colour gets that colour."""
    return {
        name: NAMED.get(name, ROBOTS[index % len(ROBOTS)])
        for index, name in enumerate(sorted(names))
    }
