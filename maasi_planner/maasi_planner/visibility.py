"""Shortest paths around obstacles: a visibility graph of corners."""

from heapq import heapify, heappop, heappush

import numpy as np
from numba import njit
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from maasi_filter.arrays import BoolArray, FloatArray, IntArray
from maasi_planner.obstacles import Surroundings, Vector, is_visible

# Largest number of checked pairs. With more vertices, each checks only its nearest ones, which
# makes paths slightly longer; robots shorten them where they see further.
PAIRS = 150_000


class VisibilityGraph:
    """Corners that see each other, and the lengths of the shortest paths from them to goals.

    extra: distance kept from obstacles in addition to the radius [m].
    """

    def __init__(self, around: Surroundings, extra: float) -> None:
        self.around = around
        vertices = around.vertices
        pairs = _pairs(vertices)
        pairs = pairs[_seen(pairs, around, extra)]
        gaps = vertices[pairs[:, 0]] - vertices[pairs[:, 1]]
        lengths, number = np.hypot(gaps[:, 0], gaps[:, 1]), len(vertices)
        edges = csr_array((lengths, (pairs[:, 0], pairs[:, 1])), (number, number))
        edges = csr_array(edges + edges.T)
        self._edges = edges.indptr.astype(np.int64), edges.indices.astype(np.int64), edges.data

    def to_goal(self, goal: Vector) -> FloatArray:
        """Return the length of the shortest clear path from each corner to a goal, (m,), or inf."""
        last = _last_legs(goal, self.around)
        return _shortest(*self._edges, last)


def _pairs(vertices: FloatArray) -> IntArray:
    """Return pairs of corners (p, 2): all, or the nearest of each."""
    number = len(vertices)
    if number * number <= 2 * PAIRS:
        return np.stack(np.triu_indices(number, 1), axis=1)
    nearest = cKDTree(vertices).query(vertices, max(2, 2 * PAIRS // number))[1]
    pairs = np.stack([np.repeat(np.arange(number), nearest.shape[1]), nearest.ravel()], axis=1)
    pairs = np.sort(pairs, axis=1)
    return np.asarray(np.unique(pairs[pairs[:, 0] < pairs[:, 1]], axis=0))


@njit(cache=True)
def _seen(pairs: IntArray, around: Surroundings, extra: float) -> BoolArray:
    out, vertices = np.zeros(pairs.shape[0], np.bool_), around.vertices
    for n in range(pairs.shape[0]):
        i, j = pairs[n]
        start, end = (vertices[i, 0], vertices[i, 1], 0.0), (vertices[j, 0], vertices[j, 1], 0.0)
        out[n] = is_visible(start, end, around, extra, True)
    return out


@njit(cache=True)
def _last_legs(goal: Vector, around: Surroundings) -> FloatArray:
    out, end = np.full(around.vertices.shape[0], np.inf), (goal[0], goal[1], 0.0)
    for j in range(out.shape[0]):
        x, y = around.vertices[j, 0], around.vertices[j, 1]
        if is_visible((x, y, 0.0), end, around, 0.0, True):
            out[j] = np.hypot(x - goal[0], y - goal[1])
    return out


@njit(cache=True)
def _shortest(first: IntArray, ends: IntArray, lengths: FloatArray, last: FloatArray) -> FloatArray:
    """Return the shortest lengths from all corners, (m,), by Dijkstra's algorithm on a heap."""
    out = last.copy()
    heap = [(out[vertex], vertex) for vertex in range(len(out)) if out[vertex] < np.inf]
    heapify(heap)
    while heap:
        length, vertex = heappop(heap)
        if length > out[vertex]:
            continue  # a shorter path was found meanwhile
        for edge in range(first[vertex], first[vertex + 1]):
            end, total = ends[edge], length + lengths[edge]
            if total < out[end]:
                out[end] = total
                heappush(heap, (total, end))
    return out
