"""Tests of means and their confidence intervals, against SciPy and printed tables."""

import math

import numpy as np
import pytest
from scipy import stats

from maasi_sim.experiments import statistics
from maasi_sim.experiments.statistics import mean_interval

GENERATOR = np.random.default_rng(3)
FIRST, SECOND, OTHER = (GENERATOR.normal(5.0, 2.0, number) for number in (12, 12, 7))


def welch(first, second):
    paper = mean_interval(second)
    published = statistics.from_published(paper.mean, paper.half_width, len(second))
    return statistics.independent_difference(mean_interval(first), published)


@pytest.mark.parametrize(
    ('ours', 'theirs'),
    [
        (mean_interval([*FIRST, math.nan]), stats.ttest_1samp(FIRST, 0.0)),
        (statistics.paired_difference(FIRST, SECOND), stats.ttest_rel(FIRST, SECOND)),
        (welch(FIRST, OTHER), stats.ttest_ind(FIRST, OTHER, equal_var=False)),
    ],
)
def test_intervals_are_those_of_scipy(ours, theirs):
    low, high = theirs.confidence_interval(0.95)
    assert ours.number == 7 or ours.number == 12
    bounds = ours.mean - ours.half_width, ours.mean + ours.half_width
    assert bounds == pytest.approx((low, high))


def test_intervals_of_few_values():
    assert math.isnan(mean_interval([]).mean)
    one = mean_interval([4.0])
    assert one.mean == 4.0 and math.isnan(one.half_width)
    # Ten runs without a printed spread: they are taken to spread as our three.
    ours = mean_interval([1.0, 2.0, 4.0])
    result = statistics.independent_difference(ours, statistics.from_published(2.0, None, 10))
    assert result.half_width == pytest.approx(ours.half_width * math.sqrt(1.3))
    assert result.mean == pytest.approx(ours.mean - 2.0)
    assert math.isnan(statistics.bootstrap_difference([], []).mean)
    one = statistics.bootstrap_difference([3.0], [1.0])
    assert one.mean == 2.0 and math.isnan(one.low) and not one.excludes_zero
    same = statistics.bootstrap_difference([1.0, 2.0], [1.0, 2.0])
    assert (same.mean, same.low, same.high, same.needed) == (0.0, 0.0, 0.0, None)


@pytest.mark.parametrize(('effect', 'expected'), [(0.2, 199), (0.5, 34), (0.8, 15)])
def test_pairs_needed_are_those_of_cohens_tables(effect, expected):
    values = np.array([-1.0, 1.0] * 50)
    gaps = values / values.std(ddof=1) + effect
    assert statistics.pairs_needed(gaps) == expected


def test_bootstrap_interval_of_normal_differences_is_near_students():
    generator = np.random.default_rng(1)
    first, second = generator.normal(3.0, 1.0, 60), generator.normal(1.0, 2.0, 60)
    low, high = stats.ttest_rel(first, second).confidence_interval(0.95)
    gap = statistics.bootstrap_difference([*first, math.nan], [*second, 1.0])
    assert gap.number == 60 and gap.mean == pytest.approx(np.mean(first - second))
    assert (gap.low, gap.high) == pytest.approx((low, high), abs=0.1)
    assert gap.excludes_zero
    assert statistics.bootstrap_difference(first, second) == gap
