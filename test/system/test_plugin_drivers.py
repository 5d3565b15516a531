"""Drivers and a planner of a user's own: by module and class, and installed."""

import math
import os
from pathlib import Path

import pytest
import yaml
from scenario_runs import of_topic, run_scenario

pytestmark = pytest.mark.system

EXAMPLES = Path(__file__).resolve().parents[2] / 'examples'
SLOW = """
from maasi_drivers.agent.agent_driver import AgentDriver
from maasi_drivers.agent.sensor_input import RangingInput
from maasi_drivers.links.topic_link import TopicLink


class HalfSpeed(TopicLink):
    def send(self, placed, command):
        super().send(placed, [0.5 * value for value in command])


class SlowDriver(AgentDriver):
    def __init__(self, **options):
        super().__init__({'topics': HalfSpeed}, RangingInput, **options)
"""
BLIND = """
from maasi_drivers.agent.agent_driver import AgentDriver
from maasi_drivers.agent.sensor_input import RangingInput
from maasi_drivers.agent.sensor_reading import Sweep
from maasi_drivers.links.topic_link import TopicLink


class Blind(RangingInput):
    def detect(self, data, pose):
        return super().detect(Sweep(data.values[:0], data.labels[:0]), pose)


class BlindDriver(AgentDriver):
    def __init__(self, **options):
        super().__init__({'topics': TopicLink}, Blind, **options)
"""
# A planner that ends the search before all is found.
ENDING = """
from maasi_planner.planners.lawnmower import Lawnmower


class Ending(Lawnmower):
    def finished(self, team):
        return 'a scripted end' if team.step >= 20 else None
"""


def test_robots_with_drivers_of_their_own_and_a_planner_that_ends_the_run(tmp_path):
    scenario = yaml.safe_load((EXAMPLES / 'own_planner' / 'search.yaml').read_text())
    scenario['planner'] = {'name': 'ending:Ending'}
    (tmp_path / 'ending.py').write_text(ENDING)
    # Each robot has targets around it.
    scenario['targets'] = {'positions': [[0.8, 0.5], [0.5, 0.8], [3.2, 0.5], [3.5, 0.8]]}
    scenario['limits'] = {'time': 60.0}
    scenario['robots']['left']['driver'] = 'slow_driver:SlowDriver'
    scenario['robots']['right']['driver'] = 'blind'
    (tmp_path / 'robots').symlink_to(EXAMPLES / 'robots')
    (tmp_path / 'slow_driver.py').write_text(SLOW)
    # An entry point in a dist-info folder on the path is one of an installed package.
    info = tmp_path / 'installed' / 'blind-1.0.dist-info'
    info.mkdir(parents=True)
    (info / 'METADATA').write_text('Metadata-Version: 2.1\nName: blind\nVersion: 1.0\n')
    (info / 'entry_points.txt').write_text('[maasi.drivers]\nblind = blind_driver:BlindDriver\n')
    (info.parent / 'blind_driver.py').write_text(BLIND)

    path = f'{info.parent}{os.pathsep}{os.environ.get("PYTHONPATH", "")}'
    run = run_scenario(scenario, tmp_path / 'run', '--lockstep', environment={'PYTHONPATH': path})
    assert run.code == 1, run.output
    assert 'ended: a scripted end' in run.output
    assert run.report['end_reason'] == 'planner_done'
    fastest, seen = {}, {}
    for robot in ('left', 'right'):
        speeds = [
            math.hypot(*(state['twist']['linear'][axis] for axis in 'xy'))
            for state in of_topic(run, f'/{robot}/state')
        ]
        fastest[robot] = max(speeds)
        seen[robot] = sum(len(item['detections']) for item in of_topic(run, f'/{robot}/detections'))
        assert run.report['measurements'][robot] > 0
    # 0.5 m/s is the speed of this type; the odometry has noise.
    assert fastest == pytest.approx({'left': 0.25, 'right': 0.5}, abs=0.05)
    assert seen['left'] > 0
    assert seen['right'] == 0
