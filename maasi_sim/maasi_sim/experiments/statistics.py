"""Means with their confidence, of numbers, of durations cut short, and of paired differences."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
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
        Values behind it.
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
        return self.half_width / float(stats.t.ppf(0.5 + 0.5 * LEVEL, self.degrees))


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
    return Interval(
        mean, error * float(stats.t.ppf(0.5 + 0.5 * LEVEL, number - 1)), number, number - 1.0
    )


def restricted_mean(durations: ArrayLike, finished: ArrayLike, limit: float) -> Interval:
    """Return the mean of min(T, limit), where some of the durations T were cut short.

    The area under Kaplan and Meier's curve up to the limit. Where nothing is cut short before
    the limit, that is the plain mean of min(T, limit), and the interval is Student's of it;
    otherwise Greenwood's variance is used.

    Parameters
    ----------
    durations : (n,) array
        T, or how long was tried.
    finished : (n,) array of bool
        Whether it is T.
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
    survival, area, last = 1.0, 0.0, 0.0
    steps: list[tuple[float, int, int]] = []
    areas: list[float] = []
    for time in np.unique(times[ended]):
        area += survival * (time - last)
        areas.append(area)
        last = float(time)
        risk = int((times >= time).sum())
        deaths = int((ended & (times == time)).sum())
        survival *= 1.0 - deaths / risk
        steps.append((last, risk, deaths))
    total = area + survival * (limit - last)
    variance = 0.0
    for (_, risk, deaths), before in zip(steps, areas):
        if risk > deaths:
            variance += (total - before) ** 2 * deaths / (risk * (risk - deaths))
    half = math.sqrt(variance) * float(stats.t.ppf(0.5 + 0.5 * LEVEL, max(number - 1, 1)))
    return Interval(total, half if number > 1 else math.nan, number, max(number - 1.0, 0.0))


def paired_difference(first: ArrayLike, second: ArrayLike) -> Interval:
    """Return the mean of first minus second on the same maps; pairs with a nan are left out.

    Raises
    ------
    ValueError
        If the lengths differ.
    """
    one, two = np.asarray(first, dtype=float), np.asarray(second, dtype=float)
    if one.shape != two.shape:
        raise ValueError(f'first, second: got shapes {one.shape}, {two.shape}, allowed are equal')
    return mean_interval(one - two)


def independent_difference(first: Interval, second: Interval) -> Interval:
    """Return the difference of two means of different runs, after Welch and Satterthwaite.

    Without a spread of one of them the interval is that of the other: too narrow, but all that
    is known.
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
    half = math.sqrt(variance) * float(stats.t.ppf(0.5 + 0.5 * LEVEL, degrees))
    return Interval(difference, half, number, degrees)


def from_published(value: float, half_width: float | None, runs: int) -> Interval:
    """Return a paper's number as an interval; a half width of None is not known."""
    if half_width is None or runs < 2:
        return Interval(value, math.nan, runs, 0.0)
    return Interval(value, half_width, runs, runs - 1.0)


def array(values: Sequence[float | None]) -> np.ndarray:
    """Return values as an array, nan where there is none."""
    return np.array([np.nan if value is None else float(value) for value in values])
