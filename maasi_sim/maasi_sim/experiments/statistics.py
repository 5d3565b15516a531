"""Means with confidence intervals: of numbers, censored durations, and paired differences."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

LEVEL = 0.95


@dataclass(frozen=True)
class Interval:
    """A mean with a confidence interval.

    Attributes
    ----------
    mean : float
        nan without values.
    half_width : float
        Of the interval; nan with fewer than two values.
    number : int
        Number of values.
    degrees : float
        Of freedom, of Student's t.
    """

    mean: float
    half_width: float
    number: int
    degrees: float

    @property
    def error(self) -> float:
        """Standard error of the mean."""
        return self.half_width / _student(self.degrees)


def mean_interval(values: ArrayLike) -> Interval:
    """Return the mean with Student's 95 % confidence interval; nan is left out."""
    array = np.asarray(values, dtype=float)
    array = array[~np.isnan(array)]
    number = len(array)
    if number == 0:
        return Interval(math.nan, math.nan, 0, 0.0)
    mean = float(array.mean())
    if number == 1:
        return Interval(mean, math.nan, 1, 0.0)
    error = float(array.std(ddof=1)) / math.sqrt(number)
    return Interval(mean, error * _student(number - 1), number, number - 1.0)


def restricted_mean(durations: ArrayLike, finished: ArrayLike, limit: float) -> Interval:
    """Return the restricted mean of durations T, of which some are censored.

    The area under Kaplan and Meier's curve up to the limit. Without censoring before the limit it
    is the mean of min(T, limit) with Student's interval; otherwise Greenwood's variance is used.

    Parameters
    ----------
    durations : (n,) array
        T, or the time of censoring.
    finished : (n,) array of bool
        False where censored.
    limit : float
        At least 0.

    Raises
    ------
    ValueError
        If anything is negative or not finite, or the lengths differ.
    """
    times = np.asarray(durations, dtype=float)
    ended = np.asarray(finished, dtype=bool)
    if times.shape != ended.shape or times.ndim != 1:
        raise ValueError(f'durations, finished: got shapes {times.shape}, {ended.shape}')
    if not (np.isfinite(times).all() and (times >= 0.0).all()):
        raise ValueError('durations: allowed are finite numbers from 0')
    if not (math.isfinite(limit) and limit >= 0.0):
        raise ValueError(f'limit: got {limit}, allowed are finite numbers from 0')
    ended = ended & (times <= limit)
    if (ended | (times >= limit)).all():
        return mean_interval(np.minimum(times, limit))
    number = len(times)
    steps, deaths = np.unique(times[ended], return_counts=True)
    risk = (times >= steps[:, None]).sum(axis=1)
    survival = np.concatenate([[1.0], np.cumprod(1.0 - deaths / risk)])
    areas = np.cumsum(survival * np.diff([0.0, *steps, limit]))
    left = risk > deaths
    spread = (deaths / (risk * np.maximum(risk - deaths, 1)))[left]
    variance = float(((areas[-1] - areas[:-1][left]) ** 2 * spread).sum())
    half = math.sqrt(variance) * _student(max(number - 1, 1))
    return Interval(
        float(areas[-1]), half if number > 1 else math.nan, number, max(number - 1.0, 0.0)
    )


def _student(degrees: float) -> float:
    """Return the half width of the interval of Student's t with variance 1."""
    return float(stats.t.ppf(0.5 + 0.5 * LEVEL, degrees))


def _gaps(first: ArrayLike, second: ArrayLike) -> NDArray[np.float64]:
    one, two = np.asarray(first, dtype=float), np.asarray(second, dtype=float)
    if one.shape != two.shape:
        raise ValueError(f'first, second: got shapes {one.shape}, {two.shape}, allowed are equal')
    return one - two


def paired_difference(first: ArrayLike, second: ArrayLike) -> Interval:
    """Return the mean of first minus second on the same maps; pairs with a nan are left out.

    Raises
    ------
    ValueError
        If the lengths differ.
    """
    return mean_interval(_gaps(first, second))


@dataclass(frozen=True)
class Difference:
    """The mean of paired differences with its bootstrap interval.

    Attributes
    ----------
    mean, low, high : float
        With the bounds of the 95 % interval; nan where there are too few values.
    median : float
        Of the differences.
    number : int
        Pairs.
    needed : int or None
        Pairs for a power of 0.8 at a difference of this size; None without difference or spread,
        and above a million.
    """

    mean: float
    low: float
    high: float
    median: float
    number: int
    needed: int | None

    @property
    def told_from_zero(self) -> bool:
        """Whether the interval excludes 0."""
        return self.low > 0.0 or self.high < 0.0


def bootstrap_difference(first: ArrayLike, second: ArrayLike) -> Difference:
    """Return the mean of first minus second on the same maps; pairs with a nan are left out.

    The interval is the bias-corrected and accelerated bootstrap (Efron) of pairs, with fixed random
    numbers.

    Raises
    ------
    ValueError
        If the lengths differ.
    """
    gaps = _gaps(first, second)
    gaps = gaps[~np.isnan(gaps)]
    if not len(gaps):
        return Difference(math.nan, math.nan, math.nan, math.nan, 0, None)
    mean, median = float(gaps.mean()), float(np.median(gaps))
    if len(gaps) == 1:
        return Difference(mean, math.nan, math.nan, median, 1, None)
    if np.ptp(gaps) == 0.0:
        return Difference(mean, mean, mean, median, len(gaps), None)
    low, high = _bootstrap_interval(tuple(gaps))
    return Difference(mean, low, high, median, len(gaps), pairs_needed(gaps))


@lru_cache
def _bootstrap_interval(gaps: tuple[float, ...]) -> tuple[float, float]:
    low, high = stats.bootstrap(
        (gaps,), np.mean, confidence_level=LEVEL, random_state=np.random.default_rng(0)
    ).confidence_interval
    return float(low), float(high)


def pairs_needed(gaps: ArrayLike, power: float = 0.8, most: int = 1_000_000) -> int | None:
    """Return the number of pairs that a paired t test needs for a mean difference as found.

    Parameters
    ----------
    gaps : (n,) array
        Differences, two or more.
    power : float
        Probability of a significant result.
    most : int
        Return None above it.
    """
    values = np.asarray(gaps, dtype=float)
    deviation = float(values.std(ddof=1))
    if deviation == 0.0 or values.mean() == 0.0:
        return None
    effect = abs(float(values.mean())) / deviation
    tail = 0.5 + 0.5 * LEVEL
    # Start from the normal approximation, which is slightly too small.
    number = max(2, int(((stats.norm.ppf(tail) + stats.norm.ppf(power)) / effect) ** 2))
    while number <= most:
        limit = stats.t.ppf(tail, number - 1)
        if stats.nct.sf(limit, number - 1, effect * math.sqrt(number)) >= power:
            return number
        number += 1
    return None


def survival(
    durations: ArrayLike, finished: ArrayLike
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return Kaplan and Meier's curve: times, and the share not finished from each time on.

    Parameters
    ----------
    durations : (n,) array
        Of each, or time of censoring.
    finished : (n,) array of bool
        False where censored.
    """
    times, ended = np.asarray(durations, dtype=float), np.asarray(finished, dtype=bool)
    curve = stats.ecdf(stats.CensoredData.right_censored(times, ~ended)).sf
    return (
        np.concatenate([[0.0], curve.quantiles]),
        np.concatenate([[1.0], curve.probabilities]),
    )


def independent_difference(first: Interval, second: Interval) -> Interval:
    """Return the difference of two means of different runs, after Welch and Satterthwaite.

    If the interval of one is unknown, that of the other is used, which is too narrow.
    """
    parts = [
        (item.error**2, item.degrees)
        for item in (first, second)
        if item.degrees > 0.0 and math.isfinite(item.half_width)
    ]
    difference = first.mean - second.mean
    variance = sum(part for part, _ in parts)
    number = min(first.number, second.number)
    if not parts:
        return Interval(difference, math.nan, number, 0.0)
    if variance == 0.0:
        return Interval(difference, 0.0, number, min(degrees for _, degrees in parts))
    degrees = variance**2 / sum(part**2 / free for part, free in parts)
    return Interval(difference, math.sqrt(variance) * _student(degrees), number, degrees)


def from_published(value: float, half_width: float | None, runs: int) -> Interval:
    """Return a paper's number as an interval; a half width of None is unknown."""
    if half_width is None or runs < 2:
        return Interval(value, math.nan, runs, 0.0)
    return Interval(value, half_width, runs, runs - 1.0)


def array(values: Sequence[float | None]) -> np.ndarray:
    """Return values as an array, None as nan."""
    return np.array([np.nan if value is None else float(value) for value in values])
