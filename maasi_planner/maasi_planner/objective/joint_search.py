"""The value J of candidates given the choices of others, and the joint choice: 000, (17), (26)."""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from maasi_filter.arrays import BoolArray, FloatArray, IntArray
from maasi_planner.objective.predicted_measurements import Measurements
from maasi_planner.objective.terms import Terms, exploration_given, refinement_given
from maasi_planner.settings import PlannerSettings


class CandidateTable(NamedTuple):
    """G candidates of R planning robots; if `shared`, what two see counts for the shorter way."""

    allowed: BoolArray
    waypoints: FloatArray
    radii: FloatArray
    cost: FloatArray
    norm: FloatArray
    alpha: float
    beta: float
    shared: bool
    planned: Measurements
    terms: Terms


@njit(cache=True, forceinline=True)
def candidate_value(table: CandidateTable, g: int, chosen: IntArray) -> tuple[float, float, float]:
    """Return T, E and J (17), (26) of g, given the others' choices (R,), -1 for none."""
    robot = table.planned.robot[g]
    # Chosen candidates whose measurements g gets no credit for.
    others, number = np.empty(chosen.shape[0], np.int64), 0
    for r in range(chosen.shape[0]):
        other = chosen[r]
        if r == robot or other < 0:
            continue
        if not table.shared or (table.norm[other], r) < (table.norm[g], robot):
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


PAIRS_LIMIT = 5  # moves of two robots at once are tried in teams up to this size


class Ranking(NamedTuple):
    """The admissible candidates, robot after robot, each robot's best first.

    order (A,): these; robot r has start[r] to start[r + 1]; alone (G,): J of a candidate without
    the other planning robots, an upper bound of J with them.
    """

    table: CandidateTable
    order: IntArray
    start: IntArray
    alone: FloatArray


@njit(cache=True)
def _search_exactly(
    ranking: Ranking, chosen: IntArray, r: int, value: float, best: IntArray, best_value: float
) -> tuple[float, int]:
    """Improve `best` (R,) to the optimum of (26) by bounds; return its value and evaluations."""
    table, order, start, alone = ranking
    if r == len(chosen):
        for other in range(r):
            best[other] = chosen[other]
        return value, 0
    rest, evaluated = 0.0, 0
    for other in range(len(chosen) - 1, r, -1):
        rest += alone[order[start[other]]]
    for g in order[start[r] : start[r + 1]]:
        if value + alone[g] + rest <= best_value:
            break
        if collides(table, g, chosen):
            continue
        chosen[r] = g
        total = total_value(table, chosen)
        evaluated += 1
        if total + rest > best_value:
            best_value, work = _search_exactly(ranking, chosen, r + 1, total, best, best_value)
            evaluated += work
        chosen[r] = -1
    return best_value, evaluated


@njit(cache=True)
def _best_reply(ranking: Ranking, r: int, chosen: IntArray) -> tuple[int, float, int]:
    """Return the best candidate of one robot for the team, its total, and the work done."""
    table, order, start, alone = ranking
    previous, chosen[r] = chosen[r], -1
    others = total_value(table, chosen)
    best, best_value, evaluated = -1, -np.inf, 0
    for g in order[start[r] : start[r + 1]]:
        if others + alone[g] <= best_value:
            break
        if collides(table, g, chosen):
            continue
        chosen[r] = g
        if others + candidate_value(table, g, chosen)[2] > best_value:
            value = total_value(table, chosen)
            if value > best_value:
                best, best_value = g, value
        chosen[r] = -1
        evaluated += 1
    chosen[r] = previous
    return best, best_value, evaluated


@njit(cache=True)
def _search_in_turn(
    ranking: Ranking, rounds: int, backwards: bool, chosen: IntArray
) -> tuple[float, int]:
    """Let robots choose in turn, each best for the team so far, then improve in rounds."""
    total, evaluated = -np.inf, 0
    for attempt in range(1 + rounds):
        changed = False
        for i in range(len(chosen)):
            r = len(chosen) - 1 - i if backwards and attempt == 0 else i
            if attempt > 0 and chosen[r] < 0:
                continue
            g, value, count = _best_reply(ranking, r, chosen)
            evaluated += count
            better = attempt == 0 or value > total + 1e-12 * abs(total)
            if g >= 0 and g != chosen[r] and better:
                chosen[r], total, changed = g, value, True
        if not changed:
            break
    return total, evaluated


@njit(cache=True)
def _improve_in_pairs(
    ranking: Ranking, total: float, budget: int, chosen: IntArray
) -> tuple[float, int]:
    """Improve a choice by moves of two robots at once, while the budget of evaluations lasts."""
    table, order, start, _ = ranking
    moving: IntArray = np.flatnonzero(chosen >= 0)
    evaluated, improved = 0, True
    while improved:
        improved = False
        for r in moving:
            for g in order[start[r] : start[r + 1]]:
                if g == chosen[r]:
                    continue
                for s in moving:
                    if evaluated >= budget:
                        return total, evaluated
                    trial = chosen.copy()
                    trial[s] = -1
                    if s == r or collides(table, g, trial):
                        continue
                    trial[r] = g
                    reply, value, count = _best_reply(ranking, s, trial)
                    evaluated += count + 1
                    if reply >= 0 and value > total + 1e-12 * abs(total):
                        chosen[r], chosen[s], total, improved = g, reply, value, True
    return total, evaluated


def search(
    table: CandidateTable, alone: FloatArray, settings: PlannerSettings
) -> tuple[IntArray, float, bool, int]:
    """Return the best joint choice, its value, whether it is exact, and choices evaluated.

    `alone` (G,) is J of each candidate without the others, -inf for inadmissible ones. The choice
    (R,) has indices into all candidates, -1 for a robot with none admissible.
    """
    robots = len(table.radii)
    if robots == 1:
        return np.array([alone.argmax()]), float(alone.max()), True, len(alone)
    order = np.lexsort((-alone, table.planned.robot))
    order = order[alone[order] > -np.inf]
    counts = np.bincount(table.planned.robot[order], minlength=robots)
    ranking = Ranking(table, order, np.array([0, *counts]).cumsum(), alone)
    tries = []
    for backwards in (False, True):
        chosen = np.full(robots, -1, np.int64)
        value, work = _search_in_turn(ranking, settings.improvement_rounds, backwards, chosen)
        if (chosen >= 0).all() and math.prod(counts.tolist()) <= settings.enumeration_limit:
            partial = np.full(robots, -1, np.int64)
            value, count = _search_exactly(ranking, partial, 0, 0.0, chosen, value)
            return chosen, value, True, work + count
        if robots <= PAIRS_LIMIT:
            value, count = _improve_in_pairs(ranking, value, settings.pair_budget, chosen)
            work += count
        tries.append((chosen, value, work))
    # Prefer more moving robots, then the larger value.
    best, value, _ = max(tries, key=lambda item: (int((item[0] >= 0).sum()), item[1]))
    return best, value, False, sum(work for *_, work in tries)
