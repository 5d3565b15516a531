"""The joint choice in large teams: robots choose in turn, each best for all.

The value of the team depends on one robot's candidate only where it sees what others see, or would
have seen. The choices of the others are summed up once for all candidates of a robot: by node and
cluster with the objective `information`, by robot with that of the paper.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from maasi_filter.arrays import FloatArray, IntArray
from maasi_planner.objective.candidate_table import (
    CandidateTable,
    Ranking,
    collides,
    total_value,
)
from maasi_planner.objective.terms import Terms, exploration_given, left_by, log_det


class Others(NamedTuple):
    """Choices of the k other robots in the order in which they count, by information.

    candidate (k,), and its norm (k,). Rows begin[n] to begin[n + 1] - 1 are of the robots that see
    node n: rank (E,) in that order, before (E,) what earlier ones leave of the node, and after
    (E,) what it and later ones see, each over its norm; the last row has no rank. Rows of cluster
    c begin at cluster_begin[c]: rank (F,), known (F, d, d) before it, and content (F,), its log
    determinant.
    """

    candidate: IntArray
    norm: FloatArray
    begin: IntArray
    rank: IntArray
    before: FloatArray
    after: FloatArray
    cluster_begin: IntArray
    cluster_rank: IntArray
    known: FloatArray
    content: FloatArray


@njit(cache=True)
def _content(terms: Terms, cluster: int, known: FloatArray, gain: FloatArray) -> float:
    """Return log det(I + P (known + gain)) of a cluster."""
    d = terms.covariance.shape[1]
    matrix = np.eye(3)
    for a in range(d):
        for b in range(d):
            for k in range(d):
                added = known[k, b] + gain[k, b]
                matrix[a, b] += terms.covariance[cluster, a, k] * added
    return log_det(matrix)


@njit(cache=True)
def _in_order(table: CandidateTable, chosen: IntArray, r: int) -> IntArray:
    """Return the choices of the others in the order in which they count."""
    others, number = np.empty(len(chosen), np.int64), 0
    for s in range(len(chosen)):
        if s == r or chosen[s] < 0:
            continue
        i = number
        while i > 0 and table.norm[others[i - 1]] > table.norm[chosen[s]]:
            others[i] = others[i - 1]
            i -= 1
        others[i], number = chosen[s], number + 1
    return others[:number]


@njit(cache=True)
def _others(table: CandidateTable, chosen: IntArray, r: int) -> Others:
    terms, candidate = table.terms, _in_order(table, chosen, r)
    number, clusters = len(candidate), len(terms.mass)
    norm = np.empty(number)
    begin = np.zeros(len(terms.unseen) + 1, np.int64)
    cluster_begin = np.zeros(clusters + 1, np.int64)
    for i in range(number):
        g = candidate[i]
        norm[i] = table.norm[g]
        for row in range(terms.first[g], terms.first[g + 1]):
            begin[terms.node[row] + 1] += 1
        for row in range(terms.gain_first[g], terms.gain_first[g + 1]):
            cluster_begin[terms.cluster[row] + 1] += 1
    # One additional row for each seen node and each cluster.
    for n in range(len(terms.unseen)):
        begin[n + 1] += begin[n] + (begin[n + 1] > 0)
    for c in range(clusters):
        cluster_begin[c + 1] += cluster_begin[c] + 1
    rank, filled = np.full(begin[-1], number), begin[:-1].copy()
    before, after = np.ones(begin[-1]), np.zeros(begin[-1])
    for i in range(number):
        g = candidate[i]
        for row in range(terms.first[g], terms.first[g + 1]):
            n = terms.node[row]
            at = filled[n]
            rank[at], filled[n] = i, at + 1
            before[at + 1] = before[at] * terms.miss[row]
    for i in range(number - 1, -1, -1):
        g = candidate[i]
        for row in range(terms.first[g], terms.first[g + 1]):
            n = terms.node[row]
            at = filled[n] - 1
            filled[n] = at
            after[at] = after[at + 1] + before[at] * (1.0 - terms.miss[row]) / norm[i]
    d = terms.covariance.shape[1]
    cluster_rank, nothing = np.full(cluster_begin[-1], number), np.zeros((d, d))
    known, content = np.zeros((cluster_begin[-1], d, d)), np.zeros(cluster_begin[-1])
    filled = cluster_begin[:-1].copy()
    for c in range(clusters):
        known[filled[c]] = terms.base[c]
        content[filled[c]] = _content(terms, c, terms.base[c], nothing)
    for i in range(number):
        g = candidate[i]
        for row in range(terms.gain_first[g], terms.gain_first[g + 1]):
            c = terms.cluster[row]
            at = filled[c]
            cluster_rank[at], filled[c] = i, at + 1
            known[at + 1] = known[at] + terms.gain[row]
            content[at + 1] = _content(terms, c, known[at + 1], nothing)
    return Others(
        candidate, norm, begin, rank, before, after, cluster_begin, cluster_rank, known, content
    )


@njit(cache=True)
def _value_of_others(table: CandidateTable, others: Others) -> float:
    terms, total = table.terms, 0.0
    for i in range(len(others.candidate)):
        total -= table.cost[others.candidate[i]] / others.norm[i]
    for n in range(len(terms.unseen)):
        if others.begin[n + 1] > others.begin[n]:
            total += table.beta * terms.unseen[n] * others.after[others.begin[n]]
    for c in range(len(terms.mass)):
        for at in range(others.cluster_begin[c], others.cluster_begin[c + 1] - 1):
            gained = max(0.0, others.content[at + 1] - others.content[at])
            norm = others.norm[others.cluster_rank[at]]
            total += table.alpha * 0.5 * terms.mass[c] * gained / norm
    return total


@njit(cache=True)
def _explored(table: CandidateTable, others: Others, g: int, rank: int) -> tuple[float, float]:
    """Return what E of candidate g adds to the sum of J without the others, and with them.

    It counts before the others from `rank` on.
    """
    terms, norm, alone, total = table.terms, table.norm[g], 0.0, 0.0
    for row in range(terms.first[g], terms.first[g + 1]):
        n = terms.node[row]
        at, end = others.begin[n], others.begin[n + 1] - 1
        share = 1.0 / norm
        if end >= at:
            if end - at == len(others.candidate):
                at += rank
            else:
                while others.rank[at] < rank:
                    at += 1
            share = others.before[at] / norm - others.after[at]
        seen = terms.unseen[n] * (1.0 - terms.miss[row])
        alone += seen / norm
        total += seen * share
    return alone, total


@njit(cache=True)
def _refined(table: CandidateTable, others: Others, g: int, rank: int) -> float:
    """Return what T of candidate g, which counts from `rank` on, adds to the sum of J."""
    terms, norm, total = table.terms, table.norm[g], 0.0
    for row in range(terms.gain_first[g], terms.gain_first[g + 1]):
        c = terms.cluster[row]
        at, end = others.cluster_begin[c], others.cluster_begin[c + 1] - 1
        while at < end and others.cluster_rank[at] < rank:
            at += 1
        gain = terms.gain[row]
        last = _content(terms, c, others.known[at], gain)
        value = max(0.0, last - others.content[at]) / norm
        for later in range(at, end):
            now = _content(terms, c, others.known[later + 1], gain)
            change = now - last - (others.content[later + 1] - others.content[later])
            value += change / others.norm[others.cluster_rank[later]]
            last = now
        total += 0.5 * terms.mass[c] * value
    return total


@njit(cache=True)
def _best_by_information(ranking: Ranking, r: int, chosen: IntArray) -> tuple[int, float, int]:
    table, order, start, alone = ranking
    others = _others(table, chosen, r)
    value = _value_of_others(table, others)
    best, best_value, evaluated = -1, -np.inf, 0
    for g in order[start[r] : start[r + 1]]:
        if value + alone[g] <= best_value:
            break
        if collides(table, g, chosen):
            continue
        evaluated += 1
        rank = 0
        while rank < len(others.candidate) and (
            others.norm[rank],
            table.planned.robot[others.candidate[rank]],
        ) < (table.norm[g], r):
            rank += 1
        total = value - table.cost[g] / table.norm[g]
        if table.beta > 0.0:
            without, explored = _explored(table, others, g, rank)
            # T without the others is an upper bound.
            if value + alone[g] + table.beta * (explored - without) <= best_value:
                continue
            total += table.beta * explored
        total += table.alpha * _refined(table, others, g, rank)
        if total > best_value:
            best, best_value = g, total
    return best, best_value, evaluated


@njit(cache=True)
def _best_as_printed(ranking: Ranking, r: int, chosen: IntArray) -> tuple[int, float, int]:
    table, order, start, alone = ranking
    terms, planned = table.terms, table.planned
    others = np.array([g for s, g in enumerate(chosen) if s != r and g >= 0], np.int64)
    left, value = np.zeros((len(others), terms.value.shape[1])), 0.0
    for s in range(len(others)):
        g = others[s]
        for i in range(terms.filled[g]):
            left[s, i] = terms.value[g, i]
        for other in others:
            if other != g:
                left[s, : terms.filled[g]] *= left_by(terms, planned, g, other)
        gain = table.alpha * terms.refinement[g] + table.beta * left[s].sum()
        value += (gain - table.cost[g]) / table.norm[g]
    best, best_value, evaluated = -1, -np.inf, 0
    for g in order[start[r] : start[r + 1]]:
        if value + alone[g] <= best_value:
            break
        if collides(table, g, chosen):
            continue
        evaluated += 1
        gain = table.alpha * terms.refinement[g] - table.cost[g]
        if table.beta > 0.0:
            gain += table.beta * exploration_given(terms, planned, g, others)
        total = value + gain / table.norm[g]
        for s in range(len(others)):
            # What g takes from the others only reduces it.
            if total <= best_value or not table.beta > 0.0:
                break
            kept, lost = left_by(terms, planned, others[s], g), 0.0
            for i in range(len(kept)):
                lost += left[s, i] * (1.0 - kept[i])
            total -= table.beta * lost / table.norm[others[s]]
        if total > best_value:
            best, best_value = g, total
    return best, best_value, evaluated


def search_in_turn(
    ranking: Ranking, rounds: int, backwards: bool, chosen: IntArray
) -> tuple[float, int]:
    """Let robots choose in turn, each best for the team so far, then improve in rounds."""
    information = ranking.table.terms.information
    best_of = _best_by_information if information else _best_as_printed
    total, evaluated = -math.inf, 0
    for attempt in range(1 + rounds):
        before = chosen.copy()
        robots = range(len(chosen))
        for r in reversed(robots) if backwards and attempt == 0 else robots:
            if attempt > 0 and chosen[r] < 0:
                continue
            g, value, count = best_of(ranking, r, chosen)
            evaluated += count
            better = attempt == 0 or value > total + 1e-12 * abs(total)
            if g >= 0 and g != chosen[r] and better:
                chosen[r], total = g, value
        if (chosen == before).all():
            break
    return total_value(ranking.table, chosen), evaluated
