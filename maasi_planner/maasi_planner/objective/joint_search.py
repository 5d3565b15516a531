"""The joint choice of all planning robots: exact, in turn, and improved in pairs."""

from __future__ import annotations

import numpy as np
from numba import njit

from maasi_filter.arrays import FloatArray, IntArray
from maasi_planner.objective.candidate_value import (
    CandidateTable,
    candidate_value,
    collides,
    total_value,
)
from maasi_planner.settings import PlannerSettings

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
    work = np.zeros((3, 3, 3))
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
        value = total_value(table, chosen, work)
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
    work: FloatArray,
) -> tuple[int, float, int]:
    """Return the best candidate of one robot for the team, its total, and the work done."""
    previous = chosen[robot]
    chosen[robot] = -1
    others = total_value(table, chosen, work)
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
        own = candidate_value(table, g, chosen, work)[2]
        if others + own > best_value:
            value = total_value(table, chosen, work)
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
    work = np.zeros((3, 3, 3))
    chosen[:] = -1
    evaluated = 0
    total = -np.inf
    for i in range(robots):
        r = robots - 1 - i if backwards else i
        g, value, count = _best_reply(table, r, alone, order, chosen, work)
        evaluated += count
        if g >= 0:
            chosen[r] = g
            total = value
    for _ in range(rounds):
        changed = False
        for r in range(robots):
            if chosen[r] < 0:
                continue
            g, value, count = _best_reply(table, r, alone, order, chosen, work)
            evaluated += count
            if g >= 0 and g != chosen[r] and value > total + 1e-12 * abs(total):
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
    work = np.zeros((3, 3, 3))
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
                    reply, value, count = _best_reply(table, s, alone, order, trial, work)
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
