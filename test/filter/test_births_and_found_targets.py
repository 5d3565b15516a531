"""Births, clusters, found targets: densities by quadrature, gates and removal by hand."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from maasi_filter import (
    Exploration,
    ExponentialDetection,
    Pose,
    RangeBearing,
    RangeBearingElevation,
)
from maasi_filter.ic_phd.births import (
    gaussian_births,
    measurement_births,
    thin_births,
    uniform_births,
)
from maasi_filter.ic_phd.clusters import group_clusters, kmeans, kmeans_clusters
from maasi_filter.ic_phd.found_targets import (
    exclusive,
    extended_information,
    found_intensity,
    refine,
    remove_measurements,
)
from maasi_filter.metrics import normalised_error
from maasi_filter.models.measurement_set import prepare_measurements

POSE = Pose.from_yaw([40.0, 50.0, 45.0], 0.3)
MODELS = {2: RangeBearing(), 3: RangeBearingElevation()}
NOISE = {2: np.diag([2.0, 0.02]), 3: np.diag([2.0, 0.02, 0.03])}


def prepared(values, dimension, pose=POSE):
    values = np.array(values, float)
    noise = np.broadcast_to(NOISE[dimension], (len(values), dimension, dimension))
    return prepare_measurements(values, noise, pose)


@pytest.mark.parametrize('dimension', [2, 3])
def test_births_weigh_what_the_unseen_intensity_predicts(dimension):
    """Sum of b is the integral of (N0 / V) e(x) pi(x) p(z | x), here over a fine grid."""
    bounds = np.array([[0.0, 100.0]] * dimension)
    exploration = Exploration(bounds, 5.0)
    detection = ExponentialDetection(0.9, [20.0] * dimension)
    exploration.update(detection, Pose([70.0, 60.0, 50.0]))
    z = np.array([[25.0, 0.6, 0.3][:dimension]])
    births = measurement_births(
        prepared(z, dimension), POSE, detection, exploration, 12.0, 40_000,
        np.random.default_rng(0),
    )  # fmt: skip
    axis = np.linspace(0.5, 99.5, 100)
    grid = np.stack(np.meshgrid(*[axis] * dimension, indexing='ij'), -1).reshape(-1, dimension)
    likelihood = np.exp(MODELS[dimension].log_density(z[0], grid, POSE, NOISE[dimension]))
    intensity = 12.0 / 100.0**dimension * exploration.at(grid)
    expected = (intensity * detection.probability(grid, POSE) * likelihood).sum()
    assert births.totals[0] == pytest.approx(expected, rel=0.02)
    assert births.intensity.sum() == pytest.approx(births.totals[0])


def test_births_outside_the_bounds_count_nothing():
    bounds = np.array([[0.0, 100.0]] * 2)
    births = measurement_births(
        prepared([[60.0, np.pi, ]], 2),
        POSE,
        ExponentialDetection(0.9, [20.0, 20.0]),
        Exploration(bounds, 5.0),
        12.0,
        500,
        np.random.default_rng(0),
    )  # fmt: skip
    assert births.totals[0] == 0.0
    assert not births.inside[0]


def test_thinned_births_keep_the_mass_and_the_place():
    births = measurement_births(
        prepared([[25.0, 0.6, 0.3], [30.0, -0.6, 0.0]], 3),
        POSE,
        ExponentialDetection(0.9, [20.0] * 3),
        Exploration([[0.0, 100.0]] * 3, 5.0),
        12.0,
        2000,
        np.random.default_rng(0),
    )
    mass = np.array([0.3, 0.9])
    particles, weights, group = thin_births(
        births, mass, np.array([300, 900]), 1200, 7, np.random.default_rng(0)
    )
    for m in range(2):
        mine = group == 7 + m
        assert weights[mine].sum() == pytest.approx(mass[m])
        own = slice(births.starts[m], births.starts[m + 1])
        mean = np.average(births.particles[own], axis=0, weights=births.intensity[own])
        np.testing.assert_allclose(particles[mine].mean(axis=0), mean, atol=0.4)


def test_uniform_births_fill_the_environment():
    bounds = np.array([[0.0, 10.0], [5.0, 6.0]])
    particles, weights = uniform_births(bounds, 0.7, 5000, np.random.default_rng(0))
    assert weights.sum() == pytest.approx(0.7)
    np.testing.assert_allclose(particles.mean(axis=0), [5.0, 5.5], atol=0.1)


def test_gaussian_births_stand_for_a_constant_intensity():
    """Weights Y / (J p(x)) estimate Y times any volume, here that of a ball in the middle."""
    bounds = np.array([[0.0, 100.0]] * 2)
    centres = np.array([[40.0, 40.0], [60.0, 55.0]])
    particles, weights = gaussian_births(
        centres, 30.0 * np.eye(2), bounds, 2.0, 200_000, np.random.default_rng(0)
    )
    near = np.linalg.norm(particles - [50.0, 47.0], axis=1) < 5.0
    assert weights[near].sum() == pytest.approx(2.0 / 1e4 * np.pi * 25.0, rel=0.05)
    single, _ = gaussian_births(
        centres[:1], 4.0 * np.eye(2), bounds, 2.0, 1000, np.random.default_rng(0)
    )
    np.testing.assert_allclose(np.cov(single.T), 4.0 * np.eye(2), atol=0.8)


@pytest.mark.parametrize('dimension', [2, 3])
def test_soft_gate_is_a_gaussian_in_measurement_space(dimension):
    model = MODELS[dimension]
    positions = POSE.position[:dimension] + np.array([[20.0, 5.0, 3.0][:dimension]])
    covariance = np.diag([1.0, 2.0, 3.0][:dimension])
    z = model.measure(positions, POSE) + 0.1
    value = found_intensity(
        positions, covariance[None], np.array([0.6]), np.array([0.1]),
        prepared(z, dimension), POSE, odds=False,
    )  # fmt: skip
    jacobian = model.jacobian(positions, POSE)[0]
    spread = jacobian @ covariance @ jacobian.T + NOISE[dimension]
    expected = 0.6 * multivariate_normal(np.zeros(dimension), spread).pdf(
        model.residual(z, model.measure(positions, POSE))[0]
    )
    assert value[0, 0] == pytest.approx(expected)
    odds = found_intensity(
        positions, covariance[None], np.array([0.6]), np.array([0.1]), prepared(z, dimension), POSE
    )
    assert odds[0, 0] == pytest.approx(expected / 0.4)


def test_a_found_target_causes_one_detection_at_most():
    kappa = np.array([[5.0, 4.0]])
    out = exclusive(kappa, np.array([0.5, 1.0]))
    assert out[0, 0] == 5.0
    assert out[0, 1] == pytest.approx(4.0 * (1.0 - 5.0 / 5.5))
    assert exclusive(kappa[:, :1], np.ones(1)) is not None


@pytest.mark.parametrize('dimension', [2, 3])
def test_refinement_is_a_kalman_update_where_the_model_is_straight(dimension):
    model = MODELS[dimension]
    position = POSE.position[:dimension] + np.array([60.0, 20.0, 10.0][:dimension])
    covariance = 0.01 * np.eye(dimension)
    z = model.measure(position[None], POSE) + 0.01
    new, spread = refine(position, covariance, prepared(z, dimension), 0, POSE)
    jacobian = model.jacobian(position[None], POSE)[0]
    information = (
        np.linalg.inv(covariance) + jacobian.T @ np.linalg.inv(NOISE[dimension]) @ jacobian
    )
    np.testing.assert_allclose(spread, np.linalg.inv(information), rtol=1e-3, atol=1e-8)
    gain = spread @ jacobian.T @ np.linalg.inv(NOISE[dimension])
    np.testing.assert_allclose(new, position + gain @ np.full(dimension, 0.01), atol=1e-5)


@pytest.mark.parametrize('dimension', [2, 3])
@pytest.mark.parametrize('offset', [(4.0, 3.0, 4.0), (5.0, -2.0, 0.0)])
def test_refinement_next_to_the_robot_has_the_moments_of_the_posterior(dimension, offset):
    """Against many draws with the likelihood as weight."""
    model = MODELS[dimension]
    position = POSE.position[:dimension] + np.array(offset[:dimension])
    root = np.array([[1.2, 0.0, 0.0], [0.6, 1.0, 0.0], [-0.3, 0.4, 1.5]])[:dimension, :dimension]
    truth = position + root @ np.array([0.8, -0.5, 0.6][:dimension])
    z = model.measure(truth[None], POSE) + 0.1
    new, spread = refine(position, root @ root.T, prepared(z, dimension), 0, POSE)
    draws = np.random.default_rng(0).normal(size=(400_000, dimension))
    draws = position + draws @ root.T
    weights = np.exp(model.log_density(z[0], draws, POSE, NOISE[dimension]))
    mean = np.average(draws, axis=0, weights=weights)
    covariance = np.cov(draws.T, aweights=weights)
    assert normalised_error(new - mean, covariance) < 0.3**2
    np.testing.assert_allclose(spread, covariance, atol=0.15 * np.trace(covariance))


def test_refinement_leaves_strangers_alone():
    spread = np.eye(3)
    far = POSE.position + np.array([40.0, 0.0, 0.0])
    assert refine(far, spread, prepared([[70.0, 1.0, 0.0]], 3), 0, POSE)[0] is far
    near = POSE.position + np.array([3.0, 0.0, 0.0])
    assert refine(near, spread, prepared([[15.0, 1.0, 0.0]], 3), 0, POSE)[0] is near


@pytest.mark.parametrize('dimension', [2, 3])
def test_a_detection_adds_to_what_is_known_of_its_target_and_of_no_other(dimension):
    model = MODELS[dimension]
    here = POSE.position[:dimension] + np.array([40.0, 10.0, 5.0][:dimension])
    known = np.eye(dimension)[None]
    for shift, inherits in ((3.0, True), (5.0, False)):
        place = here + np.array([0.0, shift, 0.0][:dimension])
        z = model.measure(place[None], POSE)
        information, places = extended_information(
            known,
            here[None],
            place[None],
            np.array([[0.9]]),
            np.array([0.9]),
            prepared(z, dimension),
            POSE,
        )
        jacobian = model.jacobian(place[None], POSE)[0]
        own = jacobian.T @ np.linalg.inv(NOISE[dimension]) @ jacobian
        np.testing.assert_allclose(information[1], own + inherits * known[0], atol=1e-9)
        np.testing.assert_array_equal(information[0], known[0])
        np.testing.assert_allclose(places, [here, place])


def test_what_few_particles_explain_is_placed_by_its_detection():
    model = MODELS[3]
    place = POSE.position + np.array([40.0, 10.0, 5.0])
    z = model.measure(place[None], POSE)
    information, places = extended_information(
        np.zeros((0, 3, 3)),
        np.zeros((0, 3)),
        POSE.position[None] - 100.0,
        np.zeros((0, 1)),
        np.array([0.01]),
        prepared(z, 3),
        POSE,
    )
    jacobian = model.jacobian(place[None], POSE)[0]
    np.testing.assert_allclose(places, place[None])
    np.testing.assert_allclose(
        information[0], jacobian.T @ np.linalg.inv(NOISE[3]) @ jacobian, atol=1e-9
    )


def test_papers_remove_the_closest_and_003_every_detection():
    centres = np.array([[1.0, 0.0], [0.5, 0.0], [8.0, 0.0], [10.2, 0.0]])
    found = np.array([[0.0, 0.0], [10.0, 0.0], [50.0, 0.0]])
    closest = remove_measurements(centres, found, 5.0, every=False)
    assert closest.tolist() == [True, False, True, False]
    every = remove_measurements(centres, found, 5.0, every=True)
    assert every.tolist() == [False, False, False, False]
    assert remove_measurements(centres, found[:0], 5.0, every=True).all()


def test_kmeans_separates_clouds_and_keeps_a_warm_start():
    generator = np.random.default_rng(0)
    centres = np.array([[0.0, 0.0], [10.0, 0.0], [0.0, 10.0]])
    label = np.repeat(np.arange(3), 200)
    particles = centres[label] + generator.normal(size=(600, 2))
    weights = np.full(600, 3.0 / 600)
    found, means = kmeans(particles, weights, 3, generator, start=centres)
    np.testing.assert_array_equal(found, label)
    _, cold_means = kmeans(particles, weights, 3, generator)
    np.testing.assert_allclose(np.sort(cold_means, axis=0), np.sort(means, axis=0), atol=0.1)
    clusters, labels = kmeans_clusters(particles, weights, found, 3)
    assert labels.tolist() == [0, 1, 2]
    for cluster, c in zip(clusters, range(3)):
        member = particles[label == c]
        assert cluster.mass == pytest.approx(1.0)
        np.testing.assert_allclose(cluster.covariance, np.cov(member.T, bias=True), atol=1e-9)
        assert cluster.radius == pytest.approx(np.sqrt(np.trace(np.cov(member.T, bias=True))))
    largest, _ = kmeans_clusters(particles, weights, found, 3, largest=True)
    member = particles[label == 0]
    far = np.linalg.norm(member - member.mean(axis=0), axis=1).max()
    assert largest[0].radius == pytest.approx(far)


def test_kmeans_of_one_point_many_times_over_ends():
    particles = np.ones((50, 3))
    label, _ = kmeans(particles, np.ones(50), 4, np.random.default_rng(0))
    clusters, _ = kmeans_clusters(particles, np.ones(50), label, 4)
    assert sum(cluster.mass for cluster in clusters) == pytest.approx(50.0)


def test_what_is_left_of_a_group_joins_the_cluster_at_its_place():
    mass = np.array([0.3, 1.0, 0.8, 0.01])
    means = np.array([[0.1, 0.0], [0.0, 0.0], [20.0, 0.0], [90.0, 0.0]])
    covariances = np.array([np.eye(2)] * 4)
    clusters = group_clusters(mass, means, covariances, 0.1, 0.5)
    assert [cluster.mass for cluster in clusters] == pytest.approx([1.3, 0.8])
    np.testing.assert_allclose(clusters[0].position, [0.3 * 0.1 / 1.3, 0.0])
    np.testing.assert_array_equal(mass, [0.3, 1.0, 0.8, 0.01])
