"""Scenarios of searches of buildings: files, node plans, simulated robots, report."""

import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from report_check import check_report

from maasi_filter.models.pose import Pose
from maasi_filter.ros.parameters import unflatten
from maasi_planner.buildings import Dynamics
from maasi_planner.buildings.settings import CuboidPlannerSettings
from maasi_sim.buildings.building_mission import BuildingMission, plan_nodes
from maasi_sim.buildings.observer import CuboidRecord, Moment, SnapshotRecord
from maasi_sim.buildings.scenario import (
    check_cuboid_scenario,
    load_cuboid_scenario,
    mission_of,
)
from maasi_sim.buildings.simulation import CuboidSimulation, MassPointBody
from maasi_sim.missions import load_mission
from maasi_sim.run.node_plan import RunSettings
from maasi_sim.run.report_files import write_report
from maasi_sim.scenario.layering import Layer
from maasi_sim.scenario.schema import Scenario, ScenarioError

NAMES = ['buildings_four', 'buildings_obstacles', 'buildings_one']


def scenario_with(change, name='buildings_one'):
    content = load_cuboid_scenario(name).content()
    change(content)
    return check_cuboid_scenario(Layer(content, {(): 'test'}))


@pytest.mark.parametrize('name', NAMES)
def test_our_scenarios_load_and_are_read_back(name, tmp_path):
    scenario = load_cuboid_scenario(name)
    assert scenario.planner.name == 'cuboid_mpc'
    copy = tmp_path / 'copy.yaml'
    copy.write_text(scenario.text())
    assert load_cuboid_scenario(copy) == scenario
    cells = {'buildings_one': 36, 'buildings_four': 32, 'buildings_obstacles': 16}
    assert len(scenario.mission().cells) == cells[name]


def test_other_scenarios_are_as_they_were():
    assert isinstance(load_mission('mambo_turtlebot').scenario, Scenario)


@pytest.mark.parametrize('name', NAMES)
def test_nodes_read_the_scenario_back_from_their_parameter_files(name):
    scenario = load_cuboid_scenario(name)
    plans = plan_nodes(
        scenario,
        RunSettings(seed=4, lockstep=True, rate=None, recorder=True, file=Path('/s.yaml')),
    )
    assert [plan.full_name for plan in plans] == [
        '/sim_node',
        *(f'/{robot}/{node}' for robot in scenario.names() for node in ('cuboid_planner', 'guard')),
    ]
    # A guard must not take a decision of a step's length for a fault.
    assert all(plan.parameters['lease'] >= scenario.step for plan in plans[2::2])
    for plan in plans[1::2]:
        flat = yaml.safe_load(plan.parameter_text())['/**']['ros__parameters']
        assert flat.pop('use_sim_time')
        read = CuboidPlannerSettings.model_validate(unflatten(CuboidPlannerSettings, flat))
        robot = scenario.robots[plan.namespace]
        assert (read.start, read.dynamics, read.hazard) == (
            robot.start,
            robot.dynamics,
            robot.hazard,
        )
        search = read.search()
        assert search.model_dump(exclude={'objects', 'obstacles'}) == scenario.planner.model_dump(
            exclude={'objects', 'obstacles', 'name'}
        )
        area = scenario.environment.array()
        for ours, theirs in (
            (search.objects, scenario.planner.objects),
            (search.obstacles, scenario.planner.obstacles),
        ):
            assert [item.array(area[2, 0]).tolist() for item in ours] == [
                item.array(area[2, 0]).tolist() for item in theirs
            ]


@pytest.mark.parametrize(
    ('change', 'words'),
    [
        (
            lambda c: c['planner']['objects'][0].update(centre=[295.0, 130.0]),
            r'planner\.objects\[0\]: read centre .*inside the area',
        ),
        (
            lambda c: c['robots']['red']['dynamics'].update(mass=4.0),
            r'robots\.red\.dynamics\.force: got 35.0 N, which cannot lift',
        ),
        (
            lambda c: c['robots']['red'].update(start=[175.0, 130.0, 10.0]),
            r'robots\.red\.start: read .*inside an object',
        ),
        (
            lambda c: c['environment'].update(bounds=[[0.0, 300.0], [0.0, 300.0]]),
            r'environment\.bounds: read 2 axes',
        ),
        (
            lambda c: c['environment'].update(bounds=[[144.0, 206.0], [99.0, 161.0], [0.0, 80.0]]),
            r'planner\.objects: no cuboid can be reached',
        ),
        (lambda c: c['planner'].update(objects=[]), r'planner\.objects: got none'),
        (lambda c: c['planner'].update(horizon=1), r'planner\.horizon'),
        (lambda c: c['planner'].update(hoizon=5), r'planner\.hoizon'),
        (
            lambda c: c['events'].append({'at': 5.0, 'robot': 'rad', 'do': 'leave'}),
            r"events\[0\]\.robot: .*'rad'",
        ),
        (lambda c: c['robots'].update(Red=c['robots']['red']), r'lower case'),
    ],
)
def test_wrong_files_are_refused_with_their_key(change, words):
    with pytest.raises(ScenarioError, match=words):
        scenario_with(change)


def test_a_body_flies_the_velocity_that_a_plan_leads_to():
    dynamics = Dynamics()
    body = MassPointBody(dynamics, Pose.from_yaw([50.0, 50.0, 20.0], 1.0), [3.0, 0.0, -1.0])
    place, speed = dynamics.next([50.0, 50.0, 20.0], [3.0, 0.0, -1.0], [10.0, -20.0, 34.0])
    turned = Pose.from_yaw([0.0, 0.0, 0.0], 1.0).rotation().T @ speed
    body.step([*turned, 0.0], 1.0)
    state = body.robot_state()
    assert state.pose.position == pytest.approx(place)
    assert state.velocity == pytest.approx(speed)
    with pytest.raises(ValueError, match=r'dt: got 0\.5 s'):
        body.step(np.zeros(4), 0.5)


def test_a_robot_without_commands_brakes():
    simulation = CuboidSimulation(load_cuboid_scenario('buildings_one'), 1)
    robot = simulation.robots['red']
    for _ in range(4):
        robot.command([0.0, 8.0, 0.0, 0.0])
        simulation.advance()
    assert robot.state.velocity[1] == pytest.approx(8.0)
    for _ in range(4):
        simulation.advance()
    assert robot.state.velocity == pytest.approx(np.zeros(3), abs=1e-9)


def test_the_link_has_a_range_and_robots_leave():
    def change(content):
        content['events'] = [
            {'at': 3.0, 'robot': 'red', 'do': 'leave'},
            {'at': 5.0, 'robot': 'red', 'do': 'back'},
        ]
        content['planner']['communication_range'] = 21.0

    simulation = CuboidSimulation(scenario_with(change, 'buildings_four'), 1)
    heard = simulation.heard_by(['blue', 'green', 'purple', 'red'])
    assert heard['red'] == ['blue', 'purple'] and heard['green'] == ['blue', 'purple']
    present = []
    for _ in range(6):
        present.append(simulation.present)
        simulation.advance()
    assert ['red' in names for names in present] == [True, True, True, False, False, True]


def record_of(name='buildings_obstacles'):
    scenario = load_cuboid_scenario(name)
    run = mission_of(scenario).run(200)
    shots = [
        SnapshotRecord(
            shot.cuboid,
            shot.robot,
            shot.step,
            float(shot.step),
            shot.position,
            shot.direction,
            shot.distance,
            shot.detection_probability,
        )
        for shot in run.snapshots
    ]
    return CuboidRecord(
        name,
        scenario,
        1,
        run.mission,
        snapshots=shots,
        trajectories={
            robot: np.column_stack([np.arange(len(path)), path])
            for robot, path in run.paths.items()
        },
        choices=run.how,
        active=np.column_stack([np.arange(len(run.active)), run.active]),
        solve_times=run.solve_times,
        end_reason='all_found',
        end_time=float(run.steps),
        wall_time=2.0,
        completed=Moment(float(run.steps), run.steps),
    )


def test_report_and_picture(tmp_path):
    record = record_of()
    mission = BuildingMission(record.name, record.scenario)
    report = write_report(mission, record, tmp_path)
    assert check_report(json.loads((tmp_path / 'report.json').read_text())) == report
    assert (tmp_path / 'report.png').stat().st_size > 20_000
    assert report['cuboids'] == {'total': 16, 'visited': 16, 'missed': [], 'lost': []}
    assert report['collisions'] == 0 and report['missed'] == 0
    assert report['time_to_find_all'] == record.completed.time
    assert sum(report['measurements'].values()) == len(report['snapshots']) >= 16
    chances = [shot['detection_probability'] for shot in report['snapshots']]
    assert report['least_detection_probability'] == min(chances) > 0.7
    assert '16 of 16 cuboids visited' in mission.summary(report)
    # A way through the building is seen.
    path = record.trajectories['red']
    path[3, 1:], path[4, 1:] = [240.0, 215.0, 10.0], [330.0, 215.0, 10.0]
    record.snapshots.clear()
    worse = write_report(mission, record, tmp_path)
    assert worse['collisions'] > 0 and worse['missed'] == 16
    assert worse['least_detection_probability'] is None
