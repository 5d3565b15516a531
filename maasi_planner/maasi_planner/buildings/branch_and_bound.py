"""Exact branch and bound over visits and obstacle faces: P2 of 004 for one robot.

A node fixes visits in the order of their steps, and the faces of obstacles beyond which segments
stay; its relaxation is a quadratic problem for each axis. An *open* node stands for every plan with
these visits and possibly later ones, a *closed* one for those without others.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from maasi_filter.arrays import BoolArray, FloatArray, IntArray
from maasi_planner.buildings.axis_problem import solve_axis
from maasi_planner.buildings.search_tree import Tree, copy_node, free, pop, push

GAP = 1e-3  # least improvement of the scaled objective
FACE_TOLERANCE = 1e-6  # tolerance of positions beyond a face [m]
GIVEN_TOLERANCE = 1e-3  # tolerance of the first two positions, which are given [m]

FOUND, EXHAUSTED, UNFINISHED, FULL = 0, 1, 2, 3


class Instance(NamedTuple):
    """One problem for the compiled search with Q possible visits; objectives are scaled."""

    gram: FloatArray  # (m, m) of each axis
    free: FloatArray  # (3, m): values of the rows at the free minimum, and their bounds
    lower: FloatArray
    upper: FloatArray
    rise: FloatArray  # (3, J): excess of braking distances over their rows, upwards and
    sink: FloatArray  # downwards [m]
    given: FloatArray  # (2, 3): P_0 and P_1 [m]
    area: FloatArray  # (3, 2) [m]
    horizon: int
    visit_step: IntArray  # (Q,), in this order
    visit_cuboid: IntArray
    visit_reward: FloatArray  # (Q,)
    visit_lower: FloatArray  # (Q, 3): corners of their cuboids [m]
    visit_upper: FloatArray
    most: float  # most reward of all visits
    ahead: FloatArray  # (Q,): most reward that can follow a visit
    follows: BoolArray  # (Q, Q): whether a visit (column) may follow another (row)
    obstacles: FloatArray  # (O, 3, 2): corners, clearance included [m]
    between: bool  # whether segments, and not only positions, keep away from obstacles


@njit(cache=True)
def _ahead(instance: Instance, tree: Tree, node: int) -> float:
    if tree.closed[node]:
        return 0.0
    if tree.number[node] == 0:
        return instance.most
    return instance.ahead[tree.visits[node, tree.number[node] - 1]]


@njit(cache=True)
def _solve(instance: Instance, tree: Tree, node: int, cutoff: float) -> bool:
    """Solve the changed axes of a node; return whether it can improve the best plan."""
    horizon = instance.horizon
    last = horizon + 1
    steps = instance.rise.shape[1]
    first = 3 * horizon - 1
    # The earlier cost of a changed axis is a lower bound.
    total = tree.cost[node, 0] + tree.cost[node, 1] + tree.cost[node, 2]
    lower, upper = tree.scratch[0], tree.scratch[1]
    for a in range(3):
        if not tree.dirty[node] >> a & 1:
            continue
        for i in range(instance.lower.shape[1]):
            lower[i] = instance.lower[a, i]
            upper[i] = instance.upper[a, i]
        for k in range(2, horizon + 1):
            lower[k - 2] = max(lower[k - 2], tree.low[node, a, k])
            upper[k - 2] = min(upper[k - 2], tree.high[node, a, k])
        for j in range(steps):
            lower[first + j] = max(lower[first + j], tree.low[node, a, last] - instance.sink[a, j])
            upper[first + j] = min(upper[first + j], tree.high[node, a, last] + instance.rise[a, j])
        for i in range(instance.lower.shape[1]):
            if lower[i] > upper[i] + 1e-9:
                return False
        total -= tree.cost[node, a]
        cost = solve_axis(
            instance.gram,
            instance.free[a],
            lower,
            upper,
            horizon,
            cutoff - total,
            tree.values[node, a],
            tree.axis_scratch,
        )
        if cost == math.inf:
            return False
        tree.cost[node, a] = cost
        total += cost
    tree.dirty[node] = 0
    return total <= cutoff


@njit(cache=True)
def _position(instance: Instance, tree: Tree, node: int, a: int, k: int) -> float:
    return instance.given[k, a] if k < 2 else tree.values[node, a, k - 2]


@njit(cache=True)
def _obstructed(instance: Instance, tree: Tree, node: int, begin: int, end: int) -> tuple[int, int]:
    """Return the first segment from begin to end in an obstacle, and the obstacle, or (-1, -1)."""
    horizon = instance.horizon
    steps = instance.rise.shape[1]
    first = 3 * horizon - 1
    for k in range(begin, end + 1):
        for o in range(instance.obstacles.shape[0]):
            for a in range(3):
                near = _position(instance, tree, node, a, min(k, horizon))
                low = near
                high = near
                if k > horizon:
                    for j in range(steps):
                        value = tree.values[node, a, first + j]
                        high = max(high, value - instance.rise[a, j])
                        low = min(low, value + instance.sink[a, j])
                elif instance.between and k > 2:
                    far = _position(instance, tree, node, a, k - 1)
                    low = min(low, far)
                    high = max(high, far)
                below = high <= instance.obstacles[o, a, 0] + FACE_TOLERANCE
                above = low >= instance.obstacles[o, a, 1] - FACE_TOLERANCE
                if instance.between and k == 2:
                    given = instance.given[1, a]
                    below = below and given <= instance.obstacles[o, a, 0] + GIVEN_TOLERANCE
                    above = above and given >= instance.obstacles[o, a, 1] - GIVEN_TOLERANCE
                if below or above:
                    break
            else:
                return k, o
    return -1, -1


@njit(cache=True)
def _branch_on_faces(
    instance: Instance, tree: Tree, node: int, k: int, o: int, closed: bool
) -> None:
    total = tree.cost[node, 0] + tree.cost[node, 1] + tree.cost[node, 2]
    for a in range(3):
        for side in range(2):
            face = instance.obstacles[o, a, side]
            if side == 0 and face <= instance.area[a, 0]:
                continue
            if side == 1 and face >= instance.area[a, 1]:
                continue
            if instance.between and k == 2:
                given = instance.given[1, a]
                if side == 0 and given > face + GIVEN_TOLERANCE:
                    continue
                if side == 1 and given < face - GIVEN_TOLERANCE:
                    continue
            child = copy_node(tree, node)
            if child < 0:
                return
            tree.closed[child] = closed
            begin = k - 1 if instance.between and k > 2 else k
            for i in range(begin, k + 1):
                if side == 0:
                    tree.high[child, a, i] = min(tree.high[child, a, i], face)
                else:
                    tree.low[child, a, i] = max(tree.low[child, a, i], face)
            tree.dirty[child] = 1 << a
            tree.bound[child] = total - tree.reward[child] - _ahead(instance, tree, child)
            push(tree, child)


@njit(cache=True)
def begin(instance: Instance, tree: Tree, hint: IntArray) -> None:
    """Start a search with the root, and the visits of an earlier plan as a closed node."""
    size = tree.heap.shape[0]
    tree.counts[:] = 0
    tree.counts[1] = size - 1
    tree.counts[3] = -1
    for i in range(size - 1):
        tree.spare[i] = size - 1 - i
    tree.best[0] = math.inf
    tree.reward[0] = 0.0
    tree.closed[0] = False
    tree.number[0] = 0
    tree.dirty[0] = 7
    tree.bound[0] = -math.inf
    tree.low[0] = -math.inf
    tree.high[0] = math.inf
    tree.cost[0] = 0.0
    if hint.shape[0]:
        child = copy_node(tree, 0)
        tree.closed[child] = True
        for i in range(hint.shape[0]):
            _visit(instance, tree, child, hint[i])
        # First, as its objective prunes others.
        tree.bound[child] = -math.inf
        push(tree, child)
    push(tree, 0)


@njit(cache=True)
def _visit(instance: Instance, tree: Tree, node: int, q: int) -> None:
    k = instance.visit_step[q]
    for a in range(3):
        low, high = instance.visit_lower[q, a], instance.visit_upper[q, a]
        tree.low[node, a, k] = max(tree.low[node, a, k], low)
        tree.high[node, a, k] = min(tree.high[node, a, k], high)
        coordinate = tree.values[node, a, k - 2]
        if coordinate < low or coordinate > high:
            tree.dirty[node] |= 1 << a  # unless it is inside already
    tree.visits[node, tree.number[node]] = q
    tree.number[node] += 1
    tree.reward[node] += instance.visit_reward[q]


@njit(cache=True)
def _can_add(instance: Instance, tree: Tree, node: int, q: int) -> bool:
    for i in range(tree.number[node]):
        if instance.visit_cuboid[tree.visits[node, i]] == instance.visit_cuboid[q]:
            return False
    k = instance.visit_step[q]
    for a in range(3):
        low, high = instance.visit_lower[q, a], instance.visit_upper[q, a]
        if tree.low[node, a, k] > high or tree.high[node, a, k] < low:
            return False
    return True


@njit(cache=True)
def _extend(instance: Instance, tree: Tree, node: int, total: float) -> None:
    number = tree.number[node]
    last = tree.visits[node, number - 1] if number else -1
    for q in range(instance.visit_step.shape[0]):
        if last >= 0 and not instance.follows[last, q]:
            continue
        bound = total - tree.reward[node] - instance.visit_reward[q] - instance.ahead[q]
        if bound >= tree.best[0] - GAP:
            continue
        if number >= tree.visits.shape[1] or not _can_add(instance, tree, node, q):
            continue
        child = copy_node(tree, node)
        if child < 0:
            return
        _visit(instance, tree, child, q)
        tree.bound[child] = bound
        push(tree, child)


@njit(cache=True)
def search(instance: Instance, tree: Tree, most: int) -> int:
    """Continue a search by at most `most` nodes; return FOUND if the best plan is optimal.

    EXHAUSTED: no plan exists; UNFINISHED: nodes remain; FULL: the capacity was reached.
    """
    horizon = instance.horizon
    end = horizon + 1
    solved = 0
    while tree.counts[0] > 0:
        if tree.counts[4]:
            return FULL
        if solved >= most:
            return UNFINISHED
        node = pop(tree)
        if tree.bound[node] >= tree.best[0] - GAP:
            break  # no other node is better
        if tree.dirty[node]:
            solved += 1
            tree.counts[2] += 1
            gain = tree.reward[node] + _ahead(instance, tree, node)
            if not _solve(instance, tree, node, tree.best[0] + gain - GAP):
                free(tree, node)
                continue
            bound = tree.cost[node, 0] + tree.cost[node, 1] + tree.cost[node, 2] - gain
            early = tree.bound[node] == -math.inf
            tree.bound[node] = bound
            if not early and tree.counts[0] > 0 and bound > tree.bound[tree.heap[0]]:
                push(tree, node)
                continue
        total = tree.cost[node, 0] + tree.cost[node, 1] + tree.cost[node, 2]
        number = tree.number[node]
        last = 2
        if number:
            last = max(last, instance.visit_step[tree.visits[node, number - 1]])
        until = end if tree.closed[node] else last
        k, o = _obstructed(instance, tree, node, 2, until)
        if k >= 0:
            _branch_on_faces(instance, tree, node, k, o, tree.closed[node])
            free(tree, node)
            continue
        own = total - tree.reward[node]
        better = own < tree.best[0] - GAP
        if not tree.closed[node]:
            if better:
                k, o = _obstructed(instance, tree, node, last + 1, end)
                if k >= 0:
                    better = False
                    _branch_on_faces(instance, tree, node, k, o, True)
            _extend(instance, tree, node, total)
        if better:
            if tree.counts[3] >= 0:
                free(tree, tree.counts[3])
            tree.counts[3] = node
            tree.best[0] = own
        else:
            free(tree, node)
    if tree.counts[4]:
        return FULL
    return FOUND if tree.counts[3] >= 0 else EXHAUSTED


@njit(cache=True)
def longest_chains(
    visit_step: IntArray,
    visit_cuboid: IntArray,
    reward: FloatArray,
    lower: FloatArray,
    upper: FloatArray,
    fall: FloatArray,
    climb: FloatArray,
) -> tuple[BoolArray, FloatArray]:
    """Return which visits may follow which, and the highest reward that can follow each."""
    number = visit_step.shape[0]
    follows = np.zeros((number, number), dtype=np.bool_)
    ahead = np.zeros(number)
    for p in range(number - 1, -1, -1):
        for q in range(p + 1, number):
            if visit_cuboid[p] == visit_cuboid[q]:
                continue
            i, j = visit_step[p], visit_step[q]
            for a in range(3):
                if (
                    lower[q, a] - upper[p, a] > climb[a, j] - climb[a, i] + 1e-9
                    or upper[q, a] - lower[p, a] < fall[a, j] - fall[a, i] - 1e-9
                ):
                    break
            else:
                follows[p, q] = True
                ahead[p] = max(ahead[p], reward[q] + ahead[q])
    return follows, ahead
