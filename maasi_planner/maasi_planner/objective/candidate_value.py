"""The value J of a candidate, alone or given the choices of the others (000, (17), (26))."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from maasi_planner.objective.candidate_table import CandidateTable
from maasi_planner.objective.information import expected_new_targets, information_gain
from maasi_planner.objective.paper import explored

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


@njit(cache=True)
def _weighed(
    control: float,
    refinement: float,
    exploration: float,
    norm: float,
    alpha: float,
    beta: float,
    control_weight: float,
) -> float:
    """Return J (17), (26) of one candidate."""
    return (-control_weight * control + alpha * refinement + beta * exploration) / norm


@njit(cache=True)
def candidate_value(
    table: CandidateTable, g: int, chosen: IntArray, work: FloatArray
) -> tuple[float, float, float]:
    """Return T, E and J of candidate g, given the others' choices in `chosen` (R,), -1 for none."""
    if table.information:
        refinement = information_gain(table, g, chosen, work)
        exploration = expected_new_targets(table, g, chosen) if table.beta > 0.0 else 0.0
    else:
        refinement = table.refinement[g]
        exploration = explored(table, g, chosen) if table.beta > 0.0 else 0.0
    value = _weighed(
        table.control[g],
        refinement,
        exploration,
        table.norm[g],
        table.alpha,
        table.beta,
        table.control_weight,
    )
    return refinement, exploration, value


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
def alone_on_paper(
    refinement: FloatArray,
    entry_start: IntArray,
    entry_value: FloatArray,
    control: FloatArray,
    norm: FloatArray,
    allowed: BoolArray,
    alpha: float,
    beta: float,
    control_weight: float,
    out: FloatArray,
) -> None:
    """Do what `alone_values` does for `paper`, without handing over the whole table."""
    for g in range(out.shape[0]):
        explored = 0.0
        for i in range(entry_start[g], entry_start[g + 1]):
            explored += entry_value[i]
        out[g, 0] = refinement[g]
        out[g, 1] = explored
        value = _weighed(control[g], refinement[g], explored, norm[g], alpha, beta, control_weight)
        out[g, 2] = value if allowed[g] else -np.inf


@njit(cache=True)
def alone_values(table: CandidateTable, out: FloatArray) -> None:
    """Write T, E and J of each candidate without the other planning robots into out (G, 3)."""
    chosen = np.full(table.radii.shape[0], -1, np.int64)
    work = np.zeros((3, 3, 3))
    for g in range(out.shape[0]):
        refinement, exploration, value = candidate_value(table, g, chosen, work)
        out[g, 0] = refinement
        out[g, 1] = exploration
        out[g, 2] = value if table.allowed[g] else -np.inf


@njit(cache=True)
def given_values(table: CandidateTable, robot: int, chosen: IntArray, out: FloatArray) -> None:
    """Write T, E and J of each candidate of one robot, given the others, into out (W, 3)."""
    work = np.zeros((3, 3, 3))
    for g in range(table.start[robot], table.start[robot + 1]):
        refinement, exploration, value = candidate_value(table, g, chosen, work)
        row = g - table.start[robot]
        out[row, 0] = refinement
        out[row, 1] = exploration
        out[row, 2] = value if table.allowed[g] and not collides(table, g, chosen) else -np.inf
