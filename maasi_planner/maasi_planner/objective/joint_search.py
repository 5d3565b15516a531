"""The joint choice of a team (000, (26))."""

import math

import numpy as np
from numba import njit

from maasi_filter.arrays import FloatArray, IntArray
from maasi_planner.objective.candidate_table import (
    CandidateTable,
    Ranking,
    candidate_value,
    collides,
    total_value,
)
from maasi_planner.objective.large_teams import search_in_turn
from maasi_planner.objective.settings import InformationSettings

PAIRS_LIMIT = 5  # largest team with moves of two robots at once


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
    """Improve a choice by moves of two robots at once within a budget of evaluations."""
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


def ranking_of(table: CandidateTable, alone: FloatArray) -> Ranking:
    """Return the admissible candidates of each robot, best first."""
    order = np.lexsort((-alone, table.planned.robot))
    order = order[alone[order] > -np.inf]
    counts = np.bincount(table.planned.robot[order], minlength=len(table.radii))
    return Ranking(table, order, np.array([0, *counts]).cumsum(), alone)


def search(
    table: CandidateTable, alone: FloatArray, settings: InformationSettings
) -> tuple[IntArray, float, bool, int]:
    """Return the best joint choice, its value, whether it is exact, and choices evaluated.

    `alone` (G,) is J of each candidate without the others, -inf if inadmissible. The choice (R,)
    has indices into all candidates; -1: none is admissible.
    """
    robots = len(table.radii)
    if robots == 1:
        return np.array([alone.argmax()]), float(alone.max()), True, len(alone)
    ranking = ranking_of(table, alone)
    counts = np.diff(ranking.start)
    tries = []
    for backwards in (False, True):
        chosen = np.full(robots, -1, np.int64)
        in_turn = _search_in_turn if robots <= PAIRS_LIMIT else search_in_turn
        value, work = in_turn(ranking, settings.improvement_rounds, backwards, chosen)
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
