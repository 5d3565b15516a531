"""Plans of a scenario's nodes: who is started, with which parameters."""

from pathlib import Path

import pytest
import yaml
from test_scenario import SCENARIOS

from maasi_drivers.settings.driver import DriverSettings
from maasi_filter.ros.node_settings import FilterNodeSettings
from maasi_filter.ros.parameters import unflatten
from maasi_planner.node_settings import PlannerNodeSettings
from maasi_sim.run.node_plan import NodePlan
from maasi_sim.run.processes import find_executable
from maasi_sim.run.run_options import Options
from maasi_sim.run.targets.mission import TargetMission
from maasi_sim.scenario.loading import load_scenario
from maasi_sim.scenario.schema import ScenarioError
from maasi_sim.simulation.sim_node import SimNodeSettings


def plans_of(scenario, **changes):
    options = Options(**{'lockstep': True, **changes})
    plans = TargetMission('', scenario).plan_nodes(options, Path('/s.yaml'))
    return {plan.full_name: plan for plan in plans}


def read_back(plan, model):
    """Return the settings that a node makes of its parameter file, and whether it is simulated."""
    flat = yaml.safe_load(plan.parameter_text())['/**']['ros__parameters']
    simulated = flat.pop('use_sim_time', False)
    return model.model_validate(unflatten(model, flat)), simulated


@pytest.mark.parametrize('name', [path.stem for path in SCENARIOS])
def test_nodes_read_the_scenario_back_from_their_parameter_files(name):
    scenario = load_scenario(name, {'--seed': (('seed',), 4)})
    # A link of a robot's own runs in real time.
    lockstep = all(robot.link == 'topics' for robot in scenario.robots.values())
    plans = plans_of(scenario, lockstep=lockstep)
    search, simulated = read_back(plans['/filter_node'], FilterNodeSettings)
    assert simulated
    assert (search.step, search.seed, search.lockstep) == (scenario.step, 4, lockstep)
    assert search.environment == scenario.environment
    # With what the preset stands for.
    assert search.filter == scenario.filter.resolved()
    # Nothing moves in lockstep while a driver hangs.
    assert not (lockstep and any(plan.role == 'guard' for plan in plans.values()))
    planner, simulated = read_back(plans['/planner_node'], PlannerNodeSettings)
    assert simulated
    assert planner.environment == scenario.environment
    assert planner.planner == scenario.planner
    for robot, settings in scenario.robots.items():
        assert search.robots[robot].sensor == settings.sensor
        for key in ('candidates', 'motion', 'sensor', 'radius', 'start'):
            assert getattr(planner.robots[robot], key) == getattr(settings, key)
        driver, simulated = read_back(plans[f'/{robot}/driver'], DriverSettings)
        assert simulated
        for key in ('start', 'yaw', 'radius', 'motion', 'sensor', 'camera', 'link', 'mambo'):
            assert getattr(driver, key) == getattr(settings, key)
        assert driver.environment == scenario.environment


@pytest.mark.parametrize(
    'lockstep, rate, expected', [(True, None, 0.0), (True, 2.0, 2.0), (False, None, 1.0)]
)
def test_the_sim_gets_the_file_how_fast_it_goes_and_whose_clock_it_is(lockstep, rate, expected):
    scenario = load_scenario('mambo', {'--seed': (('seed',), 4)})
    plans = plans_of(scenario, lockstep=lockstep, rate=rate)
    settings, simulated = read_back(plans['/sim_node'], SimNodeSettings)
    values = (settings.scenario, settings.seed, settings.lockstep, settings.rate, settings.recorder)
    assert values == ('/s.yaml', 4, lockstep, expected, True)
    # The clock is its own.
    assert not simulated
    moved = {'body': (('robots', 'mambo', 'body'), 'external')}
    plans = plans_of(load_scenario('mambo', moved), lockstep=False)
    assert read_back(plans['/sim_node'], SimNodeSettings)[1]


def test_a_team_in_a_namespace_has_all_of_its_nodes_and_topics_there(tmp_path):
    for name, plan in plans_of(load_scenario('mambo_turtlebot'), lockstep=False).items():
        process = plan.process(tmp_path, 'north/one', 'warn')
        assert process.name == f'/north/one{name}'
        assert process.log == tmp_path / f'north_one{name.replace("/", "_")}.log'
        assert process.command[-2:] == ['--log-level', 'warn']
    kind = 'maasi_drivers', 'mambo_driver'
    plan = NodePlan(*kind, 'driver', 'a', {'a.b': 1.5}, remaps={'/batch': '/a/batch'})
    for team, space, batch in (
        ('', '/a', '/batch:=/a/batch'),
        ('team', '/team/a', '/team/batch:=/team/a/batch'),
    ):
        command = plan.process(tmp_path, team).command
        assert command[:2] == [str(find_executable(*kind)), '--ros-args']
        assert {'__node:=driver', f'__ns:={space}', batch} <= set(command)
        assert Path(command[command.index('--params-file') + 1]).read_text() == (
            plan.parameter_text()
        )
    assert '__ns:=/' in NodePlan(*kind, 'driver').process(tmp_path).command
    assert yaml.safe_load(plan.parameter_text()) == {'/**': {'ros__parameters': {'a.b': 1.5}}}


def test_a_filter_that_may_be_restarted_saves_its_state_in_the_folder_of_the_run():
    scenario = load_scenario('mambo', {'on_exit': (('on_exit',), 'respawn')})
    settings, _ = read_back(plans_of(scenario)['/filter_node'], FilterNodeSettings)
    assert (settings.save_file, settings.save_batches) == ('/state/filter_node.maasi', True)
    settings, _ = read_back(plans_of(load_scenario('mambo'))['/filter_node'], FilterNodeSettings)
    assert (settings.save_file, settings.save_batches) == ('', False)


def test_independent_robots_have_filter_and_planner_of_their_own():
    overrides = {'planner': (('planner',), {'name': 'maas', 'coordination': 'independent'})}
    scenario = load_scenario('mambo_turtlebot', overrides)
    plans = plans_of(scenario)
    assert not {'/filter_node', '/planner_node'} & plans.keys()
    for name, other in (('mambo', 'turtlebot'), ('turtlebot', 'mambo')):
        search, _ = read_back(plans[f'/{name}/filter_node'], FilterNodeSettings)
        assert (list(search.robots), search.share_with) == ([name], [other])
        planner, _ = read_back(plans[f'/{name}/planner_node'], PlannerNodeSettings)
        assert list(planner.robots) == [name]
        assert planner.planner == scenario.planner
        for key in ('radius', 'start'):
            assert getattr(planner.others[other], key) == getattr(scenario.robots[other], key)
        remaps = {'/measurement_batch': f'/{name}/measurement_batch'}
        assert plans[f'/{name}/driver'].remaps == remaps
    overrides['planner'][1]['name'] = 'lawnmower'
    with pytest.raises(ScenarioError, match='coordination'):
        load_scenario('mambo_turtlebot', overrides)


def test_a_linked_robot_has_its_link_and_no_commands_by_topic():
    linked = {'drone': (('robots', 'drone', 'link'), 'mavlink')}
    linked['arm'] = (('robots', 'drone', 'mavlink', 'arm'), True)
    scenario = load_scenario('drone_rov', linked)
    plans = plans_of(scenario, lockstep=False)
    for name, link, settings in (
        ('drone', 'mavlink', scenario.robots['drone'].mavlink),
        ('rov', 'topics', None),
    ):
        driver, _ = read_back(plans[f'/{name}/driver'], DriverSettings)
        assert (driver.link, driver.mavlink) == (link, settings)
        # Its autopilot stops it.
        assert (f'/{name}/guard' in plans) == (link == 'topics')
    for pace in ({'lockstep': True}, {'lockstep': False, 'rate': 2.0}):
        with pytest.raises(ScenarioError, match=r'drone\.link: .* real time'):
            plans_of(scenario, **pace)
