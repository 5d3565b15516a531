"""Nodes that are copies of the run's process: as separate as those that are started anew."""

import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest
from waiting import wait_until

LIMIT = 120.0
BEGIN = """
import os, signal, sys, threading, time
from pathlib import Path
from maasi_sim.run.processes import NodeProcess, stop
log = Path(sys.argv[1]) / 'log'

def node(main, **environment):
    made = NodeProcess('/node', ['node_command', '--ros-args'], log, environment, main)
    made.start()
    return made

def end(process):
    while process.running:
        time.sleep(0.002)
    return process
"""


def play(tmp_path, code):
    """Run a script in a process of its own that has one thread; return what it prints."""
    done = subprocess.run(
        [sys.executable, '-c', BEGIN + textwrap.dedent(code), str(tmp_path)],
        capture_output=True,
        text=True,
        timeout=LIMIT,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def ended(tmp_path, body):
    """Return what is printed of a node whose function is `body`, and after it."""
    out = play(
        tmp_path,
        f"""
        def main():
            {body}
        try:
            print(end(node(main)).code)
        finally:
            print('the run goes on')
        """,
    )
    return out.splitlines()


@pytest.mark.parametrize(
    ('body', 'code', 'words'),
    [
        ('return None', '0', ''),
        ('return 4', '4', ''),
        ('sys.exit(5)', '5', ''),
        ('sys.exit("no such thing")', '1', 'no such thing'),
        ('raise ValueError("of the node")', '1', 'ValueError: of the node'),
        ('os.kill(os.getpid(), signal.SIGTERM); time.sleep(30)', str(-signal.SIGTERM), ''),
    ],
)
def test_it_ends_with_what_its_function_says(tmp_path, body, code, words):
    assert ended(tmp_path, body) == [code, 'the run goes on']
    assert words in (tmp_path / 'log').read_text()


@pytest.mark.parametrize(
    ('body', 'code'),
    [
        ('print("text without an end", end=""); return 4', '4'),
        ('sys.exit("no such thing")', '1'),
        ('raise ValueError("of the node")', '1'),
    ],
)
def test_it_ends_where_its_log_cannot_be_written(tmp_path, body, code):
    (tmp_path / 'log').symlink_to('/dev/full')
    assert ended(tmp_path, body) == [code, 'the run goes on']


def test_output_arguments_and_environment_are_its_own(tmp_path):
    out = play(
        tmp_path,
        """
        def main():
            print(sys.argv, os.environ['ROS_DOMAIN_ID'], os.getpgid(0) == os.getpid())
            print('of the node', file=sys.stderr)
            os.system('echo of a child of the node')
            print(Path('/proc/self/cmdline').read_bytes().rstrip(bytes(1)).decode())
        before = os.environ.get('ROS_DOMAIN_ID')
        end(node(main, ROS_DOMAIN_ID='44'))
        print(sys.argv[0], os.environ.get('ROS_DOMAIN_ID') == before)
        """,
    )
    assert out.splitlines() == ['-c True']
    lines = (tmp_path / 'log').read_text().splitlines()
    assert lines[0] == "['node_command', '--ros-args'] 44 True"
    assert lines[1:3] == ['of the node', 'of a child of the node']
    assert lines[3] == 'node_command --ros-args'


def test_signals_of_the_run_are_not_those_of_the_node(tmp_path):
    out = play(
        tmp_path,
        """
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        def main():
            print('ready')
            time.sleep(30)
        process = node(main)
        while 'ready' not in process.last_words():
            time.sleep(0.002)
        print(stop([process]), process.how_it_ended())
        """,
    )
    assert out.strip() == '[] was killed by SIGINT'


def test_with_several_threads_the_command_is_run_instead(tmp_path):
    out = play(
        tmp_path,
        """
        event = threading.Event()
        threading.Thread(target=event.wait, daemon=True).start()
        def main():
            print('a copy')
        process = NodeProcess('/node', ['echo', 'the command'], log, main=main)
        process.start()
        print(end(process).last_words())
        """,
    )
    assert out.strip() == 'the command'


def test_it_does_not_outlive_a_killed_run(tmp_path):
    code = """
    def main():
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, signal.SIG_IGN)
        time.sleep(60)
    print(node(main).pid, flush=True)
    time.sleep(60)
    """
    run = subprocess.Popen(
        [sys.executable, '-c', BEGIN + textwrap.dedent(code), str(tmp_path)],
        stdout=subprocess.PIPE,
        text=True,
    )
    pid = int(run.stdout.readline())
    run.kill()
    run.wait(LIMIT)
    run.stdout.close()
    wait_until(lambda: not _alive(pid))


def _alive(pid):
    try:
        return Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()[0] != 'Z'
    except OSError:
        return False
