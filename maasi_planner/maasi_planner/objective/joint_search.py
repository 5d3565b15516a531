"""The value J of candidates given the choices of others, and the joint choice: 000, (17), (26)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from maasi_filter.arrays import BoolArray, FloatArray, IntArray
from maasi_planner.objective.predicted_measurements import Measurements
from maasi_planner.objective.terms import Terms, exploration_given, refinement_given
from maasi_planner.settings import PlannerSettings


class CandidateTable(NamedTuple):
    """The candidates of the planning robots, with the terms of the objective in use.

    G candidates of R robots, one robot after the other; robot r has start[r] to start[r + 1].
    With `shared` what two see counts for the one with the shorter way only.
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
    shared: bool
    planned: Measurements
    terms: Terms


@njit(cache=True, forceinline=True)
def candidate_value(table: CandidateTable, g: int, chosen: IntArray) -> tuple[float, float, float]:
    """Return T, E and J (17), (26) of g, given the others' choices (R,), -1 for none."""
    # Chosen candidates whose measurements g gets no credit for.
    others = np.empty(chosen.shape[0], np.int64)
    number = 0
    for r in range(chosen.shape[0]):
        other = chosen[r]
        if r == table.robot[g] or other < 0:
            continue
        shorter = table.norm[other] < table.norm[g]
        tie = table.norm[other] == table.norm[g] and r < table.robot[g]
        if shorter or tie or not table.shared:
            others[number] = other
            number += 1
    others = others[:number]
    refinement, exploration = refinement_given(table.terms, g, others), 0.0
    if table.beta > 0.0:
        exploration = exploration_given(table.terms, table.planned, g, others)
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
        refinement, exploration, value = candidate_value(table, g, chosen)
        out[g - first, 0] = refinement
        out[g - first, 1] = exploration
        admissible = table.allowed[g] and not collides(table, g, chosen)
        out[g - first, 2] = value if admissible else -np.inf
    return out


# Moves of two robots at once are tried in teams up to this size.
PAIRS_LIMIT = 5


@njit(cache=True)
def _search_exactly(
    table: CandidateTable, alone: FloatArray, order: IntArray, best: IntArray, best_value: float
) -> tuple[float, int]:
    """Find the best joint choice (26), by depth-first search with bounds.

    J of a candidate alone is an upper bound; `best` (R,) with its value is the best choice known,
    and is replaced in place. Returns its value, and how many partial choices were evaluated.
    """
    robots = table.radii.shape[0]
    rest = np.zeros(robots + 1)
    for r in range(robots - 1, -1, -1):
        rest[r] = rest[r + 1] + alone[order[table.start[r]]]
    position = np.zeros(robots, np.int64)
    partial = np.zeros(robots + 1)
    chosen = np.full(robots, -1, np.int64)
    evaluated = 0
    depth = 0
    position[0] = table.start[0]
    while depth >= 0:
        chosen[depth] = -1
        if position[depth] >= table.start[depth + 1]:
            depth -= 1
            continue
        g = order[position[depth]]
        position[depth] += 1
        if alone[g] == -np.inf or partial[depth] + alone[g] + rest[depth + 1] <= best_value:
            depth -= 1
            continue
        if collides(table, g, chosen):
            continue
        chosen[depth] = g
        value = total_value(table, chosen)
        evaluated += 1
        if value + rest[depth + 1] <= best_value:
            continue
        if depth == robots - 1:
            best_value = value
            best[:] = chosen
            continue
        partial[depth + 1] = value
        depth += 1
        position[depth] = table.start[depth]
    return best_value, evaluated


@njit(cache=True)
def _best_reply(
    table: CandidateTable,
    robot: int,
    alone: FloatArray,
    order: IntArray,
    chosen: IntArray,
) -> tuple[int, float, int]:
    """Return the best candidate of one robot for the team, its total, and the work done."""
    previous = chosen[robot]
    chosen[robot] = -1
    others = total_value(table, chosen)
    best = -1
    best_value = -np.inf
    evaluated = 0
    for i in range(table.start[robot], table.start[robot + 1]):
        g = order[i]
        if alone[g] == -np.inf or others + alone[g] <= best_value:
            break
        if collides(table, g, chosen):
            continue
        chosen[robot] = g
        own = candidate_value(table, g, chosen)[2]
        if others + own > best_value:
            value = total_value(table, chosen)
            if value > best_value:
                best_value = value
                best = g
        chosen[robot] = -1
        evaluated += 1
    chosen[robot] = previous
    return best, best_value, evaluated


@njit(cache=True)
def _search_in_turn(
    table: CandidateTable,
    alone: FloatArray,
    order: IntArray,
    rounds: int,
    backwards: bool,
    chosen: IntArray,
) -> tuple[float, int]:
    """Let robots choose in turn, each best for the team so far, then improve in rounds.

    A robot that finds no admissible candidate keeps -1 in `chosen` (R,).
    """
    robots = table.radii.shape[0]
    chosen[:] = -1
    evaluated = 0
    total = -np.inf
    for attempt in range(1 + rounds):
        changed = False
        for i in range(robots):
            r = robots - 1 - i if backwards and attempt == 0 else i
            if attempt > 0 and chosen[r] < 0:
                continue
            g, value, count = _best_reply(table, r, alone, order, chosen)
            evaluated += count
            better = attempt == 0 or value > total + 1e-12 * abs(total)
            if g >= 0 and g != chosen[r] and better:
                chosen[r] = g
                total = value
                changed = True
        if not changed:
            break
    return total, evaluated


@njit(cache=True)
def _improve_in_pairs(
    table: CandidateTable,
    alone: FloatArray,
    order: IntArray,
    total: float,
    budget: int,
    chosen: IntArray,
) -> tuple[float, int]:
    """Improve a choice by moves of two robots at once, while the budget of evaluations lasts.

    One robot takes another candidate, the best alone first, and a second one its best reply.
    """
    robots = table.radii.shape[0]
    trial = np.zeros(robots, np.int64)
    evaluated = 0
    improved = True
    while improved and evaluated < budget:
        improved = False
        for r in range(robots):
            if chosen[r] < 0:
                continue
            for i in range(table.start[r], table.start[r + 1]):
                g = order[i]
                if alone[g] == -np.inf or evaluated >= budget:
                    break
                if g == chosen[r]:
                    continue
                for s in range(robots):
                    if s == r or chosen[s] < 0 or evaluated >= budget:
                        continue
                    trial[:] = chosen
                    trial[s] = -1
                    if collides(table, g, trial):
                        continue
                    trial[r] = g
                    reply, value, count = _best_reply(table, s, alone, order, trial)
                    evaluated += count + 1
                    if reply >= 0 and value > total + 1e-12 * abs(total):
                        chosen[r] = g
                        chosen[s] = reply
                        total = value
                        improved = True
    return total, evaluated


def search(
    table: CandidateTable, alone: FloatArray, settings: PlannerSettings
) -> tuple[IntArray, float, bool, int]:
    """Return the best joint choice, its value, whether it is exact, and the work done.

    `alone` (G,) is J of each candidate without the others. The choice (R,) has indices into all
    candidates, -1 for a robot with none admissible.
    """
    robots = len(table.radii)
    parts = [slice(*ends) for ends in zip(table.start[:-1].tolist(), table.start[1:].tolist())]
    best = np.full(robots, -1, np.int64)
    if robots == 0:
        return best, 0.0, True, 0
    if robots == 1:
        if alone.max() > -np.inf:
            best[0] = alone.argmax()
        return best, float(alone.max()), True, len(alone)
    order = np.concatenate([rows.start + np.argsort(-alone[rows], kind='stable') for rows in parts])
    rounds = settings.improvement_rounds
    value, work = _search_in_turn(table, alone, order, rounds, False, best)
    number = np.prod([max(1.0, float(np.isfinite(alone[rows]).sum())) for rows in parts])
    if number <= settings.enumeration_limit and (best >= 0).all():
        value, count = _search_exactly(table, alone, order, best, value)
        return best, value, True, work + count
    tries = [(best, value, work)]
    other = np.full(robots, -1, np.int64)
    tries.append((other, *_search_in_turn(table, alone, order, rounds, True, other)))
    if robots <= PAIRS_LIMIT:
        for index, (choice, value, work) in enumerate(tries):
            budget = settings.pair_budget
            value, count = _improve_in_pairs(table, alone, order, value, budget, choice)
            tries[index] = (choice, value, work + count)
    # Prefer more moving robots, then the larger value.
    best, value, _ = max(tries, key=lambda item: (int((item[0] >= 0).sum()), item[1]))
    return best, value, False, sum(work for _, _, work in tries)
