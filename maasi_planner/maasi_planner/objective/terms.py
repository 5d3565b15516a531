"""Refinement T and exploration E of a candidate, given the choices of other robots.

As 000 prints them, (18) to (22), (31), (32); or T as information about clusters, and E as expected
new targets.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba import njit

from maasi_filter.arrays import FloatArray, IntArray
from maasi_filter.models.detection import BOX
from maasi_filter.models.pose import Pose
from maasi_planner.objective.predicted_measurements import (
    NEVER,
    Measurements,
    apply_misses,
    chances,
)
from maasi_planner.settings import PlannerSettings
from maasi_planner.team import RobotView, TeamView

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


@njit(cache=True)
def _add_information(
    rows: FloatArray,
    lower: FloatArray,
    chance: FloatArray,
    owner: IntArray,
    cluster: IntArray,
    out: FloatArray,
) -> None:
    """Add pi H' R^-1 H to out; rows H (n, d, d) become H in units of the noise, in place."""
    d = lower.shape[0]
    for i in range(chance.shape[0]):
        for a in range(d):
            for b in range(d):
                for k in range(a):
                    rows[i, a, b] -= lower[a, k] * rows[i, k, b]
                rows[i, a, b] /= lower[a, a]
        for a in range(d):
            for b in range(d):
                total = 0.0
                for k in range(d):
                    total += rows[i, k, a] * rows[i, k, b]
                out[owner[i], cluster[i], a, b] += chance[i] * total


def _information(
    views: Sequence[RobotView], measured: Measurements, first: int, centres: FloatArray, d: int
) -> FloatArray:
    """Return sum pi H' R^-1 H over the planned measurements from `first` on, (G, C, d, d)."""
    out = np.zeros((len(measured.own), len(centres), d, d))
    chance = chances(measured, first, centres)
    for robot, view in enumerate(views):
        lower: FloatArray = np.linalg.cholesky(view.sensor.covariance).astype(float)
        owner, index, cluster = np.nonzero(chance * (measured.robot == robot)[:, None, None])
        offsets = (centres[cluster] - measured.places[owner, index])[:, :d]
        # Nearer than the noise of the range the linear model would promise too much.
        distance = np.sqrt((offsets * offsets).sum(axis=1))
        offsets *= np.maximum(1.0, lower[0, 0] / np.maximum(distance, 1e-12))[:, None]
        jacobian = view.sensor.measurement.jacobian(offsets, Pose(np.zeros(3)))
        seen = chance[owner, index, cluster]
        _add_information(jacobian, lower, seen, owner, cluster, out)
    return out


def _unseen(
    team: TeamView, settings: PlannerSettings, every_node: bool
) -> tuple[FloatArray, FloatArray]:
    """Return places (3, L) [m], nodes of e or blocks of them, and the unseen targets of each."""
    values, lower, step = team.exploration.kernel()
    volumes = team.exploration.cell_volumes().reshape(values.shape)
    most, stride = settings.exploration_nodes, 1
    while not every_node and np.prod([-(-size // stride) for size in values.shape]) > most:
        stride += 1
    # Nodes of each axis by the block that they are in.
    x, y, z = np.ix_(*(np.arange(size) // stride for size in values.shape))
    shape = [int(blocks.max()) + 1 for blocks in (x, y, z)]
    block = (x * shape[1] + y) * shape[2] + z
    left = np.bincount(block.ravel(), (values * volumes).ravel()).astype(float)
    start = lower + 0.5 * (stride - 1) * step
    places = start[:, None] + (stride * step)[:, None] * np.indices(shape).reshape(3, -1)
    return places, left * (team.area.expected_targets / float(volumes.sum()))


@njit(cache=True)
def _misses(measured: Measurements, first: int, places: FloatArray) -> FloatArray:
    """Return the product of 1 - pi of planned measurements from `first` on, at places, (G, L)."""
    out = np.ones((measured.own.shape[0], places.shape[1]))
    until, at = np.full(places.shape[1], NEVER), (places[0], places[1], places[2])
    for g in range(out.shape[0]):
        apply_misses(at, until, out[g], measured, g, first, measured.own[g])
    return out


def information_terms(
    team: TeamView,
    settings: PlannerSettings,
    planned: tuple[Sequence[RobotView], Measurements],
    settled: tuple[Sequence[RobotView], Measurements],
    first: int,
    centres: FloatArray,
) -> Terms:
    """Return the terms of candidates by measurements from `first` on, beside `settled` ones."""
    d, clusters = team.dimension, team.clusters
    places, left = _unseen(team, settings, bool((planned[1].kind >= BOX).any()))
    for miss in _misses(settled[1], 0, places):
        left *= miss
    kept = np.flatnonzero(left > 0.0)
    miss = _misses(planned[1], first, np.ascontiguousarray(places[:, kept]))
    total = len(miss)
    return Terms(
        refinement=np.zeros(total),
        filled=np.full(total, len(kept)),
        value=left[kept] * (1.0 - miss),
        slot=np.tile(np.arange(total), (total, 1)),
        cache=miss,
        mass=np.array([min(1.0, max(0.0, cluster.mass)) for cluster in clusters], float),
        covariance=np.array([c.covariance[:d, :d] for c in clusters], float).reshape(-1, d, d),
        base=_information(*settled, 0, centres, d).sum(axis=0),
        gain=_information(*planned, first, centres, d),
    )
