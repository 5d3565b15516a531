"""The update of the weights: Stone Soup, closed forms, and what must not matter."""

import datetime
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import logsumexp

from maasi_filter import ExponentialDetection, Pose, RangeBearing, RangeBearingElevation
from maasi_filter.ic_phd.phd import Workspace, associate, position_measurements
from maasi_filter.models.measurement_set import prepare_measurements
from maasi_filter.vector_math import arctan2, exponential, sines

ORIGIN = Pose([0.0, 0.0, 0.0])
MODELS = {2: RangeBearing(), 3: RangeBearingElevation()}


def polar(values, covariance, pose=ORIGIN, **options):
    covariances = np.broadcast_to(covariance, (len(values), *np.shape(covariance)))
    return prepare_measurements(np.asarray(values, float), covariances, pose, **options)


def dense_update(particles, weights, probability, likelihood, other):
    """Eq. (13) of 000 as it is written, with likelihoods (m, n)."""
    psi = probability * likelihood
    normaliser = other + (psi * weights).sum(axis=1)
    return weights * (1.0 - probability + (psi / normaliser[:, None]).sum(axis=0))


def case(dimension, seed=0, particles=500, detections=4):
    generator = np.random.default_rng(seed)
    pose = Pose.from_yaw(generator.normal(0.0, 3.0, 3), 0.5)
    positions = generator.normal(0.0, 10.0, (particles, dimension))
    weights = generator.random(particles) * 0.01
    probability = ExponentialDetection(0.9, [10.0] * dimension).probability(positions, pose)
    model = MODELS[dimension]
    values = model.measure(positions[:detections], pose) + 0.05
    root = generator.normal(0.0, 0.1, (dimension, dimension)) + 0.4 * np.eye(dimension)
    return positions, weights, probability, pose, model, values, root @ root.T


@pytest.mark.parametrize('dimension', [2, 3])
def test_update_is_equation_13(dimension):
    positions, weights, probability, pose, model, values, covariance = case(dimension)
    other = np.array([0.0, 1e-3, 0.1, 1.0])
    update = associate(
        positions, weights, probability, polar(values, covariance, pose), pose, other
    )
    likelihood = np.exp(model.log_density(values, positions, pose, covariance))
    expected = dense_update(positions, weights, probability, likelihood, other)
    np.testing.assert_allclose(weights * update.factor, expected, rtol=1e-10, atol=1e-16)
    normaliser = other + (probability * likelihood * weights).sum(axis=1)
    np.testing.assert_allclose(np.exp(update.log_normaliser), normaliser, rtol=1e-10)


@pytest.mark.parametrize('correlated', [False, True])
@pytest.mark.parametrize('dimension', [2, 3])
def test_tiles_that_are_left_out_explain_nothing(dimension, correlated):
    """Clouds that lie together, of which a bound rules most out, against the formula itself."""
    generator = np.random.default_rng(4)
    centres = generator.uniform(-60.0, 60.0, (12, dimension))
    positions = np.repeat(centres, 500, axis=0) + generator.normal(0.0, 1.0, (6000, dimension))
    weights = generator.random(6000) * 0.004
    pose = Pose.from_yaw([5.0, -3.0, 2.0], 0.5)
    model = MODELS[dimension]
    probability = ExponentialDetection(0.9, [30.0] * dimension).probability(positions, pose)
    # One of a cloud, one between two, one behind the robot's back, one beyond everything.
    points = np.array([centres[3], 0.5 * (centres[0] + centres[1]), centres[7], centres[5] * 9.0])
    values = model.measure(points, pose)
    covariance = np.diag([0.5, 0.02, 0.05][:dimension]) ** 2
    if correlated:
        covariance[0, 1] = covariance[1, 0] = 0.8 * np.sqrt(covariance[0, 0] * covariance[1, 1])
    other = np.array([0.0, 1e-6, 1e-3, 1e-9])
    update = associate(
        positions, weights, probability, polar(values, covariance, pose), pose, other
    )
    likelihood = np.exp(model.log_density(values, positions, pose, covariance))
    expected = dense_update(positions, weights, probability, likelihood, other)
    np.testing.assert_allclose(update.weights, expected, rtol=1e-10, atol=1e-18)


@pytest.mark.parametrize('dimension', [2, 3])
def test_moments_are_those_of_the_partition_by_measurement(dimension):
    positions, weights, probability, pose, model, values, covariance = case(dimension)
    other = np.full(4, 1e-3)
    group = np.arange(len(weights)) % 5
    update = associate(
        positions,
        weights,
        probability,
        polar(values, covariance, pose),
        pose,
        other,
        group=group,
        groups=5,
    )
    psi = probability * np.exp(model.log_density(values, positions, pose, covariance))
    share = psi * weights / (other + (psi * weights).sum(axis=1))[:, None]
    for m in range(4):
        mean = share[m] @ positions / share[m].sum()
        offset = positions - mean
        np.testing.assert_allclose(update.means[m], mean, rtol=1e-9)
        np.testing.assert_allclose(
            update.covariances[m], (share[m] * offset.T) @ offset / share[m].sum(), rtol=1e-6
        )
        np.testing.assert_allclose(update.own_mass[m], share[m].sum(), rtol=1e-10)
        np.testing.assert_allclose(
            update.group_share[:, m], np.bincount(group, share[m]), rtol=1e-9, atol=1e-16
        )
    # A particle joins the detection that explains most of it, or that took most of its group.
    most = share.max(axis=0) / update.weights
    clear = np.abs(most - 0.5) > 1e-9
    taken = np.arange(5)
    for g in range(5):
        if update.group_share[g].max() > 0.5 * update.weights[group == g].sum():
            taken[g] = 5 + update.group_share[g].argmax()
    joined = np.where(most > 0.5, 5 + share.argmax(axis=0), taken[group])
    assert (joined >= 5).any() and (joined < 5).any()
    np.testing.assert_array_equal(update.group[clear], joined[clear])


@pytest.mark.parametrize('detections', [0, 1, 5])
def test_weights_equal_stone_soups(detections):
    from stonesoup.models.measurement.linear import LinearGaussian
    from stonesoup.types.array import CovarianceMatrix, StateVector, StateVectors
    from stonesoup.types.detection import Detection, MissedDetection
    from stonesoup.types.hypothesis import SingleHypothesis
    from stonesoup.types.multihypothesis import MultipleHypothesis
    from stonesoup.types.numeric import Probability
    from stonesoup.types.prediction import ParticleStatePrediction
    from stonesoup.updater.particle import SMCPHDUpdater

    generator = np.random.default_rng(3)
    particles = generator.normal(0.0, 5.0, (400, 3))
    weights = generator.random(400) * 0.02
    covariance = np.diag([1.0, 2.0, 0.5]) + 0.2
    values = particles[:detections] + 0.3
    probability, clutter = 0.85, 1e-3

    now = datetime.datetime(2024, 1, 1)

    class Noiseless(LinearGaussian):
        """Release 1.9.1 adds random noise to what it predicts before it evaluates the density."""

        def function(self, state, noise=False, **options):
            return super().function(state, noise=False, **options)

    model = Noiseless(3, (0, 1, 2), CovarianceMatrix(covariance))
    prediction = ParticleStatePrediction(
        state_vector=StateVectors(particles.T), weight=weights, timestamp=now
    )
    single = [
        SingleHypothesis(
            prediction, Detection(StateVector(z), timestamp=now, measurement_model=model)
        )
        for z in values
    ] or [SingleHypothesis(prediction, MissedDetection(timestamp=now))]
    updater = SMCPHDUpdater(
        measurement_model=model,
        prob_detect=Probability(probability),
        clutter_intensity=clutter,
        resampler=None,
    )
    theirs = logsumexp(
        updater.get_log_weights_per_hypothesis(MultipleHypothesis(single)).astype(float), axis=1
    )

    update = associate(
        particles,
        weights,
        np.full(400, probability),
        position_measurements(values, np.broadcast_to(covariance, (detections, 3, 3))),
        ORIGIN,
        np.full(detections, clutter),
    )
    np.testing.assert_allclose(weights * update.factor, np.exp(theirs), rtol=1e-9)


def test_one_target_without_clutter_gets_mass_one_from_its_detection():
    """All of the mass of a detection goes to the one cloud that explains it."""
    generator = np.random.default_rng(0)
    positions = [5.0, 5.0] + 0.01 * generator.normal(size=(100, 2))
    weights = np.full(100, 0.7 / 100)
    probability = np.full(100, 0.9)
    z = RangeBearing().measure([[5.0, 5.0]], ORIGIN)
    update = associate(
        positions, weights, probability, polar(z, np.eye(2) * 0.01), ORIGIN, np.zeros(1)
    )
    assert (weights * update.factor).sum() == pytest.approx(0.1 * 0.7 + 1.0)
    assert update.own_mass[0] == pytest.approx(1.0)


def test_mass_of_a_target_tends_to_one_over_pi():
    """Detected at rate pi, a mass m becomes (1 - pi) m + pi on average: 1 / pi in the end."""
    mass, probability = 0.0, 0.4
    positions = np.array([[5.0, 5.0]])
    prepared = polar(RangeBearing().measure(positions, ORIGIN), np.eye(2) * 0.01)
    empty = polar(np.empty((0, 2)), np.eye(2))
    chance = np.array([probability])
    hit = associate(positions, np.ones(1), chance, prepared, ORIGIN, np.zeros(1))
    gain = hit.factor[0] - (1.0 - probability)
    miss = associate(positions, np.ones(1), chance, empty, ORIGIN, np.empty(0)).factor[0]
    for _ in range(200):
        mass = miss * mass + gain
    assert mass == pytest.approx(1.0 / probability)


@pytest.mark.parametrize('dimension', [2, 3])
def test_seeing_nothing_lowers_the_mass_by_exactly_one_minus_pi(dimension):
    positions, weights, probability, pose, _, _, covariance = case(dimension)
    empty = polar(np.empty((0, dimension)), covariance, pose)
    update = associate(positions, weights, probability, empty, pose, np.empty(0))
    np.testing.assert_array_equal(update.factor, 1.0 - probability)


def test_very_narrow_noise_does_not_underflow():
    """The nearest particle is 10^4 deviations away; without clutter it has to explain it all."""
    positions = np.array([[1.0, 0.0], [2.0, 0.0], [3.0, 0.0]])
    weights = np.full(3, 0.5)
    prepared = polar([[2.01, 0.0]], np.diag([1e-12, 1e-4]), cap_angles=False)
    update = associate(positions, weights, np.full(3, 0.9), prepared, ORIGIN, np.zeros(1))
    np.testing.assert_allclose(weights * update.factor, [0.05, 1.05, 0.05], rtol=1e-9)
    assert np.isfinite(update.log_normaliser[0])
    assert update.log_normaliser[0] < -1e6


def test_particles_that_are_far_leave_a_detection_to_what_else_explains_it():
    positions = np.array([[1.0, 0.0], [2.0, 0.0]])
    for range_variance in (1e-4, 1e-6, 1e-8, 1e-12):
        prepared = polar([[2.1, 0.0]], np.diag([range_variance, 1e-4]))
        other = np.array([1e-3])
        update = associate(positions, np.ones(2), np.full(2, 0.9), prepared, ORIGIN, other)
        assert update.other_scale[0] * other[0] + update.own_mass[0] == pytest.approx(1.0)
        assert (update.factor <= 0.1 + 1.0 + 1e-12).all()
    assert update.own_mass[0] == 0.0


def test_a_detection_that_nothing_explains_is_told_by_its_normaliser():
    positions = np.array([[1.0, 0.0]])
    prepared = polar([[1.0, 0.0]], np.eye(2) * 0.01)
    update = associate(positions, np.ones(1), np.zeros(1), prepared, ORIGIN, np.zeros(1))
    assert update.log_normaliser[0] == -np.inf
    assert update.factor[0] == 1.0


def test_predicted_intensity_in_the_denominator_is_equation_9_of_002():
    positions, weights, probability, pose, model, values, covariance = case(3)
    predicted = weights * 3.0
    update = associate(
        positions,
        weights,
        probability,
        polar(values, covariance, pose),
        pose,
        np.zeros(4),
        denominator_weights=predicted,
    )
    psi = probability * np.exp(model.log_density(values, positions, pose, covariance))
    factor = 1.0 - probability + (psi / (psi * predicted).sum(axis=1)[:, None]).sum(axis=0)
    np.testing.assert_allclose(update.factor, factor, rtol=1e-9, atol=1e-14)


def test_more_detections_than_fit_in_a_block_and_threads_change_nothing():
    generator = np.random.default_rng(5)
    positions = generator.normal(0.0, 10.0, (40_000, 3))
    weights = np.full(len(positions), 1e-3)
    probability = ExponentialDetection(0.9, [10.0] * 3).probability(positions, ORIGIN)
    values = MODELS[3].measure(positions[:40], ORIGIN)
    prepared = polar(values, np.diag([0.1, 0.01, 0.01]))
    other = np.full(40, 1e-4)
    alone = associate(positions, weights, probability, prepared, ORIGIN, other)
    with ThreadPoolExecutor(3) as pool:
        together = associate(positions, weights, probability, prepared, ORIGIN, other, pool=pool)
    for name in ('factor', 'log_normaliser', 'weights', 'group', 'means', 'covariances'):
        np.testing.assert_array_equal(getattr(alone, name), getattr(together, name))
    likelihood = np.exp(MODELS[3].log_density(values, positions, ORIGIN, prepared.covariances[0]))
    expected = dense_update(positions, weights, probability, likelihood, other)
    np.testing.assert_allclose(weights * alone.factor, expected, rtol=1e-9)


@settings(max_examples=40, deadline=None)
@given(st.floats(-200.0, 200.0), st.floats(-200.0, 200.0), st.floats(-np.pi, np.pi))
def test_moving_and_turning_the_world_changes_no_weight(x, y, turn):
    positions, weights, probability, pose, _, values, _ = case(3)
    noise = np.diag([0.2, 0.01, 0.02])
    other = np.full(4, 1e-3)
    c, s = np.cos(turn), np.sin(turn)
    rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    moved = positions @ rotation.T + [x, y, 5.0]
    moved_pose = Pose.from_yaw(rotation @ pose.position + [x, y, 5.0], pose.yaw + turn)
    here = associate(positions, weights, probability, polar(values, noise, pose), pose, other)
    there = associate(
        moved,
        weights,
        ExponentialDetection(0.9, [10.0] * 3).probability(moved, moved_pose),
        polar(values + np.array([0.0, turn, 0.0]), noise, moved_pose),
        moved_pose,
        other,
    )
    np.testing.assert_allclose(here.factor, there.factor, rtol=1e-6, atol=1e-9)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10_000), st.integers(0, 6), st.floats(1e-6, 10.0), st.sampled_from([2, 3]))
def test_weights_are_never_negative_or_infinite(seed, detections, scale, dimension):
    positions, weights, probability, pose, _, _, _ = case(dimension, seed, 50)
    generator = np.random.default_rng(seed)
    values = generator.normal(0.0, 20.0, (detections, dimension))
    noise = scale * np.diag([1.0, 0.1, 0.1][:dimension])
    other = generator.choice([0.0, 1e-9, 1.0], detections)
    update = associate(positions, weights, probability, polar(values, noise, pose), pose, other)
    updated = weights * update.factor
    assert np.isfinite(updated).all()
    assert (updated >= 0.0).all()
    assert updated.sum() <= weights.sum() + detections + 1e-9


def test_own_arctangent_is_the_librarys():
    generator = np.random.default_rng(0)
    x, y = generator.normal(size=(2, 20_000)) * np.exp(generator.normal(0.0, 8.0, 20_000))
    ours = np.array([arctan2(b, a) for a, b in zip(x, y)])
    np.testing.assert_allclose(ours, np.arctan2(y, x), rtol=5e-16, atol=0.0)
    assert arctan2(0.0, 0.0) == 0.0
    assert arctan2(0.0, -1.0) == np.pi
    assert arctan2(1.0, 0.0) == np.pi / 2


def test_own_sines_are_the_librarys():
    generator = np.random.default_rng(0)
    x = np.concatenate(
        [
            generator.uniform(-4.0, 4.0, 20_000),
            generator.uniform(-2e3, 2e3, 20_000),
            np.pi * np.arange(-8, 9) / 4.0,
        ]
    )
    sine = np.empty_like(x)
    cosine = np.empty_like(x)
    sines(x, len(x), sine, cosine)
    np.testing.assert_allclose(sine, np.sin(x), rtol=0.0, atol=3e-16)
    np.testing.assert_allclose(cosine, np.cos(x), rtol=0.0, atol=3e-16)


@pytest.mark.parametrize('dimension', [2, 3])
@pytest.mark.parametrize('more', [1, 300, 5000])
def test_particles_that_stay_are_not_looked_at_anew(dimension, more):
    """What is kept of the particles before births gives the same as all of it anew."""
    generator = np.random.default_rng(8)
    kernel = ExponentialDetection(0.9, [10.0] * dimension).kernel()
    positions = generator.normal(0.0, 10.0, (1000 + more, dimension))
    weights = np.full(len(positions), 1e-3)
    values = MODELS[dimension].measure(positions[[5, 900]], ORIGIN)
    prepared = polar(values, np.diag([0.1, 0.01, 0.01][:dimension]))
    other = np.full(2, 1e-4)
    workspace = Workspace()
    arguments = (kernel, prepared, ORIGIN, other)
    associate(positions[:1000], weights[:1000], *arguments, workspace=workspace)
    kept = associate(positions, weights, *arguments, workspace=workspace, known=1000)
    anew = associate(positions, weights, *arguments)
    for name in ('factor', 'weights', 'log_normaliser', 'means', 'covariances', 'group'):
        np.testing.assert_array_equal(getattr(kept, name), getattr(anew, name))


def test_own_exponential_is_the_librarys_and_becomes_zero():
    x = np.concatenate(
        [np.random.default_rng(0).uniform(-708.0, 50.0, 20_000), [0.0, -709.0, -1e9]]
    )
    ours = np.array([exponential(value) for value in x.tolist()])
    np.testing.assert_allclose(ours[:-2], np.exp(x[:-2]), rtol=4e-16, atol=0.0)
    assert ours[-3] == 1.0
    assert ours[-2:].tolist() == [0.0, 0.0]


def test_an_error_of_the_robots_position_widens_the_noise_as_it_is_seen():
    """Across the line of sight the angle an error makes goes down with the distance."""
    near = polar([[1.0, 0.0]], np.diag([1e-4, 1e-4]), pose_error=0.1).covariances[0]
    far = polar([[10.0, 0.0]], np.diag([1e-4, 1e-4]), pose_error=0.1).covariances[0]
    assert near[0, 0] == pytest.approx(1e-4 + 0.01)
    assert near[1, 1] == pytest.approx(1e-4 + 0.01)
    assert far[1, 1] == pytest.approx(1e-4 + 1e-4)


def test_a_cartesian_covariance_next_to_the_robot_comes_back():
    """A detection right below the robot: the angle is unknown, the position is not."""
    position = np.array([[0.004, 0.003]])
    z = RangeBearing().measure(position, ORIGIN)
    jacobian = RangeBearing().jacobian(position, ORIGIN)[0]
    spread = np.diag([4e-4, 1e-4])
    prepared = prepare_measurements(
        z, (jacobian @ spread @ jacobian.T)[None], ORIGIN, cartesian_near=True
    )
    assert prepared.cartesian[0]
    np.testing.assert_allclose(prepared.centres[0], position[0], atol=1e-12)
    recovered = prepared.roots[0] @ prepared.roots[0].T
    np.testing.assert_allclose(recovered, spread, atol=1e-5)
