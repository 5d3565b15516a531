"""A driver that hangs leaves its robot stopped: the guard of robots with topics."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import yaml
from action_msgs.srv import CancelGoal
from rclpy.executors import SingleThreadedExecutor
from robot_team import KINDS, Team, numbers, start_guard

from maasi_drivers.settings.driver import DriverSettings
from maasi_filter.ros.parameters import flatten

HANGING = Path(__file__).parent / 'hanging_driver.py'


@pytest.fixture(params=['turtlebot', 'mambo'])
def guarded(request, context, tmp_path):
    """Return a driver's process, its guard, and the team, with the robot under way."""
    settings = KINDS[request.param][1]
    executor = SingleThreadedExecutor(context=context)
    team = Team(context, settings, executor)
    guard = start_guard(context, team)
    file = tmp_path / 'parameters.yaml'
    flat = flatten(DriverSettings.model_validate(settings))
    file.write_text(yaml.safe_dump({'/**': {'ros__parameters': flat}}))
    driver = subprocess.Popen(
        [
            *(sys.executable, str(HANGING), request.param, '--ros-args'),
            *('--remap', '__ns:=/rover', '--params-file', str(file)),
        ],
        env=os.environ,
    )
    team.connect()
    team.awaken()
    team.send_accepted(team.start.position + np.array([0.8, 0.5, 0.0]))
    team.until(lambda: team.move() or np.any(team.command[:3] != 0.0))
    team.until(lambda: not guard.status()['stopping'])
    yield driver, guard, team
    driver.kill()
    driver.wait()
    guard.destroy_node()
    team.destroy_node()
    executor.shutdown()


def test_a_driver_that_hangs_leaves_zeros(guarded):
    """Its process and its middleware go on: only its executor thread does not."""
    driver, guard, team = guarded
    # It stops the robot itself where odometry is missing: to its guard it is alive, for longer than
    # the lease and without any state.
    end = time.monotonic() + 1.5
    while time.monotonic() < end:
        team.executor_used.spin_once(timeout_sec=0.05)
        assert not guard.status()['stopping']
    driver.send_signal(signal.SIGUSR1)
    team.until(lambda: guard.status()['stopping'], 'the guard does not notice')
    known = len(team.commands)
    team.until(lambda: len(team.commands) >= known + 3)
    assert not np.any([numbers(item) for item in team.commands[known:]])
    assert driver.poll() is None
    # Nav2 is told as well, also one that is found only now.
    asked = []
    name = 'navigate_to_pose/_action/cancel_goal'
    team.create_service(CancelGoal, name, lambda request, answer: asked.append(request) or answer)
    team.until(lambda: asked, 'the goals of Nav2 are not cancelled')
    assert asked[0] == CancelGoal.Request()
    # The last command stays; one that is not active publishes nothing.
    assert guard.trigger_deactivate().name == 'SUCCESS'
    assert not guard.active and not guard.status()['stopping']
