"""Association by belief propagation against enumeration."""

import itertools

import numpy as np
import pytest

from maasi_filter.pmb.association import associate, propagate


def enumerated(odds, other):
    """Return the exact marginals, missed, caused and new, and the sum of all weights."""
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
    return missed / total, caused / total, new / total, total


def log_sum(odds, other):
    n, m = odds.shape
    return propagate(odds / other, np.empty(n), np.empty((n, m)), np.empty(m))


@pytest.mark.parametrize(('n', 'm'), [(1, 1), (1, 4), (4, 1)])
def test_exact_where_the_graph_has_no_loop(n, m):
    generator = np.random.default_rng(n * 10 + m)
    odds = np.exp(3.0 * generator.standard_normal((n, m)))
    other = np.exp(generator.standard_normal(m))
    found = associate(odds, other)
    *marginals, total = enumerated(odds, other)
    for got, exact in zip((found.missed, found.caused, found.new), marginals):
        np.testing.assert_allclose(got, exact, rtol=1e-9)
    assert log_sum(odds, other) == pytest.approx(np.log(total / other.prod()), abs=1e-9)


def test_close_to_exact_with_loops():
    errors, gaps = [], []
    for seed in range(200):
        generator = np.random.default_rng(seed)
        odds = np.exp(2.0 * generator.standard_normal((3, 3)))
        other = np.exp(generator.standard_normal(3))
        found = associate(odds, other)
        _, caused, _, total = enumerated(odds, other)
        errors.append(np.abs(found.caused - caused).max())
        np.testing.assert_allclose(found.missed + found.caused.sum(axis=1), 1.0, rtol=1e-9)
        np.testing.assert_allclose(found.new + found.caused.sum(axis=0), 1.0, atol=1e-6)
        gaps.append(abs(log_sum(odds, other) - np.log(total / other.prod())))
    assert max(gaps) < 0.6 and np.mean(gaps) < 0.15
    assert max(errors) < 0.15
    assert np.mean(errors) < 0.04


def test_certain_detections_stay_apart():
    odds = np.array([[1e12, 1e2], [1e2, 1e12]])
    found = associate(odds, np.full(2, 1e-6))
    np.testing.assert_allclose(found.caused, np.eye(2), atol=1e-6)
    assert np.isfinite(found.missed).all()
    assert (found.missed >= 0.0).all()
