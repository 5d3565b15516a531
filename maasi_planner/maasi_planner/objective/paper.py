"""Refinement T and exploration E as 000 prints them: (18) to (22), (31), (32)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from maasi_filter.arrays import FloatArray, IntArray
from maasi_filter.models.detection import fill_probabilities
from maasi_planner.objective.predicted_measurements import Measurements, apply_misses

Grid = tuple[FloatArray, FloatArray, FloatArray]
CACHE_ROWS = 8000


class PaperTerms(NamedTuple):
    """T of the candidates (G,), and what their E consists of.

    (22) interpolates e between grid nodes: candidate g has the nodes start[g] to start[g + 1], of
    each value (n,) its weight times what is unseen, place (3, n) [m], in 2D with z = 0, and time
    (n,) of the measurement [steps from now]. What the measurements of another candidate leave there
    is kept: slot (G, G) is a row of cache (S, longest), filled on first use; used (1,) counts rows.
    """

    refinement: FloatArray
    start: IntArray
    value: FloatArray
    place: FloatArray
    time: IntArray
    slot: IntArray
    cache: FloatArray
    used: IntArray


# Of the objective `information`.
NO_PAPER = PaperTerms(
    refinement=np.zeros(0),
    start=np.zeros(1, np.int64),
    value=np.zeros(0),
    place=np.zeros((3, 0)),
    time=np.zeros(0, np.int64),
    slot=np.zeros((0, 0), np.int64),
    cache=np.zeros((0, 0)),
    used=np.zeros(1, np.int64),
)


@njit(cache=True)
def centre_sum(planned: Measurements, first: int, centres: FloatArray) -> FloatArray:
    """Return T of each candidate: the sum of pi at cluster centres (000, (19), (31))."""
    out = np.zeros(planned.own.shape[0])
    number = centres.shape[0]
    chance = np.empty(number)
    for g in range(out.shape[0]):
        robot = planned.robot[g]
        kind, parameters = planned.kind[robot], planned.parameters[robot]
        for e in range(planned.start[g] + first, planned.start[g] + planned.own[g]):
            x, y, z = (centres - planned.places[e]).T.copy()
            cosine, sine = planned.turns[e]
            fill_probabilities(kind, parameters, x, y, z, number, cosine, sine, chance)
            for c in range(number):
                out[g] += chance[c]
    return out


@njit(cache=True, error_model='numpy')
def _cell(position: float, lower: float, step: float, nodes: int) -> tuple[int, float]:
    """Return the cell of a grid's axis that a position is in, and where in it, 0 to 1."""
    u = min(max((position - lower) / step, 0.0), nodes - 1.0)
    cell = min(np.int64(u), nodes - 2)
    return cell, u - cell


@njit(cache=True)
def _nodes_around(
    at: FloatArray, grid: Grid, number: int, value: FloatArray, place: FloatArray
) -> int:
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
                    place[0, number] = lower[0] + i * step[0]
                    place[1, number] = lower[1] + j * step[1]
                    place[2, number] = lower[2] + k * step[2] if depth == 2 else 0.0
                    number += 1
    return number


@njit(cache=True)
def _unseen_nodes(
    planned: Measurements, settled: Measurements, first: int, own_counts: bool, grid: Grid
) -> tuple[IntArray, FloatArray, FloatArray, IntArray]:
    """Return start, value, place and time of `PaperTerms` without the other planning robots.

    `own_counts`: whether a measurement itself is in its product (21).
    """
    most = 8 * planned.own.sum()
    start = np.zeros(planned.own.shape[0] + 1, np.int64)
    value, place, time = np.empty(most), np.empty((3, most)), np.empty(most, np.int64)
    number = 0
    for g in range(planned.own.shape[0]):
        for e in range(planned.start[g] + first, planned.start[g] + planned.own[g]):
            before = number
            number = _nodes_around(planned.places[e], grid, number, value, place)
            time[before:number] = planned.times[e]
        start[g + 1] = number
        rows = slice(start[g], number)
        where, when, left = place[:, rows], time[rows], np.ones(number - start[g])
        until = when if own_counts else when - 1
        apply_misses(where, until, left, planned, g, 0, planned.own[g])
        value[rows] *= left
        for s in range(settled.own.shape[0]):
            total = settled.start[s + 1] - settled.start[s]
            apply_misses(where, when, value[rows], settled, s, 0, total)
    return start, value[:number], place[:, :number], time[:number]


def paper_terms(
    planned: Measurements,
    settled: Measurements,
    first: int,
    own_counts: bool,
    centres: FloatArray,
    grid: Grid,
) -> PaperTerms:
    """Return the terms of candidates with their predicted measurements, from `first` on.

    `settled` are the measurements of the robots that do not plan, `grid` the values, first node and
    distances of e.
    """
    nodes = _unseen_nodes(planned, settled, first, own_counts, grid)
    pairs = len(planned.own) if len(planned.kind) > 1 else 0
    longest = int(np.diff(nodes[0]).max(initial=0))
    return PaperTerms(
        centre_sum(planned, first, centres),
        *nodes,
        slot=np.full((pairs, pairs), -1),
        cache=np.empty((min(CACHE_ROWS, pairs * pairs), longest)),
        used=np.zeros(1, np.int64),
    )


@njit(cache=True)
def left_by(terms: PaperTerms, planned: Measurements, g: int, other: int) -> FloatArray:
    """Return what the measurements of candidate `other` leave at the nodes of g."""
    begin, end = terms.start[g], terms.start[g + 1]
    slot = terms.slot[g, other]
    if slot >= 0:
        return terms.cache[slot, : end - begin]
    if terms.used[0] < terms.cache.shape[0]:
        slot = terms.used[0]
        terms.used[0] += 1
        terms.slot[g, other] = slot
        out = terms.cache[slot, : end - begin]
    else:
        out = np.empty(end - begin)
    out[:] = 1.0
    total = planned.start[other + 1] - planned.start[other]
    place, until = terms.place[:, begin:end], terms.time[begin:end]
    apply_misses(place, until, out, planned, other, 0, total)
    return out
