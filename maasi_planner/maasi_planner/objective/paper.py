"""Refinement T and exploration E as 000 prints them, (18), (19), (31), (32)."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from maasi_filter.models.detection import detection_probability_at
from maasi_planner.objective.candidate_table import CandidateTable
from maasi_planner.objective.predicted_measurements import Events, Kernel, Measurements
from maasi_planner.objective.unexplored_nodes import (
    ROOM_ROWS,
    Entries,
    apply_misses,
    fill_detection,
    is_vectorised,
)

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@njit(cache=True)
def centre_sum(
    item: Events, first: int, centres: FloatArray, dimension: int, kernel: Kernel, out: FloatArray
) -> None:
    """Write T of each candidate into `out`: the sum of pi at cluster centres (000, (19), (31))."""
    kind, parameters = kernel
    places, turns = item.places, item.turns
    together = is_vectorised(kind)
    room = np.empty((ROOM_ROWS, places.shape[1] * centres.shape[0]))
    for w in range(places.shape[0]):
        total = 0.0
        number = 0
        for i in range(first, item.own[w]):
            for c in range(centres.shape[0]):
                dx = centres[c, 0] - places[w, i, 0]
                dy = centres[c, 1] - places[w, i, 1]
                dz = centres[c, 2] - places[w, i, 2] if dimension == 3 else 0.0
                if together:
                    room[0, number] = dx
                    room[1, number] = dy
                    room[2, number] = dz
                    number += 1
                else:
                    total += detection_probability_at(
                        kind, parameters, dx, dy, dz, turns[w, i, 0], turns[w, i, 1]
                    )
        if together:
            chances = fill_detection(kernel, number, room)
            for i in range(number):
                total += chances[i]
        out[w] = total


@njit(cache=True)
def apply_settled_misses(
    entries: Entries, measured: Measurements, dimension: int, kernel: Kernel
) -> None:
    """Multiply the entries by what a robot whose trajectory is settled will have seen."""
    begin = 0
    for w in range(entries.counts.shape[0]):
        end = begin + entries.counts[w]
        nodes, until = entries.node[begin:end], entries.time[begin:end]
        apply_misses(nodes, until, measured, dimension, kernel, entries.value[begin:end])
        begin = end


@njit(cache=True)
def miss_factors(table: CandidateTable, g: int, other: int) -> FloatArray:
    """Return what the measurements of candidate `other` leave at the entries of g."""
    begin = table.entry_start[g]
    end = table.entry_start[g + 1]
    slot = table.slot[g, other]
    if slot >= 0:
        return table.cache[slot, : end - begin]
    if table.used[0] < table.cache.shape[0]:
        slot = table.used[0]
        table.used[0] += 1
        table.slot[g, other] = slot
        out = table.cache[slot, : end - begin]
    else:
        out = np.empty(end - begin)
    first = table.event_start[other]
    last = table.event_start[other + 1]
    robot = table.robot[other]
    out[:] = 1.0
    apply_misses(
        table.entry_node[begin:end],
        table.entry_time[begin:end],
        Measurements(
            table.event_time[first:last],
            table.event_place[first:last],
            table.event_turn[first:last],
        ),
        table.dimension,
        (table.kind[robot], table.parameters[robot]),
        out,
    )
    return out


@njit(cache=True)
def explored(table: CandidateTable, g: int, chosen: IntArray) -> float:
    """Return E of `paper` for candidate g, given the others (31), (32)."""
    robot = table.robot[g]
    values = table.entry_value[table.entry_start[g] : table.entry_start[g + 1]].copy()
    for r in range(chosen.shape[0]):
        if r != robot and chosen[r] >= 0:
            left = miss_factors(table, g, chosen[r])
            for i in range(values.shape[0]):
                values[i] *= left[i]
    total = 0.0
    for i in range(values.shape[0]):
        total += values[i]
    return total
