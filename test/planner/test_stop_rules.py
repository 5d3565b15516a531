"""When planners end a search: never before it began, and when nothing is left within reach."""

import numpy as np
import pytest
from planner_helpers import area_of, follow, planning_robot

from maasi_filter.models.detection import BoxDetection, ExponentialDetection
from maasi_filter.models.sensor import Sensor
from maasi_filter.unexplored_map import UnexploredMap
from maasi_planner import (
    CandidateSet,
    CandidateSettings,
    TeamView,
    make_planner,
    planner_settings,
)
from maasi_planner.candidates import map_spacing, swath_of

PLANNERS = ('auto', 'tour', 'maasi', 'maas', 'nearest_widest', 'lawnmower')


def team_of(area, detections, starts, candidates, spacing=None):
    """Return a team that plans; candidates: settings of them all."""
    robots = {}
    for number, (detection, start) in enumerate(zip(detections, starts)):
        speed = min(0.5 * swath_of(Sensor('robot', detection, np.eye(2))), 100.0)
        points = CandidateSet(CandidateSettings(**candidates), area).at([*start, 0.0])
        robots[f'robot{number}'] = planning_robot(start, detection, area, 0.05, points, speed=speed)
    usual, _ = map_spacing(area.bounds, [view.sensor for view in robots.values()])
    return TeamView(0, 0.2, robots, [], UnexploredMap(area, spacing or usual))


def random_search(rng, narrowest):
    """Return a team with a random area, swaths, expected targets and candidates.

    narrowest: swath as a share of the shorter side.
    """
    width, height = 10.0 ** rng.uniform(np.log10(30.0), np.log10(3000.0), 2)
    swath = float(min(width, height) * 10.0 ** rng.uniform(np.log10(narrowest), -0.3))
    expected = float(10.0 ** rng.uniform(np.log10(0.05), np.log10(500.0)))
    zones = {}
    if rng.uniform() < 0.3:
        centre = rng.uniform([0.3 * width, 0.3 * height], [0.7 * width, 0.7 * height])
        zones['keep_outs'] = [{'centre': centre.tolist(), 'radius': 0.2 * min(width, height)}]
    if rng.uniform() < 0.3:
        corners = [[0.0, 0.0], [0.5 * width, 0.0], [0.5 * width, height], [0.0, height]]
        zones['prior'] = {'polygons': [{'polygon': corners, 'weight': float(rng.uniform(0, 9))}]}
    area = area_of(width, height, expected, **zones)
    half = 0.5 * swath
    detections = [
        BoxDetection([-half] * 2, [half] * 2, rng.uniform(0.5, 1.0), 'world')
        if rng.uniform() < 0.7
        else ExponentialDetection(0.95, [half] * 2)
        for _ in range(int(rng.integers(1, 4)))
    ]
    starts = []
    while len(starts) < len(detections):
        start = rng.uniform([0.0, 0.0], [width, height])
        if area.inside(start[None])[0]:
            starts.append(start)
    ring = {'ring': 8, 'distance': 0.8 * swath}
    grid = {'grid': [7, 6], 'spacing': [width / 8.0, height / 7.0]}
    return team_of(area, detections, starts, ring if rng.uniform() < 0.5 else grid)


@pytest.mark.parametrize('name', PLANNERS)
def test_no_search_ends_before_it_began_and_each_when_all_is_seen(name):
    """Areas of 30 m to 3 km, swaths of 1 % to half of them, 0.05 to 500 expected targets."""
    many = name not in ('auto', 'maasi')
    for seed in range(14 if many else 10):
        team = random_search(np.random.default_rng(seed), 0.01 if many else 0.05)
        planner = make_planner(name, team=team)
        assert planner.finished(team) is None, seed
        decision = planner.decide(team)
        moves = [robot for robot in decision.robots.values() if not robot.stays]
        assert moves and planner.finished(team) is None, (seed, decision.reason)
        # Even with a part of it explored.
        team.exploration.values[:3] = 0.0
        planner.decide(team)
        assert planner.finished(team) is None, seed
        team.exploration.values[...] = 1e-5
        planner.decide(team)
        assert 'explored' in planner.finished(team), seed


def walled(size=12.0, swath=2.0, expected=12.0):
    """Return a team of one robot that cannot enter a fifth of its area, behind a wall."""
    wall = [[0.78 * size, -1.0], [0.8 * size, -1.0], [0.8 * size, size + 1.0]]
    wall.append([0.78 * size, size + 1.0])
    area = area_of(size, size, expected, obstacles=[{'polygon': wall}])
    half = 0.5 * swath
    box = BoxDetection([-half] * 2, [half] * 2, 0.98, 'world')
    grid = {'grid': [10, 10], 'spacing': size / 11.0}
    return team_of(area, [box], [[half, half]], grid)


def follow_all(team, decision):
    for name, robot in decision.robots.items():
        follow(team, name, robot)


@pytest.mark.parametrize('expected', [0.05, 12.0, 500.0])
@pytest.mark.parametrize('name', ['tour', 'maasi'])
def test_ground_behind_a_wall_does_not_keep_a_search_alive(name, expected):
    """The number of decisions does not depend on how many targets are expected."""
    team, planner = walled(expected=expected), make_planner(name)
    decisions = 0
    while planner.finished(team) is None:
        follow_all(team, planner.decide(team))
        decisions += 1
        assert decisions < 150
    assert 0.75 < team.exploration.explored_fraction() < 0.92
    # Of what the candidates see before the wall.
    assert team.exploration.values[5:36, 5:-5].mean() < 0.02
    # The same with any other number of targets.
    other, again = walled(expected=3.0), make_planner(name)
    for _ in range(decisions):
        assert again.finished(other) is None
        follow_all(other, again.decide(other))
    assert again.finished(other) is not None


def test_the_share_at_which_a_tour_ends_is_set():
    lengths = []
    for share in (0.3, 0.03, 1e-3):
        settings = planner_settings(name='tour', gain_threshold=share)
        team, planner = walled(), make_planner('tour', settings)
        legs = 0
        while planner.finished(team) is None:
            follow_all(team, planner.decide(team))
            legs += 1
        lengths.append(legs)
        assert team.exploration.values[:36].mean() < share + 0.05, share
    assert lengths[0] < lengths[1] < lengths[2]


def test_a_zone_that_covers_what_is_left_leaves_it_and_the_tour_goes_on_when_it_is_opened():
    open_area, zone = area_of(12.0, 12.0), {'centre': [9.0, 9.0], 'radius': 2.0}
    box = BoxDetection([-1.0, -1.0], [1.0, 1.0], 0.98, 'world')
    team = team_of(open_area, [box], [[1.0, 1.0]], {'grid': [3, 3], 'spacing': 4.0})
    planner, exploration = make_planner('tour'), team.exploration
    planner.decide(team)
    x, y = np.meshgrid(*exploration.axes(), indexing='ij')
    exploration.values[np.hypot(x - 9.0, y - 9.0) > 1.8] = 0.0
    assert planner.finished(team) is None
    exploration.adopt_area(area_of(12.0, 12.0, keep_outs=[zone]))
    team.robots['robot0'].motion.adopt_area(exploration.area, 0.05)
    assert 'worth a visit' in planner.finished(team)
    assert exploration.closed_share() == pytest.approx(np.pi * 1.8**2 / 144.0, rel=0.1)
    exploration.adopt_area(open_area)
    team.robots['robot0'].motion.adopt_area(open_area, 0.05)
    assert planner.finished(team) is None
    for _ in range(20):
        follow_all(team, planner.decide(team))
        if planner.finished(team) is not None:
            break
    assert exploration.explored_fraction() > 0.998 and planner.finished(team) is not None


def test_live_settings_end_a_search_earlier():
    for size, swath, name in ((12.0, 2.0, 'tour'), (12.0, 4.0, 'maasi')):
        numbers = []
        for share in (None, 0.7):
            team = walled(size, swath)
            settings = planner_settings()
            planner = make_planner('auto', settings, team)
            assert planner.prefix == f'{name}: '
            planner.decide(team)
            if share is not None:
                settings.gain_threshold, settings.mass_threshold = share, 0.7
            numbers.append(0)
            while planner.finished(team) is None:
                follow_all(team, planner.decide(team))
                numbers[-1] += 1
        assert 0 < numbers[1] < 0.5 * numbers[0]
    with pytest.raises(ValueError, match='gain_threshold'):
        planner_settings(gain_threshold=1.0)


def test_all_robots_are_asked_for_what_is_left():
    """A robot that shows nothing more does not end the search of another one that does."""
    area = area_of(20.0, 20.0)
    boxes = [BoxDetection([-1.0, -1.0], [1.0, 1.0], 1.0, 'world')] * 2
    team = team_of(area, boxes, [[2.0, 2.0], [18.0, 18.0]], {'grid': [2, 2], 'spacing': 2.0})
    corners = np.array([[2.0, 4.0, 0.0], [18.0, 16.0, 0.0]])
    for view, corner in zip(team.robots.values(), corners):
        view.candidates = corner[None]
    planner, x = make_planner('maasi'), team.exploration.axes()[0]
    planner.decide(team)
    team.exploration.values[x < 10.0] = 0.0
    planner.decide(team)
    assert planner.finished(team) is None
    team.exploration.values[x > 16.0] = 0.0
    planner.decide(team)
    assert 'no candidate of any robot' in planner.finished(team)


def test_a_tour_on_a_million_cells_is_planned():
    """6 km with a swath of 16 m: 145,000 places."""
    area, box = area_of(6000.0, 6000.0, 8.0), BoxDetection([-8.0] * 2, [8.0] * 2, 0.8, 'world')
    team = team_of(area, [box, box], [[100.0, 100.0], [300.0, 100.0]], {'ring': 4, 'distance': 9.0})
    assert team.exploration.values.size > 1_000_000
    planner = make_planner('tour')
    assert planner.finished(team) is None
    decision = planner.decide(team)
    assert not any(robot.stays for robot in decision.robots.values())
