"""Plans of a scenario's nodes: who is started, with which parameters."""

from pathlib import Path

import pytest
import yaml

from maasi_drivers.settings.driver import DriverSettings
from maasi_filter.ros.node_settings import FilterNodeSettings
from maasi_filter.ros.parameters import unflatten
from maasi_planner.node_settings import PlannerNodeSettings
from maasi_sim.run.node_plan import NodePlan, RunSettings, in_team, with_followed_clock
from maasi_sim.scenario.loading import config_folder, load_scenario
from maasi_sim.scenario.schema import ScenarioError
from maasi_sim.sim_settings import SimNodeSettings
from maasi_sim.targets.mission import plan_nodes

SCENARIOS = sorted(
    path.stem
    for path in (config_folder() / 'scenarios').glob('*.yaml')
    if 'cuboid_mpc' not in path.read_text()
)


def plans_of(scenario, **changes):
    options = {'seed': 4, 'lockstep': True, 'rate': None, 'recorder': True, 'file': Path('/s.yaml')}
    run = RunSettings(**{**options, **changes})
    return {plan.full_name: plan for plan in plan_nodes(scenario, run)}


def read_back(plan, model):
    """Return the settings that a node makes of its parameter file."""
    flat = yaml.safe_load(plan.parameter_text())['/**']['ros__parameters']
    simulated = flat.pop('use_sim_time', False)
    return model.model_validate(unflatten(model, flat)), simulated


def test_the_demo_has_a_sim_two_guarded_drivers_a_filter_and_a_planner():
    plans = plans_of(load_scenario('mambo_turtlebot'))
    assert {name: (plan.package, plan.executable) for name, plan in plans.items()} == {
        '/sim_node': ('maasi_sim', 'sim_node'),
        '/mambo/driver': ('maasi_drivers', 'mambo_driver'),
        '/turtlebot/driver': ('maasi_drivers', 'turtlebot_driver'),
        '/mambo/guard': ('maasi_drivers', 'guard_node'),
        '/turtlebot/guard': ('maasi_drivers', 'guard_node'),
        '/filter_node': ('maasi_filter', 'filter_node'),
        '/planner_node': ('maasi_planner', 'planner_node'),
    }
    assert {name for name, plan in plans.items() if plan.says_ready} == {
        '/sim_node',
        '/mambo/driver',
        '/turtlebot/driver',
        '/filter_node',
        '/planner_node',
    }
    assert [name for name, plan in plans.items() if plan.is_clock] == ['/sim_node']
    assert plans['/mambo/driver'].file_name == 'mambo_driver'


@pytest.mark.parametrize('name', SCENARIOS)
def test_nodes_read_the_scenario_back_from_their_parameter_files(name):
    scenario = load_scenario(name)
    # A link of a robot's own runs in real time.
    lockstep = all(robot.link == 'topics' for robot in scenario.robots.values())
    plans = plans_of(scenario, lockstep=lockstep)
    search, simulated = read_back(plans['/filter_node'], FilterNodeSettings)
    assert simulated
    assert (search.step, search.seed, search.lockstep) == (scenario.step, 4, lockstep)
    assert search.environment == scenario.environment.of_nodes()
    # With what the preset stands for.
    assert search.filter == scenario.filter.resolved()
    planner, simulated = read_back(plans['/planner_node'], PlannerNodeSettings)
    assert simulated
    assert planner.environment == scenario.environment.of_nodes()
    assert planner.planner == scenario.planner
    for robot, settings in scenario.robots.items():
        assert search.robots[robot].sensor == settings.sensor
        for key in ('candidates', 'motion', 'sensor', 'radius', 'start'):
            assert getattr(planner.robots[robot], key) == getattr(settings, key)
        driver, simulated = read_back(plans[f'/{robot}/driver'], DriverSettings)
        assert simulated
        for key in ('start', 'yaw', 'radius', 'motion', 'sensor', 'camera', 'link', 'mambo'):
            assert getattr(driver, key) == getattr(settings, key)
        assert driver.environment == scenario.environment.of_nodes()


@pytest.mark.parametrize(
    'lockstep, rate, expected', [(True, None, 0.0), (True, 2.0, 2.0), (False, None, 1.0)]
)
def test_the_sim_gets_the_file_and_how_fast_it_goes(lockstep, rate, expected):
    plans = plans_of(load_scenario('mambo'), lockstep=lockstep, rate=rate, recorder=False)
    settings, simulated = read_back(plans['/sim_node'], SimNodeSettings)
    assert settings.scenario == '/s.yaml'
    assert settings.seed == 4
    assert settings.lockstep is lockstep
    assert settings.rate == expected
    assert settings.recorder is False
    # The clock is its own.
    assert not simulated


def test_a_team_in_a_namespace_has_all_of_its_nodes_and_topics_there():
    plans = plans_of(load_scenario('mambo_turtlebot'), lockstep=False)
    for name, plan in plans.items():
        moved = in_team(plan, 'north/one')
        assert moved.full_name == f'/north/one{name}'
        assert f'__ns:=/{moved.namespace}' in moved.command(Path('/lib/x'), Path('/run/p.yaml'))
        assert in_team(plan, '') is plan
    plan = NodePlan('p', 'e', 'driver', 'a', remaps={'/measurement_batch': '/a/measurement_batch'})
    assert in_team(plan, 'team').remaps == {'/team/measurement_batch': '/team/a/measurement_batch'}


@pytest.mark.parametrize(
    ('namespace', 'inside', 'full'), [('mambo', '/mambo', '/mambo/driver'), ('', '/', '/driver')]
)
def test_command_lines_name_the_node_and_its_parameters(namespace, inside, full):
    plan = NodePlan('maasi_drivers', 'mambo_driver', 'driver', namespace, {'a.b': 1.5})
    command = plan.command(Path('/lib/mambo_driver'), Path('/run/p.yaml'))
    assert command[:2] == ['/lib/mambo_driver', '--ros-args']
    assert {'__node:=driver', f'__ns:={inside}'} <= set(command)
    assert command[command.index('--params-file') + 1] == '/run/p.yaml'
    assert plan.full_name == full
    assert yaml.safe_load(plan.parameter_text()) == {'/**': {'ros__parameters': {'a.b': 1.5}}}


def test_only_the_sim_is_told_whose_clock_it_is():
    plans = plans_of(load_scenario('mambo'), lockstep=False)
    for plan in plans.values():
        assert (with_followed_clock(plan) == plan) == (not plan.is_clock)
    settings, simulated = read_back(with_followed_clock(plans['/sim_node']), SimNodeSettings)
    assert settings.follow_clock and simulated


def test_independent_robots_have_filter_and_planner_of_their_own():
    overrides = {'planner': (('planner',), {'name': 'maas', 'coordination': 'independent'})}
    scenario = load_scenario('mambo_turtlebot', overrides)
    plans = plans_of(scenario)
    assert '/filter_node' not in plans
    assert '/planner_node' not in plans
    for name, other in (('mambo', 'turtlebot'), ('turtlebot', 'mambo')):
        search, _ = read_back(plans[f'/{name}/filter_node'], FilterNodeSettings)
        assert list(search.robots) == [name]
        assert search.share_with == [other]
        planner, _ = read_back(plans[f'/{name}/planner_node'], PlannerNodeSettings)
        assert list(planner.robots) == [name]
        assert planner.planner == scenario.planner
        assert planner.others[other].radius == scenario.robots[other].radius
        assert planner.others[other].start == scenario.robots[other].start
        command = plans[f'/{name}/driver'].command(Path('/x'), Path('/y'))
        assert f'/measurement_batch:=/{name}/measurement_batch' in command


def test_lawnmowers_share_their_lanes():
    overrides = {'planner': (('planner',), {'name': 'lawnmower', 'coordination': 'independent'})}
    with pytest.raises(ScenarioError, match='coordination'):
        load_scenario('mambo_turtlebot', overrides)


def test_a_linked_robot_has_its_link_and_no_commands_by_topic():
    linked = {'drone': (('robots', 'drone', 'link'), 'mavlink')}
    linked['arm'] = (('robots', 'drone', 'mavlink', 'arm'), True)
    scenario = load_scenario('drone_rov', linked)
    plans = plans_of(scenario, lockstep=False)
    driver, _ = read_back(plans['/drone/driver'], DriverSettings)
    assert driver.link == 'mavlink'
    assert driver.mavlink == scenario.robots['drone'].mavlink
    # Its autopilot stops it.
    assert '/drone/guard' not in plans
    assert '/rov/guard' in plans
    driver, _ = read_back(plans['/rov/driver'], DriverSettings)
    assert (driver.link, driver.mavlink) == ('topics', None)
    for pace in ({'lockstep': True}, {'lockstep': False, 'rate': 2.0}):
        with pytest.raises(ScenarioError, match=r'drone\.link: .* runs in real time'):
            plans_of(scenario, **pace)
