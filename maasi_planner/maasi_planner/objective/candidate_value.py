"""The value J of a candidate, alone or given the choices of the others (000, (17), (26))."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from maasi_filter.arrays import BoolArray, FloatArray, IntArray
from maasi_planner.objective.information import InformationTerms, information_gain
from maasi_planner.objective.paper import PaperTerms, left_by
from maasi_planner.objective.predicted_measurements import Measurements


class CandidateTable(NamedTuple):
    """The candidates of the planning robots, with the terms of the objective in use.

    G candidates of R robots, one robot after the other; robot r has start[r] to start[r + 1].
    """

    start: IntArray
    robot: IntArray
    allowed: BoolArray
    waypoints: FloatArray
    radii: FloatArray
    control: FloatArray
    norm: FloatArray
    alpha: float
    beta: float
    control_weight: float
    planned: Measurements
    is_paper: bool
    paper: PaperTerms
    information: InformationTerms


@njit(cache=True)
def _counted_before(table: CandidateTable, g: int, chosen: IntArray) -> IntArray:
    """Return the chosen candidates of others whose measurements g gets no credit for.

    In `information` what two see counts for the one with the shorter way.
    """
    out = np.empty(chosen.shape[0], np.int64)
    number = 0
    for r in range(chosen.shape[0]):
        other = chosen[r]
        if r == table.robot[g] or other < 0:
            continue
        shorter = table.norm[other] < table.norm[g]
        tie = table.norm[other] == table.norm[g] and r < table.robot[g]
        if table.is_paper or shorter or tie:
            out[number] = other
            number += 1
    return out[:number]


@njit(cache=True)
def exploration_given(table: CandidateTable, g: int, others: IntArray) -> float:
    """Return E of candidate g, given others that count before it."""
    if table.is_paper:
        left = table.paper.value[table.paper.start[g] : table.paper.start[g + 1]].copy()
    else:
        left = table.information.unseen * (1.0 - table.information.miss[g])
    for other in others:
        if table.is_paper:
            factor = left_by(table.paper, table.planned, g, other)
        else:
            factor = table.information.miss[other]
        for i in range(left.shape[0]):
            left[i] *= factor[i]
    total = 0.0
    for i in range(left.shape[0]):
        total += left[i]
    return total


@njit(cache=True)
def candidate_value(
    table: CandidateTable, g: int, chosen: IntArray, work: FloatArray
) -> tuple[float, float, float]:
    """Return T, E and J (17), (26) of g, given the others' choices (R,), -1 for none."""
    others = _counted_before(table, g, chosen)
    if table.is_paper:
        refinement = table.paper.refinement[g]
    else:
        refinement = information_gain(table.information, g, others, work)
    exploration = exploration_given(table, g, others) if table.beta > 0.0 else 0.0
    value = -table.control_weight * table.control[g] + table.alpha * refinement
    return refinement, exploration, (value + table.beta * exploration) / table.norm[g]


@njit(cache=True)
def collides(table: CandidateTable, g: int, chosen: IntArray) -> bool:
    """Return whether the waypoint of g is within the radii of another chosen waypoint."""
    robot = table.robot[g]
    for r in range(chosen.shape[0]):
        if r == robot or chosen[r] < 0:
            continue
        reach = table.radii[robot] + table.radii[r]
        if reach > 0.0:
            square = 0.0
            for axis in range(3):
                square += (table.waypoints[g, axis] - table.waypoints[chosen[r], axis]) ** 2
            if square < reach * reach:
                return True
    return False


@njit(cache=True)
def total_value(table: CandidateTable, chosen: IntArray, work: FloatArray) -> float:
    """Return the sum of J over all chosen candidates (26)."""
    total = 0.0
    for r in range(chosen.shape[0]):
        if chosen[r] >= 0:
            total += candidate_value(table, chosen[r], chosen, work)[2]
    return total


@njit(cache=True)
def values_given(table: CandidateTable, first: int, last: int, chosen: IntArray) -> FloatArray:
    """Return T, E and J of the candidates `first` to `last`, given the others' choices, (n, 3)."""
    out = np.empty((last - first, 3))
    work = np.zeros((3, 3, 3))
    for g in range(first, last):
        refinement, exploration, value = candidate_value(table, g, chosen, work)
        out[g - first, 0] = refinement
        out[g - first, 1] = exploration
        admissible = table.allowed[g] and not collides(table, g, chosen)
        out[g - first, 2] = value if admissible else -np.inf
    return out
