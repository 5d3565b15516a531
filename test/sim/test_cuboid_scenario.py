"""Scenarios of searches of buildings: files, node plans, simulated robots, report."""

import json
from pathlib import Path

import numpy as np
import pytest
from report_check import check_report
from test_node_plan import read_back
from test_scenario import changed

from maasi_planner.buildings.dynamics import Dynamics
from maasi_planner.buildings.settings import CuboidPlannerSettings
from maasi_sim.run.buildings.building_mission import BuildingMission
from maasi_sim.run.buildings.observer import CuboidRecord
from maasi_sim.run.buildings.scenario import check_cuboid_scenario, load_cuboid_scenario
from maasi_sim.run.buildings.simulation import CuboidSimulation
from maasi_sim.run.facts import RobotAt
from maasi_sim.run.log import RunEnd
from maasi_sim.run.report_files import write_report
from maasi_sim.run.run_options import Options
from maasi_sim.scenario.layering import Layer
from maasi_sim.scenario.schema import ScenarioError

NAMES = ['buildings_four', 'buildings_obstacles', 'buildings_one']
ONE = load_cuboid_scenario('buildings_one').content()


def scenario_with(*changes):
    content = changed(*changes, content=ONE)
    return check_cuboid_scenario(Layer(content, {(): 'test'}))


@pytest.mark.parametrize('name', NAMES)
def test_our_scenarios_load_and_are_read_back_also_by_nodes(name, tmp_path):
    scenario = load_cuboid_scenario(name)
    assert scenario.planner.name == 'cuboid_mpc'
    copy = tmp_path / 'copy.yaml'
    copy.write_text(scenario.text())
    assert load_cuboid_scenario(copy) == scenario
    cells = {'buildings_one': 36, 'buildings_four': 32, 'buildings_obstacles': 16}
    assert len(scenario.mission().cells) == cells[name]
    mission, file = BuildingMission(name, scenario), Path('/s.yaml')
    planners = [f'/{robot}/cuboid_planner' for robot in scenario.names()]
    # Nothing moves in lockstep while a planner hangs.
    waiting = mission.plan_nodes(Options(lockstep=True), file)
    assert [plan.full_name for plan in waiting] == ['/sim_node', *planners]
    plans = mission.plan_nodes(Options(lockstep=False), file)
    assert [plan.full_name for plan in plans] == [
        '/sim_node',
        *(f'/{robot}/{node}' for robot in scenario.names() for node in ('cuboid_planner', 'guard')),
    ]
    # A guard must not take a decision of a step's length for a fault.
    assert all(plan.parameters['lease'] >= scenario.step for plan in plans[2::2])
    for plan in plans[1::2]:
        read, simulated = read_back(plan, CuboidPlannerSettings)
        assert simulated
        robot = scenario.robots[plan.namespace]
        for key in ('start', 'yaw', 'dynamics', 'hazard'):
            assert getattr(read, key) == getattr(robot, key)
        ours, theirs = read.search(), scenario.planner
        boxes = {'objects', 'obstacles'}
        assert ours.model_dump(exclude=boxes) == theirs.model_dump(exclude=boxes | {'name'})
        floor = scenario.environment.array()[2, 0]
        for key in boxes:
            assert [item.numbers(floor) for item in getattr(ours, key)] == [
                item.numbers(floor) for item in getattr(theirs, key)
            ]
        assert [item.faces for item in ours.objects] == [item.faces for item in theirs.objects]


@pytest.mark.parametrize(
    ('key', 'value', 'words'),
    [
        (
            'planner.objects.0.centre',
            [295, 130],
            r'planner\.objects\[0\]: read centre .*inside the area',
        ),
        (
            'robots.red.dynamics.mass',
            4.0,
            r'robots\.red\.dynamics: force: got 35.0 N, which cannot lift.*39\.24 N',
        ),
        ('robots.red.start', [175, 130, 10], r'robots\.red\.start: read .*inside an object'),
        ('environment.bounds', [[0, 300], [0, 300]], r'environment\.bounds: read 2 axes'),
        (
            'environment.bounds',
            [[144, 206], [99, 161], [0, 80]],
            r'planner\.objects: no cuboid can be reached .*outside the area',
        ),
        ('planner.objects', [], r'planner\.objects: got none'),
        ('planner.hoizon', 5, r'planner\.hoizon'),
        ('planner.visit_depth', 0.5, r'planner\.visit_depth: .*0\.5.*less than 0\.5'),
        ('planner.visit_depth', -1e-3, r'planner\.visit_depth: .*-0\.001.*0'),
        ('planner.brake_at_end', 'late', r"planner\.brake_at_end: .*'late'.*(true|bool)"),
        ('events', [{'at': 5.0, 'robot': 'rad', 'do': 'leave'}], r"events\[0\]\.robot: .*'rad'"),
        ('robots.Red', ONE['robots']['red'], r'lower case'),
    ],
)
def test_wrong_files_are_refused_with_their_key(key, value, words):
    with pytest.raises(ScenarioError, match=words):
        scenario_with((key, value))


def test_a_robot_flies_the_velocity_that_a_plan_leads_to_and_brakes_without_one():
    dynamics = Dynamics()
    scenario = scenario_with(('robots.red.start', [50.0, 50.0, 20.0]), ('robots.red.yaw', 1.0))
    simulation = CuboidSimulation(scenario, 1)
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


def test_report_and_picture_of_a_run_that_went_wrong(tmp_path):
    scenario = load_cuboid_scenario('buildings_obstacles')
    mission = BuildingMission('buildings_obstacles', scenario)
    record = CuboidRecord(scenario, 1, mission.name)
    # Through the building.
    for time, x in ((0.0, 240.0), (1.0, 330.0)):
        record.add(RobotAt(time, 'red', (x, 215.0, 10.0, 0.0)))
    record.close(RunEnd('time_limit', 1.0, 2.0), 1.0)
    report = write_report(mission, record, tmp_path)
    assert check_report(json.loads((tmp_path / 'report.json').read_text())) == report
    assert (tmp_path / 'report.png').stat().st_size > 20_000
    assert report['cuboids'] == {'total': 16, 'visited': 0, 'missed': [*range(16)], 'lost': []}
    assert report['collisions'] > 0 and report['missed'] == 16
    assert report['least_detection_probability'] is None and report['solve_time'] is None
    assert '0 of 16 cuboids visited' in mission.summary(report)
