"""The command-line tool beside a run that goes freely."""

import os
import subprocess
import sys

import numpy as np
import pytest
from nav_msgs.msg import Odometry
from reserved_domain import reserved_domain
from run_operator import Operator

from maasi_filter.ros.qos import sensor_reader

pytestmark = pytest.mark.system
ROBOTS = ('turtlebot', 'mambo')
# A robot that has not moved further between odometry of this time stands [s, m].
SPAN, STILL = 1.5, 0.04


class Watcher(Operator):
    """Hears where the robots are."""

    def __init__(self, domain):
        super().__init__(domain)
        self.path = {name: [] for name in ROBOTS}
        for name in ROBOTS:
            self.node.create_subscription(
                Odometry,
                f'{name}/odom',
                lambda message, name=name: self.hear(name, message),
                sensor_reader(False),
            )

    def hear(self, name, message):
        stamp, point = message.header.stamp, message.pose.pose.position
        self.path[name].append((stamp.sec + stamp.nanosec * 1e-9, point.x, point.y, point.z))

    def moved(self, name, span):
        """Return how far a robot went in the last `span` seconds; None where not known."""
        path = np.array(self.path[name])
        if not len(path) or path[-1, 0] - path[0, 0] < span:
            return None
        recent = path[path[:, 0] >= path[-1, 0] - span]
        return float(np.linalg.norm(np.ptp(recent[:, 1:], axis=0)))

    def all_stand(self):
        moved = [self.moved(name, SPAN) for name in ROBOTS]
        return all(way is not None and way < STILL for way in moved)

    def all_moved(self):
        return all((self.moved(name, SPAN) or 0.0) > 3.0 * STILL for name in ROBOTS)

    def forget(self):
        for path in self.path.values():
            path.clear()


@pytest.fixture
def domain():
    with reserved_domain() as reserved:
        yield reserved


def test_robots_of_a_free_run_stand_while_paused_and_go_on_when_resumed(tmp_path, domain):
    number, environment = domain.number, {**os.environ, **domain.environment()}
    words = [
        'mambo_turtlebot',
        '--time-limit',
        '300',
        '--no-record',
        '--out',
        str(tmp_path / 'run'),
    ]
    run = subprocess.Popen(
        [sys.executable, '-m', 'maasi_sim.run.run_scenario', *words, '--domain-id', str(number)],
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.STDOUT,
    )
    watcher = Watcher(domain)

    def command(word):
        process = subprocess.Popen(
            [sys.executable, '-m', 'maasi_planner.search_command', word, '--timeout', '60'],
            env=environment,
            stdout=subprocess.PIPE,
            text=True,
        )
        watcher.until(lambda: process.poll() is not None, f'{word} does not end')
        assert process.returncode == 0, process.stdout.read()
        watcher.forget()

    try:
        watcher.until(watcher.all_moved, 'robots do not move')
        command('pause')
        watcher.until(watcher.all_stand, 'robots do not stand')
        watcher.forget()
        for _ in range(3):
            watcher.until(lambda: all(watcher.moved(n, SPAN) is not None for n in ROBOTS), 'silent')
            assert watcher.all_stand()
            watcher.forget()
        command('resume')
        watcher.until(watcher.all_moved, 'robots do not go on')
        assert run.poll() is None
    finally:
        run.terminate()
        try:
            run.wait(60.0)
        finally:
            run.kill()
            watcher.close()
