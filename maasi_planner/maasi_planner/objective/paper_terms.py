"""The terms T and E as printed (000, (18) to (22), (31), (32))."""

import numpy as np
from numba import njit

from maasi_filter.arrays import FloatArray, IntArray
from maasi_planner.objective.predicted_measurements import (
    Measurements,
    apply_misses,
    chances,
    parts_of,
)
from maasi_planner.objective.terms import CACHE_KEYS, CACHE_ROWS, Terms

Grid = tuple[FloatArray, FloatArray, FloatArray]


@njit(cache=True, error_model='numpy')
def _unseen_nodes(
    planned: Measurements, settled: Measurements, first: int, own_counts: bool, grid: Grid
) -> tuple[IntArray, FloatArray, FloatArray, IntArray]:
    """Return count, value, position and time of `Terms`, without the other planning robots.

    (22) interpolates e between grid nodes: each has its weight times its unseen share. With
    `own_counts` a measurement itself is in its product (21).
    """
    values, lower, step = grid
    total, corners = planned.own.shape[0], 8 if values.shape[2] > 1 else 4
    most = corners * max(1, planned.own.max() - first)
    count = np.zeros(total, np.int64)
    value, time = np.empty((total, most)), np.empty((total, most), np.int64)
    position = np.empty((3, total, most))
    low, share = np.zeros(3, np.int64), np.zeros(3)
    for g in range(total):
        number = 0
        for e in range(first, planned.own[g]):
            for axis in range(3 if corners == 8 else 2):
                u = (planned.positions[g, e, axis] - lower[axis]) / step[axis]
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
                    position[0, g, number] = lower[0] + i * step[0]
                    position[1, g, number] = lower[1] + j * step[1]
                    position[2, g, number] = lower[2] + k * step[2]
                    number += 1
        count[g], worth, when, left = number, value[g, :number], time[g, :number], np.ones(number)
        at = position[0, g, :number], position[1, g, :number], position[2, g, :number]
        until = when if own_counts else when - 1
        apply_misses(at, until, left, planned, g, np.int64(0), planned.own[g])
        worth *= left
        for s in range(settled.own.shape[0]):
            apply_misses(at, when, worth, settled, s, np.int64(0), settled.number[s])
    return count, value, position, time


def paper_terms(
    planned: Measurements,
    settled: Measurements,
    first: int,
    own_counts: bool,
    centres: FloatArray,
    grid: Grid,
) -> Terms:
    """Return the terms of candidates for their predicted measurements from `first` on.

    T is the sum of pi at cluster centres (000, (19), (31)). `settled` are the measurements of
    robots that do not plan; `grid` has the values, first node and distances of e.
    """
    count, value, position, time = _unseen_nodes(planned, settled, first, own_counts, grid)
    total = len(planned.own)
    seen = [
        chances(part, first, centres).sum(axis=(1, 2))
        for _, part in parts_of(planned, len(centres))
    ]
    kept = min(CACHE_ROWS, total * total) if len(planned.kind) > 1 else 0
    return Terms(
        information=False,
        refinement=np.concatenate(seen),
        first=np.zeros(total + 1, np.int64),
        filled=count,
        value=value,
        position=position,
        time=time,
        keys=np.full(CACHE_KEYS, -1),
        slots=np.zeros(CACHE_KEYS, np.int32),
        rows=np.empty((kept, value.shape[1])),
        used=np.zeros(1, np.int64),
        gain_first=np.zeros(total + 1, np.int64),
    )
