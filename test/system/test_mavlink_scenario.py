"""Whole searches by vehicles under MAVLink and by a Mambo that pyparrot reaches."""

from copy import deepcopy

import pytest
from scenario_runs import run_scenario

from maasi_sim.scenario.loading import load_scenario
from maasi_sim.simulation.emulators.mambo.fake_mambo import free_address

pytestmark = pytest.mark.system


def short_search():
    """Return a small scenario of three vehicles under three autopilots, linked by MAVLink."""
    scenario = load_scenario('drone_rov').content()
    scenario['environment']['bounds'] = [[0.0, 40.0], [0.0, 40.0]]
    scenario['targets'] |= {'count': 5, 'margin': 2.0}
    robots = scenario['robots']
    robots['drone']['candidates'] |= {'grid': [4, 4], 'spacing': 10.0, 'corner': [5.0, 5.0]}
    robots['drone']['start'] = [4.0, 4.0, 3.0]
    robots['rov']['candidates'] |= {'grid': [7, 7], 'spacing': 6.0, 'corner': [2.0, 2.0]}
    robots['rov']['start'] = [20.0, 20.0, -1.5]
    robots['other'] = deepcopy(robots['drone'])
    robots['other'] |= {'start': [36.0, 36.0, 2.5]}
    robots['other']['autopilot'] |= {'firmware': 'px4', 'parameters': {'COM_OF_LOSS_T': 5.0}}
    for system, robot in enumerate(robots.values(), 11):
        robot['link'] = 'mavlink'
        # The machine may be busy.
        robot['mavlink'] |= {'arm': True, 'system': system, 'link_timeout': 3.0}
        robot['mavlink']['url'] = f'udpin:{free_address()}:{14550 + system}'
    scenario['limits']['time'] = 150.0
    return scenario


def finds_all(scenario, folder, number):
    """Run a scenario whose robots find all; return the run."""
    run = run_scenario(scenario, folder / 'run', '--seed', 1)
    assert run.code == 0, run.output
    assert run.report['true_found'] == number
    found = (run.folder / 'found_targets.csv').read_text()
    assert run.report['missed'] == run.report['false_found'] == 0, f'{found}{run.output}'
    return run


def test_three_vehicles_find_all_through_the_real_protocol(tmp_path):
    scenario = short_search()
    scenario['targets'] = {'positions': [[22.7, 27.9], [25.3, 14.0], [22.4, 6.3], [29.7, 8.6]]}
    run = finds_all(scenario, tmp_path, 4)
    assert min(run.report['measurements'].values()) >= 4
    assert min(run.report['distance'].values()) > 2.0
    for name, system in (('drone', 'ArduCopter'), ('rov', 'ArduSub'), ('other', 'PX4')):
        log = (run.folder / f'{name}_driver.log').read_text()
        assert f'{system} connected as system' in log
        # Positions came, before the simulated time did.
        assert 'no LOCAL_POSITION_NED received' not in log


def small_demo():
    """Return a small scenario of the demo's robots, the Mambo linked as the real one."""
    scenario = load_scenario('mambo_turtlebot').content()
    scenario['environment']['bounds'] = [[-0.3, 1.2], [-0.3, 1.2]]
    scenario['targets'] = {'positions': [[0.6, 0.2], [0.45, 0.0], [0.8, 0.0]]}
    robots = scenario['robots']
    # The machine may be busy.
    settings = {'arm': True, 'full_speed': 1.97, 'link_timeout': 3.0, 'land_after': 10.0}
    robots['mambo'] |= {'link': 'mambo_wifi', 'mambo': settings}
    robots['mambo']['start'] = [0.9, 0.9, 1.0]
    robots['mambo']['candidates']['grid'] = [4, 4]
    robots['turtlebot']['candidates']['grid'] = [5, 5]
    scenario['limits']['time'] = 150.0
    return scenario


def test_a_mambo_reached_by_pyparrot_and_a_turtlebot_find_all(tmp_path):
    run = finds_all(small_demo(), tmp_path, 3)
    assert run.report['rmse'] <= 0.08
    assert run.report['measurements']['mambo'] >= 5
    assert run.report['distance']['mambo'] > 0.3
    log = (run.folder / 'mambo_driver.log').read_text()
    # pyparrot's own words.
    assert 'Success in setting up the wifi network to the drone' in log
    for phase in ('taking off', 'climbing', 'flying'):
        assert f'] [mambo.driver]: {phase}' in log
    assert 'has not reported landing' not in log
