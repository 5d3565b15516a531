"""Parts of the PHD filter, by quadrature, dense sums and by hand."""

import numpy as np
import pytest
from searches import log_density

from maasi_filter import AgentMeasurement, ExponentialDetection, Pose, Sensor
from maasi_filter.found_targets import FoundTargets, restore
from maasi_filter.geometry.area import Area
from maasi_filter.ic_phd.births import gaussian_births, measurement_births, noise_in_space, resample
from maasi_filter.ic_phd.clusters import clusters_of, kmeans
from maasi_filter.ic_phd.corrector import phd_correct, phd_scan
from maasi_filter.ic_phd.filter import kept_measurements
from maasi_filter.records import FoundTarget

POSE = Pose.from_yaw([40.0, 50.0, 45.0], 0.3)
NOISE = {2: np.diag([2.0, 0.02]), 3: np.diag([2.0, 0.02, 0.03])}


def sensor_of(dimension):
    return Sensor('any', ExponentialDetection(0.9, [20.0] * dimension), NOISE[dimension])


@pytest.mark.parametrize('dimension', [2, 3])
def test_births_weigh_what_the_constant_intensity_predicts(dimension):
    """Sum of b is the integral of (N0 / V) (1 - pi_before) pi p(z | x), here over a fine grid."""
    area = Area([[0.0, 100.0]] * dimension)
    sensor, before = sensor_of(dimension), Pose([70.0, 60.0, 50.0])
    z = np.array([[25.0, 0.6, 0.3][:dimension]])
    member, other = (AgentMeasurement('any', pose, sensor, z) for pose in (POSE, before))
    _, births = measurement_births(member, [other], area, 40_000, np.random.default_rng(0))
    axis = np.linspace(0.5, 99.5, 100)
    grid = np.stack(np.meshgrid(*[axis] * dimension, indexing='ij'), -1).reshape(-1, dimension)
    likelihood = np.exp(log_density(sensor, z, grid, POSE))
    missed = 1.0 - sensor.detection.probability(grid, before)
    chance = sensor.detection.probability(grid, POSE)
    expected = (12.0 / 100.0**dimension * missed * chance * likelihood).sum()
    assert births.sum() == pytest.approx(expected, rel=0.02)


def test_gaussian_births_stand_for_a_constant_intensity():
    """Weights Y / (J p(x)) estimate Y times any volume, here that of a ball in the middle."""
    area = Area([[0.0, 100.0]] * 2)
    centres = np.array([[40.0, 40.0], [60.0, 55.0]])
    particles, weights = gaussian_births(
        centres, 30.0 * np.eye(2), area, 2.0, 200_000, np.random.default_rng(0)
    )
    near = np.linalg.norm(particles - [50.0, 47.0], axis=1) < 5.0
    assert weights[near].sum() == pytest.approx(2.0 / 1e4 * np.pi * 25.0, rel=0.05)
    single, _ = gaussian_births(
        centres[:1], 4.0 * np.eye(2), area, 2.0, 1000, np.random.default_rng(0)
    )
    np.testing.assert_allclose(np.cov(single.T), 4.0 * np.eye(2), atol=0.8)


@pytest.mark.parametrize('dimension', [2, 3])
def test_noise_in_space_is_that_of_drawn_measurements(dimension):
    sensor = sensor_of(dimension)
    precise = Sensor('any', sensor.detection, 1e-4 * NOISE[dimension])
    z = np.array([[25.0, 0.6, 0.3][:dimension]])
    root = np.linalg.cholesky(precise.covariance)
    drawn = z + np.random.default_rng(0).standard_normal((20_000, dimension)) @ root.T
    places = precise.measurement.inverse(drawn, POSE)
    expected = np.cov(places.T)
    spread = noise_in_space(AgentMeasurement('any', POSE, precise, z))
    np.testing.assert_allclose(spread, expected, atol=0.05 * np.trace(expected))


@pytest.mark.parametrize('detections', [0, 1, 40])
@pytest.mark.parametrize('dimension', [2, 3])
def test_the_corrector_is_equation_13(dimension, detections):
    """The factor and C(z) of (13) and (16), summed densely."""
    generator = np.random.default_rng(0)
    root = generator.normal(0.0, 0.1, (dimension, dimension)) + 0.4 * np.eye(dimension)
    detection = ExponentialDetection(0.9, [10.0] * dimension)
    sensor = Sensor('any', detection, root @ root.T)
    pose = Pose.from_yaw(generator.normal(0.0, 3.0, 3), 0.5)
    positions = generator.normal(0.0, 10.0, (5000, dimension))
    weights = generator.random(5000) * 0.01
    values = sensor.measurement.measure(positions[:detections], pose) + 0.05
    background = np.geomspace(1e-6, 1.0, detections)
    scan = phd_scan(values, sensor, pose)
    factor, normaliser = phd_correct(positions, weights, scan, background)
    probability = detection.probability(positions, pose)
    psi = probability * np.exp(log_density(sensor, values, positions, pose))
    expected = background + (psi * weights).sum(axis=1)
    np.testing.assert_allclose(normaliser, expected, rtol=1e-9)
    missed = 1.0 - probability
    np.testing.assert_allclose(factor, missed + (psi / expected[:, None]).sum(axis=0), rtol=1e-9)


def test_copies_are_in_proportion_to_the_weights():
    generator = np.random.default_rng(0)
    weights = np.array([0.0, 1.0, 2.0, 0.0, 5.0, 2.0, 0.0])
    counts = np.zeros(7)
    for _ in range(400):
        index = resample(weights, 50, generator)
        assert (np.diff(index) >= 0).all()
        counts += np.bincount(index, minlength=7)
    np.testing.assert_array_equal(counts[weights == 0.0], 0.0)
    np.testing.assert_allclose(counts / 400, 50 * weights / 10.0, rtol=0.05)


@pytest.mark.parametrize('in_order', [True, False])
@pytest.mark.parametrize('dimension', [2, 3])
def test_kmeans_compares_all_particles_with_all_centres(dimension, in_order):
    """As plain loops do: parts of particles that are left out have the same nearest centre."""
    generator = np.random.default_rng(0)
    cloud = generator.integers(0, 5, 3000)
    cloud = np.sort(cloud) if in_order else cloud
    particles = 9.0 * generator.random((5, dimension))[cloud]
    particles += generator.normal(size=particles.shape)
    weights, expected = generator.random(3000), particles[generator.choice(3000, 7)]
    label, centres = kmeans(particles, weights, 7, generator, expected, 12)
    for _ in range(12):
        nearest = np.square(particles[:, None] - expected).sum(axis=2).argmin(axis=1)
        groups = [nearest == g for g in range(7)]
        means = [np.average(particles[g], axis=0, weights=weights[g]) for g in groups]
        expected = np.array(means)
    np.testing.assert_array_equal(label, nearest)
    np.testing.assert_allclose(centres, expected, rtol=1e-12)


def test_kmeans_of_one_point_many_times_over_ends():
    particles = np.ones((50, 3))
    label, centres = kmeans(particles, np.ones(50), 4, np.random.default_rng(0), np.empty((0, 3)))
    clusters = clusters_of(particles, np.ones(50), label, centres)
    assert sum(cluster.mass for cluster in clusters.values()) == pytest.approx(50.0)


def found_at(*positions):
    return [
        FoundTarget(number, np.array(position), np.eye(2), 'own', 0, 1.0)
        for number, position in enumerate(positions, start=1)
    ]


def test_papers_remove_the_closest_and_003_every_detection():
    centres = np.array([[1.0, 0.0], [0.5, 0.0], [8.0, 0.0], [10.2, 0.0]])
    found = found_at([0.0, 0.0], [10.0, 0.0], [50.0, 0.0])
    assert kept_measurements(centres, found, 5.0, False).tolist() == [True, False, True, False]
    assert kept_measurements(centres, found, 5.0, True).tolist() == [False] * 4
    assert kept_measurements(centres, [], 5.0, True).all()


def test_targets_kept_over_a_restart_keep_their_ids_unless_taken():
    known = FoundTargets(found_at([0.0, 0.0]), 1)
    same, other = found_at([0.1, 0.0], [40.0, 0.0])
    assert not restore(known, [same])
    change = restore(known, [other, FoundTarget(1, np.full(2, 80.0), np.eye(2), 'own', 0, 1.0)])
    assert [target.id for target in change.changed] == [2, 3]
    assert change.found.next_id() == 4
    assert known.last_id == len(known.targets) == 1
