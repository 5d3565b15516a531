"""Poses: conventions, inverses, and what they refuse."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from maasi_filter import Pose, compose, inverse

angles = st.floats(-10.0, 10.0)
coordinates = st.tuples(*[st.floats(-1e3, 1e3)] * 3)


def test_yaw_turns_body_x_to_the_left():
    pose = Pose.from_yaw([1.0, 2.0, 3.0], np.pi / 2)
    np.testing.assert_allclose(pose.rotation() @ [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], atol=1e-12)
    assert pose.yaw == pytest.approx(np.pi / 2)


def test_two_coordinates_lie_on_the_floor():
    assert Pose([1.0, 2.0]).position.tolist() == [1.0, 2.0, 0.0]


@given(coordinates, angles)
def test_pose_and_its_inverse_cancel(position, yaw):
    pose = Pose.from_yaw(position, yaw)
    same = compose(pose, inverse(pose))
    np.testing.assert_allclose(same.position, 0.0, atol=1e-9)
    np.testing.assert_allclose(same.rotation(), np.eye(3), atol=1e-12)


@given(coordinates, angles, coordinates, angles)
def test_composition_adds_yaws(first, yaw, second, turn):
    pose = compose(Pose.from_yaw(first, yaw), Pose.from_yaw(second, turn))
    assert np.cos(pose.yaw - yaw - turn) == pytest.approx(1.0)
    expected = np.array(first) + Pose.from_yaw(first, yaw).rotation() @ second
    np.testing.assert_allclose(pose.position, expected, atol=1e-9)


@pytest.mark.parametrize(
    ('position', 'orientation', 'word'),
    [
        ([np.nan, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], 'position'),
        ([0.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], 'position'),
        ([0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0], 'orientation'),
        ([0.0, 0.0, 0.0], [np.inf, 0.0, 0.0, 0.0], 'orientation'),
    ],
)
def test_bad_poses_are_refused_by_name(position, orientation, word):
    with pytest.raises(ValueError, match=word):
        Pose(position, orientation)


def test_poses_are_compared_by_value_and_cannot_be_changed():
    pose = Pose([1.0, 2.0, 3.0])
    assert pose == Pose([1.0, 2.0, 3.0])
    assert hash(pose) == hash(Pose([1.0, 2.0, 3.0]))
    with pytest.raises(ValueError, match='read-only'):
        pose.position[0] = 5.0
