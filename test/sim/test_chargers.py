"""Chargers are checked as starts are: by name, before anything moves."""

import copy
import re
from pathlib import Path

import numpy as np
import pytest
import shapely
import yaml
from small_field import SMALL_FIELD

from maasi_filter.geometry.area import Area, level_shape
from maasi_planner.motion import RobotState, make_motion
from maasi_sim.scenario.checks import warnings_about
from maasi_sim.scenario.free_space import FreeSpace
from maasi_sim.scenario.layering import ScenarioError
from maasi_sim.scenario.loading import find_scenario, scenario_from_values
from maasi_sim.simulation.robots import Simulation

# Two halls of 40 m, joined by a door of 6 m.
HALLS = [[0, 0], [40, 0], [40, 17], [50, 17], [50, 0], [90, 0]]
HALLS += [[90, 40], [50, 40], [50, 23], [40, 23], [40, 40], [0, 40]]


def scenario(chargers, robot=(), **environment):
    """Return a search of the halls by a drone that starts in the western one."""
    drone = {
        'type': 'mavlink_drone',
        'start': [10.0, 10.0, 20.0],
        'motion': {'clearance': 1.0, 'speed': 5.0, 'acceleration': 3.0},
        'candidates': {'ring': 4, 'distance': 5.0},
        'endurance': {'per_second': 0.001, 'chargers': chargers},
    }
    values = copy.deepcopy(SMALL_FIELD) | {
        'environment': {'area': HALLS, 'expected_targets': 4.0, **environment},
        'targets': {'count': 2},
        'robots': {'drone': drone | dict(robot)},
    }
    return scenario_from_values(values, 'test')


ZONES = {
    'keep_outs': [[[20, 20], [30, 20], [30, 30], [20, 30]]],
    'obstacles': [{'centre': [10.0, 30.0], 'radius': 2.0}],
}
WRONG = [
    ([45.0, 5.0, 20.0], '5 m outside of the area'),
    ([25.0, 25.0, 20.0], 'in a keep-out zone'),
    ([10.0, 32.2, 20.0], '0.2 m from one of environment.obstacles; allowed is at least the radius'),
    ([10.0, 32.7, 20.0], '0.7 m from the border.* 1.5 m'),
    ([31.2, 25.0, 20.0], '1.2 m from the border.* 1.5 m'),
    ([0.5, 5.0, 20.0], '0.5 m from the border.* 1.5 m'),
]


@pytest.mark.parametrize(('place', 'words'), WRONG)
def test_a_charger_that_cannot_be_used_is_refused_by_name(place, words):
    good = [60.0, 20.0, 20.0]
    assert scenario([good], **ZONES).robots['drone'].endurance.chargers == [good]
    with pytest.raises(ScenarioError) as caught:
        scenario([good, place], **ZONES)
    (line,) = str(caught.value).splitlines()
    key = 'robots.drone.endurance.chargers[1]'
    assert f'{key}: read {place}, ' in line
    assert re.search(words, line), line


def test_a_charger_behind_a_closed_door_is_refused():
    door = {'keep_outs': [[[43, 16], [44, 16], [44, 24], [43, 24]]]}
    far = [60.0, 20.0, 20.0]
    with pytest.raises(ScenarioError, match=r'chargers\[0\]: .* cannot reach'):
        scenario([far], **door)
    assert scenario([[30.0, 30.0, 20.0]], **door)
    # Too narrow for a robot as wide as the door.
    with pytest.raises(ScenarioError, match=r'chargers\[0\]: .* cannot reach'):
        scenario([far], {'radius': 3.0, 'start': [10.0, 10.0, 20.0]})


def test_a_start_is_a_charger_where_none_is_named():
    near = [10.0, 0.7, 20.0]
    with pytest.raises(ScenarioError, match=r'drone\.start: .* is its charger, 0\.7 m from the'):
        scenario([], {'start': near, 'motion': {'clearance': 3.0, 'tolerance': 0.1}})
    for start in (near, [10.0, 0.2, 20.0]):
        assert scenario([[20.0, 10.0, 20.0], [60.0, 20.0, 20.0]], {'start': start})


def test_full_has_to_be_above_the_reserve():
    home = {'endurance': {'per_second': 0.001, 'reserve': 0.5, 'full': 0.4}}
    with pytest.raises(ScenarioError, match=r'drone\.endurance\.full: read 0\.4, .*reserve, 0\.5'):
        scenario([], home)


def test_random_chargers_are_those_that_the_robot_gets_to():
    """In areas that zones cut into parts, by the robot's own predictions."""
    rng = np.random.default_rng(910)
    counts = {True: 0, False: 0}
    for _ in range(12):
        zones = [
            {'centre': rng.uniform([25.0, 5.0], [85.0, 35.0]).tolist(), 'radius': 4.0},
            [[(x := float(rng.uniform(15.0, 80.0))), -1], [x + 2, -1], [x + 2, 41], [x, 41]],
        ]
        values = {'start': [float(v) for v in (*rng.uniform(2.0, 12.0, 2), 20.0)]}
        field = scenario([], values, keep_outs=zones)
        robot, area = field.robots['drone'], Area(field.environment)
        closed = list(map(level_shape, field.environment.keep_outs))
        left = area.border.difference(shapely.union_all(closed))
        space = FreeSpace(robot, area)
        motion = make_motion(robot.motion, area, robot.radius)
        start = RobotState.at_rest(robot.start)
        places = rng.uniform([0.0, 0.0], [90.0, 40.0], (40, 2))
        # What the rounding of discs may decide is left out.
        inner = left.buffer(-1.5 - 0.1)
        for place in places[shapely.contains_xy(inner, places)]:
            goal = np.array([*place, 20.0])
            allowed = space.gets_to(goal)
            assert allowed == bool(motion.predict(start, goal[None], 0.2).reached[0])
            counts[allowed] += 1
    assert min(counts.values()) > 20


def test_the_block_of_the_how_to_names_a_robot_that_is_charged():
    """As it stands there, in the scenario that it is of."""
    text = (Path(__file__).parents[2] / 'docs' / 'how_to' / 'batteries.md').read_text()
    (block,) = (
        item
        for item in re.findall(r'```yaml\n(.*?)```', text, re.S)
        if 'endurance' in item and 'environment' not in item
    )
    values = yaml.safe_load(find_scenario('field').read_text())
    values['environment']['area'] = str(find_scenario('field').with_name('field.geojson'))
    for name, given in yaml.safe_load(block)['robots'].items():
        values['robots'][name] |= given
    field = scenario_from_values(values, 'tutorial')
    assert not list(warnings_about(field))
    west = Simulation(field, 1).robots['west']
    west.battery.charge = 0.4
    for step in range(1, 1001):
        west.step(step, 1.0)
    assert west.battery.charge > 0.9
