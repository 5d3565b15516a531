"""What a search will take, before it starts; and when one that ends is complete."""

import copy
import re
from pathlib import Path

import numpy as np
import pytest
import shapely
import yaml

from maasi_filter.geometry.area import Area
from maasi_sim.run import run_scenario
from maasi_sim.run.ending import DONE, NOT_ALL_FOUND, end_of_planners
from maasi_sim.run.missions import load_mission
from maasi_sim.scenario.free_space import FreeSpace
from maasi_sim.scenario.loading import config_folder, scenario_from_values
from maasi_sim.scenario.preflight import Effort, preflight

# 25 ha, and two drones that fly for 20 minutes: 456 kJ at 300 W + 8 m/s x 10 W/(m/s).
DRONE = {
    'type': 'mavlink_drone',
    'start': [480.0, 20.0, 20.0],
    'motion': {'speed': 8.0, 'acceleration': 3.0, 'clearance': 1.0},
    'battery': {'capacity': 456e3},
    'candidates': {'ring': 4, 'distance': 10.0},
}
FIELD = {
    'version': 1,
    'environment': {
        'area': [[0, 0], [500, 0], [500, 500], [0, 500]],
        'expected_targets': 2.0,
    },
    'step': 0.2,
    'targets': {'count': 2},
    'robots': {'east': DRONE, 'west': DRONE | {'start': [20.0, 20.0, 20.0]}},
    'filter': {'method': 'pmb'},
    'stop': 'planner_done',
    'limits': {'time': 600.0},
}


def field(drones=None, **changes):
    """Return the field with changes, and with some settings of all drones changed."""
    values = copy.deepcopy(FIELD | changes)
    for robot in values['robots'].values():
        robot |= drones or {}
    return scenario_from_values(values, 'test')


def test_25_hectares_in_10_minutes_are_too_many():
    report = preflight(field())
    assert report.lines[0] == 'area: 25 ha'
    alone = 'swath 16 m; one pass alone takes 15.6 km, 33 min at 8 m/s, 1.6 batteries'
    assert report.lines[1:3] == [f'east: {alone}', f'west: {alone}']
    assert report.lines[3] == (
        'team: one pass takes 16 min; no charging needed; the time limit is 10 min'
    )
    assert report.lines[-1] == 'west: starts at (20, 20, 20) m'
    # 2 x 16 m x 8 m/s x 600 s of 250,000 m2.
    assert len(report.warnings) == 1 and report.warnings[0].startswith(
        'limits.time: one pass of the team takes 16 min without turns; in 10 min about 61 % of'
    )
    hour = {'limits': {'time': 3600.0}}
    (warning,) = {text.partition(': ')[2] for text in preflight(field(**hour)).warnings}
    assert warning.startswith('its battery lasts for 20 min of 60 min, ')
    home = {'endurance': {'per_second': 1.0 / 1200.0, 'reserve': 0.25}}
    report = preflight(field(home, **hour))
    # A flight of 15 minutes, then 21 minutes at the charger.
    assert report.warnings == []
    both = 'east charges once, west charges once'
    assert report.lines[3].startswith(f'team: one pass takes 37 min; {both}; the')
    assert report.lines[-1] == 'west: starts at (20, 20, 20) m, its charger'


def test_robots_that_cannot_be_charged_have_one_flight():
    once = {'endurance': {'per_second': 1.0 / 1200.0}}
    once['battery'] = DRONE['battery'] | {'charging_power': 0.0}
    report = preflight(field(once))
    assert 'cannot be charged and returns home after 15 min' in report.lines[-1]
    # Two flights of 15 minutes.
    assert report.warnings[0].startswith('one pass needs more than all batteries: at most 92 % ')
    assert 'in 10 min about 61 %' in report.warnings[1]
    assert report.lines[3].startswith('team: one pass needs more than all batteries')


def test_cells_that_are_wider_than_the_swath_are_named():
    coarse = field(filter={'method': 'pmb', 'exploration_spacing': 30.0})
    report = preflight(coarse)
    assert 'exploration map: 17 x 17 cells of 30 m' in report.lines
    assert any('exploration_spacing: read 30, wider than' in text for text in report.warnings)


def test_parts_that_no_robot_gets_to_are_named_with_their_size():
    """A wall cuts off a third; a zone round the rest of it is of another warning."""
    wall = {'keep_outs': [[[330, -1], [340, -1], [340, 501], [330, 501]]]}
    environment = FIELD['environment'] | wall
    drones = {'west': FIELD['robots']['west']}
    report = preflight(field(environment=environment, robots=drones))
    assert report.lines[0] == 'area: 24.5 ha, without 0.5 ha of keep-out zones and obstacles'
    (text,) = (text for text in report.warnings if 'no robot can see' in text)
    # It sees 8 m across, from 1.5 m next to the wall: not all of the part is out of sight.
    where = r'8 ha \(x 340 to 500 m, y 0 to 500 m\)'
    assert re.search(f'no robot can see 33 % of the area: {where}', text), text
    # With a drone on each side all is searched.
    report = preflight(field(environment=environment))
    assert not any('no robot can see' in text for text in report.warnings)
    assert 'it can see 67 % of the area' in report.lines[2]


def test_the_time_of_work_is_that_of_flights_and_charges_in_turn():
    rng = np.random.default_rng(920)
    for _ in range(50):
        use, first, later = 1e-3, float(rng.uniform(0.0, 0.8)), float(rng.uniform(0.05, 0.8))
        charging = float(rng.choice([50.0, 900.0, np.inf]))
        effort = Effort(10.0, 5.0, use, first, later, charging, 1e5, 1e4)
        total = float(rng.uniform(1.0, 6000.0))
        worked, charges, charge, busy = 0.0, 0, first, 0.0
        for _ in np.arange(0.0, total, 0.5):
            if busy > 0.0:
                busy -= 0.5
                charge = later if busy <= 0.0 else charge
                charges += busy <= 0.0
            elif charge > 0.0:
                worked, charge = worked + 0.5, charge - 0.5 * use
            if charge <= 0.0 and busy <= 0.0:
                busy = charging
        time, number = effort.working(total)
        assert time == pytest.approx(worked, abs=5.0 + 0.01 * total)
        assert abs(number - charges) <= 1


def test_the_tutorial_shows_what_is_printed():
    text = (Path(__file__).parents[2] / 'docs' / 'tutorials' / 'area.md').read_text()
    (shown,) = re.findall(r'```text\n(area: .*?)\n```', text, re.S)
    assert shown == '\n'.join(load_mission('field').preflight().lines)


def test_shipped_scenarios_have_no_warnings():
    for path in sorted((config_folder() / 'scenarios').glob('*.yaml')):
        report = load_mission(path).preflight()
        assert report.warnings == [], path.stem
        assert re.match(r'(area|space): ', report.lines[0])


# Of the structure of fields that failed: a corridor with a charger, one person in a large field,
# a round zone in a plain box.
FIELDS = {
    'corridor': {
        'environment': {'bounds': [[0.0, 150.0], [0.0, 50.0]], 'expected_targets': 3.0},
        'robots': {
            'd': DRONE
            | {
                'start': [25.0, 12.0, 20.0],
                'battery': {'capacity': 9e3, 'idle_power': 90.0, 'charging_power': 900.0},
                'endurance': {'per_second': 0.01, 'per_metre': 0.001, 'reserve': 0.3},
            }
        },
        'planner': {'name': 'lawnmower'},
    },
    'one person': {
        'environment': {'bounds': [[0.0, 700.0], [0.0, 500.0]], 'expected_targets': 0.8},
        'targets': {'count': 1},
        'limits': {'time': 120.0},
    },
    'round zone': {
        'environment': {
            'bounds': [[0.0, 90.0], [0.0, 90.0]],
            'keep_outs': [{'centre': [45.0, 70.0], 'radius': 12.0}],
        },
        'targets': {'count': 0},
        'robots': {'d': DRONE | {'start': [6.0, 84.0, 20.0]}},
    },
}


def test_one_robot_sees_what_the_team_sees():
    """Also where shapes that are united differ in their last digits."""
    rng = np.random.default_rng(922)
    for _ in range(20):
        zones = [
            {
                'centre': rng.uniform(80.0, 420.0, 2).tolist(),
                'radius': float(rng.uniform(5.0, 40.0)),
            }
            for _ in range(15)
        ]
        environment = FIELD['environment'] | {'keep_outs': zones}
        drone = {'east': DRONE | {'battery': {'capacity': 1e9}}}
        limit = {'limits': {'time': 1e5}}
        report = preflight(field(environment=environment, robots=drone, **limit))
        assert report.lines[2].startswith('team: one pass takes ')
        assert all('no robot can see' in text for text in report.warnings)


def test_the_command_prints_what_a_search_takes_and_starts_nothing(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name, changes in FIELDS.items():
        (tmp_path / 'field.yaml').write_text(yaml.safe_dump(copy.deepcopy(FIELD) | changes))
        assert run_scenario.main(['--check', 'field.yaml']) == DONE
        output = capsys.readouterr().out
        assert output.startswith('area: ') and 'team: one pass ' in output, name
    assert 'area: 0.765 ha, without 452 m2 of keep-out zones and obstacles' in output
    # What wins over the file counts.
    (tmp_path / 'field.yaml').write_text(yaml.safe_dump(FIELD))
    assert run_scenario.main(['--check', 'field.yaml', '--time-limit', '1800']) == DONE
    assert 'the time limit is 30 min' in capsys.readouterr().out
    wrong = copy.deepcopy(FIELD)
    wrong['robots']['east']['start'] = [505.0, 20.0, 20.0]
    (tmp_path / 'field.yaml').write_text(yaml.safe_dump(wrong))
    assert run_scenario.main(['--check', 'field.yaml']) == 2
    assert 'robots.east.start: read (505, 20, 20) m' in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ['field.yaml']


def test_what_a_robot_gets_to_is_the_area_less_its_body():
    """By shapely, for random areas: no part is missing, none is beyond a wall."""
    rng = np.random.default_rng(921)
    for _ in range(20):
        corners = rng.uniform(0.0, 100.0, (12, 2))
        ring = shapely.convex_hull(shapely.multipoints(corners))
        hole = shapely.Point(ring.centroid).buffer(float(rng.uniform(2.0, 12.0)), quad_segs=2)
        rings = [shapely.get_coordinates(part).tolist() for part in (ring.exterior, hole.exterior)]
        inner = ring.difference(hole).buffer(-2.6)
        start = [*inner.representative_point().coords[0], 20.0]
        changes = {
            'environment': {'area': rings},
            'robots': {'d': DRONE | {'start': start, 'motion': {'clearance': 2.0}}},
            'targets': {'count': 0},
        }
        scenario = field(**changes)
        space = FreeSpace(scenario.robots['d'], Area(scenario.environment))
        expected = ring.difference(hole).buffer(-2.5, join_style='mitre')
        assert shapely.union_all(space.parts).symmetric_difference(expected).area < 0.1
        here = shapely.Point(start)
        own = sum(part.area for part in shapely.get_parts(expected) if part.distance(here) < 1e-6)
        assert shapely.union_all(space.reachable).area == pytest.approx(own, rel=1e-3)


def test_a_search_that_gives_up_is_not_complete():
    assert end_of_planners('all is explored', 0.999, meant=True).code == DONE
    assert end_of_planners('all is explored', 0.999, meant=False).code == NOT_ALL_FOUND
    for explored in (0.0, 0.49):
        ending = end_of_planners('no place is worth a visit', explored, meant=True)
        assert ending.code == NOT_ALL_FOUND and ending.reason == 'planner_done'
        assert f' only {100.0 * explored:.1f} % explored' in ending.text
