"""Parameters as ROS tools see them: ranges, changes at run time, dumps, foreign keys."""

import shutil
import subprocess
from functools import reduce

import pytest
import yaml
from player import parameters
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter, parameter_value_to_python
from rclpy.parameter_client import AsyncParameterClient
from waiting import PATIENCE, wait_until

from maasi_filter.filter_node import FilterNode
from maasi_filter.ros.node_settings import FilterNodeSettings
from maasi_filter.ros.parameters import flatten
from maasi_sim.run.processes import NodeProcess, find_executable

SETTINGS = FilterNodeSettings.model_validate(
    {
        'environment': {'bounds': [[0.0, 2.0], [0.0, 2.0]]},
        'filter': {'preset': 'paper_001'},
        'robots': {'a': {}},
    }
)


@pytest.fixture
def node(context):
    made = FilterNode(context=context, parameter_overrides=parameters(SETTINGS))
    yield made
    made.destroy_node()


@pytest.fixture
def process(domain, tmp_path):
    running = []

    def start(flat=None, before=()):
        command = [*before, str(find_executable('maasi_filter', 'filter_node')), '--ros-args']
        name = f'node{len(running)}'
        if flat is not None:
            file = tmp_path / f'{name}.yaml'
            file.write_text(yaml.safe_dump({'/**': {'ros__parameters': flat}}))
            command += ['--params-file', str(file)]
        running.append(NodeProcess(name, command, tmp_path / name))
        running[-1].start()
        return running[-1]

    yield start
    for item in running:
        item.kill()
        item.join()


@pytest.fixture
def dump(context):
    """Return a function that does what `ros2 param dump` does: parameters nested by the dots."""
    node = Node('tool', context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    client = AsyncParameterClient(node, '/filter_node')

    def result(ask, *arguments):
        # An answer is lost where the service has not discovered its client yet: ask again.
        def answer():
            future = ask(*arguments)
            executor.spin_until_future_complete(future, timeout_sec=5.0)
            return future.result()

        return wait_until(answer)

    def dumped():
        assert client.wait_for_services(timeout_sec=PATIENCE)
        names = result(client.list_parameters).result.names
        nested = {}
        for name, value in zip(names, result(client.get_parameters, names).values):
            *path, last = name.split('.')
            place = reduce(lambda place, part: place.setdefault(part, {}), path, nested)
            value = parameter_value_to_python(value)
            assert value is not None
            place[last] = value if not hasattr(value, 'tolist') else value.tolist()
        return nested

    yield dumped
    executor.shutdown()
    node.destroy_node()


def ended(node, *, ask=False):
    """Return the exit code of a process, which may be asked to end, and what it said."""
    if ask:
        node.terminate()
    node.join(PATIENCE)
    said = node.last_words(10_000)
    assert 'Traceback' not in said
    return node.exitcode, said


def test_numbers_have_ranges_and_what_may_change_when_can_be_set_and_read(node):
    def refused(name, value, words):
        (answer,) = node.set_parameters([Parameter(name, value=value)])
        return not answer.successful and words in answer.reason

    described = {item.name: item for item in node.describe_parameters(['step', 'seed'])}
    found = described['step'].floating_point_range[0]
    assert (found.from_value, found.to_value) == (0.0, 10.0)
    assert described['seed'].integer_range[0].from_value == 0
    assert refused('step', 11.0, 'step')
    # Not in the range, which has its ends.
    assert refused('step', 0.0, 'greater than 0')
    assert node.trigger_configure().name == 'SUCCESS', node.problem
    # What a preset resolves to.
    assert node.get_parameter('filter.particles').value == 5000
    assert node.filter.settings.resolved().particles == 5000
    assert node.get_parameter('filter.found_radius').value == 1.1
    assert node.trigger_activate().name == 'SUCCESS'
    for name, value in (('batch_timeout', 2.5), ('markers_rate', 1.0), ('particles_rate', 0.0)):
        assert node.set_parameters([Parameter(name, value=value)])[0].successful
        assert getattr(node.settings, name) == value
    assert refused('batch_timeout', -1.0, 'batch_timeout')
    assert refused('filter.particles', 10, 'is read in configure')
    assert node.settings.batch_timeout == 2.5
    node.trigger_deactivate()
    node.trigger_cleanup()
    assert refused('filter.found_mass', -1.0, 'read -1.0')
    # Also of a robot that is new.
    changes = {'filter.preset': 'paper_003', 'robots': ['a', 'b'], 'robot.b.sensor.period': 0.25}
    for name, value in changes.items():
        assert node.set_parameters([Parameter(name, value=value)])[0].successful
    assert node.trigger_configure().name == 'SUCCESS', node.problem
    assert node.get_parameter('filter.found_radius').value == 0.5
    assert node.filter.settings.resolved().found_radius == 0.5
    assert node.settings.robots['b'].sensor.period == 0.25
    wait_until(lambda: node.count_subscribers('/b/detections') == 1)


def test_a_dump_loads_again_and_foreign_keys_are_named(process, dump):
    flat = {**flatten(SETTINGS), 'environment.bounds': ['0.0 2.0', '0.0 2.0']}
    foreign = {'filter.partikles': 10, 'start_type_description_service': True}
    first = process(flat | foreign)
    dumped = dump()
    code, said = ended(first, ask=True)
    assert code == 0
    assert 'parameter filter.partikles: is unknown' in said and 'did you mean' in said
    assert 'start_type_description_service' not in said
    second = process(dumped)
    assert dump() == dumped
    code, said = ended(second, ask=True)
    assert code == 0 and 'is unknown' not in said, said


def test_missing_and_wrong_parameters_are_named_with_what_was_read(process):
    code, said = ended(process())
    last = said.splitlines()[-1]
    assert code == 2
    assert last.startswith('error: parameters environment.bounds, robots: needed, but not set')
    code, said = ended(process(flatten(SETTINGS) | {'step': -0.5, 'filter.particles': 'many'}))
    assert code == 2
    assert 'parameter step: read -0.5, allowed is greater than 0' in said
    assert 'parameter filter.particles: ' in said and "read 'many'" in said


def test_a_node_started_alone_says_that_the_loopback_interface_is_down(process):
    # A new network namespace has a loopback interface that is down.
    alone = [shutil.which('unshare') or 'unshare', '--map-root-user', '--net']
    if subprocess.run([*alone, 'true'], capture_output=True).returncode:
        pytest.skip('a network namespace needs root, or user namespaces in the kernel')
    node = process(flatten(SETTINGS), alone)
    wait_until(lambda: 'loopback interface' in node.last_words())
