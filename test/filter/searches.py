"""Small searches in one process that the tests share."""

from __future__ import annotations

import numpy as np
from scipy.stats import multivariate_normal

from maasi_filter import (
    AgentMeasurement,
    BoxDetection,
    DetectionSettings,
    FilterSettings,
    NoiseSettings,
    Pose,
    SensorSettings,
    make_filter,
    wrap_angle,
)
from maasi_filter.state_file import pack

CUBE = np.array([[0.0, 260.0]] * 3)
FLOOR = np.array([[-0.3, 2.4]] * 2)
# Of the papers' filter on the floor.
FLOOR_LENGTHS = {'found_radius': 0.02, 'removal_distance': 0.05, 'jitter_deviation': 0.003}
DEGREES = NoiseSettings(range=1.5, bearing=0.175, elevation=0.295, as_='variance', angles='degrees')
RADIANS = NoiseSettings(range=1.5, bearing=0.175, elevation=0.295)


def same(one, other):
    """Check that the states of two filters are equal to the bit."""
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


def separated(generator, number, lower, upper, apart, dimension):
    """Return random targets at least `apart` from each other."""
    targets = []
    while len(targets) < number:
        candidate = lower + (upper - lower) * generator.random(dimension)
        if all(np.linalg.norm(candidate - other) >= apart for other in targets):
            targets.append(candidate)
    return np.array(targets)


def mow_floor(seed, settings=None):
    """Search the floor along a lawnmower, there and back; return the filter and the targets.

    The true field of view is a hard box.
    """
    generator = np.random.default_rng([seed, 1])
    targets = separated(generator, 12, -0.2, 2.3, 0.15, 2)
    sensor = floor_sensor()
    true_view = BoxDetection([-0.2, -0.2], [0.2, 0.2], 1.0)
    search = make_filter(settings or FilterSettings(), FLOOR, np.random.default_rng([seed, 2]))
    path = []
    for row, y in enumerate(np.arange(-0.15, 2.41, 0.3)):
        line = np.arange(-0.3, 2.41, 0.1)
        path += [(x, y) for x in (line if row % 2 == 0 else line[::-1])]
    for step, (x, y) in enumerate(path + path[::-1]):
        pose = Pose([x, y, 1.0])
        seen = targets[true_view.probability(targets, pose) > 0.0]
        values = sensor.measurement.measure(seen, pose)
        values += generator.standard_normal(values.shape) * [0.016, 0.052]
        values[:, 1] = wrap_angle(values[:, 1])
        search.step([AgentMeasurement('mambo', pose, sensor, values, None, step)], 1, float(step))
    return search, targets
