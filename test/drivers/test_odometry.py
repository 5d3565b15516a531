"""Odometry in the map, and poses at a stamp."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from maasi_drivers.agent.odometry import MapOdometry, PoseHistory, PoseSpeed, StampedPose
from maasi_filter.models.pose import Pose, compose


def stamped(stamp, position=(0.0, 0.0, 0.0), yaw=0.0):
    return StampedPose(stamp, Pose.from_yaw(position, yaw))


def test_odometry_is_placed_by_the_initial_pose_and_its_origin():
    origin = Pose.from_yaw([3.0, -1.0, 0.0], 0.7)
    initial = Pose.from_yaw([1.9, 1.8, 1.0], np.pi / 2)
    covariance = np.diag([1.0, 4.0, 9.0, 0.1, 0.2, 0.3])
    for own, odometry in (
        (Pose.from_yaw([0.0, 0.0, 0.0], 0.0), MapOdometry(initial)),
        (origin, MapOdometry(initial, origin)),
    ):
        start = odometry.apply(0, own).pose
        assert_allclose([*start.position, start.yaw], [1.9, 1.8, 1.0, np.pi / 2], atol=1e-12)
        moved = compose(own, Pose.from_yaw([0.5, 0.1, 0.2], 0.3))
        ahead = odometry.apply(1, moved, covariance, velocity=[0.4, 0.0, 0.1])
        heading = np.pi / 2 + 0.3
        assert_allclose([*ahead.pose.position, ahead.pose.yaw], [1.8, 2.3, 1.2, heading])
        assert_allclose(ahead.velocity, [0.4 * np.cos(heading), 0.4 * np.sin(heading), 0.1])
    turned = MapOdometry(initial).apply(0, origin, covariance).covariance
    assert_allclose(turned, np.diag([4.0, 1.0, 9.0, 0.2, 0.1, 0.3]), atol=1e-12)


@pytest.mark.parametrize(
    ('name', 'value'),
    [
        ('covariance', np.full((6, 6), np.nan)),
        ('covariance', np.eye(3)),
        ('velocity', [np.inf, 0, 0]),
        ('angular_velocity', [0, 0]),
    ],
)
def test_what_is_not_finite_is_refused(name, value):
    odometry = MapOdometry(Pose.from_yaw([0.0, 0.0, 0.0], 0.0))
    with pytest.raises(ValueError, match=f'{name}: got'):
        odometry.apply(0, Pose.from_yaw([0.0, 0.0, 0.0], 0.0), **{name: value})


@settings(max_examples=50, deadline=None)
@given(
    first=st.floats(-np.pi, np.pi),
    turn=st.floats(-3.0, 3.0),
    part=st.integers(0, 1000),
    sign=st.sampled_from([1, -1]),
)
def test_interpolation_goes_the_short_way_round(first, turn, part, sign):
    a = stamped(0, [1.0, 2.0, 3.0], first)
    b = Pose.from_yaw([2.0, 0.0, 3.5], first + turn)
    # The sign of a quaternion does not matter.
    b = StampedPose(1000, Pose(b.position, sign * b.orientation))
    history = PoseHistory()
    history.add(a)
    history.add(b)
    pose = history.at(part).pose
    assert_allclose(pose.position, [1 + part / 1e3, 2 - part / 500, 3 + part / 2e3], atol=1e-9)
    difference = pose.yaw - (first + turn * part / 1000)
    assert_allclose(np.mod(difference + np.pi, 2 * np.pi), np.pi, atol=1e-6)


def test_the_history_gives_exact_poses_at_their_stamps_and_nothing_outside():
    history = PoseHistory(3)
    assert history.latest is None and history.at(0) is None
    poses = [stamped(stamp, [0.001 * stamp, 0.0, 0.0]) for stamp in (50, 100, 200, 400)]
    for pose in poses:
        history.add(pose)
    # What comes twice or late is not added, and the oldest is forgotten.
    history.add(stamped(400, [5.0, 0.0, 0.0]))
    history.add(stamped(150))
    assert [history.at(stamp) for stamp in (50, 99, 401)] == [None] * 3
    assert [history.at(pose.stamp) for pose in poses[1:]] == poses[1:]
    assert history.first == 100 and history.latest is poses[-1]
    assert_allclose(history.at(250).pose.position, [0.25, 0.0, 0.0])
    history.clear()
    assert history.latest is None and history.first is None


def test_velocities_come_from_differences():
    speed = PoseSpeed()
    assert not speed.with_velocity(0, Pose.from_yaw([0.0, 0.0, 1.0], 3.1)).velocity.any()
    placed = speed.with_velocity(10**8, Pose.from_yaw([0.02, -0.04, 1.0], -3.1))
    assert_allclose(placed.velocity, [0.2, -0.4, 0.0], atol=1e-9)
    assert_allclose(placed.angular_velocity, [0.0, 0.0, 10 * (2 * np.pi - 6.2)], atol=1e-9)
    # A jump is no velocity, and neither is a difference over a gap.
    assert not speed.with_velocity(2 * 10**8, Pose([9.0, 0.0, 1.0])).velocity.any()
    assert not speed.with_velocity(5 * 10**9, Pose([9.5, 0.0, 1.0])).velocity.any()
