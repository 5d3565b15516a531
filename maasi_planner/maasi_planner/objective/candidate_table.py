"""All candidates of a team, and the value J of one given the others' choices (000, (17), (26))."""

from typing import NamedTuple

import numpy as np
from numba import njit

from maasi_filter.arrays import BoolArray, FloatArray, IntArray
from maasi_planner.objective.predicted_measurements import Measurements, part_of
from maasi_planner.objective.terms import Terms, exploration_given, refinement_given


class CandidateTable(NamedTuple):
    """G candidates of R planning robots.

    By information, what two robots see counts for the one with the shorter path.
    """

    allowed: BoolArray
    waypoints: FloatArray
    radii: FloatArray
    cost: FloatArray
    norm: FloatArray
    alpha: float
    beta: float
    planned: Measurements
    terms: Terms


def part_of_table(table: CandidateTable, begin: int, end: int) -> CandidateTable:
    """Return the candidates from `begin` to before `end`, without their terms."""
    each = ('allowed', 'waypoints', 'cost', 'norm')
    parts = {name: getattr(table, name)[begin:end] for name in each}
    return table._replace(**parts, planned=part_of(table.planned, begin, end))


@njit(cache=True, forceinline=True)
def candidate_value(table: CandidateTable, g: int, chosen: IntArray) -> tuple[float, float, float]:
    """Return T, E and J (17), (26) of g, given the others' choices (R,); -1: none."""
    robot = table.planned.robot[g]
    # Chosen candidates that count before g.
    others, number = np.empty(chosen.shape[0], np.int64), 0
    for r in range(chosen.shape[0]):
        other = chosen[r]
        if r == robot or other < 0:
            continue
        if not table.terms.information or (table.norm[other], r) < (table.norm[g], robot):
            others[number] = other
            number += 1
    others = others[:number]
    refinement, exploration = refinement_given(table.terms, g, others), 0.0
    if table.beta > 0.0:
        exploration = exploration_given(table.terms, table.planned, g, others)
    value = -table.cost[g] + table.alpha * refinement
    return refinement, exploration, (value + table.beta * exploration) / table.norm[g]


@njit(cache=True)
def collides(table: CandidateTable, g: int, chosen: IntArray) -> bool:
    """Return whether the waypoint of g is within the radii of another chosen waypoint."""
    robot = table.planned.robot[g]
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
def total_value(table: CandidateTable, chosen: IntArray) -> float:
    """Return the sum of J over all chosen candidates (26)."""
    total = 0.0
    for r in range(chosen.shape[0]):
        if chosen[r] >= 0:
            total += candidate_value(table, chosen[r], chosen)[2]
    return total


@njit(cache=True)
def values_given(table: CandidateTable, first: int, last: int, chosen: IntArray) -> FloatArray:
    """Return T, E and J of the candidates `first` to `last`, given the others' choices, (n, 3)."""
    out = np.empty((last - first, 3))
    for g in range(first, last):
        row = out[g - first]
        row[0], row[1], row[2] = candidate_value(table, g, chosen)
        if not table.allowed[g] or collides(table, g, chosen):
            out[g - first, 2] = -np.inf
    return out


class Ranking(NamedTuple):
    """The admissible candidates of one robot after another, best first.

    order (A,): candidates; those of robot r are start[r] to start[r + 1]; alone (G,): J without the
    other planning robots, an upper bound of J.
    """

    table: CandidateTable
    order: IntArray
    start: IntArray
    alone: FloatArray
