"""Association by belief propagation against enumeration."""

import itertools

import numpy as np
import pytest

from maasi_filter.pmb.association import associate, propagate


def enumerated(odds, other):
    """Return the exact marginals: missed, caused, new."""
    n, m = odds.shape
    missed, caused, new = np.zeros(n), np.zeros((n, m)), np.zeros(m)
    total = 0.0
    for choice in itertools.product(range(-1, m), repeat=n):
        taken = [j for j in choice if j >= 0]
        if len(set(taken)) < len(taken):
            continue
        weight = 1.0
        for i, j in enumerate(choice):
            weight *= odds[i, j] if j >= 0 else 1.0
        for j in set(range(m)) - set(taken):
            weight *= other[j]
        total += weight
        for i, j in enumerate(choice):
            if j >= 0:
                caused[i, j] += weight
            else:
                missed[i] += weight
        for j in set(range(m)) - set(taken):
            new[j] += weight
    return missed / total, caused / total, new / total


@pytest.mark.parametrize(('n', 'm'), [(1, 1), (1, 4), (4, 1)])
def test_exact_where_the_graph_has_no_loop(n, m):
    generator = np.random.default_rng(n * 10 + m)
    odds = np.exp(3.0 * generator.standard_normal((n, m)))
    other = np.exp(generator.standard_normal(m))
    found = associate(odds, other)
    for got, exact in zip((found.missed, found.caused, found.new), enumerated(odds, other)):
        np.testing.assert_allclose(got, exact, rtol=1e-9)


def test_close_to_exact_with_loops():
    worst, sums = 0.0, []
    for seed in range(200):
        generator = np.random.default_rng(seed)
        odds = np.exp(2.0 * generator.standard_normal((3, 3)))
        other = np.exp(generator.standard_normal(3))
        found = associate(odds, other)
        _, caused, _ = enumerated(odds, other)
        error = np.abs(found.caused - caused).max()
        worst = max(worst, error)
        sums.append(error)
        np.testing.assert_allclose(found.missed + found.caused.sum(axis=1), 1.0, rtol=1e-9)
        np.testing.assert_allclose(found.new + found.caused.sum(axis=0), 1.0, atol=1e-6)
    assert worst < 0.15
    assert np.mean(sums) < 0.04


def test_certain_detections_stay_apart():
    odds = np.array([[1e12, 1e2], [1e2, 1e12]])
    found = associate(odds, np.full(2, 1e-6))
    np.testing.assert_allclose(found.caused, np.eye(2), atol=1e-6)
    assert np.isfinite(found.missed).all()
    assert (found.missed >= 0.0).all()


@pytest.mark.parametrize('shape', [(0, 0), (3, 0), (0, 2)])
def test_nothing_to_associate(shape):
    found = associate(np.zeros(shape), np.ones(shape[1]))
    np.testing.assert_array_equal(found.missed, np.ones(shape[0]))
    np.testing.assert_array_equal(found.new, np.ones(shape[1]))
    assert found.caused.shape == shape


@pytest.mark.parametrize(('n', 'm'), [(1, 3), (3, 1), (3, 3)])
def test_the_log_of_the_sum_of_all_weights_is_that_of_enumeration(n, m):
    ratios = np.exp(2.0 * np.random.default_rng(n + m).standard_normal((n, m)))
    total = sum(
        np.prod([ratios[i, j] for i, j in enumerate(choice) if j >= 0])
        for choice in itertools.product(range(-1, m), repeat=n)
        if all(choice.count(j) <= 1 for j in range(m))
    )
    log_sum = propagate(ratios, np.empty(n), np.empty((n, m)), np.empty(m))
    assert log_sum == pytest.approx(np.log(total), abs=1e-9 if min(n, m) == 1 else 0.3)
