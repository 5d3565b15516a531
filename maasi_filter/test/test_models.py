"""Poses, measurements and probabilities of detection: by hand, inverses, edges, and refusals."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from maasi_filter import (
    BoxDetection,
    ExponentialDetection,
    GaussianDetection,
    NoiseSettings,
    Pose,
    RangeAndAngles,
    Sensor,
    compose,
    detection_probability_at,
    inverse,
    wrap_angle,
)

angles = st.floats(-10.0, 10.0)
coordinates = st.tuples(*[st.floats(-1e3, 1e3)] * 3)


def test_yaw_turns_body_x_to_the_left():
    pose = Pose.from_yaw([1.0, 2.0, 3.0], np.pi / 2)
    np.testing.assert_allclose(pose.rotation() @ [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], atol=1e-12)
    assert pose.yaw == pytest.approx(np.pi / 2)


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


# Measurements.

MODELS = [RangeAndAngles(2), RangeAndAngles(3)]


@pytest.mark.parametrize('model', MODELS)
def test_inverse_undoes_measure_and_the_jacobian_is_its_derivative(model):
    positions = np.random.default_rng(0).normal(0.0, 30.0, (500, model.dimension))
    pose = Pose.from_yaw([1.0, 2.0, 3.0], 0.4)
    values = model.measure(positions, pose)
    np.testing.assert_allclose(model.inverse(values, pose), positions, atol=1e-10)
    # Away from the poles.
    positions = np.random.default_rng(1).normal(0.0, 30.0, (100, model.dimension))
    jacobian = model.jacobian(positions, pose)
    for axis in range(model.dimension):
        step = 1e-5 * np.eye(model.dimension)[axis]
        difference = model.residual(
            model.measure(positions + step, pose), model.measure(positions - step, pose)
        )
        np.testing.assert_allclose(jacobian[:, :, axis], difference / 2e-5, atol=1e-6)


def test_values_by_hand():
    pose = Pose.from_yaw([1.0, 1.0, 1.0], 2.0)
    z = RangeAndAngles(3).measure([[1.0, 4.0, 5.0]], pose)[0]
    np.testing.assert_allclose(z, [5.0, np.pi / 2, np.arcsin(4.0 / 5.0)])
    z = RangeAndAngles(2).measure([[1.0, 4.0]], pose)[0]
    np.testing.assert_allclose(z, [3.0, np.pi / 2])
    # Across pi.
    residual = RangeAndAngles(2).residual([1.0, np.pi - 0.01], [1.0, -np.pi + 0.01])
    np.testing.assert_allclose(residual, [0.0, -0.02])


def test_poles_have_finite_answers():
    pose = Pose([1.0, 2.0, 3.0])
    for model in MODELS:
        at_robot = pose.position[None, : model.dimension]
        np.testing.assert_array_equal(model.measure(at_robot, pose), 0.0)
        np.testing.assert_array_equal(model.jacobian(at_robot, pose), 0.0)
    solid = RangeAndAngles(3)
    above = np.array([[1.0, 2.0, 10.0]])
    np.testing.assert_allclose(solid.measure(above, pose)[0], [7.0, 0.0, np.pi / 2])
    jacobian = solid.jacobian(above, pose)[0]
    np.testing.assert_array_equal(jacobian[0], [0.0, 0.0, 1.0])
    np.testing.assert_array_equal(jacobian[1], 0.0)


@given(st.floats(-100.0, 100.0))
def test_wrapped_angles_are_the_same_angles(angle):
    wrapped = float(wrap_angle(angle))
    assert -np.pi <= wrapped < np.pi
    assert np.cos(wrapped) == pytest.approx(np.cos(angle), abs=1e-9)
    assert np.sin(wrapped) == pytest.approx(np.sin(angle), abs=1e-9)


def test_noise_says_what_its_numbers_are():
    numbers = {'range': 1.5, 'bearing': 0.175, 'elevation': 0.295}
    radians = NoiseSettings(**numbers)
    np.testing.assert_allclose(np.sqrt(np.diag(radians.covariance(3))), [1.5, 0.175, 0.295])
    degrees = NoiseSettings(**numbers, as_='variance', angles='degrees')
    expected = np.sqrt([1.5, 0.175, 0.295]) * [1.0, np.pi / 180, np.pi / 180]
    np.testing.assert_allclose(np.sqrt(np.diag(degrees.covariance(3))), expected)
    assert NoiseSettings.model_validate({**numbers, 'as': 'variance'}).as_ == 'variance'


# Probability of detection.

BOX = BoxDetection([-0.2, -0.2], [0.2, 0.2], 0.9)


@pytest.mark.parametrize(
    ('model', 'exponent'),
    [
        (ExponentialDetection(0.98, [25.0, 50.0, 25.0]), -0.5 * np.sqrt(2.0)),
        (GaussianDetection(0.98, [25.0, 50.0]), -0.5 * 2.0),
    ],
)
def test_radial_models_are_equation_3(model, exponent):
    value = model.probability([[35.0, 70.0, 10.0]], Pose([10.0, 20.0, 10.0]))
    assert value[0] == pytest.approx(0.98 * np.exp(exponent))


@pytest.mark.parametrize(('frame', 'seen'), [('robot', [0.0, 1.0]), ('world', [1.0, 0.0])])
def test_box_off_centre_turns_with_the_robot(frame, seen):
    box = BoxDetection([-0.1, -0.1], [0.2, 0.2], frame=frame)
    turned = Pose.from_yaw([0.0, 0.0, 1.0], np.pi)
    assert box.probability([[0.15, 0.0], [-0.15, 0.0]], turned).tolist() == seen


def test_a_ramp_falls_linearly_across_the_edge():
    box = BOX.softened(0.02)
    positions = [[0.17, 0.0], [0.19, 0.0], [0.2, 0.0], [0.21, 0.0], [0.23, 0.0]]
    values = box.probability(positions, Pose([0.0, 0.0, 1.0]))
    np.testing.assert_allclose(values, [0.9, 0.675, 0.45, 0.225, 0.0], atol=1e-12)
    assert box.softened(0.01).edge == 0.02


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


@pytest.mark.parametrize(
    ('make', 'word'),
    [
        (lambda: ExponentialDetection(0.98, [25.0, -1.0]), 'size'),
        (lambda: GaussianDetection(1.5, [25.0, 25.0]), 'probability'),
        (lambda: BoxDetection([0.2, -0.2], [-0.2, 0.2]), 'lower, upper'),
        (lambda: BoxDetection([-0.2, -0.2], [0.2, 0.2], frame='camera'), 'frame'),
        (lambda: Sensor('bad', BOX, np.zeros((2, 2))), 'positive definite'),
        (lambda: Sensor('bad', BOX, np.eye(2), clutter=np.nan), 'clutter'),
        (lambda: Pose([np.nan, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]), 'position'),
        (lambda: Pose([0.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]), 'position'),
        (lambda: Pose([0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0]), 'orientation'),
        (lambda: Pose([0.0, 0.0, 0.0], [np.inf, 0.0, 0.0, 0.0]), 'orientation'),
    ],
)
def test_bad_values_are_refused_by_name(make, word):
    with pytest.raises(ValueError, match=word):
        make()
