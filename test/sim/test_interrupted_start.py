"""SIGINT while a node starts: it ends at once, and its log has no traceback."""

import os
import signal
import subprocess
import time
from pathlib import Path

import pytest
from node_kinds import KINDS
from waiting import wait_until

from maasi_sim.run.domain import Domain
from maasi_sim.run.processes import NodeProcess, find_executable, stop

PATIENCE = 120.0
# What a process has mapped at a moment of its start.
MOMENTS = {
    'imports': 'numpy',
    'ROS imports': '_rclpy_pybind11',
    'node is made': 'librmw_fastrtps',
}
NODES = {
    'filter': ('maasi_filter', 'filter_node'),
    'planner': ('maasi_planner', 'planner_node'),
    'turtlebot': ('maasi_drivers', 'turtlebot_driver'),
    'sim': ('maasi_sim', 'sim_node'),
}


@pytest.fixture
def environment():
    with Domain() as domain:
        yield {**os.environ, **domain.environment()}


def wait_for(pid, library):
    """Return once a process has loaded a library."""
    end = time.monotonic() + PATIENCE
    while library not in Path(f'/proc/{pid}/maps').read_text():
        assert time.monotonic() < end, f'{library} was not loaded'
        time.sleep(0.001)


def arguments(kind, folder):
    file = folder / 'node.yaml'
    KINDS[kind].write(file)
    return ['--ros-args', '--params-file', str(file), '-r', f'__ns:={KINDS[kind].namespace or "/"}']


def command_of(kind, folder):
    if kind == 'run_scenario':
        own = [str(find_executable('maasi_sim', kind)), 'mambo_turtlebot']
        return [*own, '--out', str(folder / 'run')]
    return [str(find_executable(*NODES[kind])), *arguments(kind, folder)]


@pytest.mark.parametrize(
    ('kind', 'moment'),
    [
        *(('filter', moment) for moment in MOMENTS),
        *((kind, 'imports') for kind in ('planner', 'turtlebot', 'sim', 'run_scenario')),
    ],
)
def test_a_console_script_says_nothing(tmp_path, environment, kind, moment):
    with subprocess.Popen(
        command_of(kind, tmp_path),
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    ) as process:
        try:
            wait_for(process.pid, MOMENTS[moment])
            process.send_signal(signal.SIGINT)
            said, _ = process.communicate(timeout=PATIENCE)
        finally:
            process.kill()
    assert 'Traceback' not in said, said
    ended = 130 if kind == 'run_scenario' else 0
    assert process.returncode in (ended, -signal.SIGINT), said


@pytest.mark.parametrize('moment', ['ROS imports', 'node is made'])
def test_a_forked_node_says_nothing(tmp_path, environment, moment):
    command = [str(find_executable('maasi_filter', 'filter_node')), *arguments('filter', tmp_path)]
    node = NodeProcess('/node', command, tmp_path / 'log', 'maasi_filter', environment)
    node.start()
    try:
        wait_for(node.pid, MOMENTS[moment])
        node.signal(signal.SIGINT)
        wait_until(lambda: not node.running)
    finally:
        stop([node])
    assert node.how_it_ended() in ('exited with 0', 'was killed by SIGINT'), node.last_words()
    assert 'Traceback' not in node.last_words(100)
