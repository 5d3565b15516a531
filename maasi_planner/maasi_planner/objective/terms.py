"""Refinement T and exploration E of a candidate, given the choices of other robots."""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from maasi_filter.arrays import FloatArray, IntArray
from maasi_planner.objective.predicted_measurements import Measurements, apply_misses

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
