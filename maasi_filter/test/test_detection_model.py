"""Probability of detection: values by hand, frames, edges, and refusals."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from maasi_filter import (
    BoxDetection,
    DetectionSettings,
    ExponentialDetection,
    GaussianDetection,
    Pose,
    detection_probability_at,
)


def test_exponential_is_equation_3():
    model = ExponentialDetection(0.98, [25.0, 50.0, 25.0])
    value = model.probability([[35.0, 70.0, 10.0]], Pose([10.0, 20.0, 10.0]))
    assert value[0] == pytest.approx(0.98 * np.exp(-np.hypot(1.0, 1.0) / 2))


def test_gaussian_has_the_squared_exponent():
    model = GaussianDetection(0.98, [15.0, 15.0])
    value = model.probability([[15.0, 30.0]], Pose([0.0, 0.0, 7.0]))
    assert value[0] == pytest.approx(0.98 * np.exp(-2.5))


def test_box_off_centre_turns_with_the_robot():
    lower, upper = [-0.1, -0.1], [0.2, 0.2]
    ahead, behind = [[0.15, 0.0]], [[-0.15, 0.0]]
    robot = BoxDetection(lower, upper)
    world = BoxDetection(lower, upper, frame='world')
    turned = Pose.from_yaw([0.0, 0.0, 1.0], np.pi)
    assert robot.probability(ahead, turned)[0] == 0.0
    assert robot.probability(behind, turned)[0] == 1.0
    assert world.probability(ahead, turned)[0] == 1.0
    assert world.probability(behind, turned)[0] == 0.0


def test_a_ramp_falls_linearly_across_the_edge():
    box = BoxDetection([-0.2, -0.2], [0.2, 0.2], 0.9).softened(0.02)
    positions = [[0.17, 0.0], [0.19, 0.0], [0.2, 0.0], [0.21, 0.0], [0.23, 0.0]]
    values = box.probability(positions, Pose([0.0, 0.0, 1.0]))
    np.testing.assert_allclose(values, [0.9, 0.675, 0.45, 0.225, 0.0], atol=1e-12)
    assert box.softened(0.01) is box


@pytest.mark.parametrize(
    'model',
    [
        ExponentialDetection(0.98, [25.0, 20.0, 15.0]),
        GaussianDetection(0.7, [25.0, 20.0]),
        BoxDetection([-5.0, -9.0, -20.0], [10.0, 9.0, 20.0], 0.95),
        BoxDetection([-5.0, -9.0], [10.0, 9.0], 0.95, 'world', 1.0),
    ],
)
def test_the_kernel_agrees_with_the_model(model):
    generator = np.random.default_rng(0)
    positions = generator.normal(0.0, 15.0, (200, 3))
    pose = Pose.from_yaw([1.0, 2.0, 3.0], 0.7)
    kind, parameters = model.kernel()
    inline = [
        detection_probability_at(kind, parameters, *offset, np.cos(pose.yaw), np.sin(pose.yaw))
        for offset in positions - pose.position
    ]
    values = model.probability(positions, pose)
    # Two forms of the exponential function, each to a unit in the last place.
    np.testing.assert_allclose(values, inline, rtol=5e-16)
    assert ((values >= 0.0) & (values <= 1.0)).all()


def test_bad_models_are_refused():
    with pytest.raises(ValueError, match='size'):
        ExponentialDetection(0.98, [25.0, -1.0])
    with pytest.raises(ValueError, match='probability'):
        GaussianDetection(1.5, [25.0, 25.0])
    with pytest.raises(ValueError, match='lower, upper'):
        BoxDetection([0.2, -0.2], [-0.2, 0.2])
    with pytest.raises(ValueError, match='frame'):
        BoxDetection([-0.2, -0.2], [0.2, 0.2], frame='camera')


@given(st.floats(-np.pi, np.pi), st.floats(-50.0, 50.0), st.floats(-50.0, 50.0))
def test_a_box_in_the_robot_frame_only_sees_relative_positions(yaw, x, y):
    box = DetectionSettings(kind='box', lower=[-1.0, -2.0], upper=[3.0, 2.0], edge=0.5).build()
    offset = np.array([1.7, -1.8])
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    here = box.probability([offset], Pose([0.0, 0.0, 0.0]))
    there = box.probability([turn @ offset + [x, y]], Pose.from_yaw([x, y, 0.0], yaw))
    np.testing.assert_allclose(here, there, atol=1e-9)
