"""SIGINT while a node starts: it ends at once, and its log has no traceback."""

import signal
import subprocess
import time
from pathlib import Path

import pytest
from node_kinds import KINDS
from waiting import PATIENCE, wait_until

from maasi_sim.run.processes import NodeProcess, find_executable, stop

# What a process has mapped at a moment of its start.
MOMENTS = {
    'imports': 'numpy',
    'ROS imports': '_rclpy_pybind11',
    'node is made': 'librmw_fastrtps',
}


def wait_for(pid, library):
    """Return once a process has loaded a library."""
    maps = Path(f'/proc/{pid}/maps')
    wait_until(lambda: library in maps.read_text(), lambda: time.sleep(0.001), library)


def command_of(kind, folder):
    if kind == 'run_scenario':
        own = [str(find_executable('maasi_sim', kind)), 'mambo_turtlebot']
        return [*own, '--out', str(folder / 'run')]
    return KINDS[kind].command(folder / 'node.yaml')


@pytest.mark.parametrize(
    ('kind', 'moment'),
    [
        *(('filter', moment) for moment in MOMENTS),
        *((kind, 'imports') for kind in ('planner', 'turtlebot', 'sim', 'run_scenario')),
    ],
)
def test_a_console_script_says_nothing(tmp_path, domain, kind, moment):
    with subprocess.Popen(
        command_of(kind, tmp_path), stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
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
def test_a_forked_node_says_nothing(tmp_path, domain, moment):
    node = NodeProcess('/node', command_of('filter', tmp_path), tmp_path / 'log', 'maasi_filter')
    node.start()
    try:
        wait_for(node.pid, MOMENTS[moment])
        node.signal(signal.SIGINT)
        wait_until(lambda: not node.running)
    finally:
        stop([node])
    assert node.how_it_ended() in ('exited with 0', 'was killed by SIGINT'), node.last_words()
    assert 'Traceback' not in node.last_words(100)
