"""Errors of the estimate of a set of targets."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from maasi_filter.arrays import FloatArray, IntArray


@dataclass(frozen=True)
class Gospa:
    """GOSPA with alpha = 2 and its parts (Rahmathullah, Garcia-Fernandez and Svensson, 2017).

    `total` is (localisation + missed + false) to the power 1/p.
    """

    total: float  #: The metric, metres.
    localisation: float  #: Sum of distances of matched pairs, to the power p.
    missed: float  #: c^p / 2 for each unmatched target.
    false: float  #: c^p / 2 for each unmatched estimate.
    matched: int  #: Number of pairs.


def _points(name: str, value: ArrayLike) -> FloatArray:
    array = np.asarray(value, dtype=float)
    if array.size == 0:
        return np.empty((0, array.shape[1] if array.ndim == 2 else 0))
    if array.ndim != 2:
        raise ValueError(f'{name}: got shape {array.shape}, allowed is (n, d)')
    if not np.isfinite(array).all():
        raise ValueError(f'{name}: got a number that is not finite')
    return array


def _distances(estimates: ArrayLike, truth: ArrayLike) -> FloatArray:
    ours = _points('estimates', estimates)
    theirs = _points('truth', truth)
    if len(ours) == 0 or len(theirs) == 0:
        return np.zeros((len(ours), len(theirs)))
    if ours.shape[1] != theirs.shape[1]:
        raise ValueError(
            f'estimates, truth: got {ours.shape[1]} and {theirs.shape[1]} coordinates, '
            'allowed is the same number'
        )
    return np.sqrt(((ours[:, None, :] - theirs[None, :, :]) ** 2).sum(axis=2))


def _assign(cost: FloatArray) -> tuple[IntArray, IntArray]:
    # Deferred: the slowest import, which no node needs.
    from scipy.optimize import linear_sum_assignment

    rows, columns = linear_sum_assignment(cost)
    return rows, columns


def _positive(name: str, value: float, least: float = 0.0) -> None:
    if not (math.isfinite(value) and value > 0.0 and value >= least):
        raise ValueError(f'{name}: got {value}, allowed are finite numbers above {least}')


def gospa(estimates: ArrayLike, truth: ArrayLike, cutoff: float, power: float = 2.0) -> Gospa:
    """Return the GOSPA metric between two sets of points.

    Parameters
    ----------
    estimates : (n, d) array
        Estimated positions, metres.
    truth : (m, d) array
        True positions, metres.
    cutoff : float
        c, largest distance of a matched pair, metres.
    power : float
        p, at least 1.
    """
    _positive('cutoff', cutoff)
    _positive('power', power, 1.0)
    apart = _distances(estimates, truth)
    cost = np.minimum(apart, cutoff) ** power
    rows, columns = _assign(cost)
    matched = apart[rows, columns] < cutoff
    localisation = float(cost[rows, columns][matched].sum())
    pairs = int(matched.sum())
    each = 0.5 * cutoff**power
    missed = each * (apart.shape[1] - pairs)
    false = each * (apart.shape[0] - pairs)
    total = (localisation + missed + false) ** (1.0 / power)
    return Gospa(float(total), localisation, float(missed), float(false), pairs)


@dataclass(frozen=True)
class Match:
    """One-to-one matching of found targets to true ones."""

    pairs: list[tuple[int, int]]  #: Indices of found and true target.
    true_found: int  #: Number of pairs.
    missed: int  #: Number of unmatched true targets.
    false_found: int  #: Number of unmatched found targets.
    rmse: float  #: Root mean square distance of the pairs, metres; nan without pairs.


def match_targets(estimates: ArrayLike, truth: ArrayLike, radius: float) -> Match:
    """Match as many found targets as possible to true ones, closest first.

    Parameters
    ----------
    estimates : (m, d) array
        Found targets [m].
    truth : (n, d) array
        True targets [m].
    radius : float
        Largest distance of a pair [m].

    Returns
    -------
    Match
        Pairs of indices, counts, and the root mean square distance [m].

    Raises
    ------
    ValueError
        If shapes do not fit or `radius` is not above 0.
    """
    _positive('radius', radius)
    apart = _distances(estimates, truth)
    # One more pair outweighs any sum of distances.
    worth = (min(apart.shape) + 1.0) * radius**2 if apart.size else 0.0
    cost = np.where(apart <= radius, apart**2 - worth, 0.0)
    rows, columns = _assign(cost)
    near = apart[rows, columns] <= radius
    pairs = [(int(i), int(j)) for i, j in zip(rows[near], columns[near])]
    squares = apart[rows, columns][near] ** 2
    return Match(
        pairs=pairs,
        true_found=len(pairs),
        missed=apart.shape[1] - len(pairs),
        false_found=apart.shape[0] - len(pairs),
        rmse=math.sqrt(float(squares.mean())) if len(squares) else math.nan,
    )
