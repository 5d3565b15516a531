"""Refinement T and exploration E of a candidate, given the choices of other robots."""

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from maasi_filter.arrays import FloatArray, IntArray
from maasi_planner.objective.predicted_measurements import Measurements, apply_misses

IndexArray = NDArray[np.int32]
CACHE_ROWS = 8000  # cached rows of what one candidate leaves of another
CACHE_KEYS = 1 << 15  # entries of their hash table, a power of two


class Terms(NamedTuple):
    """Data for T and E of G candidates, with E as printed or by information.

    By information, E is what a candidate sees of the unseen targets (L,) of L nodes. Rows first[g]
    to first[g + 1] have its nodes (N,), in order, and the unseen factor miss (N,).

    As printed, E is what others leave of value (G, n), of which filled[g] numbers are used: their
    product with what each other candidate leaves by its measurements until time (G, n) [steps from
    now] at position (3, G, n) [m]. Rows (S, n) cache it by pair of candidates, in a hash table of
    keys and slots; used (1,) counts rows.

    T is refinement (G,), and for C clusters with mass (C,) and covariance (C, d, d) the information
    that a candidate adds to base (C, d, d), both sums of pi H' R^-1 H. Rows gain_first[g] to
    gain_first[g + 1] have its clusters, in order, and gains (M, d, d).
    """

    information: bool
    refinement: FloatArray
    first: IntArray
    node: IndexArray = np.zeros(0, np.int32)
    miss: FloatArray = np.zeros(0)
    unseen: FloatArray = np.zeros(0)
    filled: IntArray = np.zeros(0, np.int64)
    value: FloatArray = np.zeros((0, 0))
    position: FloatArray = np.zeros((3, 0, 0))
    time: IntArray = np.zeros((0, 0), np.int64)
    keys: IntArray = np.zeros(0, np.int64)
    slots: IndexArray = np.zeros(0, np.int32)
    rows: FloatArray = np.zeros((0, 0))
    used: IntArray = np.zeros(1, np.int64)
    mass: FloatArray = np.zeros(0)
    covariance: FloatArray = np.zeros((0, 0, 0))
    base: FloatArray = np.zeros((0, 0, 0))
    gain_first: IntArray = np.zeros(1, np.int64)
    cluster: IndexArray = np.zeros(0, np.int32)
    gain: FloatArray = np.zeros((0, 0, 0))


@njit(cache=True)
def left_by(terms: Terms, planned: Measurements, g: int, other: int) -> FloatArray:
    """Return what candidate `other` leaves of the value of g, as printed."""
    count, key = terms.filled[g], g * terms.filled.shape[0] + other
    mask = terms.keys.shape[0] - 1
    index = ((key ^ (key >> 15)) * 2654435761) & mask
    while terms.keys[index] >= 0:
        if terms.keys[index] == key:
            return terms.rows[terms.slots[index], :count]
        index = (index + 1) & mask
    out = np.ones(count)
    until, number, position = terms.time[g, :count], planned.number[other], terms.position
    at = position[0, g, :count], position[1, g, :count], position[2, g, :count]
    # A literal would be compiled separately.
    apply_misses(at, until, out, planned, other, np.int64(0), number)
    if terms.used[0] < terms.rows.shape[0]:
        for i in range(count):
            terms.rows[terms.used[0], i] = out[i]
        terms.keys[index], terms.slots[index] = key, terms.used[0]
        terms.used[0] += 1
    return out


@njit(cache=True)
def seen_by(terms: Terms, g: int) -> FloatArray:
    """Return the expected new targets seen by candidate g at each of its nodes."""
    begin, end = terms.first[g], terms.first[g + 1]
    if end - begin == terms.unseen.shape[0]:
        return terms.unseen * (1.0 - terms.miss[begin:end])
    out = np.empty(end - begin)
    for i in range(begin, end):
        out[i - begin] = terms.unseen[terms.node[i]] * (1.0 - terms.miss[i])
    return out


@njit(cache=True)
def _multiply_by_misses(terms: Terms, g: int, other: int, values: FloatArray) -> None:
    i, i_end = terms.first[g], terms.first[g + 1]
    j, j_end = terms.first[other], terms.first[other + 1]
    if i_end - i == terms.unseen.shape[0] and j_end - j == i_end - i:
        values *= terms.miss[j:j_end]
        return
    begin = i
    while i < i_end and j < j_end:
        one, two = terms.node[i], terms.node[j]
        if one == two:
            values[i - begin] *= terms.miss[j]
        i += one <= two
        j += two <= one


@njit(cache=True, forceinline=True)
def exploration_given(terms: Terms, planned: Measurements, g: int, others: IntArray) -> float:
    """Return E of candidate g, given others that count before it."""
    if terms.information:
        left = seen_by(terms, g)
        for other in others:
            _multiply_by_misses(terms, g, other, left)
        return left.sum()
    left = terms.value[g, : terms.filled[g]].copy()
    for other in others:
        left *= left_by(terms, planned, g, other)
    return left.sum()


@njit(cache=True)
def log_det(matrix: FloatArray) -> float:
    """Return log det of a (3, 3) matrix with determinant of at least 1."""
    det = (
        matrix[0, 0] * (matrix[1, 1] * matrix[2, 2] - matrix[1, 2] * matrix[2, 1])
        - matrix[0, 1] * (matrix[1, 0] * matrix[2, 2] - matrix[1, 2] * matrix[2, 0])
        + matrix[0, 2] * (matrix[1, 0] * matrix[2, 1] - matrix[1, 1] * matrix[2, 0])
    )
    return math.log(max(det, 1.0))


@njit(cache=True)
def gain_of(terms: Terms, g: int, cluster: int) -> int:
    """Return the row of the gain of candidate g for a cluster, or -1 if it has none."""
    low, high = terms.gain_first[g], terms.gain_first[g + 1]
    if high - low == terms.mass.shape[0]:
        return low + cluster
    while low < high:
        middle = (low + high) >> 1
        if terms.cluster[middle] == cluster:
            return middle
        if terms.cluster[middle] < cluster:
            low = middle + 1
        else:
            high = middle
    return -1


@njit(cache=True, forceinline=True)
def refinement_given(terms: Terms, g: int, others: IntArray) -> float:
    """Return T of candidate g, given the candidates `others` that count before it."""
    total = terms.refinement[g]
    d = terms.covariance.shape[1]
    # In 2D the third row and column stay those of the identity.
    known, before, after = np.empty((d, d)), np.eye(3), np.eye(3)
    for row in range(terms.gain_first[g], terms.gain_first[g + 1]):
        if not np.any(terms.gain[row]):
            continue
        c = terms.cluster[row]
        # By elements: an assignment to a slice takes seconds to compile.
        for a in range(d):
            for b in range(d):
                known[a, b] = terms.base[c, a, b]
        for other in others:
            added = gain_of(terms, other, c)
            if added >= 0:
                known += terms.gain[added]
        for a in range(d):
            for b in range(d):
                before[a, b] = 1.0 if a == b else 0.0
                extra = 0.0
                for k in range(d):
                    before[a, b] += terms.covariance[c, a, k] * known[k, b]
                    extra += terms.covariance[c, a, k] * terms.gain[row, k, b]
                after[a, b] = before[a, b] + extra
        total += 0.5 * terms.mass[c] * max(0.0, log_det(after) - log_det(before))
    return total
