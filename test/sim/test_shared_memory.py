"""What killed processes leave in shared memory goes; what a live one uses, or owns, stays."""

import mmap
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest
from waiting import PATIENCE, wait_until

from maasi_sim.run import shared_memory
from maasi_sim.run.processes import Domain
from maasi_sim.run.shared_memory import remove_dead

SHARED = Path('/dev/shm')
NODE = """
import rclpy
from std_msgs.msg import Empty
rclpy.init()
node = rclpy.create_node('node')
publisher = node.create_publisher(Empty, 'beat', 10)
subscription = node.create_subscription(Empty, 'beat', lambda _: print('heard', flush=True), 10)
node.create_timer(0.05, lambda: publisher.publish(Empty()))
rclpy.spin(node)
"""


@pytest.fixture
def folder():
    with tempfile.TemporaryDirectory(dir=SHARED) as name:
        yield Path(name)


def write(folder, *names):
    for name in names:
        (folder / name).write_bytes(bytes(64))
    return set(names)


def started():
    """Start a node; return its process and its files, once it hears itself."""
    process = subprocess.Popen(
        [sys.executable, '-c', NODE], stdout=subprocess.PIPE, text=True, start_new_session=True
    )
    assert process.stdout.readline() == 'heard\n'
    maps = Path(f'/proc/{process.pid}/maps').read_text().splitlines()
    files = {line.split()[-1] for line in maps if '/dev/shm/fastrtps' in line}
    files |= {
        target
        for link in Path(f'/proc/{process.pid}/fd').iterdir()
        if '/dev/shm/fastrtps' in (target := os.readlink(link))
    }
    return process, {Path(file) for file in files}


def test_files_of_a_killed_node_go_and_those_of_a_live_one_stay(domain):
    killed, files = started()
    # Not the ports, which all nodes of a domain share.
    left = {path for path in files if 'port' not in path.name}
    killed.kill()
    killed.wait(PATIENCE)
    assert left
    # Another process that looks at the same moment has the files open, or removes them.
    wait_until(lambda: not any(path.exists() for path in left), remove_dead)
    live, used = started()
    try:
        remove_dead()
        assert used and all(path.exists() for path in used)
        assert live.stdout.readline() == 'heard\n'
    finally:
        live.kill()
        live.wait(PATIENCE)


def test_a_run_removes_them_at_its_start_and_at_its_end():
    def dead():
        return SHARED / write(SHARED, f'fastrtps_port{os.getpid() + 10**6}').pop()

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


def test_ports_that_were_ready_go_only_with_their_domain(folder):
    # Domain 5 has the ports from 7400 + 5 * 250.
    ready = {'fastrtps_port8650', 'fastrtps_port8899', 'fastrtps_port8900'}
    for name in ready:
        (folder / name).write_bytes((2).to_bytes(4, sys.byteorder) + bytes(60))
    locks = write(folder, 'fastrtps_port8650_el', 'fastrtps_port8900_el', 'fastrtps_port8902_el')
    assert remove_dead(folder=folder) == []
    assert set(remove_dead(5, folder)) == {
        'fastrtps_port8650',
        'fastrtps_port8650_el',
        'fastrtps_port8899',
    }
    assert {'fastrtps_port8900'} | locks - {'fastrtps_port8650_el'} == {
        path.name for path in folder.iterdir()
    }


def test_a_port_of_a_live_node_has_the_mark_by_which_it_is_known(domain):
    process, files = started()
    try:
        ports = [path for path in files if re.fullmatch(r'fastrtps_port\d+', path.name)]
        assert ports
        for port in ports:
            with port.open('rb') as file:
                assert file.read(4) == (2).to_bytes(4, sys.byteorder)
        numbers = {int(port.name.removeprefix('fastrtps_port')) for port in ports}
        # Those below 7400 are common to all domains.
        assert {(number - 7400) // 250 for number in numbers if number >= 7400} == {domain.number}
    finally:
        process.kill()
        process.wait(PATIENCE)


def test_a_port_goes_as_a_whole_where_nobody_uses_a_part_of_it(folder):
    dead = write(folder, 'fastrtps_port7411', 'fastrtps_port7411_el', 'sem.fastrtps_port7411_mutex')
    dead |= write(folder, 'fastrtps_0017a085580e8ff0', 'fastrtps_0017a085580e8ff0_el')
    mapped = write(folder, 'fastrtps_port7413', 'fastrtps_port7413_el')
    opened = write(folder, 'fastrtps_0017a085580e8ff1', 'fastrtps_0017a085580e8ff1_el')
    others = write(folder, 'fastrtps_notes', 'sem.others', 'fastrtps_port7411_copy')
    with (folder / 'fastrtps_port7413').open('r+b') as file:
        memory = mmap.mmap(file.fileno(), 64)
    with (folder / 'fastrtps_0017a085580e8ff1_el').open('rb'):
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
    monkeypatch.setattr(shared_memory.os, 'getuid', lambda: -1)
    assert remove_dead(folder=folder) == []
    assert len(list(folder.iterdir())) == 4


def test_there_may_be_no_shared_memory(folder):
    assert remove_dead(folder / 'missing') == []
