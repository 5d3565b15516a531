"""SIGINT while a node starts: it ends at once, and its log has no traceback."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from node_kinds import KINDS

from maasi_sim.run.processes import Domain, find_executable

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
FORK = """
import sys, time
from pathlib import Path
from maasi_sim.run.processes import NodeProcess
from maasi_sim.warm_up import main_of
main = main_of('maasi_filter', 'filter_node')
node = NodeProcess('/node', sys.argv[2:], Path(sys.argv[1]), {}, main)
node.start()
print(node.pid, flush=True)
while node.running:
    time.sleep(0.002)
print(node.how_it_ended(), flush=True)
"""


@pytest.fixture
def environment():
    with Domain() as domain:
        # A process with threads of BLAS would not be forked.
        yield {**os.environ, **domain.environment(), 'OPENBLAS_NUM_THREADS': '1'}


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


@pytest.mark.parametrize(
    ('kind', 'moment'),
    [
        *(('filter', moment) for moment in MOMENTS),
        *((kind, 'imports') for kind in ('planner', 'turtlebot', 'sim')),
    ],
)
def test_a_console_script_says_nothing(tmp_path, environment, kind, moment):
    command = [str(find_executable(*NODES[kind])), *arguments(kind, tmp_path)]
    with subprocess.Popen(
        command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    ) as process:
        try:
            wait_for(process.pid, MOMENTS[moment])
            process.send_signal(signal.SIGINT)
            said, _ = process.communicate(timeout=PATIENCE)
        finally:
            process.kill()
    assert 'Traceback' not in said, said
    assert process.returncode in (0, -signal.SIGINT), said


def test_run_scenario_says_no_more_than_that_it_was_interrupted(tmp_path, environment):
    command = [str(find_executable('maasi_sim', 'run_scenario')), 'mambo_turtlebot']
    command += ['--out', str(tmp_path / 'run')]
    with subprocess.Popen(
        command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    ) as process:
        try:
            wait_for(process.pid, MOMENTS['imports'])
            process.send_signal(signal.SIGINT)
            said, _ = process.communicate(timeout=PATIENCE)
        finally:
            process.kill()
    assert 'Traceback' not in said, said
    assert process.returncode in (130, -signal.SIGINT), said


@pytest.mark.parametrize('moment', ['ROS imports', 'node is made'])
def test_a_forked_node_says_nothing(tmp_path, environment, moment):
    log = tmp_path / 'log'
    command = [sys.executable, '-c', FORK, str(log), 'filter_node']
    with subprocess.Popen(
        [*command, *arguments('filter', tmp_path)],
        env=environment,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        try:
            node = int(process.stdout.readline())
            wait_for(node, MOMENTS[moment])
            os.kill(node, signal.SIGINT)
            ending, _ = process.communicate(timeout=PATIENCE)
        finally:
            process.kill()
    assert ending.strip() in ('exited with 0', 'was killed by SIGINT'), log.read_text()
    assert 'Traceback' not in log.read_text()
