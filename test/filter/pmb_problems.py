"""Small problems on a plane that the tests of the multi-Bernoulli filter share."""

from __future__ import annotations

import numpy as np
from searches import log_density

from maasi_filter import (
    AgentMeasurement,
    DetectionSettings,
    FilterSettings,
    NoiseSettings,
    Pose,
    SensorSettings,
)
from maasi_filter.pmb.filter import PmbFilter

PLANE = np.array([[0.0, 100.0]] * 2)
SIDE = 100


def plane_sensor(probability=0.9, clutter=0.0, range_noise=3.0, bearing=0.08):
    """Return a sensor for the plane."""
    return SensorSettings(
        detection=DetectionSettings(
            kind='gaussian', probability=probability, size=[60.0, 60.0, 60.0]
        ),
        noise=NoiseSettings(range=range_noise, bearing=bearing),
        clutter=clutter,
    ).build('robot', 2)


def plane_filter(seed=0, particles=1000, **settings):
    """Return a filter on the plane, e on nodes 2 m apart."""
    return PmbFilter(
        FilterSettings(
            method='pmb',
            exploration_spacing=2.0,
            pmb={'particles': particles},
            **{'expected_targets': 3.0, **settings},
        ),
        PLANE,
        np.random.default_rng(seed),
    )


def measured(sensor, position, values, step=0, robot='robot'):
    """Return a measurement of a robot at a position."""
    d = sensor.dimension
    pose = Pose(np.asarray(position, float))
    return AgentMeasurement(robot, pose, sensor, np.reshape(values, (-1, d)), None, step)


def cells():
    """Return the centres (n, 2) of cells of 1 m^2 of the plane."""
    axis = np.arange(SIDE) + 0.5
    return np.stack(np.meshgrid(axis, axis, indexing='ij'), axis=-1).reshape(-1, 2)


def densities(sensor, position, values):
    """Return pi (n,) and g (m, n) at the cells, pi as the filter caps it."""
    pose = Pose(np.asarray(position, float))
    probability = np.minimum(sensor.detection.probability(cells(), pose), 0.98)
    values = np.reshape(values, (-1, 2))
    logs = log_density(sensor, values, cells(), pose)
    return probability, np.exp(logs)
