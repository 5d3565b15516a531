"""Driving clear of what the laser scanner sees and nobody knew of."""

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose

from maasi_drivers.agent.odometry import StampedPose
from maasi_drivers.agent.scan_motion import ScanUnicycle, scan_points
from maasi_drivers.settings.driver import ScanSettings
from maasi_filter.geometry.area import Area
from maasi_filter.models.pose import Pose
from maasi_planner.motion import RobotState
from maasi_planner.settings import MotionSettings
from maasi_sim.simulation.sensors import LaserScanner, LaserSettings

RADIUS = 0.11
STEP = 0.05
MOTION = MotionSettings(
    model='unicycle', speed=0.2, acceleration=0.5, yaw_rate=1.8, yaw_acceleration=4.0
)
BOUNDS = np.array([[-1.0, 3.0], [-1.0, 3.0]])


def stamped(x=0.0, y=0.0, yaw=0.0, velocity=(0.0, 0.0, 0.0), turn=0.0):
    pose, turning = Pose.from_yaw([x, y, 0.0], yaw), np.array([0.0, 0.0, turn])
    return StampedPose(0, pose, velocity=np.array(velocity), angular_velocity=turning)


def points(ranges, placed, increment=0.0, mount=(0.0, 0.0, 0.0)):
    return scan_points(ranges, (0.0, math.pi / 2), (0.1, 3.5), increment, placed, mount)


def test_beams_are_placed_in_the_map():
    placed = stamped(1.0, 2.0, math.pi / 2)
    # What is no measurement is left out.
    ranges = [1.0, 2.0, math.inf, 0.5, math.nan, 0.05, 9.0]
    seen = points(ranges, placed, mount=(-0.1, 0.2, 0.0))
    # The scanner sits at (0.8, 1.9) and looks along +y.
    assert_allclose(seen, [[0.8, 2.9], [-1.2, 1.9], [1.3, 1.9]], atol=1e-12)
    turned = points([1.0], placed, mount=(0.0, 0.0, math.pi))
    assert_allclose(turned, [[1.0, 1.0]], atol=1e-12)
    # The robot moves on during a turn of the scanner.
    moving = stamped(velocity=(0.2, 0.0, 0.0), turn=1.0)
    seen = points([1.0, 1.0], moving, increment=0.1)
    assert_allclose(seen, [[1.0, 0.0], [0.02 - math.sin(0.1), math.cos(0.1)]], atol=1e-12)


def drive(goal, centres, radii, seconds=60.0, yaw=0.0, margin=0.0):
    """Drive under scans at 5 Hz with noise, and touch nothing; return whether it arrives."""
    model = ScanUnicycle(MOTION, Area([[-99.0, 99.0]] * 2), RADIUS, ScanSettings())
    centres, radii = np.reshape(centres, (-1, 2)), np.array(radii)
    body = model.body(RobotState.at_rest([0.0, 0.0, 0.0], yaw))
    scanner = LaserScanner(LaserSettings(), Area(BOUNDS), 3, 'rover')
    goal = np.array([*goal, 0.0])
    for step in range(round(seconds / STEP)):
        state = body.robot_state()
        gaps = np.hypot(*(centres - state.pose.position[:2]).T) - radii
        assert gaps.min(initial=math.inf) > RADIUS + margin
        if step % 4 == 0:
            motion = {'velocity': state.velocity, 'angular_velocity': state.angular_velocity}
            placed = StampedPose(0, state.pose, **motion)
            ranges = scanner.scan(state.pose, step, centres, radii)
            angles = 0.0, 2.0 * math.pi / 360
            model.see(scan_points(ranges, angles, (0.12, 3.5), 0.0, placed, [0.0, 0.0, 0.0]))
        if model.arrived(state.pose.position, goal):
            return True
        body.step(model.command(state, goal), STEP)
    return False


@pytest.mark.parametrize(
    ('centres', 'radii'),
    [
        ([], []),
        ([[0.9, 0.0]], [0.15]),
        ([[0.9, 0.05], [0.9, 0.35], [0.9, -0.25]], [0.15, 0.15, 0.15]),
        ([[0.8, 0.2], [1.2, -0.25]], [0.1, 0.2]),
    ],
)
def test_a_robot_gets_around_what_it_did_not_know_of(centres, radii):
    assert drive([1.8, 0.0], centres, radii)


@pytest.mark.parametrize('seed', range(5))
def test_a_robot_touches_nothing_whatever_stands_there(seed):
    places = np.random.default_rng(seed).uniform(-0.5, 2.5, (30, 2))
    gaps = [np.linalg.norm(places - end, axis=1) for end in ([0.0, 0.0], [2.0, 1.6])]
    centres = places[np.min(gaps, axis=0) > 0.5][:8]
    assert drive([2.0, 1.6], centres, np.full(8, 0.12), yaw=2.0)


def test_a_robot_that_touches_something_may_leave():
    model = ScanUnicycle(MOTION, Area([[-99.0, 99.0]] * 2), RADIUS, ScanSettings())
    for place, leaves in ((-0.1, True), (0.1, False)):
        model.see([[place, 0.0]])
        command = model.command(RobotState.at_rest([0.0, 0.0, 0.0]), [1.0, 0.0, 0.0])
        assert (command[0] > 0.0) == leaves


def test_it_keeps_a_margin_to_a_wall():
    along = np.arange(-0.8, 0.81, 0.03)
    wall = np.stack([np.full(len(along), 1.0), along], axis=1)
    assert not drive([0.95, 0.0], wall, np.full(len(along), 0.02), seconds=25.0, margin=0.02)
