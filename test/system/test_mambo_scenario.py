"""A whole search in which the Mambo is reached by pyparrot, over loopback, in real time."""

import pytest
import yaml
from scenario_runs import run_scenario

from maasi_sim.scenario.loading import load_scenario

pytestmark = pytest.mark.system


def short_search(folder):
    """Write a small scenario of the demo's robots, the Mambo linked as the real one."""
    scenario = load_scenario('mambo_turtlebot').content()
    scenario['environment']['bounds'] = [[-0.3, 1.2], [-0.3, 1.2]]
    scenario['targets']['count'] = 4
    robots = scenario['robots']
    # The machine may be busy.
    settings = {'arm': True, 'full_speed': 1.97, 'link_timeout': 3.0, 'land_after': 10.0}
    robots['mambo'] |= {'link': 'mambo_wifi', 'mambo': settings}
    robots['mambo']['start'] = [0.9, 0.9, 1.0]
    robots['mambo']['candidates']['grid'] = [4, 4]
    robots['turtlebot']['candidates']['grid'] = [5, 5]
    scenario['limits']['time'] = 150.0
    file = folder / 'short.yaml'
    file.write_text(yaml.safe_dump(scenario))
    return file


def test_a_mambo_reached_by_pyparrot_and_a_turtlebot_find_all(tmp_path):
    run = run_scenario(short_search(tmp_path), tmp_path / 'run', '--seed', 1)
    assert run.code == 0, run.output
    report = run.report
    assert report['true_found'] == 4
    assert report['missed'] == report['false_found'] == 0
    assert report['rmse'] <= 0.08
    assert report['measurements']['mambo'] >= 5
    assert report['distance']['mambo'] > 0.3
    log = (run.folder / 'mambo_driver.log').read_text()
    # pyparrot's own words.
    assert 'Success in setting up the wifi network to the drone' in log
    for phase in ('taking off', 'climbing', 'flying'):
        assert f'] [mambo.driver]: {phase}' in log
    assert 'has not reported that it lands' not in log
