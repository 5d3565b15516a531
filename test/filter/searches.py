"""Small searches in one process that the tests share."""

import numpy as np
from scipy.stats import multivariate_normal

from maasi_filter import (
    AgentMeasurement,
    DetectionSettings,
    FilterSettings,
    NoiseSettings,
    Pose,
    SensorSettings,
    wrap_angle,
)
from maasi_filter.geometry.area import Area
from maasi_filter.geometry.environment import EnvironmentSettings
from maasi_filter.measurement_check import check_measurements
from maasi_filter.pmb.filter import PmbFilter
from maasi_filter.state_file import pack

CUBE = np.array([[0.0, 260.0]] * 3)
FLOOR = np.array([[-0.3, 2.4]] * 2)
# Of the papers' filter on the floor.
FLOOR_LENGTHS = {'found_radius': 0.02, 'removal_distance': 0.05, 'jitter_deviation': 0.003}
DEGREES = NoiseSettings(range=1.5, bearing=0.175, elevation=0.295, as_='variance', angles='degrees')
RADIANS = NoiseSettings(range=1.5, bearing=0.175, elevation=0.295)
# A small problem for the multi-Bernoulli filter.
SIDE = 100
PLANE = np.array([[0.0, SIDE]] * 2)


def same(one, other):
    first, second = pack(one.state()), pack(other.state())
    assert first.keys() == second.keys()
    for name in first:
        np.testing.assert_array_equal(first[name], second[name], err_msg=name)


def play(search, measurements, first=0):
    """Let a filter have measurements one by one; return it."""
    for step, measurement in enumerate(measurements, start=first):
        search.step([measurement], 1, float(step))
    return search


def cube_sensor(noise=DEGREES):
    """Return the papers' 3D sensor."""
    return SensorSettings(noise=noise).build('drone', 3)


def floor_sensor():
    """Return the papers' sensor of targets on the floor."""
    return SensorSettings(
        detection=DetectionSettings(kind='box', probability=0.95),
        noise=NoiseSettings(range=0.016, bearing=0.052),
    ).build('mambo', 2)


def observe(generator, sensor, targets, pose):
    """Return noisy detections of the targets that happen to be detected."""
    seen = generator.random(len(targets)) < sensor.detection.probability(targets, pose)
    values = sensor.measurement.measure(targets[seen], pose)
    values += generator.multivariate_normal(
        np.zeros(sensor.dimension), sensor.covariance, len(values)
    ).reshape(values.shape)
    values[:, 1] = wrap_angle(values[:, 1])
    return values


def log_density(sensor, z, positions, pose):
    """Return log p(z | x) (m, n) of measurements (m, d) and positions (n, d): 000, (10)."""
    model = sensor.measurement
    errors = model.residual(z[:, None, :], model.measure(positions, pose))
    logs = multivariate_normal(np.zeros(model.dimension), sensor.covariance).logpdf(errors)
    return logs.reshape(len(z), len(positions))


def wander(generator, number, centre=130.0, size=110.0, stride=12.0):
    """Return positions a stride apart on straight lines between random points."""
    position = centre + size * (generator.random(3) - 0.5)
    way = position
    for _ in range(number):
        while np.linalg.norm(way - position) < stride:
            way = centre + size * (generator.random(3) - 0.5)
        position = position + stride * (way - position) / np.linalg.norm(way - position)
        yield position


def plane_sensor(probability=0.9, clutter=0.0, range_noise=3.0, bearing=0.08):
    return SensorSettings(
        detection=DetectionSettings(
            kind='gaussian', probability=probability, size=[60.0, 60.0, 60.0]
        ),
        noise=NoiseSettings(range=range_noise, bearing=bearing),
        clutter=clutter,
    ).build('robot', 2)


def plane_filter(seed=0, particles=1000, expected_targets=3.0, **settings):
    """Return a filter on the plane, e on nodes 2 m apart."""
    return PmbFilter(
        FilterSettings(
            method='pmb', exploration_spacing=2.0, pmb={'particles': particles}, **settings
        ),
        Area(EnvironmentSettings(bounds=PLANE.tolist(), expected_targets=expected_targets)),
        np.random.default_rng(seed),
    )


def measured(sensor, position, values, step=0, robot='robot'):
    d = sensor.dimension
    pose = Pose(np.asarray(position, float))
    return AgentMeasurement(robot, pose, sensor, np.reshape(values, (-1, d)), None, step)


def checked(measurement):
    """Return a measurement as a filter takes it."""
    settings = FilterSettings(method='pmb').resolved()
    return check_measurements([measurement], 1, 0.0, settings, measurement.sensor.dimension)[0]


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
