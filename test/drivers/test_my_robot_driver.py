"""The driver of a robot of one's own in `examples`, with a rover on the other end."""

import importlib.util
import json
import math
import socket
import time
from functools import partial
from pathlib import Path
from select import select

import numpy as np
import pytest
import yaml
from action_msgs.msg import GoalStatus
from numpy.testing import assert_allclose

from maasi_drivers.agent.agent_driver import AgentDriver
from maasi_drivers.settings.driver import DriverSettings
from maasi_drivers.vision.camera_input import CameraInput
from maasi_filter.models.pose import compose, inverse
from maasi_filter.ros.conversions import pose_from_ros
from maasi_filter.ros.parameters import unflatten
from maasi_msgs.msg import AgentState

FILE = Path(__file__).parents[2] / 'examples' / 'my_robot_driver' / 'my_robot_driver.py'
PARAMETERS = yaml.safe_load(FILE.with_name('rover.yaml').read_text())['/**']['ros__parameters']


class Rover:
    """The robot: a body that moves in real time, behind a socket."""

    def __init__(self):
        self.start = self.body = None
        self.link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.link.bind(('127.0.0.1', 0))
        self.command, self.commands, self.peer = (0.0, 0.0), 0, None
        self.talks, self.extra = True, {}
        self.at = self.said_at = time.monotonic()

    def live(self):
        while select([self.link], [], [], 0.0)[0]:
            data, self.peer = self.link.recvfrom(1500)
            words = json.loads(data)
            self.command = (words['forward'], words['turn'])
            self.commands += 1
        now = time.monotonic()
        self.body.step([self.command[0], 0.0, 0.0, self.command[1]], min(now - self.at, 0.1))
        self.at = now
        if self.peer and self.talks and now - self.said_at > 0.04:
            self.said_at = now
            self.link.sendto(json.dumps(self.report()).encode(), self.peer)

    def report(self):
        state = self.body.robot_state()
        own = compose(inverse(self.start), state.pose)
        forward = math.hypot(state.velocity[0], state.velocity[1])
        report = {'x': own.position[0], 'y': own.position[1], 'yaw': own.yaw, 'battery': 0.8}
        return report | {'forward': forward, 'turn': state.angular_velocity[2]} | self.extra


def test_it_goes_where_it_is_sent_and_is_stopped_if_silent_or_talking_nonsense(play):
    spec = importlib.util.spec_from_file_location('my_robot_driver', FILE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    rover = Rover()
    module.ROVER = rover.link.getsockname()
    made = partial(AgentDriver, {'topics': module.RoverLink}, CameraInput)
    driver, team = play((made, unflatten(DriverSettings, PARAMETERS)), deaf=True)
    rover.start, rover.body = team.start, team.body

    def until(condition):
        team.until(lambda: rover.live() or condition())

    until(lambda: team.states)
    assert_allclose(pose_from_ros(team.state.pose.pose).position, team.start.position, atol=0.01)
    assert team.state.battery == pytest.approx(0.8)
    waypoint = team.start.position + np.array([0.35, 0.15, 0.0])
    _, result = team.send_accepted(waypoint, live=rover.live)
    assert team.ended(result, rover.live)[0] == GoalStatus.STATUS_SUCCEEDED
    assert np.linalg.norm(rover.body.robot_state().pose.position - waypoint) < 0.08
    far = team.start.position + np.array([1.0, 0.8, 0.0])
    for fault in ({'extra': {'x': math.nan}}, {'talks': False}):
        _, result = team.send_accepted(far, live=rover.live)
        until(lambda: rover.command != (0.0, 0.0))
        vars(rover).update(fault)
        assert 'no odometry for' in team.aborted(result, rover.live)
        # Reports from before may still be on their way.
        until(lambda: rover.command == (0.0, 0.0))
        known = rover.commands
        until(lambda known=known: rover.commands > known + 2)
        assert rover.command == (0.0, 0.0)
        until(lambda: driver.dropped['report'] > 3)
        rover.extra, rover.talks = {}, True
        until(lambda: team.state.goal_status == AgentState.ABORTED)
    # At the end it stands.
    rover.command = (0.2, 0.0)
    driver.halt()
    until(lambda: rover.command == (0.0, 0.0))
    rover.link.close()
