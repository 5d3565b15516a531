"""Means with confidence intervals: of numbers, and of paired differences."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

LEVEL = 0.95
_TAIL = 0.5 + 0.5 * LEVEL
# Power of a paired test for which the number of pairs is given, and the largest such number.
_POWER = 0.8
_MOST_PAIRS = 1_000_000


@dataclass(frozen=True)
class Interval:
    """A mean with half the width of its confidence interval."""

    mean: float  # nan without values
    half_width: float  # nan with fewer than two
    number: int
    degrees: float  # of freedom of Student's distribution


def student(degrees: float, level: float = LEVEL) -> float:
    """Return the half width of the interval of Student's t with variance 1."""
    return float(stats.t.ppf(0.5 + 0.5 * level, degrees))


def mean_interval(values: ArrayLike) -> Interval:
    """Return the mean with Student's 95 % confidence interval; nan is left out."""
    array = np.asarray(values, dtype=float)
    array = array[~np.isnan(array)]
    number = len(array)
    mean = float(array.mean()) if number else math.nan
    if number < 2:
        return Interval(mean, math.nan, number, 0.0)
    error = float(array.std(ddof=1)) / math.sqrt(number)
    return Interval(mean, error * student(number - 1), number, number - 1.0)


def _gaps(first: ArrayLike, second: ArrayLike) -> NDArray[np.float64]:
    one, two = np.asarray(first, dtype=float), np.asarray(second, dtype=float)
    if one.shape != two.shape:
        raise ValueError(f'first, second: got shapes {one.shape}, {two.shape}, allowed are equal')
    return one - two


def paired_difference(first: ArrayLike, second: ArrayLike) -> Interval:
    """Return the mean of first minus second on the same maps; pairs with a nan are left out."""
    return mean_interval(_gaps(first, second))


@dataclass(frozen=True)
class Difference:
    """Mean and median of paired differences; what too few values do not give is nan."""

    mean: float
    low: float  # bounds of the bootstrap interval
    high: float
    median: float
    number: int
    needed: int | None  # pairs for a power of 0.8 at this size; None: no difference, no spread

    @property
    def excludes_zero(self) -> bool:
        """Whether the interval excludes 0."""
        return self.low > 0.0 or self.high < 0.0


def bootstrap_difference(first: ArrayLike, second: ArrayLike) -> Difference:
    """Return the mean of first minus second on the same maps; pairs with a nan are left out.

    The bootstrap is bias-corrected and accelerated (Efron), with fixed random numbers.
    """
    gaps = _gaps(first, second)
    gaps = gaps[~np.isnan(gaps)]
    if not len(gaps):
        return Difference(math.nan, math.nan, math.nan, math.nan, 0, None)
    mean, median = float(gaps.mean()), float(np.median(gaps))
    if np.ptp(gaps) == 0.0:
        bound = mean if len(gaps) > 1 else math.nan
        return Difference(mean, bound, bound, median, len(gaps), None)
    low, high = stats.bootstrap(
        (gaps,), np.mean, confidence_level=LEVEL, random_state=np.random.default_rng(0)
    ).confidence_interval
    return Difference(mean, float(low), float(high), median, len(gaps), pairs_needed(gaps))


def pairs_needed(gaps: ArrayLike) -> int | None:
    """Return the number of pairs that a paired t test needs for a mean difference as found."""
    values = np.asarray(gaps, dtype=float)
    deviation = float(values.std(ddof=1))
    if deviation == 0.0 or values.mean() == 0.0:
        return None
    effect = abs(float(values.mean())) / deviation
    # Start from the normal approximation, which is slightly too small.
    number = max(2, int(((stats.norm.ppf(_TAIL) + stats.norm.ppf(_POWER)) / effect) ** 2))
    while number <= _MOST_PAIRS:
        limit = stats.t.ppf(_TAIL, number - 1)
        if stats.nct.sf(limit, number - 1, effect * math.sqrt(number)) >= _POWER:
            return number
        number += 1
    return None


def independent_difference(first: Interval, second: Interval) -> Interval:
    """Return the difference of two means of different runs, after Welch and Satterthwaite.

    If the interval of one is unknown, its values are taken to spread as those of the other.
    """
    difference = first.mean - second.mean
    number = min(first.number, second.number)
    known = [
        item for item in (first, second) if item.degrees > 0.0 and math.isfinite(item.half_width)
    ]
    if not known:
        return Interval(difference, math.nan, number, 0.0)
    if len(known) == 1:
        other = second if known[0] is first else first
        width = known[0].half_width * math.sqrt(1.0 + known[0].number / other.number)
        return Interval(difference, width, number, known[0].degrees)
    parts = [((item.half_width / student(item.degrees)) ** 2, item.degrees) for item in known]
    variance = sum(part for part, _ in parts)
    if variance == 0.0:
        return Interval(difference, 0.0, number, min(degrees for _, degrees in parts))
    degrees = variance**2 / sum(part**2 / free for part, free in parts)
    return Interval(difference, math.sqrt(variance) * student(degrees), number, degrees)


def from_published(value: float, half_width: float | None, runs: int) -> Interval:
    """Return a paper's number as an interval; a half width of None is unknown."""
    if half_width is None or runs < 2:
        return Interval(value, math.nan, runs, 0.0)
    return Interval(value, half_width, runs, runs - 1.0)
