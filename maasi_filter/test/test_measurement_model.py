"""Range and angles: inverses, Jacobians, wrapping and poles."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from maasi_filter import NoiseSettings, Pose, RangeBearing, RangeBearingElevation, wrap_angle

MODELS = [RangeBearing(), RangeBearingElevation()]
coordinate = st.floats(-100.0, 100.0)


@pytest.mark.parametrize('model', MODELS)
def test_inverse_undoes_measure(model):
    generator = np.random.default_rng(0)
    positions = generator.normal(0.0, 30.0, (500, model.dimension))
    pose = Pose.from_yaw([1.0, 2.0, 3.0], 0.4)
    np.testing.assert_allclose(
        model.inverse(model.measure(positions, pose), pose), positions, atol=1e-10
    )


def test_values_by_hand():
    pose = Pose.from_yaw([1.0, 1.0, 1.0], 2.0)
    z = RangeBearingElevation().measure([[1.0, 4.0, 5.0]], pose)[0]
    np.testing.assert_allclose(z, [5.0, np.pi / 2, np.arcsin(4.0 / 5.0)])
    z = RangeBearing().measure([[1.0, 4.0]], pose)[0]
    np.testing.assert_allclose(z, [3.0, np.pi / 2])


@pytest.mark.parametrize('model', MODELS)
def test_jacobian_is_the_derivative(model):
    generator = np.random.default_rng(1)
    positions = generator.normal(0.0, 30.0, (100, model.dimension))
    pose = Pose([1.0, 2.0, 3.0])
    jacobian = model.jacobian(positions, pose)
    for axis in range(model.dimension):
        step = 1e-5 * np.eye(model.dimension)[axis]
        difference = model.residual(
            model.measure(positions + step, pose), model.measure(positions - step, pose)
        )
        np.testing.assert_allclose(jacobian[:, :, axis], difference / 2e-5, atol=1e-6)


def test_poles_have_finite_answers():
    pose = Pose([1.0, 2.0, 3.0])
    for model in MODELS:
        at_robot = pose.position[None, : model.dimension]
        np.testing.assert_array_equal(model.measure(at_robot, pose), 0.0)
        np.testing.assert_array_equal(model.jacobian(at_robot, pose), 0.0)
    solid = RangeBearingElevation()
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


def test_bearings_across_pi_are_close():
    residual = RangeBearing().residual([1.0, np.pi - 0.01], [1.0, -np.pi + 0.01])
    np.testing.assert_allclose(residual, [0.0, -0.02])


def test_noise_says_what_its_numbers_are():
    numbers = {'range': 1.5, 'bearing': 0.175, 'elevation': 0.295}
    radians = NoiseSettings(**numbers)
    np.testing.assert_allclose(np.sqrt(np.diag(radians.covariance(3))), [1.5, 0.175, 0.295])
    degrees = NoiseSettings(**numbers, as_='variance', angles='degrees')
    expected = np.sqrt([1.5, 0.175, 0.295]) * [1.0, np.pi / 180, np.pi / 180]
    np.testing.assert_allclose(np.sqrt(np.diag(degrees.covariance(3))), expected)
    assert degrees.covariance(2).shape == (2, 2)
    assert NoiseSettings.model_validate({**numbers, 'as': 'variance'}).as_ == 'variance'


@given(coordinate, coordinate, coordinate)
def test_range_is_the_distance(x, y, z):
    value = RangeBearingElevation().measure([[x, y, z]], Pose([1.0, 2.0, 3.0]))[0]
    assert value[0] == pytest.approx(np.linalg.norm([x - 1.0, y - 2.0, z - 3.0]))
    assert abs(value[2]) <= np.pi / 2
