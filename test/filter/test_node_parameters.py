"""Parameters as ROS tools see them: ranges, changes at run time, dumps, foreign keys."""

import os
import subprocess
import sys

import pytest
import yaml
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter, parameter_value_to_python
from rclpy.parameter_client import AsyncParameterClient
from waiting import PATIENCE, wait_until

from maasi_filter.filter_node import FilterNode
from maasi_filter.ros.node_settings import FilterNodeSettings
from maasi_filter.ros.parameters import flatten

SETTINGS = FilterNodeSettings.model_validate(
    {
        'environment': {'bounds': [[0.0, 2.0], [0.0, 2.0]]},
        'filter': {'preset': 'paper_001'},
        'robots': {'a': {}},
    }
)


@pytest.fixture
def make(context):
    nodes = []

    def start(flat=None):
        flat = flatten(SETTINGS) if flat is None else flat
        overrides = [Parameter(name, value=value) for name, value in flat.items()]
        nodes.append(FilterNode(context=context, parameter_overrides=overrides))
        return nodes[-1]

    yield start
    for node in nodes:
        node.destroy_node()


@pytest.fixture
def process(domain, tmp_path):
    running = []

    def start(content=None, before=()):
        command = [*before, sys.executable, '-m', 'maasi_filter.filter_node', '--ros-args']
        if content is not None:
            file = tmp_path / f'parameters{len(running)}.yaml'
            file.write_text(yaml.safe_dump(content))
            command += ['--params-file', str(file)]
        environment = os.environ | domain.environment()
        running.append(
            subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True)
        )
        return running[-1]

    yield start
    for item in running:
        if item.poll() is None:
            item.kill()
        item.communicate()


class Tool:
    """What `ros2 param` does, by the services of the node."""

    def __init__(self, context):
        self.node = Node('tool', context=context)
        self.executor = SingleThreadedExecutor(context=context)
        self.executor.add_node(self.node)
        self.client = AsyncParameterClient(self.node, '/filter_node')

    def result(self, future):
        wait_until(future.done, lambda: self.executor.spin_once(timeout_sec=0.05))
        return future.result()

    def dump(self):
        """Return all parameters as `ros2 param dump` writes them: nested by the dots."""
        assert self.client.wait_for_services(timeout_sec=PATIENCE)
        names = self.result(self.client.list_parameters()).result.names
        values = self.result(self.client.get_parameters(names)).values
        nested = {}
        for name, value in zip(names, values):
            *path, last = name.split('.')
            place = nested
            for part in path:
                place = place.setdefault(part, {})
            value = parameter_value_to_python(value)
            place[last] = value if not hasattr(value, 'tolist') else value.tolist()
        return {'/filter_node': {'ros__parameters': nested}}

    def close(self):
        self.executor.shutdown()
        self.node.destroy_node()


@pytest.fixture
def tool(context):
    made = Tool(context)
    yield made
    made.close()


def has_none(value):
    return value is None or (isinstance(value, dict) and any(map(has_none, value.values())))


def test_numbers_have_real_ranges(make):
    node = make()
    described = {item.name: item for item in node.describe_parameters(['step', 'seed'])}
    found = described['step'].floating_point_range[0]
    assert (found.from_value, found.to_value) == (0.0, 10.0)
    assert described['seed'].integer_range[0].from_value == 0
    refused = node.set_parameters([Parameter('step', value=11.0)])[0]
    assert not refused.successful and 'step' in refused.reason
    # Not in the range, which has its ends.
    refused = node.set_parameters([Parameter('step', value=0.0)])[0]
    assert not refused.successful and 'greater than 0' in refused.reason


def test_rates_and_timeouts_can_be_set_while_the_node_runs(make):
    node = make()
    assert node.trigger_configure().name == 'SUCCESS', node.problem
    assert node.trigger_activate().name == 'SUCCESS'
    for name, value in (('batch_timeout', 2.5), ('markers_rate', 1.0), ('particles_rate', 0.0)):
        assert node.set_parameters([Parameter(name, value=value)])[0].successful
        assert getattr(node.settings, name) == value
    refused = node.set_parameters([Parameter('batch_timeout', value=-1.0)])[0]
    assert not refused.successful and 'batch_timeout' in refused.reason
    refused = node.set_parameters([Parameter('filter.particles', value=10)])[0]
    assert not refused.successful and 'is read in configure' in refused.reason
    assert node.settings.batch_timeout == 2.5


def test_what_a_preset_resolves_to_can_be_read(make):
    flat = flatten(SETTINGS)
    node = make(flat)
    assert node.trigger_configure().name == 'SUCCESS', node.problem
    assert node.get_parameter('filter.particles').value == 5000
    assert node.filter.settings.resolved().particles == 5000
    assert node.get_parameter('filter.found_radius').value == 1.1
    node.trigger_cleanup()
    assert node.set_parameters([Parameter('filter.preset', value='paper_003')])[0].successful
    assert node.trigger_configure().name == 'SUCCESS', node.problem
    assert node.get_parameter('filter.found_radius').value == 0.5
    assert node.filter.settings.resolved().found_radius == 0.5


def test_a_dump_loads_again_and_is_the_same(process, tool):
    flat = {**flatten(SETTINGS), 'environment.bounds': ['0.0 2.0', '0.0 2.0']}
    first = process({'/**': {'ros__parameters': flat}})
    dumped = tool.dump()
    assert not has_none(dumped)
    first.terminate()
    assert first.wait(timeout=PATIENCE) == 0
    second = process(dumped)
    again = tool.dump()
    assert again == dumped
    second.terminate()
    _, said = second.communicate(timeout=PATIENCE)
    assert second.returncode == 0 and 'is not known' not in said, said


def test_foreign_keys_are_named_and_ignored(process, tool):
    flat = flatten(SETTINGS) | {'filter.partikles': 10, 'start_type_description_service': True}
    node = process({'/**': {'ros__parameters': flat}})
    tool.dump()
    node.terminate()
    _, said = node.communicate(timeout=PATIENCE)
    assert node.returncode == 0
    assert 'parameter filter.partikles: is not known, and ignored; did you mean' in said
    assert 'start_type_description_service' not in said


def test_a_node_without_parameters_says_in_one_sentence_what_it_needs(process):
    node = process()
    _, said = node.communicate(timeout=PATIENCE)
    assert node.returncode == 2
    last = said.splitlines()[-1]
    assert last.startswith('error: parameters environment.bounds, robots: needed, but not set')
    assert 'Traceback' not in said


def test_wrong_parameters_are_named_with_what_was_read(process):
    flat = flatten(SETTINGS) | {'step': -0.5, 'filter.particles': 'many'}
    node = process({'/**': {'ros__parameters': flat}})
    _, said = node.communicate(timeout=PATIENCE)
    assert node.returncode == 2
    assert 'parameter step: Input should be greater than 0, read -0.5' in said
    assert 'parameter filter.particles: ' in said and "read 'many'" in said
    assert 'Traceback' not in said


def test_a_node_started_alone_says_that_the_loopback_interface_is_down(process):
    # A network namespace of its own has a loopback interface that is down.
    alone = ['unshare', '--map-root-user', '--net']
    if subprocess.run([*alone, 'true'], capture_output=True).returncode:
        pytest.skip('no network namespaces here')
    node = process({'/**': {'ros__parameters': flatten(SETTINGS)}}, alone)
    said = iter(node.stderr.readline, '')
    assert any('the loopback interface cannot be used' in line for line in said)
