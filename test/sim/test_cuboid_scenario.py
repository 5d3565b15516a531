"""Scenarios of searches of buildings: files, node plans, simulated robots, report."""

import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from report_check import check_report

from maasi_filter.ros.parameters import unflatten
from maasi_planner.buildings.dynamics import Dynamics
from maasi_planner.buildings.settings import CuboidPlannerSettings
from maasi_sim.buildings.building_mission import BuildingMission
from maasi_sim.buildings.observer import CuboidRecord
from maasi_sim.buildings.scenario import check_cuboid_scenario, load_cuboid_scenario
from maasi_sim.buildings.simulation import CuboidSimulation
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
    run = RunSettings(seed=4, lockstep=True, rate=None, recorder=True, file=Path('/s.yaml'))
    plans = BuildingMission(name, scenario).plan_nodes(run)
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
        for key in ('start', 'yaw', 'dynamics', 'hazard'):
            assert getattr(read, key) == getattr(robot, key)
        search = read.search()
        assert search.model_dump(exclude={'objects', 'obstacles'}) == scenario.planner.model_dump(
            exclude={'objects', 'obstacles', 'name'}
        )
        floor = scenario.environment.array()[2, 0]
        for key in ('objects', 'obstacles'):
            ours, theirs = getattr(search, key), getattr(scenario.planner, key)
            assert [item.numbers(floor) for item in ours] == [
                item.numbers(floor) for item in theirs
            ]
        assert [item.faces for item in search.objects] == [
            item.faces for item in scenario.planner.objects
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
            r'robots\.red\.dynamics: force: got 35.0 N, which cannot lift',
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


def test_a_robot_flies_the_velocity_that_a_plan_leads_to_and_brakes_without_one():
    def turn(content):
        content['robots']['red'].update(start=[50.0, 50.0, 20.0], yaw=1.0)

    dynamics = Dynamics()
    simulation = CuboidSimulation(scenario_with(turn), 1)
    robot = simulation.robots['red']
    place, speed = robot.state.pose.position, robot.state.velocity
    for control in ([10.0, -20.0, 34.0], [0.0, 30.0, 33.0]):
        place, speed = dynamics.next(place, speed, control)
        robot.command([*robot.state.pose.rotation().T @ speed, 0.0])
        simulation.advance()
        assert robot.state.pose.position == pytest.approx(place)
        assert robot.state.velocity == pytest.approx(speed)
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


def test_report_and_picture_of_a_run_that_went_wrong(tmp_path):
    scenario = load_cuboid_scenario('buildings_obstacles')
    mission = BuildingMission('buildings_obstacles', scenario)
    ways = dict.fromkeys(scenario.names(), np.zeros((0, 4)))
    # Through the building.
    ways['red'] = np.array([[0.0, 240.0, 215.0, 10.0], [1.0, 330.0, 215.0, 10.0]])
    record = CuboidRecord(
        mission.name,
        scenario,
        1,
        scenario.mission(),
        trajectories=ways,
        choices={'brake': 1},
        active=np.array([[0.0, 2.0]]),
        end_reason='time_limit',
        end_time=1.0,
        wall_time=2.0,
    )
    report = write_report(mission, record, tmp_path)
    assert check_report(json.loads((tmp_path / 'report.json').read_text())) == report
    assert (tmp_path / 'report.png').stat().st_size > 20_000
    assert report['cuboids'] == {'total': 16, 'visited': 0, 'missed': [*range(16)], 'lost': []}
    assert report['collisions'] > 0 and report['missed'] == 16
    assert report['least_detection_probability'] is None and report['solve_time'] is None
    assert '0 of 16 cuboids visited (ended: time limit)' in mission.summary(report)
