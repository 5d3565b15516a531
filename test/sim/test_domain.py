"""ROS domains of runs; of shared memory, what killed processes leave goes, and the rest stays."""

import mmap
import os
import re
import signal
import socket
import subprocess
import sys
import tempfile
from contextlib import contextmanager
from pathlib import Path

import pytest
from waiting import PATIENCE, wait_until

from maasi_sim.run import domain as domain_module
from maasi_sim.run.domain import Domain, DomainError, remove_dead

SHARED = Path('/dev/shm')
# Of Fast DDS 2.14 (Jazzy) and 3.2 (Kilted): beginning of file names, variable with the profiles.
PREFIXES = ('fastrtps', 'fastdds')
PROFILES = {
    'jazzy': 'FASTRTPS_DEFAULT_PROFILES_FILE',
    'kilted': 'FASTDDS_DEFAULT_PROFILES_FILE',
}
# First word of a port that its creator has made ready.
READY = (2).to_bytes(4, sys.byteorder)
NODE = """
import rclpy
from std_msgs.msg import Empty
rclpy.init()
node = rclpy.create_node('node')
publisher = node.create_publisher(Empty, 'beat', 10)
subscription = node.create_subscription(Empty, 'beat', lambda _: print('received', flush=True), 10)
node.create_timer(0.05, lambda: publisher.publish(Empty()))
rclpy.spin(node)
"""


@pytest.fixture(params=PREFIXES)
def prefix(request):
    return request.param


@pytest.fixture(params=PROFILES)
def profiles(request, monkeypatch):
    monkeypatch.setenv('ROS_DISTRO', request.param)
    for name in PROFILES.values():
        monkeypatch.delenv(name, raising=False)
    return PROFILES[request.param]


@pytest.fixture
def folder():
    with tempfile.TemporaryDirectory(dir=SHARED) as name:
        yield Path(name)


def write(folder, *names, content=bytes(64)):
    for name in names:
        (folder / name).write_bytes(content)
    return set(names)


@contextmanager
def started():
    """Start a node; yield its process and its files, once it receives its own messages."""
    process = subprocess.Popen(
        [sys.executable, '-c', NODE], stdout=subprocess.PIPE, text=True, start_new_session=True
    )
    try:
        # Fast DDS says so where a port has gone that it was about to open, and takes another one.
        assert 'received\n' in iter(process.stdout.readline, '')
        maps = Path(f'/proc/{process.pid}/maps').read_text().split()
        opened = map(os.readlink, Path(f'/proc/{process.pid}/fd').iterdir())
        yield process, {Path(file) for file in (*maps, *opened) if '/dev/shm/fast' in file}
    finally:
        process.kill()
        process.wait(PATIENCE)
        process.stdout.close()


def made(files):
    """Return what a node made, whose locks it holds; not ports and segments that it only opened."""
    locks = {path for path in files if re.fullmatch(r'fast[a-z]+_[0-9a-f]{16}_el', path.name)}
    return locks | {path.with_name(path.name.removesuffix('_el')) for path in locks}


def test_files_of_a_killed_node_go_and_those_of_a_live_one_stay(domain):
    with started() as (_, files):
        left = made(files)
    assert left
    # Another process that looks at the same moment has the files open, or removes them.
    wait_until(lambda: not any(path.exists() for path in left), remove_dead)
    with started() as (live, used):
        remove_dead()
        assert made(used) and all(path.exists() for path in made(used))
        assert 'received\n' in iter(live.stdout.readline, '')
        # A port is known by its mark.
        ports = [path for path in used if re.fullmatch(r'fast[a-z]+_port\d+', path.name)]
        assert ports
        for port in ports:
            with port.open('rb') as file:
                assert file.read(4) == READY
        numbers = {int(port.name.partition('_port')[2]) for port in ports}
        # Those below 7400 are common to all domains.
        assert {(number - 7400) // 250 for number in numbers if number >= 7400} == {domain.number}


def test_a_run_removes_them_at_its_start_and_at_its_end(prefix):
    def dead():
        return SHARED / write(SHARED, f'{prefix}_port{os.getpid() + 10**6}').pop()

    def at_start():
        path = dead()
        with Domain():
            return not path.exists()

    def at_end():
        with Domain():
            path = dead()
        return not path.exists()

    # Another process that looks at the same moment has the files open: once more, then.
    wait_until(at_start)
    wait_until(at_end)


def test_ports_that_were_ready_go_only_with_their_domain(folder, prefix):
    # Domain 5 has the ports from 7400 + 5 * 250.
    own = write(folder, f'{prefix}_port8650', f'{prefix}_port8899', content=READY + bytes(60))
    own |= write(folder, f'{prefix}_port8650_el')
    others = write(folder, f'{prefix}_port8900', content=READY + bytes(60))
    others |= write(folder, f'{prefix}_port8900_el', f'{prefix}_port8902_el')
    assert remove_dead(folder=folder) == []
    assert set(remove_dead(5, folder)) == own
    assert {path.name for path in folder.iterdir()} == others


def test_a_port_goes_as_a_whole_where_nobody_uses_a_part_of_it(folder, prefix):
    dead = write(
        folder, f'{prefix}_port7411', f'{prefix}_port7411_el', f'sem.{prefix}_port7411_mutex'
    )
    dead |= write(folder, f'{prefix}_0017a085580e8ff0', f'{prefix}_0017a085580e8ff0_el')
    mapped = write(folder, f'{prefix}_port7413', f'{prefix}_port7413_el')
    opened = write(folder, f'{prefix}_0017a085580e8ff1', f'{prefix}_0017a085580e8ff1_el')
    others = write(folder, f'{prefix}_notes', 'sem.others', f'{prefix}_port7411_copy')
    with (folder / f'{prefix}_port7413').open('r+b') as file:
        memory = mmap.mmap(file.fileno(), 64)
    with (folder / f'{prefix}_0017a085580e8ff1_el').open('rb'):
        assert set(remove_dead(folder=folder)) == dead
        assert {path.name for path in folder.iterdir()} == mapped | opened | others
    memory.close()
    assert set(remove_dead(folder=folder)) == mapped | opened


def test_what_another_user_put_there_is_left(folder, monkeypatch):
    write(folder, 'precious')
    (folder / 'fastrtps_port7411').symlink_to(folder / 'precious')
    os.mkfifo(folder / 'fastrtps_port7413')
    assert remove_dead(folder=folder) == []
    write(folder, 'fastrtps_port7415')
    monkeypatch.setattr(domain_module.os, 'getuid', lambda: -1)
    assert remove_dead(folder=folder) == []
    assert len(list(folder.iterdir())) == 4
    # There may be no shared memory.
    assert remove_dead(folder=folder / 'missing') == []


def test_beyond_the_participants_that_are_found_by_default_more_are_contacted(profiles):
    with Domain() as domain:
        few, many = domain.environment(10), domain.environment(40)
        assert few['ROS_AUTOMATIC_DISCOVERY_RANGE'] == 'LOCALHOST'
        # The profile keeps it on this host.
        assert many['ROS_AUTOMATIC_DISCOVERY_RANGE'] == 'SYSTEM_DEFAULT'
        file = Path(many[profiles])
        text = file.read_text()
        (contacted,) = re.findall(r'<maxInitialPeersRange>(\d+)<', text)
        assert int(contacted) > 40
        assert set(re.findall(r'<address>(.*?)</address>', text)) == {'127.0.0.1'}
    assert Path(few[profiles]).exists() and not file.exists()


def test_domains_are_not_shared_with_runs_or_other_nodes(profiles, monkeypatch):
    for number in (-1, 102):
        with pytest.raises(DomainError, match='0 to 101'):
            Domain(number)
    with Domain() as first, Domain() as second:
        assert first.number != second.number
        assert 1 <= first.number <= 101
        variables = first.environment()
        assert Path(variables.pop(profiles)).exists()
        assert variables == {
            'ROS_DOMAIN_ID': str(first.number),
            'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
        }
        for name in PROFILES.values():
            with monkeypatch.context() as patch:
                patch.setenv(name, 'of the user')
                assert not set(PROFILES.values()) & set(first.environment())
    # Of discovery, and of a participant that is seen on this host only.
    for port in (0, 10, 13, 119):
        with Domain() as domain:
            number = domain.number
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
            other.bind(('', 7400 + 250 * number + port))
            with Domain() as domain:
                assert domain.number != number


def test_teams_share_a_domain_where_another_program_publishes_their_clock(tmp_path):
    with Domain(57, str(tmp_path), team='team_a') as first:
        assert first.number == 57
        with Domain(57, str(tmp_path), team='team/b', shared=True) as second:
            assert second.number == 57
            for team, shared, words in (
                ('team/b', True, 'namespace /team/b in 57'),
                ('team_a', True, 'namespace /team_a in 57'),
                ('team_c', False, 'domain id: .*57'),
            ):
                with pytest.raises(DomainError, match=words):
                    Domain(57, str(tmp_path), team=team, shared=shared)
        Domain(57, str(tmp_path), team='team/b', shared=True).release()


def test_a_domain_is_locked_without_a_file_until_its_process_ends(tmp_path):
    """In a shared folder another user could have put a link in the place of one."""
    code = (
        'import os, sys\n'
        'from maasi_sim.run.domain import Domain\n'
        'def note(event, words):\n'
        "    made = event == 'open' and isinstance(words[2], int) and words[2] & os.O_CREAT\n"
        "    if made or event in ('os.mkdir', 'os.chmod', 'os.link', 'os.symlink'):\n"
        '        print(event, *words, flush=True)\n'
        'sys.addaudithook(note)\nDomain().release()\nDomain(33, sys.argv[1])\n'
        'os.kill(os.getpid(), 9)\n'
    )
    command = [sys.executable, '-B', '-c', code, str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE)
    assert (done.returncode, done.stdout) == (-signal.SIGKILL, ''), done.stderr
    Domain(33, str(tmp_path)).release()


def test_a_run_says_that_the_loopback_interface_is_down():
    code = 'from maasi_sim.run.run_scenario import main; raise SystemExit(main(["mambo"]))'
    # A new network namespace has a loopback interface that is down.
    alone = ['unshare', '--map-root-user', '--net']
    if subprocess.run([*alone, 'true'], capture_output=True).returncode:
        pytest.skip('a network namespace needs root, or user namespaces in the kernel')
    done = subprocess.run([*alone, sys.executable, '-c', code], capture_output=True, text=True)
    assert done.returncode == 2
    assert 'loopback interface' in done.stderr
