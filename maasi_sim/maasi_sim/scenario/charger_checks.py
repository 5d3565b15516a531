"""Checks of what a robot with `endurance` needs: chargers that it gets to, and that charge it."""

import math
from collections.abc import Iterator

import shapely

from maasi_sim.scenario.free_space import FreeSpace
from maasi_sim.scenario.schema import RobotSettings

# Of its clearance, by which a charger may be nearer to a wall: rounding.
_SLACK = 1e-3


def charger_problems(space: FreeSpace) -> Iterator[str]:
    """Yield problems of where a robot is charged, `key: text`, as keys of the robot."""
    robot, home = space.robot, space.robot.endurance
    if home is None:
        return
    if home.full <= home.reserve:
        yield (
            f'endurance.full: read {home.full:g}, allowed is more than endurance.reserve, '
            f'{home.reserve:g}: it would never go out again'
        )
    chargers = {f'endurance.chargers[{i}]': place for i, place in enumerate(home.chargers)}
    # Its start is its charger; a robot that stands there may be off by its tolerance.
    slack = _SLACK * robot.motion.clearance
    if not chargers:
        chargers, slack = {'start': robot.start}, 2.0 * robot.motion.tolerance
    for key, place in chargers.items():
        problem = _charger_problem(space, place, slack)
        if problem:
            which = '' if home.chargers else ', which is its charger'
            yield f'{key}: read {place}{which}, {problem}'


def _charger_problem(space: FreeSpace, place: list[float], slack: float) -> str:
    """Return what is wrong with a charger, and what is allowed; or an empty text."""
    robot, area = space.robot, space.area
    if not area.inside([place])[0]:
        outside = area.outside_by(place)
        where = f'{outside:.3g} m outside of the area' if outside > 0.0 else 'in a keep-out'
        return f'{where}; allowed is what lies inside of the area and outside of keep-outs'
    gap = area.distances(place).min(initial=math.inf)
    if gap < robot.radius:
        return (
            f'{gap:.3g} m from one of environment.obstacles; allowed is at least the radius, '
            f'{robot.radius:g} m'
        )
    point = shapely.Point(place[:2])
    if not space.parts or shapely.distance(space.parts, point).min() > slack:
        return (
            f'{space.gap(place):.3g} m from the border, a keep-out or an obstacle; allowed is at '
            f'least radius and motion.clearance, {robot.radius + robot.motion.clearance:g} m'
        )
    if not space.gets_to(place):
        return (
            f'which the robot does not reach from its start, {robot.start}; allowed is what it '
            f'gets to with its radius and motion.clearance, {robot.radius:g} and '
            f'{robot.motion.clearance:g} m'
        )
    return ''


def endurance_doubts(robot: RobotSettings) -> Iterator[str]:
    """Yield what is hardly meant about a robot's battery, `key: text`, as keys of the robot."""
    if robot.endurance is None:
        return
    if not robot.battery.chargeable and not robot.external:
        yield (
            'battery.charging_power: read 0, and the robot has endurance: it goes home once, and '
            'takes no further part in the search'
        )
    if robot.endurance.per_second == 0.0 and robot.endurance.per_metre == 0.0:
        yield (
            'endurance: per_second and per_metre are 0, so that the way home costs nothing: it '
            'turns home at its reserve, wherever it is'
        )
