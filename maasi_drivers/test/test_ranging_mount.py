"""Sweeps of a mounted sensor as measurements from the robot."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from maasi_drivers.agent.odometry import StampedPose
from maasi_drivers.agent.sensor_input import RangingMount
from maasi_drivers.settings.driver import RangingSettings
from maasi_filter.models.pose import Pose
from maasi_filter.settings import SensorSettings

MOUNT = {'frame': 'body', 'position': [0.3, -0.1, -0.2], 'rpy': [0.1, 0.6, -0.4]}
NOISE = {'range': 0.05, 'bearing': 0.02, 'elevation': 0.03, 'as': 'deviation', 'angles': 'radians'}
POSE = Pose([4.0, -3.0, 12.0], [0.9, 0.05, -0.1, 0.42])
TARGETS = np.array([[9.0, 1.0, 5.0], [-3.0, -9.0, 2.0], [4.5, -2.5, 30.0]])

AXES = np.array([1.5, 0.5, 1.0])  # of the deviations of the attitude, along the axes of the map


def stamped(attitude=0.0):
    return StampedPose(0, POSE, np.diag([0.0, 0.0, 0.0, *(attitude * AXES) ** 2]))


def mount(dimension=3):
    sensor = SensorSettings.model_validate({'noise': NOISE}).build('sonar', dimension)
    return sensor, RangingMount(RangingSettings.model_validate(MOUNT), sensor)


def sweep_of(targets):
    """Return slant ranges and angles as the sensor gives them: an independent way round."""
    turn = POSE.rotation() @ Rotation.from_euler('xyz', MOUNT['rpy']).as_matrix()
    seen = (targets - POSE.position - POSE.rotation() @ np.array(MOUNT['position'])) @ turn
    ranges = np.linalg.norm(seen, axis=1)
    angles = np.arctan2(seen[:, 1], seen[:, 0]), np.arcsin(seen[:, 2] / ranges)
    return np.stack([ranges, *angles], axis=1)


@pytest.mark.parametrize('dimension', [2, 3])
def test_targets_are_where_they_are_whatever_the_attitude(dimension):
    sensor, mounted = mount(dimension)
    values, _, positions = mounted.measurements(sweep_of(TARGETS), stamped())
    assert_allclose(positions, TARGETS[:, :dimension], atol=1e-12)
    assert_allclose(values, sensor.measurement.measure(TARGETS[:, :dimension], POSE), atol=1e-12)


@pytest.mark.parametrize(('dimension', 'attitude'), [(2, 0.0), (3, 0.0), (3, 0.02)])
def test_covariances_are_those_of_many_sweeps(dimension, attitude):
    _, mounted = mount(dimension)
    generator = np.random.default_rng(4)
    _, covariances, _ = mounted.measurements(sweep_of(TARGETS[:2]), stamped(attitude=attitude))
    sigma = np.array([NOISE['range'], NOISE['bearing'], NOISE['elevation']])
    if dimension == 2:
        sigma[2] = sigma[1]
    for index in range(2):
        values = []
        for _ in range(600):
            # The sensor is turned a little more than its pose says.
            angles = attitude * AXES * generator.normal(size=3)
            error = Rotation.from_euler('xyz', angles).as_matrix()
            turned = POSE.position + (TARGETS[[index]] - POSE.position) @ error
            noisy = sweep_of(turned) + generator.normal(size=(20, 3)) * sigma
            values.append(mounted.measurements(noisy, stamped())[0])
        spread = np.cov(np.concatenate(values).T)
        scale = np.sqrt(np.diagonal(covariances[index]))
        error = (spread - covariances[index]) / np.outer(scale, scale)
        assert np.abs(error).max() < (0.12 if attitude else 0.05)


def test_nothing_seen_is_nothing_and_straight_below_has_any_bearing():
    _, mounted = mount()
    values, covariances, positions = mounted.measurements(np.zeros((0, 3)), stamped())
    assert values.shape == (0, 3) and covariances.shape == (0, 3, 3) and positions.shape == (0, 3)
    below = POSE.position - np.array([[0.0, 0.0, 5.0]])
    _, covariances, _ = mounted.measurements(sweep_of(below), stamped())
    assert np.linalg.eigvalsh(covariances[0]).min() > 0.0
