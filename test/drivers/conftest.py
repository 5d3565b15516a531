"""What the tests of the drivers share: drivers at work."""

import os
import signal
import subprocess
from contextlib import ExitStack

import pytest
import yaml
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from robot_team import KINDS, TURTLEBOT, Team, parameters_of

from maasi_drivers.guard_node import GuardNode
from maasi_drivers.settings.driver import DriverSettings
from maasi_filter.ros.parameters import flatten


@pytest.fixture
def executor(context):
    executor = SingleThreadedExecutor(context=context)
    yield executor
    executor.shutdown()


@pytest.fixture
def start_node(context, executor):
    """Return a function that has a node take part until the end of the test."""
    with ExitStack() as stack:

        def start(make, **options):
            node = make(context=context, namespace='/rover', **options)
            executor.add_node(node)
            stack.callback(node.destroy_node)
            if hasattr(node, 'halt'):
                stack.callback(node.halt)
            return node

        yield start


@pytest.fixture
def make_team(context, executor):
    """Return a function that makes a team around a robot with these settings."""
    with ExitStack() as stack:

        def make(settings=TURTLEBOT, **options):
            team = Team(context, settings, executor, **options)
            stack.callback(team.destroy_node)
            return team

        yield make


@pytest.fixture
def team(make_team):
    return make_team()


def begin(node):
    assert node.trigger_configure().name == 'SUCCESS'
    assert node.trigger_activate().name == 'SUCCESS'
    return node


@pytest.fixture
def start_guard(start_node):
    return lambda lockstep=False: begin(
        start_node(GuardNode, parameter_overrides=[Parameter('lockstep', value=lockstep)])
    )


@pytest.fixture
def play(start_node, make_team):
    """Return a function that starts a driver, by a name in KINDS or by class and settings."""

    def start(kind='turtlebot', wants=None, deaf=False, **changes):
        made, settings = KINDS[kind] if isinstance(kind, str) else kind
        settings = settings | changes
        driver = start_node(made, parameter_overrides=parameters_of(settings))
        team = make_team(settings, wants=wants, deaf=deaf)
        begin(driver)
        team.connect()
        return driver, team

    return start


def end_process(process):
    """End a process by SIGTERM; one that hangs is killed."""
    # A killed one may leave the others a broken port in the shared memory of Fast DDS, on which
    # they crash when they end.
    process.send_signal(signal.SIGCONT)
    process.terminate()
    try:
        process.wait(5.0)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


@pytest.fixture
def process(context, tmp_path):
    """Return a function that starts a driver as a separate process."""
    with ExitStack() as stack:

        def start(environment=None, program=('turtlebot_driver',), settings=TURTLEBOT, **changes):
            file = tmp_path / 'parameters.yaml'
            flat = flatten(DriverSettings.model_validate(settings | changes))
            file.write_text(yaml.safe_dump({'/**': {'ros__parameters': flat}}))
            arguments = ['--ros-args', '--remap', '__ns:=/rover', '--params-file', str(file)]
            made = subprocess.Popen([*program, *arguments], env=os.environ | (environment or {}))
            stack.callback(end_process, made)
            return made

        yield start
