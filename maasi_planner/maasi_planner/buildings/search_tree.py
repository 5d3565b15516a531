"""Nodes of the branch and bound search in arrays of fixed size, best bound first."""

from typing import NamedTuple

import numpy as np
from numba import njit

from maasi_filter.arrays import BoolArray, FloatArray, IntArray
from maasi_planner.buildings.axis_problem import AxisScratch


class Tree(NamedTuple):
    """Nodes of the search in reusable arrays, best bound first."""

    bound: FloatArray  # (n,): lower bound of the objective
    reward: FloatArray  # (n,) of the visits made
    cost: FloatArray  # (n, 3): of each axis
    dirty: IntArray  # (n,): bit mask of the axes that have to be solved again
    closed: BoolArray  # (n,): whether no further visits are made
    visits: IntArray  # (n, V): visits
    number: IntArray  # (n,) of them
    low: FloatArray  # (n, 3, T + 2): bounds of P_0 to P_T and the braking distance [m]
    high: FloatArray
    values: FloatArray  # (n, 3, m): of the rows
    heap: IntArray  # (n,): nodes by bound
    spare: IntArray  # (n,): free nodes
    counts: IntArray  # sizes of heap and spare, nodes solved, best node (or -1), out of nodes
    best: FloatArray  # (1,): objective of the best node
    scratch: FloatArray  # (3, m): bounds of an axis while it is solved
    axis_scratch: AxisScratch


def make_tree(size: int, horizon: int, rows: int) -> Tree:
    """Allocate `size` nodes."""
    n = horizon + 1
    return Tree(
        bound=np.empty(size),
        reward=np.empty(size),
        cost=np.empty((size, 3)),
        dirty=np.empty(size, dtype=np.int64),
        closed=np.empty(size, dtype=np.bool_),
        visits=np.empty((size, 2 * horizon), dtype=np.int64),
        number=np.empty(size, dtype=np.int64),
        low=np.empty((size, 3, horizon + 2)),
        high=np.empty((size, 3, horizon + 2)),
        values=np.empty((size, 3, rows)),
        heap=np.empty(size, dtype=np.int64),
        spare=np.empty(size, dtype=np.int64),
        counts=np.zeros(5, dtype=np.int64),
        best=np.full(1, np.inf),
        scratch=np.empty((3, rows)),
        axis_scratch=AxisScratch(
            np.empty(n, np.int64), np.empty(n), np.empty((n, n)), np.empty((2, n))
        ),
    )


@njit(cache=True)
def push(tree: Tree, node: int) -> None:
    """Put a node into the heap of bounds."""
    slot = tree.counts[0]
    tree.counts[0] += 1
    while slot > 0:
        parent = (slot - 1) // 2
        if tree.bound[tree.heap[parent]] <= tree.bound[node]:
            break
        tree.heap[slot] = tree.heap[parent]
        slot = parent
    tree.heap[slot] = node


@njit(cache=True)
def pop(tree: Tree) -> int:
    """Remove and return the node of the lowest bound."""
    top = tree.heap[0]
    tree.counts[0] -= 1
    size = tree.counts[0]
    if size:
        node = tree.heap[size]
        slot = 0
        while True:
            child = 2 * slot + 1
            if child >= size:
                break
            if child + 1 < size and tree.bound[tree.heap[child + 1]] < tree.bound[tree.heap[child]]:
                child += 1
            if tree.bound[tree.heap[child]] >= tree.bound[node]:
                break
            tree.heap[slot] = tree.heap[child]
            slot = child
        tree.heap[slot] = node
    return top


@njit(cache=True)
def free(tree: Tree, node: int) -> None:
    """Free a node."""
    tree.spare[tree.counts[1]] = node
    tree.counts[1] += 1


@njit(cache=True)
def copy_node(tree: Tree, source: int) -> int:
    """Return a copy of a node whose bounds can be tightened, or -1 without capacity."""
    if tree.counts[1] == 0:
        tree.counts[4] = 1
        return -1
    tree.counts[1] -= 1
    node = tree.spare[tree.counts[1]]
    tree.reward[node] = tree.reward[source]
    tree.closed[node] = tree.closed[source]
    tree.number[node] = tree.number[source]
    tree.dirty[node] = tree.dirty[source]
    tree.visits[node] = tree.visits[source]
    tree.cost[node] = tree.cost[source]
    tree.low[node] = tree.low[source]
    tree.high[node] = tree.high[source]
    tree.values[node] = tree.values[source]
    return node
