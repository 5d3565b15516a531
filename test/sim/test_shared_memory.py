"""A process that is killed while it creates a DDS port must not block all later ones."""

import os
import threading
import time

from maasi_sim.run.processes import Domain
from maasi_sim.run.shared_memory import LONGEST_CREATION, remove_dead_ports


def write(folder, name, word, age):
    path = folder / name
    path.write_bytes(word.to_bytes(4, 'little') + bytes(60))
    os.utime(path, (time.time() - age, time.time() - age))
    return path


def test_only_ports_of_dead_creators_are_removed(tmp_path):
    ready = write(tmp_path, 'fastrtps_port7411', 2, 60.0)
    young = write(tmp_path, 'fastrtps_port7412', 0, 0.0)
    lock = write(tmp_path, 'fastrtps_port7413_el', 0, 60.0)
    segment = write(tmp_path, 'fastrtps_0017a085580e8ff0', 0, 60.0)
    dead = write(tmp_path, 'fastrtps_port7414', 0, 60.0)
    half = write(tmp_path, 'fastrtps_port7415', 1, 60.0)
    assert remove_dead_ports(tmp_path) == [dead.name, half.name]
    assert all(path.exists() for path in (ready, young, lock, segment))
    assert not dead.exists() and not half.exists()


def test_a_run_waits_until_young_ports_are_ready_or_known_to_be_dead(tmp_path):
    dies = write(tmp_path, 'fastrtps_port7411', 1, LONGEST_CREATION - 0.5)
    lives = write(tmp_path, 'fastrtps_port7412', 1, 0.0)
    creator = threading.Timer(0.2, write, (tmp_path, lives.name, 2, 0.0))
    creator.start()
    assert remove_dead_ports(tmp_path, patience=60.0) == [dies.name]
    assert lives.exists()
    creator.join()


def test_a_run_gets_a_domain_beside_a_port_that_was_just_left(tmp_path, monkeypatch):
    port = write(tmp_path, 'fastrtps_port7411', 1, 0.0)
    monkeypatch.setattr(remove_dead_ports, '__defaults__', (tmp_path, 0.0))
    with Domain():
        assert not port.exists()
