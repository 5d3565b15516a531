"""Refinement T and exploration E of a candidate, given the choices of other robots.

As 000 prints them, (18) to (22), (31), (32); of `information.py` they are of another kind.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from maasi_filter.arrays import FloatArray, IntArray
from maasi_planner.objective.predicted_measurements import Measurements, apply_misses, chances

CACHE_ROWS = 8000  # rows kept of what one candidate leaves of another


class Terms(NamedTuple):
    """What T and E of G candidates consist of.

    E is what others leave of value (G, n), of which filled[g] numbers are used: their product with
    what each other candidate leaves. That is row slot (G, G) of cache (S, n), or where that is
    negative comes from its measurements until time (G, n) [steps from now] at place (3, G, n) [m],
    and is kept, as the search needs it many times; used (1,) counts rows.

    T is refinement (G,), and of C clusters with mass (C,) and covariance (C, d, d) the information
    that a candidate's gain (G, C, d, d) adds to base (C, d, d), both sums of pi H' R^-1 H.
    """

    refinement: FloatArray
    filled: IntArray
    value: FloatArray
    slot: IntArray
    cache: FloatArray
    place: FloatArray = np.zeros((3, 0, 0))
    time: IntArray = np.zeros((0, 0), np.int64)
    used: IntArray = np.zeros(1, np.int64)
    mass: FloatArray = np.zeros(0)
    covariance: FloatArray = np.zeros((0, 0, 0))
    base: FloatArray = np.zeros((0, 0, 0))
    gain: FloatArray = np.zeros((0, 0, 0, 0))


@njit(cache=True)
def left_by(terms: Terms, planned: Measurements, g: int, other: int) -> FloatArray:
    """Return what the measurements of candidate `other` leave of the value of g."""
    count, slot = terms.filled[g], terms.slot[g, other]
    if slot >= 0:
        return terms.cache[slot, :count]
    out = np.ones(count)
    until, number, place = terms.time[g, :count], planned.number[other], terms.place
    at = place[0, g, :count], place[1, g, :count], place[2, g, :count]
    # Not a literal, for which it would be compiled once more.
    apply_misses(at, until, out, planned, other, np.int64(0), number)
    if terms.used[0] < terms.cache.shape[0]:
        for index in range(count):
            terms.cache[terms.used[0], index] = out[index]
        terms.slot[g, other] = terms.used[0]
        terms.used[0] += 1
    return out


@njit(cache=True, forceinline=True)
def exploration_given(terms: Terms, planned: Measurements, g: int, others: IntArray) -> float:
    """Return E of candidate g, given others that count before it."""
    left = terms.value[g, : terms.filled[g]].copy()
    for other in others:
        left *= left_by(terms, planned, g, other)
    return left.sum()


@njit(cache=True)
def _log_det(matrix: FloatArray) -> float:
    """Return log det of a (3, 3) matrix with determinant of at least 1."""
    det = (
        matrix[0, 0] * (matrix[1, 1] * matrix[2, 2] - matrix[1, 2] * matrix[2, 1])
        - matrix[0, 1] * (matrix[1, 0] * matrix[2, 2] - matrix[1, 2] * matrix[2, 0])
        + matrix[0, 2] * (matrix[1, 0] * matrix[2, 1] - matrix[1, 1] * matrix[2, 0])
    )
    return math.log(max(det, 1.0))


@njit(cache=True, forceinline=True)
def refinement_given(terms: Terms, g: int, others: IntArray) -> float:
    """Return T of candidate g, given the candidates `others` that count before it."""
    total = terms.refinement[g]
    clusters, d, _ = terms.covariance.shape
    # In 2D the third row and column stay those of the identity.
    known, before, after = np.empty((d, d)), np.eye(3), np.eye(3)
    for c in range(clusters):
        if not np.any(terms.gain[g, c]):
            continue
        # By elements: an assignment to a slice takes seconds to compile.
        for a in range(d):
            for b in range(d):
                known[a, b] = terms.base[c, a, b]
        for other in others:
            known += terms.gain[other, c]
        for a in range(d):
            for b in range(d):
                before[a, b] = 1.0 if a == b else 0.0
                extra = 0.0
                for k in range(d):
                    before[a, b] += terms.covariance[c, a, k] * known[k, b]
                    extra += terms.covariance[c, a, k] * terms.gain[g, c, k, b]
                after[a, b] = before[a, b] + extra
        total += 0.5 * terms.mass[c] * max(0.0, _log_det(after) - _log_det(before))
    return total


Grid = tuple[FloatArray, FloatArray, FloatArray]


@njit(cache=True, error_model='numpy')
def _unseen_nodes(
    planned: Measurements, settled: Measurements, first: int, own_counts: bool, grid: Grid
) -> tuple[IntArray, FloatArray, FloatArray, IntArray]:
    """Return count, value, place and time of `Terms`, without the other planning robots.

    (22) interpolates e between grid nodes: each has its weight times what is unseen there. With
    `own_counts` a measurement itself is in its product (21).
    """
    values, lower, step = grid
    total, corners = planned.own.shape[0], 8 if values.shape[2] > 1 else 4
    most = corners * planned.times.shape[1]
    count = np.zeros(total, np.int64)
    value, time = np.empty((total, most)), np.empty((total, most), np.int64)
    place = np.empty((3, total, most))
    low, share = np.zeros(3, np.int64), np.zeros(3)
    for g in range(total):
        number = 0
        for e in range(first, planned.own[g]):
            for axis in range(3 if corners == 8 else 2):
                u = (planned.places[g, e, axis] - lower[axis]) / step[axis]
                u = min(max(u, 0.0), values.shape[axis] - 1.0)
                low[axis] = min(np.int64(u), values.shape[axis] - 2)
                share[axis] = u - low[axis]
            for corner in range(0, 8, 8 // corners):
                i, j, k = low[0] + (corner >> 2), low[1] + (corner >> 1 & 1), low[2] + (corner & 1)
                weight = share[0] if corner & 4 else 1.0 - share[0]
                weight *= share[1] if corner & 2 else 1.0 - share[1]
                weight *= share[2] if corner & 1 else 1.0 - share[2]
                weight *= values[i, j, k]
                if weight > 0.0:
                    value[g, number], time[g, number] = weight, planned.times[g, e]
                    place[0, g, number] = lower[0] + i * step[0]
                    place[1, g, number] = lower[1] + j * step[1]
                    place[2, g, number] = lower[2] + k * step[2]
                    number += 1
        count[g], worth, when, left = number, value[g, :number], time[g, :number], np.ones(number)
        at = place[0, g, :number], place[1, g, :number], place[2, g, :number]
        until = when if own_counts else when - 1
        apply_misses(at, until, left, planned, g, np.int64(0), planned.own[g])
        worth *= left
        for s in range(settled.own.shape[0]):
            apply_misses(at, when, worth, settled, s, np.int64(0), settled.number[s])
    return count, value, place, time


def paper_terms(
    planned: Measurements,
    settled: Measurements,
    first: int,
    own_counts: bool,
    centres: FloatArray,
    grid: Grid,
) -> Terms:
    """Return the terms of candidates with their predicted measurements, from `first` on.

    T is the sum of pi at cluster centres (000, (19), (31)). `settled` are the measurements of the
    robots that do not plan, `grid` the values, first node and distances of e.
    """
    count, value, place, time = _unseen_nodes(planned, settled, first, own_counts, grid)
    pairs = len(planned.own) if len(planned.kind) > 1 else 0
    return Terms(
        refinement=chances(planned, first, centres).sum(axis=(1, 2)),
        filled=count,
        value=value,
        slot=np.full((pairs, pairs), -1),
        cache=np.empty((min(CACHE_ROWS, pairs * pairs), value.shape[1])),
        place=place,
        time=time,
        used=np.zeros(1, np.int64),
    )
