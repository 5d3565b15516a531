"""Processes of a run: domains, endings, and that nothing is left over."""

import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest
from waiting import PATIENCE, wait_until

from maasi_sim.run.processes import Domain, NodeProcess, ProcessError, find_executable, stop


def alive(pid):
    try:
        return Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()[0] != 'Z'
    except OSError:
        return False


def python(tmp_path, code, name='/node'):
    log = tmp_path / f'{name.strip("/")}.log'
    return NodeProcess(name, [sys.executable, '-u', '-c', code], log)


READY = 'print("ready", flush=True)\n'
WAIT = 'import signal\n' + READY + 'signal.pause()\n'
IGNORE_INTERRUPT = (
    'import signal\nsignal.signal(signal.SIGINT, signal.SIG_IGN)\n'
    + READY
    + 'while True: signal.pause()\n'
)
IGNORE_ALL = IGNORE_INTERRUPT.replace(
    'signal.SIG_IGN)\n', 'signal.SIG_IGN)\nsignal.signal(signal.SIGTERM, signal.SIG_IGN)\n', 1
)


def started(process):
    process.start()
    wait_until(lambda: 'ready' in process.last_words())
    return process


def test_domains_are_not_shared(monkeypatch):
    profiles = 'FASTRTPS_DEFAULT_PROFILES_FILE'
    monkeypatch.delenv(profiles, raising=False)
    with Domain() as first, Domain() as second:
        assert first.number != second.number
        assert 1 <= first.number <= 101
        variables = first.environment()
        assert Path(variables.pop(profiles)).exists()
        assert variables == {
            'ROS_DOMAIN_ID': str(first.number),
            'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
        }
        monkeypatch.setenv(profiles, 'of the user')
        assert profiles not in first.environment()


def test_a_domain_that_was_asked_for_is_given_once(tmp_path):
    with Domain(57, str(tmp_path)) as domain:
        assert domain.number == 57
        with pytest.raises(ProcessError, match='57 is used by another run'):
            Domain(57, str(tmp_path))
    Domain(57, str(tmp_path)).release()


def test_runs_of_several_teams_share_a_domain_where_they_follow_its_clock(tmp_path):
    with Domain(57, str(tmp_path), team='team_a'):
        with Domain(57, str(tmp_path), team='team/b', shared=True) as second:
            assert second.number == 57
            with pytest.raises(ProcessError, match='namespace /team/b in 57 is used by another'):
                Domain(57, str(tmp_path), team='team/b', shared=True)
            with pytest.raises(ProcessError, match='namespace /team_a in 57 is used by another'):
                Domain(57, str(tmp_path), team='team_a', shared=True)
            with pytest.raises(ProcessError, match='domain id: 57 is used by another run'):
                Domain(57, str(tmp_path), team='team_c')
        Domain(57, str(tmp_path), team='team/b', shared=True).release()


@pytest.mark.parametrize('number', [-1, 102])
def test_domains_that_do_not_exist_are_refused(number):
    with pytest.raises(ProcessError, match='0 to 101'):
        Domain(number)


def test_a_domain_with_other_nodes_is_left_to_them():
    with Domain() as domain:
        number = domain.number
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(('', 7400 + 250 * number))
        with Domain() as domain:
            assert domain.number != number


def test_the_lock_ends_with_the_process(tmp_path):
    code = (
        'import os, sys\nfrom maasi_sim.run.processes import Domain\n'
        'Domain(33, sys.argv[1])\nos.kill(os.getpid(), 9)\n'
    )
    done = subprocess.run(
        [sys.executable, '-c', code, str(tmp_path)], check=False, timeout=PATIENCE
    )
    assert done.returncode == -signal.SIGKILL
    Domain(33, str(tmp_path)).release()


def test_a_domain_is_locked_without_a_file():
    """In a shared folder another user could have put a link in the place of one."""
    code = (
        'import os, sys\n'
        'import maasi_filter.ros.loopback\nfrom maasi_sim.run.processes import Domain\n'
        'def note(event, words):\n'
        "    made = event == 'open' and isinstance(words[2], int) and words[2] & os.O_CREAT\n"
        "    if made or event in ('os.mkdir', 'os.chmod', 'os.link', 'os.symlink'):\n"
        '        print(event, *words)\n'
        'sys.addaudithook(note)\nDomain().release()\n'
    )
    done = subprocess.run(
        [sys.executable, '-B', '-c', code],
        check=True,
        capture_output=True,
        text=True,
        timeout=PATIENCE,
    )
    assert done.stdout == ''


def test_a_process_writes_its_log_and_says_how_it_ended(tmp_path):
    process = python(tmp_path, 'print("hello"); raise SystemExit(3)')
    process.start()
    wait_until(lambda: not process.running)
    assert process.code == 3
    assert process.how_it_ended() == 'exited with 3'
    assert process.last_words() == 'hello'


def test_a_restart_goes_on_in_the_same_log(tmp_path):
    process = python(tmp_path, 'print("hello")')
    process.start()
    wait_until(lambda: not process.running)
    process.restart()
    wait_until(lambda: not process.running)
    assert process.restarts == 1
    assert process.last_words().splitlines() == ['hello', '--- start number 2 ---', 'hello']


def test_environment_is_passed_on(tmp_path):
    code = 'import os; print(os.environ["ROS_DOMAIN_ID"])'
    process = NodeProcess(
        '/node', [sys.executable, '-c', code], tmp_path / 'log', {'ROS_DOMAIN_ID': '44'}
    )
    process.start()
    wait_until(lambda: not process.running)
    assert process.last_words() == '44'


def test_what_cannot_be_started_is_named(tmp_path):
    process = NodeProcess('/node', [str(tmp_path / 'missing')], tmp_path / 'log')
    with pytest.raises(ProcessError, match='/node: cannot be started'):
        process.start()
    assert process.code is None and not process.running


def test_interrupt_ends_what_listens(tmp_path):
    processes = [started(python(tmp_path, WAIT, f'/node{i}')) for i in range(2)]
    assert stop(processes) == []
    assert [process.code for process in processes] == [-signal.SIGINT] * 2


def test_what_does_not_listen_is_told_again(tmp_path):
    process = started(python(tmp_path, IGNORE_INTERRUPT))
    assert stop([process], [(signal.SIGINT, 0.05), (signal.SIGTERM, PATIENCE)]) == []
    assert process.how_it_ended() == 'was killed by SIGTERM'


def test_what_listens_to_nothing_is_killed(tmp_path):
    process = started(python(tmp_path, IGNORE_ALL))
    ending = [(signal.SIGINT, 0.05), (signal.SIGTERM, 0.05), (signal.SIGKILL, PATIENCE)]
    assert stop([process], ending) == ['/node']
    assert process.how_it_ended() == 'was killed by SIGKILL'


def test_stopping_what_has_ended_or_never_started_does_nothing(tmp_path):
    ended = python(tmp_path, '')
    ended.start()
    wait_until(lambda: not ended.running)
    assert stop([ended, python(tmp_path, '', '/other')]) == []


def test_ctrl_c_in_the_terminal_does_not_reach_the_node(tmp_path):
    process = started(python(tmp_path, WAIT))
    assert os.getpgid(process.pid) != os.getpgid(0)
    stop([process])


@pytest.mark.parametrize('number', [signal.SIGKILL, signal.SIGTERM])
def test_nodes_do_not_outlive_a_killed_run(tmp_path, number):
    code = (
        'import signal, sys\nfrom pathlib import Path\n'
        'from maasi_sim.run.processes import NodeProcess\n'
        f'node = NodeProcess("/node", [sys.executable, "-u", "-c", {IGNORE_ALL!r}],'
        ' Path(sys.argv[1]) / "log")\n'
        'node.start()\nprint(node.pid, flush=True)\nsignal.pause()\n'
    )
    run = subprocess.Popen(
        [sys.executable, '-u', '-c', code, str(tmp_path)], stdout=subprocess.PIPE, text=True
    )
    pid = int(run.stdout.readline())
    wait_until(lambda: 'ready' in (tmp_path / 'log').read_text())
    assert alive(pid)
    run.send_signal(number)
    run.wait(PATIENCE)
    run.stdout.close()
    wait_until(lambda: not alive(pid))


def test_unknown_packages_and_executables_are_named(tmp_path, monkeypatch):
    monkeypatch.setenv('AMENT_PREFIX_PATH', str(tmp_path))
    with pytest.raises(ProcessError, match='maasi_nowhere is not installed'):
        find_executable('maasi_nowhere', 'node')
    marker = tmp_path / 'share' / 'ament_index' / 'resource_index' / 'packages' / 'maasi_here'
    marker.parent.mkdir(parents=True)
    marker.write_text('')
    with pytest.raises(ProcessError, match='maasi_here: has no executable some_node'):
        find_executable('maasi_here', 'some_node')
    executable = tmp_path / 'lib' / 'maasi_here' / 'some_node'
    executable.parent.mkdir(parents=True)
    executable.write_text('#!/bin/sh\n')
    executable.chmod(0o755)
    assert find_executable('maasi_here', 'some_node') == executable


def test_a_run_says_that_the_loopback_interface_is_down():
    code = 'from maasi_sim.run.run_scenario import main; raise SystemExit(main(["mambo"]))'
    # A network namespace of its own has a loopback interface that is down.
    alone = ['unshare', '--map-root-user', '--net']
    if subprocess.run([*alone, 'true'], capture_output=True).returncode:
        pytest.skip('no network namespaces here')
    done = subprocess.run([*alone, sys.executable, '-c', code], capture_output=True, text=True)
    assert done.returncode == 2
    assert 'error: the loopback interface cannot be used' in done.stderr
