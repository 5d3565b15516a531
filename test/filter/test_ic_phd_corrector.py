"""The PHD corrector against its equations, summed densely."""

from __future__ import annotations

import numpy as np
import pytest
from searches import log_density

from maasi_filter import (
    AgentMeasurement,
    DetectionSettings,
    ExponentialDetection,
    FilterSettings,
    IcPhdFilter,
    NoiseSettings,
    Pose,
    Sensor,
    SensorSettings,
)
from maasi_filter.ic_phd.corrector import make_scan, phd_correct

SIDE = 40.0
BOUNDS = np.array([[0.0, SIDE]] * 2)


def sensor_of(dimension, generator, probability=0.9):
    root = generator.normal(0.0, 0.1, (dimension, dimension)) + 0.4 * np.eye(dimension)
    detection = ExponentialDetection(probability, [10.0] * dimension)
    return Sensor.ranging('any', detection, root @ root.T)


def case(dimension, seed=0, particles=500, detections=4):
    """Return a sensor, its pose, a cloud with weights, detections, and a background."""
    generator = np.random.default_rng(seed)
    sensor = sensor_of(dimension, generator)
    pose = Pose.from_yaw(generator.normal(0.0, 3.0, 3), 0.5)
    positions = generator.normal(0.0, 10.0, (particles, dimension))
    weights = generator.random(particles) * 0.01
    values = sensor.measurement.measure(positions[:detections], pose) + 0.05
    return sensor, pose, positions, weights, values, np.geomspace(1e-6, 1.0, detections)


def dense(sensor, pose, positions, weights, values, background):
    """Return the factor and C(z) of (13) and (16), term by term."""
    probability = sensor.detection.probability(positions, pose)
    likelihood = np.exp(log_density(sensor, values, positions, pose))
    psi = probability * likelihood
    normaliser = background + (psi * weights).sum(axis=1)
    return 1.0 - probability + (psi / normaliser[:, None]).sum(axis=0), normaliser


@pytest.mark.parametrize('detections', [1, 4, 40])
@pytest.mark.parametrize('dimension', [2, 3])
def test_the_corrector_is_equation_13(dimension, detections):
    parts = case(dimension, particles=5000, detections=detections)
    sensor, pose, positions, weights, values, background = parts
    scan = make_scan(values, sensor, pose)
    factor, normaliser = phd_correct(positions, weights, scan, background)
    expected = dense(*parts)
    np.testing.assert_allclose(factor, expected[0], rtol=1e-9)
    np.testing.assert_allclose(normaliser, expected[1], rtol=1e-9)


@pytest.mark.parametrize('dimension', [2, 3])
def test_seeing_nothing_leaves_exactly_one_minus_pi(dimension):
    sensor, pose, positions, weights, values, _ = case(dimension)
    scan = make_scan(values[:0], sensor, pose)
    factor, normaliser = phd_correct(positions, weights, scan, np.empty(0))
    np.testing.assert_array_equal(factor, 1.0 - sensor.detection.probability(positions, pose))
    assert normaliser.shape == (0,)


def test_no_particles_leave_a_detection_to_the_background():
    sensor, pose, positions, weights, values, background = case(3)
    scan = make_scan(values, sensor, pose)
    factor, normaliser = phd_correct(positions[:0], weights[:0], scan, background)
    assert factor.shape == (0,)
    np.testing.assert_array_equal(normaliser, background)


# Two robots, births included.

N0 = 12.0
TARGETS = np.array([[16.0, 20.0], [30.0, 24.0], [12.0, 8.0]])
# Which robot sees which target; the third is known already.
SEEN = {'one': [0, 2], 'two': [0, 1, 2]}
POSES = {'one': Pose([10.0, 14.0, 0.0]), 'two': Pose([24.0, 14.0, 0.0])}
SENSOR = SensorSettings(
    detection=DetectionSettings(kind='exponential', probability=0.9, size=[8.0, 8.0]),
    noise=NoiseSettings(range=1.5, bearing=0.12),
    clutter=1e-3,
).build('any', 2)


def known_cloud():
    generator = np.random.default_rng(5)
    return TARGETS[2] + generator.normal(0.0, 1.5, (3000, 2)), np.full(3000, 0.8 / 3000)


def detections(name):
    return SENSOR.measurement.measure(TARGETS[SEEN[name]], POSES[name])


def literal():
    """Return points and masses after (16) of 000, without what nobody detected.

    The constant intensity Y is summed over a fine grid. Its part Y prod(1 - pi) stays background:
    the filter has it in the intensity of births, not in particles.
    """
    cells = 800
    axis = (np.arange(cells) + 0.5) * SIDE / cells
    grid = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    cloud, weights = known_cloud()
    points = np.vstack([cloud, grid])
    intensity = np.concatenate([weights, np.full(len(grid), N0 / len(grid))])
    background = np.concatenate([np.zeros(len(cloud)), np.full(len(grid), N0 / len(grid))])
    for name in ('one', 'two'):
        probability = SENSOR.detection.probability(points, POSES[name])
        background *= 1.0 - probability
        values = detections(name)
        clutter = np.full(len(values), SENSOR.clutter)
        intensity = intensity * dense(SENSOR, POSES[name], points, intensity, values, clutter)[0]
    return points, intensity - background


def mass_near(points, masses, target):
    return float(masses[np.linalg.norm(points - target, axis=1) < 6.0].sum())


def test_two_robots_correct_as_printed():
    settings = FilterSettings(
        preset='paper_002',
        found_mass=1e9,
        expected_targets=N0,
        particles=400_000,
        particles_per_target=20_000,
        birth_particles=20_000,
        jitter_deviation=0.01,
        kmeans_iterations=1,
    )
    search = IcPhdFilter(settings, BOUNDS, np.random.default_rng(0))
    search.particles, search.weights = known_cloud()
    search.step(
        [AgentMeasurement(name, POSES[name], SENSOR, detections(name)) for name in POSES], 1, 0.0
    )
    points, masses = literal()
    assert search.expected_number == pytest.approx(float(masses.sum()), rel=0.03)
    for target in TARGETS:
        expected = mass_near(points, masses, target)
        assert mass_near(search.particles, search.weights, target) == pytest.approx(
            expected, rel=0.05
        )
