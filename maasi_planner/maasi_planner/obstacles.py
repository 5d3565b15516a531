"""Obstacles, keep-outs and the border of the area for compiled code.

They are cylinders of any height (in 2D discs), spheres, and walls, which are edges of polygons, all
inflated by the radius of a robot in `keep_out.KeepOut`. A grid lists those near each of its cells,
so that the cost of a step hardly depends on their number.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from maasi_filter.arrays import FloatArray, IntArray

Vector = tuple[float, float, float]
_BEYOND = 1.0  # second number of a cell outside of the walls; 0: inside; 2: near a wall


class Nearby(NamedTuple):
    """Circles near each cell of a horizontal grid.

    head (3,): lower corner and width of the cells [m]; cells (nx, ny, 2): least distance of the
    cell's centre from all circles [m], and whether the cell is inside of the walls; lists: begin of
    the rows of each cell, (nx ny + 1), begin of the walls in each row of cells along x, (ny + 1),
    and these rows of `circles`, nearest first for cells; gaps: their distances from the centre of
    the cell [m].
    """

    head: FloatArray
    cells: FloatArray
    lists: IntArray
    gaps: FloatArray


class Surroundings(NamedTuple):
    """Obstacles of a robot, inflated by its radius.

    circles (n, 7): x, y, z, radius [m, map], 1 for a sphere, and the vector to the other end of a
    wall [m]; vertices (m, 2): of the visibility graph [m, map]; clearance: distance of planned
    paths beyond the radius [m]; nearby: grid of the circles; solid (s, 7): circles without
    keep-outs, for a robot that leaves a closed zone; inflation: of all circles [m]; spheres:
    whether there are any.
    """

    circles: FloatArray
    vertices: FloatArray
    clearance: float
    nearby: Nearby
    solid: FloatArray
    inflation: float
    spheres: bool


class Felt(NamedTuple):
    """Circles that matter at a position: those of `rows` from `first` to `last`.

    They are in the order of their `gaps` from a point at the distance `off` from the position [m].
    """

    circles: FloatArray
    rows: IntArray
    gaps: FloatArray
    first: int
    last: int
    off: float


@njit(cache=True, forceinline=True)
def minus(a: Vector, b: Vector) -> Vector:
    """Return a - b."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@njit(cache=True, forceinline=True)
def plus(a: Vector, factor: float, b: Vector) -> Vector:
    """Return a + factor b."""
    return a[0] + factor * b[0], a[1] + factor * b[1], a[2] + factor * b[2]


@njit(cache=True, forceinline=True)
def dot(a: Vector, b: Vector) -> float:
    """Return the inner product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True, forceinline=True)
def norm(a: Vector) -> float:
    """Return the length."""
    return math.sqrt(dot(a, a))


# Inlined, as counting references to array arguments costs more than the functions.
@njit(cache=True, forceinline=True)
def from_centre(point: Vector, circles: FloatArray, i: int) -> Vector:
    """Return the offset of a point from a wall or a circle's centre; horizontal but for spheres."""
    height = point[2] - circles[i, 2] if circles[i, 4] > 0.5 else 0.0
    x, y = point[0] - circles[i, 0], point[1] - circles[i, 1]
    dx, dy = circles[i, 5], circles[i, 6]
    if dx != 0.0 or dy != 0.0:
        part = min(max((x * dx + y * dy) / (dx * dx + dy * dy), 0.0), 1.0)
        x, y = x - part * dx, y - part * dy
    return x, y, height


@njit(cache=True)
def _wall_distance(start: Vector, end: Vector, circles: FloatArray, i: int) -> float:
    ax, ay = circles[i, 0] - start[0], circles[i, 1] - start[1]
    dx, dy = circles[i, 5], circles[i, 6]
    ex, ey = end[0] - start[0], end[1] - start[1]
    # They cross where each has its ends on both sides of the other.
    one = (ex * ay - ey * ax) * (ex * (ay + dy) - ey * (ax + dx))
    other = (dy * ax - dx * ay) * (dx * (ey - ay) - dy * (ex - ax))
    if one < 0.0 and other < 0.0:
        return 0.0
    square = ex * ex + ey * ey
    nearest = min(norm(from_centre(start, circles, i)), norm(from_centre(end, circles, i)))
    if square > 0.0:
        for x, y in ((ax, ay), (ax + dx, ay + dy)):
            part = min(max((x * ex + y * ey) / square, 0.0), 1.0)
            nearest = min(nearest, math.hypot(x - part * ex, y - part * ey))
    return nearest


@njit(cache=True)
def crossed_walls(point: Vector, felt: Felt) -> tuple[bool, bool]:
    """Return whether there are walls, and whether a ray along x crosses an odd number of them."""
    any_wall, odd = False, False
    circles = felt.circles
    for n in range(felt.first, felt.last):
        i = felt.rows[n]
        dx, dy = circles[i, 5], circles[i, 6]
        if dx != 0.0 or dy != 0.0:
            any_wall = True
            y = point[1] - circles[i, 1]
            if (y < 0.0) != (y < dy) and (point[0] - circles[i, 0] < dx * y / dy):
                odd = not odd
    return any_wall, odd


@njit(cache=True, forceinline=True)
def _cell(point: Vector, nearby: Nearby) -> tuple[int, int]:
    head, cells = nearby.head, nearby.cells
    # Clipped before the conversion, as numbers may be large.
    u = min(max((point[0] - head[0]) / head[2], 0.0), cells.shape[0] - 1.0)
    v = min(max((point[1] - head[1]) / head[2], 0.0), cells.shape[1] - 1.0)
    return int(u), int(v)


@njit(cache=True, forceinline=True)
def felt_at(point: Vector, around: Surroundings) -> Felt:
    """Return the circles near to a position."""
    nearby = around.nearby
    i, j = _cell(point, nearby)
    n, off = i * nearby.cells.shape[1] + j, 0.0
    if nearby.head[2] < np.inf:
        x = point[0] - nearby.head[0] - (i + 0.5) * nearby.head[2]
        y = point[1] - nearby.head[1] - (j + 0.5) * nearby.head[2]
        off = math.sqrt(x * x + y * y)
    lists = nearby.lists
    return Felt(around.circles, lists, nearby.gaps, lists[n], lists[n + 1], off)


@njit(cache=True, forceinline=True)
def beyond_walls(point: Vector, around: Surroundings) -> bool:
    """Return whether a point is outside of the walls, if there are any."""
    nearby = around.nearby
    i, j = _cell(point, nearby)
    known = nearby.cells[i, j, 1]
    if known <= _BEYOND:
        return bool(known == _BEYOND)
    n = nearby.cells.shape[0] * nearby.cells.shape[1] + 1 + j
    lists = nearby.lists
    walls = Felt(around.circles, lists, nearby.gaps, lists[n], lists[n + 1], 0.0)
    return not crossed_walls(point, walls)[1]


@njit(cache=True)
def all_felt(circles: FloatArray) -> Felt:
    """Return all circles."""
    number = circles.shape[0]
    return Felt(circles, np.arange(number), np.full(number, -np.inf), 0, number, 0.0)


@njit(cache=True, forceinline=True)
def segment_distance(start: Vector, end: Vector, circles: FloatArray, i: int) -> float:
    """Return the distance of a circle's centre, or of a wall, from a segment."""
    if circles[i, 5] != 0.0 or circles[i, 6] != 0.0:
        return _wall_distance(start, end, circles, i)
    line = minus(end, start)
    if circles[i, 4] <= 0.5:
        line = (line[0], line[1], 0.0)
    offset = from_centre(start, circles, i)
    square = dot(line, line)
    part = min(max(-dot(offset, line) / square, 0.0), 1.0) if square > 0.0 else 0.0
    return norm(plus(offset, part, line))


@njit(cache=True, forceinline=True)
def is_far(start: Vector, end: Vector, circles: FloatArray, i: int, reach: float) -> bool:
    """Return whether the bounding boxes of a segment and a wall are more than `reach` apart."""
    x, y = circles[i, 0], circles[i, 1]
    dx, dy = circles[i, 5], circles[i, 6]
    if dx == 0.0 and dy == 0.0:
        return False
    return bool(
        min(start[0], end[0]) - max(x, x + dx) > reach
        or min(x, x + dx) - max(start[0], end[0]) > reach
        or min(start[1], end[1]) - max(y, y + dy) > reach
        or min(y, y + dy) - max(start[1], end[1]) > reach
    )


@njit(cache=True)
def is_clear(start: Vector, end: Vector, felt: Felt, extra: float, cylinders_only: bool) -> bool:
    """Return whether a segment keeps `extra` beyond the radius from every circle."""
    circles = felt.circles
    enough = norm(minus(end, start)) + extra + felt.off
    for n in range(felt.first, felt.last):
        i = felt.rows[n]
        if felt.gaps[n] > enough:
            break
        if cylinders_only and circles[i, 4] > 0.5:
            continue
        if is_far(start, end, circles, i, circles[i, 3] + extra):
            continue
        if segment_distance(start, end, circles, i) < circles[i, 3] + extra:
            return False
    return True


@njit(cache=True, forceinline=True)
def clearance_at(point: Vector, around: Surroundings) -> float:
    """Return a lower bound of the distance from all circles [m]; minus infinity if unknown."""
    nearby = around.nearby
    size = nearby.head[2]
    if size == np.inf:
        return -np.inf
    i, j = _cell(point, nearby)
    x = point[0] - nearby.head[0] - (i + 0.5) * size
    y = point[1] - nearby.head[1] - (j + 0.5) * size
    return float(nearby.cells[i, j, 0] - math.sqrt(x * x + y * y))


@njit(cache=True)
def is_visible(
    start: Vector, end: Vector, around: Surroundings, extra: float, cylinders_only: bool
) -> bool:
    """Do as `is_clear` for all circles, in long strides where nothing is near."""
    nearby = around.nearby
    if nearby.cells.shape[0] * nearby.cells.shape[1] == 1:
        return is_clear(start, end, felt_at(start, around), extra, cylinders_only)
    size = nearby.head[2]
    line = minus(end, start)
    length, done, here = norm(line), 0.0, start
    while True:
        stride = clearance_at(here, around) - extra
        free = stride > 0.1 * size
        stride = stride if stride > 0.1 * size else 0.5 * size
        done += stride
        there = plus(start, done / length, line) if done < length else end
        if not free and not is_clear(here, there, felt_at(here, around), extra, cylinders_only):
            return False
        if done >= length:
            return True
        here = there


@njit(cache=True, forceinline=True)
def is_free_at(point: Vector, around: Surroundings) -> bool:
    """Return whether a robot at a position is inside of the walls and touches nothing."""
    clear = is_clear(point, point, felt_at(point, around), 0.0, False)
    return clear and not beyond_walls(point, around)


@njit(cache=True)
def clear_vertices(corners: FloatArray, around: Surroundings) -> FloatArray:
    """Return the corners (n, 2) at which a robot has half of its clearance."""
    kept, number = np.empty_like(corners), 0
    for x, y in corners:
        point = (x, y, 0.0)
        felt, extra = felt_at(point, around), 0.5 * around.clearance
        if is_clear(point, point, felt, extra, True) and not beyond_walls(point, around):
            kept[number, 0], kept[number, 1] = x, y
            number += 1
    return kept[:number].copy()
