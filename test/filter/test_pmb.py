"""The Poisson multi-Bernoulli filter against closed forms and exact posteriors."""

from dataclasses import replace

import numpy as np
import pytest
from exact_pmbm import ExactPmbm
from searches import (
    CUBE,
    PLANE,
    SIDE,
    cells,
    checked,
    cube_sensor,
    densities,
    measured,
    plane_filter,
    plane_sensor,
)

from maasi_filter import AgentMeasurement, FilterSettings, Pose, UnexploredMap, wrap_angle
from maasi_filter.models.sensor import LEAST_PER_SCAN
from maasi_filter.pmb.component import Component, is_known, reflects
from maasi_filter.pmb.density import Density
from maasi_filter.pmb.filter import PmbFilter
from maasi_filter.pmb.learnt import PRIOR_SCANS, Learnt
from maasi_filter.pmb.scan import make_scan
from maasi_filter.records import FoundTarget, Label

TARGET = np.array([[60.0, 45.0]])
# Where the robot measures from, in turn.
PLACES = [(30.0, 30.0), (50.0, 70.0), (80.0, 20.0), (40.0, 50.0)]
# Enough for one target not to be taken for another.
PRECISE = plane_sensor(range_noise=0.5, bearing=0.01)
MANY_DRAWS = FilterSettings(method='pmb', pmb={'particles': 20_000}).resolved()


def observe(generator, sensor, targets, position):
    """Return noisy values of all targets."""
    values = sensor.measurement.measure(targets, Pose(np.asarray(position, float)))
    noise = np.sqrt(np.diagonal(sensor.covariance))
    return values + noise * generator.standard_normal(values.shape)


def look(search, sensor, targets, places, first=0):
    """Let a robot see all targets from one place after the other; return the last result."""
    generator = np.random.default_rng(0)
    for step, place in enumerate(places, start=first):
        values = observe(generator, sensor, targets, place)
        result = search.step([measured(sensor, place, values, step)], 1, float(step))
    return result


def test_one_target_without_clutter_is_the_bayesian_posterior():
    generator = np.random.default_rng(3)
    sensor = plane_sensor()
    search = plane_filter(particles=4000)
    exact = np.ones(SIDE**2)
    for step, place in enumerate(PLACES):
        values = observe(generator, sensor, TARGET, place)
        search.step([measured(sensor, place, values, step)], 1, step)
        probability, likelihood = densities(sensor, place, values)
        exact = exact * probability * likelihood[0]
    best = max(search.components, key=lambda item: item.existence)
    exact /= exact.sum()
    mean, covariance = exact @ cells(), np.cov(cells().T, aweights=exact, ddof=0)
    assert best.existence > 0.99
    largest = np.diagonal(covariance).max()
    np.testing.assert_allclose(best.density.mean, mean, atol=0.12 * np.sqrt(largest))
    np.testing.assert_allclose(best.density.covariance, covariance, atol=0.12 * largest)


def test_existence_is_that_of_bayes_after_a_detection_and_after_misses():
    sensor = plane_sensor(clutter=2e-4)
    search = plane_filter(particles=4000)
    place, values = PLACES[0], [[30.0, 0.5]]
    search.step([measured(sensor, place, values)], 1, 0.0)
    probability, likelihood = densities(sensor, place, values)
    density = probability * likelihood[0]
    intensity = 3.0 / SIDE**2 * density.sum()
    kappa = max(2e-4, LEAST_PER_SCAN / sensor.measurement_space(PLANE))
    (item,) = search.components
    assert item.existence == pytest.approx(intensity / (intensity + kappa), rel=0.03)
    r = item.existence
    for step in range(1, 6):
        density = density / density.sum()
        expected = (density * (1.0 - probability)).sum()
        r = r * expected / (1.0 - r + r * expected)
        density = density * (1.0 - probability)
        search.step([measured(sensor, place, [], step)], 1, step)
        (item,) = search.components
        assert item.existence == pytest.approx(r, rel=0.02)


def test_unseen_targets_are_thinned_as_the_exploration_function_says():
    sensor = plane_sensor()
    search = plane_filter()
    other = UnexploredMap(PLANE, 2.0)
    for step, place in enumerate(PLACES):
        search.step([measured(sensor, place, [], step)], 1, step)
        other.update(sensor.detection, Pose(np.array(place)))
    np.testing.assert_array_equal(search.exploration.values, other.values)
    # New targets: lambda = (N0 / V) int e pi g dx, here by a sum over cells.
    value = sensor.measurement.measure(np.array([[50.0, 30.0]]), Pose(np.array(PLACES[0])))
    probability, likelihood = densities(sensor, PLACES[0], value)
    expected = 3.0 / SIDE**2 * (search.exploration.at(cells()) * probability * likelihood[0]).sum()
    member = checked(measured(sensor, PLACES[0], value))
    scan = make_scan(member, 1.0, search.exploration, MANY_DRAWS, np.random.default_rng(0))
    assert scan.intensity[0] == pytest.approx(expected, rel=0.02)


def test_clutter_is_learnt_as_a_gamma_prior_says():
    learnt = Learnt()
    assert learnt.clutter_per_scan(2.0) == 2.0
    for _ in range(40):
        learnt.count_clutter(3.0)
    assert learnt.clutter_per_scan(0.05) == pytest.approx(
        (PRIOR_SCANS * 0.05 + 120.0) / (PRIOR_SCANS + 40)
    )


@pytest.mark.parametrize(
    ('targets', 'tolerance'),
    [
        ([[20.0, 30.0], [70.0, 60.0], [60.0, 20.0]], 0.03),
        ([[60.0, 45.0], [68.0, 50.0]], 0.10),
        ([[60.0, 45.0], [63.0, 48.0], [58.0, 50.0]], 0.12),
    ],
)
def test_close_to_the_exact_mixture(targets, tolerance):
    """At most three targets, three scans with misses and clutter: expected numbers by region."""
    targets = np.array(targets)
    worst = []
    for seed in range(4):
        generator = np.random.default_rng([seed, 8])
        # The exact filter knows of no resolution.
        sensor = replace(plane_sensor(clutter=2e-4), resolution=0.0)
        search = plane_filter(seed=seed, particles=2000)
        exact = ExactPmbm(np.full(SIDE**2, 3.0 / SIDE**2))
        for step, place in enumerate(PLACES[:3]):
            seen = targets[generator.random(len(targets)) < 0.8]
            values = observe(generator, sensor, seen, place)
            if step == seed % 3 and len(values) < 3:
                false = [generator.uniform(5.0, 40.0), generator.uniform(-3.0, 3.0)]
                values = np.concatenate([values, [false]])
            space = sensor.measurement_space(PLANE)
            learnt = search._learnt.get('robot', Learnt())
            kappa = learnt.clutter_per_scan(max(sensor.clutter * space, 0.05)) / space
            search.step([measured(sensor, place, values, step)], 1, step)
            exact.update(*densities(sensor, place, values), kappa)
        density = exact.density()
        total = sum(item.existence for item in search.components)
        assert total == pytest.approx(density.sum(), abs=3.0 * tolerance)
        for target in targets:
            near = np.linalg.norm(cells() - target, axis=1) < 12.0
            ours = 0.0
            for item in search.components:
                inside = np.linalg.norm(item.density.particles - target, axis=1) < 12.0
                ours += item.existence * float(item.density.weights[inside].sum())
            worst.append(abs(ours - density[near].sum()))
    assert np.mean(worst) < tolerance
    assert max(worst) < 3.0 * tolerance


def test_precise_detection_of_a_sparse_cloud_makes_no_duplicate():
    coarse = plane_sensor(range_noise=20.0, bearing=0.6)
    fine = plane_sensor(range_noise=0.02, bearing=0.0005)
    search = plane_filter(particles=300)
    for step in range(6):
        sensor = coarse if step == 0 else fine
        place = PLACES[step % 4]
        values = sensor.measurement.measure(TARGET, Pose(np.array(place)))
        search.step([measured(sensor, place, values, step)], 1, step)
        assert len([item for item in search.components if item.existence > 0.1]) == 1
    (target,) = search.found_targets
    assert np.linalg.norm(target.position - TARGET[0]) < 0.2


@pytest.mark.parametrize(
    ('resolution', 'identities', 'repeated'),
    [(1.0, 'aac', 1), (0.0, 'aac', 0), (1.0, 'abc', 0), (3.0, 'aaa', 2)],
)
def test_a_detection_that_comes_twice_is_one_by_the_resolution_of_the_sensor(
    resolution, identities, repeated
):
    sensor = replace(plane_sensor(), resolution=resolution)
    deviations = np.sqrt(np.diagonal(sensor.covariance))
    values = np.array([40.0, -np.pi]) + np.array([[0.0, 0.0], [0.3, -0.3], [2.0, 2.0]]) * deviations
    # Bearings on both sides of the same direction.
    values[:, 1] = wrap_angle(values[:, 1])
    member = measured(sensor, (60.0, 50.0), values)
    member.labels = [Label(identity=name) for name in identities]
    assert plane_filter().step([member], 1, 0.0).dropped.get('repeated', 0) == repeated


@pytest.mark.parametrize(('misses', 'existence'), [(37, None), (1, 0.6)])
def test_found_target_that_is_missed_again_and_again_is_withdrawn(misses, existence):
    """As a reflection, or as it hardly exists."""
    search = plane_filter(particles=300)
    look(search, PRECISE, TARGET, PLACES[:1] * 3)
    assert len(search.found_targets) == 1
    search.components[0].existence = existence or search.components[0].existence
    results = [look(search, PRECISE, TARGET[:0], [(58.0, 45.0)], 3 + n) for n in range(misses)]
    assert any(result.found_changed for result in results)
    assert search.found_targets == []


def test_one_detection_alone_is_no_found_target_however_certain():
    sensor = plane_sensor()
    search = plane_filter(particles=300, expected_targets=1000.0, found_radius=50.0)
    value = sensor.measurement.measure(TARGET, Pose(np.array(PLACES[0])))
    # The second scan, from far away, hardly tells anything.
    for step, (place, values, found) in enumerate(
        [(PLACES[0], value, 0), ((0.0, 99.0), [], 0), (PLACES[0], value, 1)]
    ):
        search.step([measured(sensor, place, values, step)], 1, step)
        assert search.components[0].existence > 0.99
        assert len(search.found_targets) == found


@pytest.mark.parametrize(('caused', 'known'), [(0.7, True), (0.8, False)])
def test_two_that_cause_two_detections_of_a_scan_are_two_targets(caused, known):
    frame = np.array([[-9.0, -9.0, 0.0], [9.0, 9.0, 0.0], [1.0, 1.0, 0.0]])
    density = Density.normal(np.zeros(2), np.eye(2), 100, frame, np.random.default_rng(0))
    target = FoundTarget(1, density.mean, density.covariance, 'robot', 0, 0.0)
    found = Component(1.0, density, 5.0, 0, 0.0, 1.0, target=target)
    other = Component(1.0, density, 5.0, 1, 0.0, 1.0)
    assert is_known(1, [found, other], np.array([caused, caused]), [0]) == known


def answering(share, targets, scans=80, seed=0, later=None):
    """Return a filter, and which places it found that answer with a share of pi, later another."""
    generator = np.random.default_rng(seed)
    search = plane_filter(seed=seed, expected_targets=5.0)
    for step in range(scans):
        place = generator.uniform(20.0, 80.0, 2)
        pose = Pose(place)
        share = later if later and step == 20 else share
        chance = np.asarray(share) * PRECISE.detection.probability(targets, pose)
        seen = targets[generator.random(len(targets)) < chance]
        values = observe(generator, PRECISE, seen, place)
        search.step([measured(PRECISE, place, values, step)], 1, step)
    found = np.array([target.position for target in search.found_targets]).reshape(-1, 2)
    gaps = np.linalg.norm(targets[:, None] - found[None], axis=2)
    return search, (gaps < 3.0).any(axis=1).tolist()


FOUR = np.array([[20.0, 30.0], [70.0, 60.0], [60.0, 20.0], [30.0, 75.0]])


@pytest.mark.parametrize('seed', range(2))
def test_a_place_that_answers_too_rarely_is_not_found_unless_all_do(seed):
    assert answering(0.5, FOUR, seed=seed)[1] == [True] * 4
    search, found = answering([1.0, 1.0, 1.0, 0.3], FOUR, seed=seed)
    assert found == [True, True, True, False]
    # It is hardly worth another look.
    assert sum(cluster.mass for cluster in search.clusters) < 0.5


@pytest.mark.parametrize('seed', range(8))
def test_what_exists_for_sure_is_looked_at_again_until_it_is_found_or_surely_a_reflection(seed):
    generator = np.random.default_rng(seed)
    search, doubtful = plane_filter(seed=seed, particles=300), 0
    chance = generator.uniform(0.4, 0.9)
    for step in range(40):
        seen = TARGET[generator.random(1) < chance]
        look(search, PRECISE, seen, [(58.0, 45.0)], step)
        masses = [cluster.mass for cluster in search.clusters]
        for item in search.potential:
            reflecting = reflects(item.answers, search._rates)
            if item.existence > 0.99 and item.hits >= 2.0 and reflecting < 0.95:
                doubtful += reflecting >= 0.3
                assert item.existence in masses
    # Otherwise it asserts nothing.
    assert doubtful or search.found_targets


def test_found_target_that_answers_too_rarely_is_withdrawn():
    _, found = answering(1.0, FOUR, scans=20)
    assert found == [True] * 4
    search, found = answering(1.0, FOUR, scans=100, later=[1.0, 1.0, 1.0, 0.3])
    assert found == [True, True, True, False]
    # Its detections restore its existence.
    assert sum(item.existence > 0.9 for item in search.components) == 4


def test_walking_targets_widen_and_spread_what_is_unexplored():
    settings = FilterSettings(method='pmb', pmb={'particles': 1000, 'walk': 0.5})
    search = PmbFilter(settings, PLANE, np.random.default_rng(0))
    look(search, PRECISE, TARGET, PLACES[:1] * 3)
    before = search.found_targets[0].covariance
    total = search.exploration.values.sum()
    search.step([], 1, 12.0)
    after = search.found_targets[0].covariance
    np.testing.assert_allclose(after - before, 0.25 * 10.0 * np.eye(2), atol=0.6)
    assert search.exploration.values.sum() == pytest.approx(total, rel=1e-12)
    assert search.exploration.values.min() > 0.0


def test_noise_of_a_camera_is_cartesian_next_to_the_robot():
    sensor, search = plane_sensor(range_noise=0.1), plane_filter()
    pose, place = Pose([50.0, 50.0, 1.0]), np.array([[50.002, 50.003]])
    jacobian = sensor.measurement.jacobian(place, pose)
    covariances = 0.005**2 * jacobian @ jacobian.swapaxes(1, 2)
    values = sensor.measurement.measure(place, pose)
    member = checked(AgentMeasurement('robot', pose, sensor, values, covariances))
    scan = make_scan(member, 1.0, search.exploration, MANY_DRAWS, np.random.default_rng(0))
    np.testing.assert_allclose(scan.means, place, atol=2e-4)
    np.testing.assert_allclose(scan.covariances[0], 0.005**2 * np.eye(2), atol=2e-6)


@pytest.mark.parametrize('seed', range(20))
def test_clutter_that_is_uniform_in_the_area_is_so_in_measurements(seed):
    generator = np.random.default_rng(seed)
    bounds = (PLANE, CUBE)[seed % 2]
    sensor = plane_sensor() if seed % 2 == 0 else cube_sensor()
    sensor.clutter_in = 'area'
    pose = Pose.from_yaw(generator.uniform(0.0, 100.0, 3), generator.uniform(-3.0, 3.0))
    positions = generator.uniform(*bounds.T, (50, len(bounds)))
    values = sensor.measurement.measure(positions, pose)
    jacobians = sensor.measurement.jacobian(positions, pose)
    volume = (bounds[:, 1] - bounds[:, 0]).prod()
    expected = 3.0 / volume / np.abs(np.linalg.det(jacobians))
    np.testing.assert_allclose(sensor.clutter_at(values, 3.0, bounds), expected, rtol=1e-6)
