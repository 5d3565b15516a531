"""Grid that lists the obstacles near each of its cells."""

import math

import numpy as np
from numba import njit
from scipy.ndimage import distance_transform_edt

from maasi_filter.arrays import FloatArray, IntArray
from maasi_planner.obstacles import Felt, Nearby, crossed_walls, from_centre

_FEW = 48  # circles that need no grid
_HALF = math.sqrt(0.5)  # of the diagonal of a cell, by its width


def nearby_of(circles: FloatArray, reach: float, extra: float) -> Nearby:
    """Return the grid over circles (n, 7).

    reach: distance at which they matter [m]; extra: largest distance of lines beyond their radius
    [m].
    """
    far = circles[:, :2] + circles[:, 5:]
    radii = circles[:, 3:4]
    points = np.vstack([circles[:, :2] - radii, circles[:, :2] + radii, far - radii, far + radii])
    if len(circles) <= _FEW or not math.isfinite(reach):
        rows = np.arange(len(circles))
        number = len(circles)
        lists = np.array([4, 4 + number, 4, 4 + number, *rows])
        walls = (circles[:, 5:] != 0.0).any()
        cells = np.array([[[-math.inf, 2.0 if walls else 0.0]]])
        gaps = np.full(len(lists), -math.inf)
        return Nearby(np.array([0.0, 0.0, math.inf]), cells, lists, gaps)
    extent = float(np.ptp(points, axis=0).max())
    size = max(extent / 200.0, min(0.25 * reach, extent / 50.0))
    listed = max(reach, size + extra) + _HALF * size
    low = points.min(axis=0) - listed
    counts = np.ceil((points.max(axis=0) + listed - low) / size).astype(np.int64)
    head = np.array([*low, size])
    gaps = np.full(counts, np.inf)
    pairs, apart = _near(circles, head, listed, gaps)
    cells = np.zeros((*counts, 2))
    empty = np.isinf(gaps)
    # Without listed circles, the nearest one is in another cell.
    lower = (distance_transform_edt(empty) - 1.0) * size if empty.any() else gaps
    cells[..., 0] = np.where(empty, lower, gaps)
    by_row = _walls_by_row(circles, head, int(counts[1]))
    number = int(counts.prod())
    starts, rows, apart = _listed(pairs, apart, number)
    wall_starts, walls, _ = _listed(by_row, np.zeros(len(by_row)), int(counts[1]))
    offset = number + 1 + int(counts[1]) + 1
    lists = np.concatenate([starts + offset, wall_starts + offset + len(rows), rows, walls])
    _mark_inside(circles, head, cells, wall_starts, walls)
    sorted_gaps = np.concatenate([np.zeros(offset), apart, np.zeros(len(walls))])
    return Nearby(head, cells, lists, sorted_gaps)


def _listed(
    pairs: IntArray, keys: FloatArray, number: int
) -> tuple[IntArray, IntArray, FloatArray]:
    """Return begin, rows and sorted keys of lists, from pairs (p, 2) of list and row."""
    order = np.lexsort((keys, pairs[:, 0]))
    starts = np.searchsorted(pairs[order, 0], np.arange(number + 1))
    return starts.astype(np.int64), pairs[order, 1], keys[order]


@njit(cache=True)
def _near(
    circles: FloatArray, head: FloatArray, listed: float, gaps: FloatArray
) -> tuple[IntArray, FloatArray]:
    """Fill the distance of circles from the centre of each cell; return cells, circles and gaps."""
    nx, ny = gaps.shape
    size, number = head[2], 0
    out, apart = np.empty((64, 2), np.int64), np.empty(64)
    for i in range(circles.shape[0]):
        margin = circles[i, 3] + listed
        x, y = circles[i, 0] - head[0], circles[i, 1] - head[1]
        dx, dy = circles[i, 5], circles[i, 6]
        u0 = max(int((min(x, x + dx) - margin) / size), 0)
        v0 = max(int((min(y, y + dy) - margin) / size), 0)
        u1 = min(int((max(x, x + dx) + margin) / size) + 1, nx)
        v1 = min(int((max(y, y + dy) + margin) / size) + 1, ny)
        for u in range(u0, u1):
            for v in range(v0, v1):
                middle = head[0] + (u + 0.5) * size, head[1] + (v + 0.5) * size, circles[i, 2]
                ox, oy, _ = from_centre(middle, circles, i)
                gap = math.hypot(ox, oy) - circles[i, 3]
                if gap > listed:
                    continue
                gaps[u, v] = min(gaps[u, v], gap)
                if number == len(apart):
                    out, apart = np.concatenate((out, out)), np.concatenate((apart, apart))
                out[number, 0], out[number, 1], apart[number] = u * ny + v, i, gap
                number += 1
    return out[:number].copy(), apart[:number].copy()


@njit(cache=True)
def _walls_by_row(circles: FloatArray, head: FloatArray, rows: int) -> IntArray:
    """Return rows of cells and the walls in them, (p, 2)."""
    out = np.empty((64, 2), np.int64)
    number = 0
    for i in range(circles.shape[0]):
        if circles[i, 5] == 0.0 and circles[i, 6] == 0.0:
            continue
        y, dy = circles[i, 1] - head[1], circles[i, 6]
        first = max(int(min(y, y + dy) / head[2] - 1e-6), 0)
        last = min(int(max(y, y + dy) / head[2] + 1e-6), rows - 1)
        for row in range(first, last + 1):
            if number == out.shape[0]:
                out = np.concatenate((out, out))
            out[number, 0], out[number, 1] = row, i
            number += 1
    return out[:number]


@njit(cache=True)
def _mark_inside(
    circles: FloatArray, head: FloatArray, cells: FloatArray, starts: IntArray, walls: IntArray
) -> None:
    """Mark cells without walls nearby: 0 inside of the walls, 1 outside; others 2."""
    size = head[2]
    for v in range(cells.shape[1]):
        y = head[1] + (v + 0.5) * size
        met = Felt(circles, walls, np.zeros(0), starts[v], starts[v + 1], 0.0)
        for u in range(cells.shape[0]):
            if walls.shape[0] == 0:
                continue
            if cells[u, v, 0] <= _HALF * size:
                cells[u, v, 1] = 2.0
                continue
            middle = head[0] + (u + 0.5) * size, y, 0.0
            cells[u, v, 1] = 0.0 if crossed_walls(middle, met)[1] else 1.0
