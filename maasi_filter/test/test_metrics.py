"""Metrics: by hand, by brute force, and their properties."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from maasi_filter import gospa, match_targets

points = st.lists(
    st.tuples(st.floats(-10.0, 10.0), st.floats(-10.0, 10.0)), min_size=0, max_size=4
).map(lambda values: np.array(values, float).reshape(-1, 2))


def brute_gospa(estimates, truth, cutoff, power):
    """The smallest cost over every way to leave out, and to pair, points."""
    best = np.inf
    small, large = sorted((len(estimates), len(truth)))
    for size in range(small + 1):
        for ours in itertools.combinations(range(len(estimates)), size):
            for theirs in itertools.permutations(range(len(truth)), size):
                cost = sum(
                    np.linalg.norm(estimates[i] - truth[j]) ** power for i, j in zip(ours, theirs)
                )
                cost += cutoff**power / 2 * (small + large - 2 * size)
                best = min(best, cost)
    return best ** (1 / power)


@settings(max_examples=60, deadline=None)
@given(points, points, st.floats(0.5, 20.0), st.sampled_from([1.0, 2.0]))
def test_gospa_is_the_best_assignment(estimates, truth, cutoff, power):
    value = gospa(estimates, truth, cutoff, power)
    assert value.total == pytest.approx(brute_gospa(estimates, truth, cutoff, power), abs=1e-9)
    parts = value.localisation + value.missed + value.false
    assert value.total == pytest.approx(parts ** (1 / power))


def test_values_by_hand():
    value = gospa([[0.0, 3.0], [50.0, 0.0]], [[0.0, 0.0], [0.0, 40.0], [9.0, 9.0]], 10.0, 2.0)
    assert (value.localisation, value.missed, value.false) == (9.0, 100.0, 50.0)
    assert value.matched == 1
    match = match_targets([[1.0, 0.0], [0.1, 0.0], [9.0, 9.0]], [[0.0, 0.0], [-1.0, 0.0]], 1.2)
    assert sorted(match.pairs) == [(0, 0), (1, 1)]
    assert (match.true_found, match.missed, match.false_found) == (2, 0, 1)
    assert match.rmse == pytest.approx(np.sqrt((1.0 + 1.21) / 2))
    assert np.isnan(match_targets([], [[0.0, 0.0]], 1.0).rmse)


@pytest.mark.parametrize(
    'call',
    [
        lambda: gospa([[np.nan, 0.0]], [[0.0, 0.0]], 1.0),
        lambda: gospa([[0.0, 0.0]], [[0.0, 0.0, 0.0]], 1.0),
        lambda: gospa([[0.0, 0.0]], [[0.0, 0.0]], 0.0),
        lambda: gospa([[0.0, 0.0]], [[0.0, 0.0]], 1.0, 0.5),
        lambda: match_targets([[0.0, 0.0]], [[0.0, 0.0]], -1.0),
    ],
)
def test_bad_input_is_refused(call):
    with pytest.raises(ValueError, match='got'):
        call()
