"""Refinement T and exploration E as 000 prints them: (18) to (22), (31), (32)."""

from __future__ import annotations

import numpy as np
from numba import njit

from maasi_filter.arrays import FloatArray, IntArray
from maasi_planner.objective.predicted_measurements import (
    Measurements,
    Places,
    apply_misses,
    chances,
)
from maasi_planner.objective.terms import CACHE_ROWS, Terms

Grid = tuple[FloatArray, FloatArray, FloatArray]


@njit(cache=True, error_model='numpy')
def _cell(position: float, lower: float, step: float, nodes: int) -> tuple[int, float]:
    """Return the cell of a grid's axis that a position is in, and where in it, 0 to 1."""
    u = min(max((position - lower) / step, 0.0), nodes - 1.0)
    cell = min(np.int64(u), nodes - 2)
    return cell, u - cell


@njit(cache=True, forceinline=True)
def _nodes_around(at: FloatArray, grid: Grid, number: int, value: FloatArray, place: Places) -> int:
    """Add the nodes around a place with their weight times e, if above 0; return the new number."""
    values, lower, step = grid
    depth = 2 if values.shape[2] > 1 else 1
    i0, u = _cell(at[0], lower[0], step[0], values.shape[0])
    j0, v = _cell(at[1], lower[1], step[1], values.shape[1])
    k0, w = np.int64(0), 0.0
    if depth == 2:
        k0, w = _cell(at[2], lower[2], step[2], values.shape[2])
    for i in range(i0, i0 + 2):
        for j in range(j0, j0 + 2):
            for k in range(k0, k0 + depth):
                weight = (u if i > i0 else 1.0 - u) * (v if j > j0 else 1.0 - v)
                weight = weight * (w if k > k0 else 1.0 - w) * values[i, j, k]
                if weight > 0.0:
                    value[number] = weight
                    place[0][number] = lower[0] + i * step[0]
                    place[1][number] = lower[1] + j * step[1]
                    place[2][number] = lower[2] + k * step[2] if depth == 2 else 0.0
                    number += 1
    return number


@njit(cache=True)
def _unseen_nodes(
    planned: Measurements, settled: Measurements, first: int, own_counts: bool, grid: Grid
) -> tuple[IntArray, FloatArray, FloatArray, IntArray]:
    """Return count, value, place and time of `Terms`, without the other planning robots.

    (22) interpolates e between grid nodes: each has its weight times what is unseen there. With
    `own_counts` a measurement itself is in its product (21).
    """
    total, most = planned.own.shape[0], 8 * max(planned.own) if planned.own.shape[0] else 0
    count = np.zeros(total, np.int64)
    value, time = np.empty((total, most)), np.empty((total, most), np.int64)
    place = np.empty((3, total, most))
    for g in range(total):
        number, worth, when = 0, value[g], time[g]
        at = place[0, g], place[1, g], place[2, g]
        for e in range(first, planned.own[g]):
            before = number
            number = _nodes_around(planned.places[g, e], grid, number, worth, at)
            when[before:number] = planned.times[g, e]
        count[g] = number
        worth, when, left = worth[:number], when[:number], np.ones(number)
        until = when if own_counts else when - 1
        apply_misses(at, until, left, planned, g, 0, planned.own[g])
        worth *= left
        for s in range(settled.own.shape[0]):
            apply_misses(at, when, worth, settled, s, 0, settled.number[s])
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
