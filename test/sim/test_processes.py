"""Nodes as processes: how they start and end, and that nothing is left over."""

import os
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import pytest
from node_kinds import KINDS
from waiting import PATIENCE, wait_until

from maasi_sim.run import processes
from maasi_sim.run.processes import NodeProcess, ProcessError, find_executable, stop

# Ignores the signals that are named.
DEAF = """
import signal
for number in ({}): signal.signal(number, signal.SIG_IGN)
print("ready", flush=True)
while True: signal.pause()
"""
WAIT, IGNORE_ALL = DEAF.format(''), DEAF.format('signal.SIGINT, signal.SIGTERM')
# A run whose nodes ignore all signals.
RUN = """
import signal, sys
from pathlib import Path
from maasi_sim.run.processes import NodeProcess
if __name__ == '__main__':
    nodes = [
        NodeProcess('/node', [sys.executable, '-u', '-c', sys.argv[2]], Path(sys.argv[1]) / 'node'),
        NodeProcess('/own', [sys.argv[3], '--help'], Path(sys.argv[1]) / 'own'),
    ]
    for node in nodes:
        node.start()
    print(nodes[0].pid, flush=True)
    signal.pause()
"""


def stat(pid):
    """Return state, parent and so on of a process."""
    return Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()


def alive(pid):
    try:
        return stat(pid)[0] != 'Z'
    except OSError:
        return False


def python(tmp_path, code, name='/node'):
    log = tmp_path / f'{name.strip("/")}.log'
    command = [sys.executable, '-u', '-c', textwrap.dedent(code)]
    return NodeProcess(name, command, log)


def started(process):
    process.start()
    wait_until(lambda: 'ready' in process.last_words())
    return process


def ended(process):
    process.start()
    wait_until(lambda: not process.is_alive())
    return process


def test_a_process_has_its_own_output_and_environment_and_says_how_it_ended(tmp_path, monkeypatch):
    monkeypatch.setenv('OF_THE_RUN', 'run')
    code = """
        import os, sys
        print(os.environ['OF_THE_RUN'], sys.stdin.read() == '')
        print(os.getsid(0) == os.getpid(), file=sys.stderr)
        os.system('echo of a child of the node')
        raise SystemExit(3)
    """
    process = ended(python(tmp_path, code))
    assert process.exitcode == 3
    assert process.how_it_ended() == 'exited with 3'
    process.restart()
    wait_until(lambda: not process.is_alive())
    assert process.restarts == 1
    said = ['run True', 'True', 'of a child of the node']
    assert process.last_words().splitlines() == [*said, '--- start number 2 ---', *said]


def test_a_node_that_cannot_be_executed_ends_and_says_why(tmp_path):
    process = NodeProcess('/node', [str(tmp_path / 'missing')], tmp_path / 'log')
    assert process.exitcode is None and not process.is_alive()
    assert ended(process).exitcode == 1
    assert 'FileNotFoundError' in process.last_words()


def test_a_node_of_the_suite_is_shown_by_its_command_and_ends_as_it_says(tmp_path, domain):
    command = KINDS['filter'].command(tmp_path / 'node.yaml')
    # It inherits what the server has loaded.
    process = NodeProcess('/node', command, tmp_path / 'log')
    process.start()
    line = Path(f'/proc/{process.pid}/cmdline')
    wait_until(lambda: line.read_bytes().rstrip(bytes(1)).decode() == ' '.join(process.command))
    assert os.getsid(process.pid) == process.pid
    stop([process])
    assert process.how_it_ended() in ('exited with 0', 'was killed by SIGINT')


@pytest.mark.parametrize('log', ['log', 'full'])
def test_a_node_of_the_suite_that_refuses_its_input_says_so(tmp_path, domain, log):
    (tmp_path / 'full').symlink_to('/dev/full')
    command = KINDS['filter'].command(tmp_path / 'node.yaml')
    (tmp_path / 'node.yaml').unlink()
    process = ended(NodeProcess('/node', command, tmp_path / log))
    assert process.exitcode not in (0, None)
    assert log == 'full' or 'node.yaml' in (tmp_path / 'log').read_text()


@pytest.mark.parametrize(
    ('code', 'last', 'killed'),
    [
        (WAIT, signal.SIGINT, False),
        (DEAF.format('signal.SIGINT,'), signal.SIGTERM, False),
        (IGNORE_ALL, signal.SIGKILL, True),
    ],
)
def test_signals_get_stronger_until_all_have_ended(tmp_path, monkeypatch, code, last, killed):
    nodes = [started(python(tmp_path, code, f'/node{i}')) for i in range(2)]
    every = (signal.SIGINT, signal.SIGTERM, signal.SIGKILL)
    ending = [(number, PATIENCE if number == last else 0.05) for number in every]
    monkeypatch.setattr(processes, 'ENDING', ending)
    names = [node.name for node in nodes]
    assert stop(nodes) == (names if killed else [])
    assert {node.how_it_ended() for node in nodes} == {f'was killed by {last.name}'}
    # What has ended, or never started.
    assert stop([*nodes, python(tmp_path, '', '/other')]) == []


@pytest.mark.parametrize('number', [signal.SIGKILL, signal.SIGTERM])
def test_nodes_do_not_outlive_a_killed_run(tmp_path, number):
    own = find_executable('maasi_filter', 'filter_node')
    (tmp_path / 'run.py').write_text(RUN)
    run = subprocess.Popen(
        [sys.executable, '-u', str(tmp_path / 'run.py'), str(tmp_path), IGNORE_ALL, str(own)],
        stdout=subprocess.PIPE,
        text=True,
    )
    pid = int(run.stdout.readline())
    log = tmp_path / 'node'
    wait_until(lambda: log.exists() and 'ready' in log.read_text())
    server = int(stat(pid)[1])
    assert alive(pid) and server != run.pid
    run.send_signal(number)
    run.wait(PATIENCE)
    run.stdout.close()
    wait_until(lambda: not alive(pid) and not alive(server))


def test_a_dead_server_is_started_again(tmp_path):
    process = started(python(tmp_path, WAIT))
    server = int(stat(process.pid)[1])
    assert os.getsid(server) == server
    os.kill(server, signal.SIGKILL)
    wait_until(lambda: not (process.is_alive() or alive(process.pid) or alive(server)))
    assert ended(python(tmp_path, 'print(1)')).exitcode == 0


def test_unknown_packages_and_executables_are_named(tmp_path, monkeypatch):
    monkeypatch.setenv('AMENT_PREFIX_PATH', str(tmp_path))
    with pytest.raises(ProcessError, match='maasi_nowhere is not installed'):
        find_executable('maasi_nowhere', 'node')
    marker = tmp_path / 'share' / 'ament_index' / 'resource_index' / 'packages' / 'maasi_here'
    marker.parent.mkdir(parents=True)
    marker.write_text('')
    with pytest.raises(ProcessError, match=r'maasi_here .* some_node'):
        find_executable('maasi_here', 'some_node')
    executable = tmp_path / 'lib' / 'maasi_here' / 'some_node'
    executable.parent.mkdir(parents=True)
    executable.write_text('#!/bin/sh\n')
    executable.chmod(0o755)
    assert find_executable('maasi_here', 'some_node') == executable


# What a process has mapped at a moment of its start.
MOMENTS = {'imports': 'numpy', 'ROS imports': '_rclpy_pybind11', 'node is made': 'librmw_fastrtps'}


def wait_for(pid, library):
    maps = Path(f'/proc/{pid}/maps')
    wait_until(lambda: library in maps.read_text(), lambda: time.sleep(0.001), library)


def command_of(kind, folder):
    if kind == 'run_scenario':
        own = [str(find_executable('maasi_sim', kind)), 'mambo_turtlebot']
        return [*own, '--out', str(folder / 'run')]
    return KINDS[kind].command(folder / 'node.yaml')


@pytest.mark.parametrize(
    ('kind', 'moment'),
    [('filter', 'imports'), ('filter', 'node is made'), ('run_scenario', 'imports')],
)
def test_an_interrupt_while_a_script_starts_leaves_no_traceback(tmp_path, domain, kind, moment):
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
def test_an_interrupt_while_a_forked_node_starts_leaves_no_traceback(tmp_path, domain, moment):
    node = NodeProcess('/node', command_of('filter', tmp_path), tmp_path / 'log')
    node.start()
    try:
        wait_for(node.pid, MOMENTS[moment])
        node.signal(signal.SIGINT)
        wait_until(lambda: not node.is_alive())
    finally:
        stop([node])
    assert node.how_it_ended() in ('exited with 0', 'was killed by SIGINT'), node.last_words()
    assert 'Traceback' not in node.last_words(100)
