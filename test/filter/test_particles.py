"""Resampling schemes and jitter."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from maasi_filter.ic_phd.particles import (
    clear,
    gather,
    group_moments,
    groups_of,
    jitter,
    resample,
    total_weight,
)

SCHEMES = ['systematic', 'stratified', 'multinomial']
BOUNDS = np.array([[-100.0, 100.0]] * 3)


@pytest.mark.parametrize('scheme', SCHEMES)
def test_copies_are_in_proportion_to_the_weights(scheme):
    generator = np.random.default_rng(0)
    weights = np.array([0.0, 1.0, 2.0, 0.0, 5.0, 2.0, 0.0])
    counts = np.zeros(7)
    for _ in range(400):
        index = resample(weights, 50, scheme, generator)
        assert (np.diff(index) >= 0).all()
        counts += np.bincount(index, minlength=7)
    np.testing.assert_array_equal(counts[weights == 0.0], 0.0)
    np.testing.assert_allclose(counts / 400, 50 * weights / 10.0, rtol=0.05)


@settings(max_examples=50, deadline=None)
@given(
    st.lists(st.floats(0.0, 1e3), min_size=1, max_size=60),
    st.integers(1, 200),
    st.integers(0, 1000),
)
def test_systematic_copies_are_within_one_of_their_share(weights, number, seed):
    weights = np.array(weights)
    if not weights.sum() > 1e-200:
        return
    index = resample(weights, number, 'systematic', np.random.default_rng(seed))
    share = number * weights / weights.sum()
    counts = np.bincount(index, minlength=len(weights))
    assert (np.abs(counts - share) <= 1.0 + 1e-6 * number).all()
    assert counts.sum() == number
    assert (counts[weights == 0.0] == 0).all()


@pytest.mark.parametrize('scheme', SCHEMES)
def test_threads_change_nothing(scheme):
    weights = np.random.default_rng(0).random(50_000)
    alone = resample(weights, 70_000, scheme, np.random.default_rng(1))
    with ThreadPoolExecutor(3) as pool:
        together = resample(weights, 70_000, scheme, np.random.default_rng(1), pool)
    np.testing.assert_array_equal(alone, together)
    counts = np.bincount(alone, minlength=len(weights))
    if scheme == 'systematic':
        assert np.abs(counts - 70_000 * weights / weights.sum()).max() < 1.0 + 1e-6


def test_weights_without_a_sum_and_unknown_schemes_are_refused():
    generator = np.random.default_rng(0)
    with pytest.raises(ValueError, match='weights'):
        resample(np.zeros(5), 10, 'systematic', generator)
    with pytest.raises(ValueError, match='weights'):
        resample(np.array([1.0, np.nan]), 10, 'systematic', generator)
    with pytest.raises(ValueError, match='resampling'):
        resample(np.ones(5), 10, 'residual', generator)


def test_total_weight_adds_up():
    weights = np.random.default_rng(0).random(30_000)
    assert total_weight(weights) == pytest.approx(weights.sum())
    assert total_weight(np.empty(0)) == 0.0


@pytest.mark.parametrize('dimension', [2, 3])
def test_group_moments_are_the_weighted_ones(dimension):
    generator = np.random.default_rng(0)
    particles = 1e6 + generator.normal(size=(20_000, dimension))
    weights = generator.random(20_000)
    group = np.sort(generator.integers(0, 4, 20_000))
    mass, means, covariances = group_moments(particles, weights, group, 5)
    for g in range(4):
        member = group == g
        expected = np.cov(particles[member].T, aweights=weights[member], bias=True)
        assert mass[g] == pytest.approx(weights[member].sum())
        np.testing.assert_allclose(
            means[g], np.average(particles[member], axis=0, weights=weights[member])
        )
        np.testing.assert_allclose(covariances[g], expected, atol=1e-6)
    assert mass[4] == 0.0
    np.testing.assert_array_equal(covariances[4], 0.0)


def test_gather_renumbers_the_groups_that_are_left():
    particles = np.arange(12.0).reshape(6, 2)
    group = np.array([0, 0, 3, 3, 5, 5])
    out, copy, starts, present = gather(np.array([1, 4, 4]), particles, group, 6)
    np.testing.assert_array_equal(out, particles[[1, 4, 4]])
    assert copy.tolist() == [False, False, True]
    assert groups_of(starts).tolist() == [0, 1, 1]
    assert np.nonzero(present)[0].tolist() == [0, 5]


def test_gather_puts_groups_together_in_order_and_threads_change_nothing():
    generator = np.random.default_rng(2)
    particles = generator.normal(size=(30_000, 3))
    group = generator.integers(0, 7, 30_000)
    index = np.sort(generator.integers(0, 30_000, 50_000))
    expected = index[np.argsort(group[index], kind='stable')]
    with ThreadPoolExecutor(3) as pool:
        for threads in (None, pool):
            out, copy, starts, _ = gather(index, particles, group, 7, threads)
            np.testing.assert_array_equal(out, particles[expected])
            np.testing.assert_array_equal(copy[1:], expected[1:] == expected[:-1])
            np.testing.assert_array_equal(groups_of(starts, threads), group[expected])


def test_clearing_takes_a_group_and_what_is_around_but_not_other_detections():
    particles = np.array([[0.0, 0.0], [9.0, 0.0], [0.5, 0.0], [0.5, 0.0], [5.0, 0.0]])
    weights = np.ones(5)
    clear(particles, weights, np.array([0, 3, 1, 2, 1]), np.zeros(2), 1.0, 3, 2)
    assert weights.tolist() == [0.0, 0.0, 0.0, 1.0, 1.0]


def resampled_cloud(seed=0, number=20_000):
    """Return a resampled cloud of one group, and which particles are duplicates."""
    generator = np.random.default_rng(seed)
    source = generator.multivariate_normal([1, 2, 3], [[4, 1, 0], [1, 2, 0], [0, 0, 1]], number)
    index = np.sort(generator.integers(0, number, number))
    copy = np.append(False, index[1:] == index[:-1])
    return source[index], copy, np.array([0, number]), generator


def test_jitter_keeps_mean_and_covariance():
    particles, copy, starts, generator = resampled_cloud()
    group = np.zeros(len(copy), np.int64)
    _, means, before = group_moments(particles, np.ones(len(copy)), group, 1)
    for _ in range(20):
        particles = jitter(particles, copy, starts, means, np.full(1, 0.3), 0.0, BOUNDS, generator)
    _, after_means, after = group_moments(particles, np.ones(len(copy)), group, 1)
    np.testing.assert_allclose(after_means, means, atol=0.05)
    np.testing.assert_allclose(after[0], before[0], rtol=0.05, atol=0.08)
    assert len(np.unique(particles[:, 0])) == len(particles)


def test_jitter_leaves_single_particles_of_a_group_without_duplicates_alone():
    particles = np.random.default_rng(0).normal(size=(100, 2))
    moved = jitter(
        particles,
        np.zeros(100, np.bool_),
        np.array([0, 100]),
        particles.mean(axis=0)[None],
        np.full(1, 0.3),
        0.1,
        BOUNDS[:2],
        np.random.default_rng(0),
    )
    np.testing.assert_allclose(moved, particles, atol=1e-12)


def test_fill_adds_the_covariance_that_is_asked_for():
    number = 40_000
    particles = np.tile([5.0, 6.0], (number, 1))
    root = np.array([[0.5, 0.0], [0.2, 0.1]])
    moved = jitter(
        particles,
        np.zeros(number, np.bool_),
        np.array([0, number]),
        particles[:1],
        np.zeros(1),
        0.0,
        BOUNDS[:2],
        np.random.default_rng(0),
        fill=root[None],
    )
    np.testing.assert_allclose(np.cov(moved.T), root @ root.T, atol=0.006)
    np.testing.assert_allclose(moved.mean(axis=0), [5.0, 6.0], atol=0.01)


def test_jitter_stays_inside_the_bounds_and_does_not_depend_on_threads():
    particles, copy, starts, _ = resampled_cloud(number=40_000)
    bounds = np.array([[particles[:, a].min(), particles[:, a].max()] for a in range(3)])
    arguments = (particles, copy, starts, particles.mean(axis=0)[None], np.full(1, 0.5), 0.2)
    alone = jitter(*arguments, bounds, np.random.default_rng(2))
    with ThreadPoolExecutor(3) as pool:
        together = jitter(*arguments, bounds, np.random.default_rng(2), pool=pool)
    np.testing.assert_array_equal(alone, together)
    assert ((alone >= bounds[:, 0]) & (alone <= bounds[:, 1])).all()
