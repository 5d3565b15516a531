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


def follow_one_target(
    seed, noise, settings=None, after=15, most=300, position_deviation=0.0, told=True
):
    """Return error and covariance of one target: when found, and `after` measurements later.

    The robot believes to be `position_deviation` from where it is, another way each time, and
    tells so, or not.
    """
    generator = np.random.default_rng([seed, 5])
    sensor = cube_sensor(noise)
    target = 130.0 + 40.0 * (generator.random((1, 3)) - 0.5)
    search = make_filter(settings or FilterSettings(), CUBE, np.random.default_rng([seed, 6]))
    first = None
    left = after
    for step, position in enumerate(wander(generator, most)):
        values = observe(generator, sensor, target, Pose(position))
        pose = Pose(position)
        reported = None
        if position_deviation > 0.0:
            pose = Pose(position + position_deviation * generator.standard_normal(3))
            reported = position_deviation**2 * np.eye(3) if told else None
        result = search.step(
            [AgentMeasurement('drone', pose, sensor, values, None, step, reported)], 1, float(step)
        )
        if result.newly_found and first is None:
            first = result.newly_found[0]
        if first is not None:
            left -= 1
            if left < 0:
                break
    if first is None:
        return None
    last = search.found_targets[0]
    return [(found.position - target[0], found.covariance) for found in (first, last)], len(
        search.found_targets
    )


def separated(generator, number, lower, upper, apart, dimension):
    """Return random targets at least `apart` from each other."""
    targets = []
    while len(targets) < number:
        candidate = lower + (upper - lower) * generator.random(dimension)
        if all(np.linalg.norm(candidate - other) >= apart for other in targets):
            targets.append(candidate)
    return np.array(targets)


def mow_floor(seed, pose_error=0.0, camera=False, search=None, settings=None):
    """Search the floor along a lawnmower, there and back; return the filter and the targets.

    The true field of view is a hard box; `pose_error` is the deviation of a slowly changing error
    of the robot's position. With `camera` detections carry covariances from a Cartesian error.
    """
    generator = np.random.default_rng([seed, 1])
    targets = separated(generator, 12, -0.2, 2.3, 0.15, 2)
    sensor = floor_sensor()
    true_view = BoxDetection([-0.2, -0.2], [0.2, 0.2], 1.0)
    if search is None:
        generator_of_filter = np.random.default_rng([seed, 2])
        search = make_filter(settings or FilterSettings(), FLOOR, generator_of_filter)
    path = []
    for row, y in enumerate(np.arange(-0.15, 2.41, 0.3)):
        line = np.arange(-0.3, 2.41, 0.1)
        path += [(x, y) for x in (line if row % 2 == 0 else line[::-1])]
    error = np.zeros(2)
    for step, (x, y) in enumerate(path + path[::-1]):
        error = 0.95 * error + pose_error * np.sqrt(1 - 0.95**2) * generator.standard_normal(2)
        true_pose = Pose([x, y, 1.0])
        pose = Pose([x + error[0], y + error[1], 1.0])
        seen = targets[true_view.probability(targets, true_pose) > 0.0]
        covariances = None
        if camera:
            deviation = 0.005
            placed = seen + error + deviation * generator.standard_normal(seen.shape)
            values = sensor.measurement.measure(placed, pose)
            jacobian = sensor.measurement.jacobian(placed, pose)
            covariances = deviation**2 * np.einsum('nij,nkj->nik', jacobian, jacobian)
        else:
            values = sensor.measurement.measure(seen, true_pose)
            values += generator.standard_normal(values.shape) * [0.016, 0.052]
            values[:, 1] = wrap_angle(values[:, 1])
        search.step(
            [AgentMeasurement('mambo', pose, sensor, values, covariances, step)], 1, float(step)
        )
    return search, targets
