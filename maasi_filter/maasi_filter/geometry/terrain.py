"""The ground as a grid of heights: bilinear surface, rays that meet it, and lines of sight."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from maasi_filter.arrays import BoolArray, FloatArray

_BLOCK = 4  # blocks of 2^4 cells on each axis, with their largest height
# A line of sight may touch the ground: targets stand on it. Above rounding of coordinates up to
# 1,000 km and slopes up to 1,000, of 1e6 x 1e3 x 2e-16 m.
TOUCHING = 1e-6  # [m]


class Surface(NamedTuple):
    """The bilinear surface for compiled functions.

    heights (nx, ny) [m] at the nodes; corner (2,) and step (2,) [m, map] of the nodes; tops
    (ceil(nx / 16), ceil(ny / 16)): largest height of each block of 16 x 16 cells.
    """

    heights: FloatArray
    corner: FloatArray
    step: FloatArray
    tops: FloatArray
    lowest: float
    highest: float


#: Flat ground, which hides nothing.
FLAT = Surface(np.zeros((0, 0)), np.zeros(2), np.ones(2), np.zeros((0, 0)), 0.0, 0.0)


@njit(cache=True, error_model='numpy')
def height_at(surface: Surface, x: float, y: float) -> float:
    """Return the height at a position [m, map]; outside of the grid that of its border."""
    heights, corner, step = surface.heights, surface.corner, surface.step
    u = min(max((x - corner[0]) / step[0], 0.0), heights.shape[0] - 1.0)
    v = min(max((y - corner[1]) / step[1], 0.0), heights.shape[1] - 1.0)
    i, j = min(int(u), heights.shape[0] - 2), min(int(v), heights.shape[1] - 2)
    u, v = u - i, v - j
    low = (1.0 - v) * heights[i, j] + v * heights[i, j + 1]
    high = (1.0 - v) * heights[i + 1, j] + v * heights[i + 1, j + 1]
    return (1.0 - u) * low + u * high


@njit(cache=True, error_model='numpy')
def _slope_at(surface: Surface, x: float, y: float) -> tuple[float, float]:
    """Return the slope of the surface along x and y; 0 outside of the grid."""
    heights, corner, step = surface.heights, surface.corner, surface.step
    u, v = (x - corner[0]) / step[0], (y - corner[1]) / step[1]
    if not (0.0 <= u <= heights.shape[0] - 1.0 and 0.0 <= v <= heights.shape[1] - 1.0):
        return 0.0, 0.0
    i, j = min(int(u), heights.shape[0] - 2), min(int(v), heights.shape[1] - 2)
    u, v = u - i, v - j
    south, north = heights[i + 1, j] - heights[i, j], heights[i + 1, j + 1] - heights[i, j + 1]
    west, east = heights[i, j + 1] - heights[i, j], heights[i + 1, j + 1] - heights[i + 1, j]
    along_x, along_y = (1.0 - v) * south + v * north, (1.0 - u) * west + u * east
    return along_x / step[0], along_y / step[1]


@njit(cache=True, error_model='numpy')
def _inside(
    surface: Surface, start: FloatArray, way: FloatArray, end: float
) -> tuple[float, float]:
    """Return the part of 0 to `end` of a ray (start + t way) over the grid; empty: begin > end."""
    begin = 0.0
    for axis in range(2):
        low = surface.corner[axis] - start[axis]
        high = low + (surface.heights.shape[axis] - 1) * surface.step[axis]
        if way[axis] == 0.0:
            if low > 0.0 or high < 0.0:
                return 1.0, 0.0
            continue
        one, two = low / way[axis], high / way[axis]
        begin, end = max(begin, min(one, two)), min(end, max(one, two))
    return begin, end


@njit(cache=True, error_model='numpy')
def _exit(surface: Surface, start: FloatArray, way: FloatArray, axis: int, edge: int) -> float:
    """Return where a ray crosses the grid line `edge` of an axis; never: infinity."""
    if way[axis] == 0.0:
        return np.inf
    return (surface.corner[axis] + edge * surface.step[axis] - start[axis]) / way[axis]


@njit(cache=True, error_model='numpy')
def _node_before(surface: Surface, axis: int, value: float, low: int, high: int) -> int:
    """Return the index of the cell of a coordinate, from low to high."""
    number = math.floor((value - surface.corner[axis]) / surface.step[axis])
    return min(max(int(number), low), high)


@njit(cache=True, error_model='numpy')
def _along_ray(  # type: ignore[no-untyped-def]
    surface: Surface, start: FloatArray, way: FloatArray, end: float, first: bool, enough: float
):
    """Follow a ray (start + t way, t from 0 to `end`) over the cells below it.

    With `first`: return the smallest t at which its height above the surface is 0 or less, or
    infinity. Otherwise: return the smallest height above the surface if that is below `enough` (the
    first found), else any from `enough`; infinity off the grid. Over a cell, the height is a
    parabola of t, so both are exact. If `enough` is minus infinity, the smallest height.
    """
    heights, corner, step = surface.heights, surface.corner, surface.step
    least = np.inf
    begin, end = _inside(surface, start, way, end)
    if begin > end:
        return least
    if first:
        # Above the highest point there is nothing to meet.
        if way[2] == 0.0 and start[2] > surface.highest:
            return least
        over = (surface.highest - start[2]) / way[2] if way[2] != 0.0 else 0.0
        if way[2] < 0.0:
            begin = max(begin, over)
        elif way[2] > 0.0:
            end = min(end, over)
        if begin > end:
            return least
    last_i, last_j = heights.shape[0] - 2, heights.shape[1] - 2
    i = _node_before(surface, 0, start[0] + begin * way[0], 0, last_i)
    j = _node_before(surface, 1, start[1] + begin * way[1], 0, last_j)
    right, up = (1 if way[0] > 0.0 else 0), (1 if way[1] > 0.0 else 0)
    size = 1 << _BLOCK
    t = begin
    while True:
        # A whole block, if the ray stays far enough above it.
        spare = 0.0 if first else (enough if enough > -np.inf else least)
        a, b = i >> _BLOCK, j >> _BLOCK
        to_x = _exit(surface, start, way, 0, min((a + right) * size, last_i + 1))
        to_y = _exit(surface, start, way, 1, min((b + up) * size, last_j + 1))
        leave = max(min(to_x, to_y, end), t)
        # Vertical rays have no length on the ground, and infinite ends.
        lower = start[2] + (leave if way[2] < 0.0 else t) * way[2] if leave < np.inf else -np.inf
        if lower - surface.tops[a, b] > spare:
            if leave >= end:
                return least
            if to_x <= to_y:
                i = (a + right) * size - (1 - right)
                low, high = b * size, min((b + 1) * size - 1, last_j)
                j = _node_before(surface, 1, start[1] + leave * way[1], low, high)
            else:
                j = (b + up) * size - (1 - up)
                low, high = a * size, min((a + 1) * size - 1, last_i)
                i = _node_before(surface, 0, start[0] + leave * way[0], low, high)
            if not (0 <= i <= last_i and 0 <= j <= last_j):
                return least
            t = leave
            continue
        to_x = _exit(surface, start, way, 0, i + right)
        to_y = _exit(surface, start, way, 1, j + up)
        leave = max(min(to_x, to_y, end), t)
        # Height above the cell: gap + rate s + bend s^2, with s from t.
        u = (start[0] + t * way[0] - corner[0]) / step[0] - i
        v = (start[1] + t * way[1] - corner[1]) / step[1] - j
        u, v = min(max(u, 0.0), 1.0), min(max(v, 0.0), 1.0)
        du, dv = way[0] / step[0], way[1] / step[1]
        here, east, north = heights[i, j], heights[i + 1, j], heights[i, j + 1]
        twist = heights[i + 1, j + 1] - east - north + here
        gap = start[2] + t * way[2]
        gap -= here + (east - here) * u + (north - here) * v + twist * u * v
        rate = way[2] - (east - here) * du - (north - here) * dv - twist * (u * dv + v * du)
        bend = -twist * du * dv
        length = leave - t
        if first:
            if gap <= 0.0:
                return t
            root, square = np.inf, rate * rate - 4.0 * gap * bend
            if square >= 0.0:
                half = 0.5 * (math.sqrt(square) + abs(rate))
                if rate < 0.0:
                    root = gap / half
                elif bend < 0.0:
                    root = -half / bend
            if root <= length:
                return t + root
        else:
            least = min(least, gap)
            if length < np.inf:
                least = min(least, gap + length * (rate + length * bend))
            if bend > 0.0 and 0.0 < -rate < 2.0 * bend * length:
                least = min(least, gap - 0.25 * rate * rate / bend)
            if least < enough:
                return least
        if leave >= end:
            return least
        if to_x <= to_y:
            i += 1 if right else -1
        else:
            j += 1 if up else -1
        if not (0 <= i <= last_i and 0 <= j <= last_j):
            return least
        t = leave


@njit(cache=True, error_model='numpy')
def ray_length(surface: Surface, start: FloatArray, way: FloatArray) -> float:
    """Return t at which a ray, start + t way (3,), first meets the ground; infinity: never."""
    if way[0] == 0.0 and way[1] == 0.0:
        gap = start[2] - height_at(surface, start[0], start[1])
        if gap <= 0.0:
            return 0.0
        return gap / -way[2] if way[2] < 0.0 else np.inf
    return _along_ray(surface, start, way, np.inf, True, 0.0)


@njit(cache=True, error_model='numpy')
def clearance_along(surface: Surface, start: FloatArray, end: FloatArray, enough: float) -> float:
    """Return the least height above ground from start to end (3,), as far as it is below `enough`.

    Minus infinity: the least height.
    """
    one = start[2] - height_at(surface, start[0], start[1])
    two = end[2] - height_at(surface, end[0], end[1])
    if min(one, two) < enough or (start[0] == end[0] and start[1] == end[1]):
        return min(one, two)
    return min(one, two, _along_ray(surface, start, end - start, 1.0, False, enough))


@njit(cache=True, error_model='numpy')
def is_in_sight(surface: Surface, start: FloatArray, end: FloatArray) -> bool:
    """Return whether no ground is between two positions (3,), which may be on the ground."""
    return clearance_along(surface, start, end, -TOUCHING) >= -TOUCHING


@njit(cache=True, error_model='numpy')
def hides(surface: Surface, x: float, y: float, height: float, to_x: float, to_y: float) -> bool:
    """Return whether the ground hides one of its points from a height above another one."""
    start = np.array([x, y, height_at(surface, x, y) + height])
    return not is_in_sight(surface, start, np.array([to_x, to_y, height_at(surface, to_x, to_y)]))


@njit(cache=True, error_model='numpy')
def _heights(surface, points, out):  # type: ignore[no-untyped-def]
    for k in range(points.shape[0]):
        out[k] = height_at(surface, points[k, 0], points[k, 1])


@njit(cache=True, error_model='numpy')
def _slopes(surface, points, out):  # type: ignore[no-untyped-def]
    for k in range(points.shape[0]):
        out[k, 0], out[k, 1] = _slope_at(surface, points[k, 0], points[k, 1])


@njit(cache=True, error_model='numpy')
def _ray_lengths(surface, start, ways, out):  # type: ignore[no-untyped-def]
    for k in range(ways.shape[0]):
        out[k] = ray_length(surface, start, ways[k]) if np.isfinite(ways[k]).all() else np.inf


@njit(cache=True, error_model='numpy')
def _in_sight(surface, start, points, out):  # type: ignore[no-untyped-def]
    for k in range(points.shape[0]):
        out[k] = is_in_sight(surface, start, points[k])


class Terrain:
    """Ground whose height is bilinear between the nodes of a grid.

    Parameters
    ----------
    heights : (nx, ny) array
        Heights at the nodes, metres, frame `map`; at least 2 x 2.
    corner, step : (2,) arrays
        Position of the first node, and distances of nodes on x and y, metres, frame `map`.

    Raises
    ------
    ValueError
        If there are fewer than 2 x 2 nodes, or a number is invalid.
    """

    def __init__(self, heights: ArrayLike, corner: ArrayLike, step: ArrayLike) -> None:
        grid = np.ascontiguousarray(heights, dtype=float)
        if grid.ndim != 2 or min(grid.shape) < 2:
            raise ValueError(f'heights: got shape {grid.shape}, allowed are at least 2 x 2')
        if not np.isfinite(grid).all():
            raise ValueError('heights: got a number that is not finite')
        first, apart = np.array(corner, dtype=float), np.array(step, dtype=float)
        for name, value in (('corner', first), ('step', apart)):
            if value.shape != (2,) or not np.isfinite(value).all():
                raise ValueError(f'{name}: got {value.tolist()}, allowed are two finite numbers')
        if not (apart > 0.0).all():
            raise ValueError(f'step: got {apart.tolist()}, allowed are numbers above 0')
        size = 1 << _BLOCK
        # Blocks share the nodes between them.
        rows, columns = (np.arange(0, number - 1, size) for number in grid.shape)
        tops = np.maximum.reduceat(np.maximum(grid[:-1], grid[1:]), rows, axis=0)
        tops = np.maximum.reduceat(np.maximum(tops[:, :-1], tops[:, 1:]), columns, axis=1)
        extremes = float(grid.min()), float(grid.max())
        self.surface = Surface(grid, first, apart, np.ascontiguousarray(tops), *extremes)

    @property
    def bounds(self) -> FloatArray:
        """Lower and upper bound of the nodes on x and y, (2, 2) [m, map]."""
        surface = self.surface
        last = surface.corner + surface.step * (np.array(surface.heights.shape) - 1)
        return np.stack([surface.corner, last], axis=1)

    def heights(self, points: ArrayLike) -> FloatArray:
        """Return the heights (n,) at points (n, 2 or 3) [m, map]; outside, that of the border."""
        array = np.ascontiguousarray(points, dtype=float)
        out = np.empty(len(array))
        _heights(self.surface, array, out)
        return out

    def height(self, point: ArrayLike) -> float:
        """Return the height at a point (2 or 3,) [m, map]."""
        return float(height_at(self.surface, *np.asarray(point, dtype=float)[:2].tolist()))

    def slopes(self, points: ArrayLike) -> FloatArray:
        """Return the slopes (n, 2) along x and y at points (n, 2 or 3) [m, map]."""
        array = np.ascontiguousarray(points, dtype=float)
        out = np.empty((len(array), 2))
        _slopes(self.surface, array, out)
        return out

    def on_ground(self, points: ArrayLike) -> FloatArray:
        """Return points (n, 2 or 3) with the height of the ground, (n, 3) [m, map]."""
        array = np.asarray(points, dtype=float)
        return np.column_stack([array[:, :2], self.heights(array)])

    def meets(self, start: ArrayLike, ways: ArrayLike) -> FloatArray:
        """Return where rays from `start` (3,) in directions (n, 3) first meet the ground.

        Positions (n, 3) [m, map]; nan where a ray does not meet it within the grid.
        """
        begin = np.asarray(start, dtype=float)
        rays = np.ascontiguousarray(ways, dtype=float)
        lengths = np.empty(len(rays))
        _ray_lengths(self.surface, begin, rays, lengths)
        lengths[np.isinf(lengths)] = np.nan
        return np.asarray(begin + lengths[:, None] * rays)

    def visible(self, start: ArrayLike, points: ArrayLike) -> BoolArray:
        """Return which points (n, 3) [m, map] the ground does not hide from `start` (3,)."""
        array = np.ascontiguousarray(points, dtype=float)
        out = np.empty(len(array), dtype=np.bool_)
        _in_sight(self.surface, np.asarray(start, dtype=float), array, out)
        return out

    def clearance(self, start: ArrayLike, end: ArrayLike) -> float:
        """Return the least height above ground of the straight path between points (3,) [m]."""
        ends = np.asarray(start, dtype=float), np.asarray(end, dtype=float)
        return float(clearance_along(self.surface, *ends, -np.inf))
