"""What is in sight over terrain from the cells of a lattice."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from maasi_filter.arrays import BoolArray, FloatArray, IntArray
from maasi_filter.geometry.terrain import Surface, hides


class View(NamedTuple):
    """What is seen in passing cells.

    kernel: probability of detection, by offset in cells. Over terrain, rows begin[c] to
    begin[c + 1] have the nodes of the map that are seen in passing cell c, and the probability
    there. Those behind a hill from the middle of their own cell are seen where that is not
    passed, but what is left of the cell: where whole (n,) is False.
    """

    kernel: FloatArray
    begin: IntArray = np.zeros(0, np.int64)
    node: IntArray = np.zeros(0, np.int64)
    chance: FloatArray = np.zeros(0)
    behind: BoolArray = np.zeros(0, np.bool_)
    whole: BoolArray = np.zeros(0, np.bool_)


class Cells(NamedTuple):
    """Cells of a lattice over nodes (m, 2) of the map [m].

    shape: numbers on each axis; middles (n, 2) [m]. Rows begin[c] to begin[c + 1] have the nodes of
    cell c, and their share in it.
    """

    shape: tuple[int, int, int]
    middles: FloatArray
    nodes: FloatArray
    begin: IntArray
    node: IntArray
    share: FloatArray


def view_over(cells: Cells, kernel: FloatArray, surface: Surface, height: float) -> View:
    """Return what is seen in passing cells at a height above a surface."""
    return View(kernel, *_rows(cells, kernel, surface, height))


@njit(cache=True)
def _around(cells, kernel, cell, found, touched):  # type: ignore[no-untyped-def]
    """Add the probability of detection in passing a cell to found (m,); return how many nodes."""
    nx, ny, _ = cells.shape
    a, b = kernel.shape[0] // 2, kernel.shape[1] // 2
    i, j, number = cell // ny, cell % ny, 0
    for u in range(max(i - a, 0), min(i + a + 1, nx)):
        for v in range(max(j - b, 0), min(j + b + 1, ny)):
            value, other = kernel[u - i + a, v - j + b, 0], u * ny + v
            if value <= 0.0:
                continue
            for row in range(cells.begin[other], cells.begin[other + 1]):
                n = cells.node[row]
                if found[n] == 0.0:
                    touched[number] = n
                    number += 1
                found[n] += value * cells.share[row]
    return number


@njit(cache=True)
def _rows(cells, kernel, surface, height):  # type: ignore[no-untyped-def]
    number, nodes, used = len(cells.middles), len(cells.nodes), 0
    found, touched, own = np.zeros(nodes), np.empty(nodes, np.int64), np.zeros(nodes, np.bool_)
    begin = np.zeros(number + 1, np.int64)
    node, chance = np.empty(4 * nodes, np.int64), np.empty(4 * nodes)
    behind = np.empty(4 * nodes, np.bool_)
    for c in range(number):
        mine = cells.node[cells.begin[c] : cells.begin[c + 1]]
        count = _around(cells, kernel, c, found, touched) if len(mine) > 0 else 0
        for n in mine:
            own[n] = True
        if used + count > len(node):
            node = np.concatenate((node, np.empty(len(node) + count, np.int64)))
            chance = np.concatenate((chance, np.empty(len(chance) + count)))
            behind = np.concatenate((behind, np.empty(len(behind) + count, np.bool_)))
        x, y = cells.middles[c, 0], cells.middles[c, 1]
        for k in range(count):
            n = touched[k]
            hidden = hides(surface, x, y, height, cells.nodes[n, 0], cells.nodes[n, 1])
            if own[n] or not hidden:
                node[used], chance[used], behind[used] = n, min(found[n], 1.0), hidden
                used += 1
            found[n] = 0.0
        for n in mine:
            own[n] = False
        begin[c + 1] = used
    return begin, node[:used], chance[:used], behind[:used]
