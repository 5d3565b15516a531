"""Obstacles, keep-outs and the border of the area as compiled code meets them at every step.

They are cylinders of any height (in 2D discs), spheres, and walls: the edges of polygons, all
inflated by the radius of a robot (`keep_out.KeepOut` makes them). A grid over them lists which are
near to each of its cells, so that a step costs about the same among a thousand as among ten.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from maasi_filter.arrays import FloatArray, IntArray

Vector = tuple[float, float, float]
# In more vertices than these the one to head for is looked for anew only where it is reached or
# hidden; a prediction among fewer is the controller's own, to the bit.
MANY = 100
_BEYOND = 1.0  # second number of a cell outside of all walls; 0: in the room; 2: a wall is near


class Nearby(NamedTuple):
    """Which circles are near to each cell of a level grid.

    head (3,): lower corner and width of the cells [m]; cells (nx, ny, 2): how far the middle of a
    cell is at least from all circles [m], and whether it is in the room that the walls enclose;
    lists: where the rows of each cell begin, (nx ny + 1), where those of the walls that each row of
    cells along x meets, (ny + 1), and these rows of `circles`.
    """

    head: FloatArray
    cells: FloatArray
    lists: IntArray


class Surroundings(NamedTuple):
    """Obstacles of a robot, inflated by its radius.

    circles (n, 7): x, y, z, radius [m, map], 1 for a sphere, and x and y from there to the other
    end of a wall [m]; vertices (m, 2): of the visibility graph [m, map]; clearance: kept beyond the
    radius by planned paths [m]; nearby: of the circles; solid (s, 7): those that also a robot keeps
    out of that leaves a closed zone; inflation: of all of them [m]; spheres: whether there are any.
    """

    circles: FloatArray
    vertices: FloatArray
    clearance: float
    nearby: Nearby
    solid: FloatArray
    inflation: float
    spheres: bool


class Felt(NamedTuple):
    """Circles that a robot minds at a position: those of `rows` from `first` to `last`."""

    circles: FloatArray
    rows: IntArray
    first: int
    last: int


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


# Inlined: counting references to array arguments costs more than these functions themselves.
@njit(cache=True, forceinline=True)
def from_centre(point: Vector, circles: FloatArray, i: int) -> Vector:
    """Return the offset of a point from a circle's centre or a wall, level but for a sphere."""
    height = point[2] - circles[i, 2] if circles[i, 4] > 0.5 else 0.0
    x, y = point[0] - circles[i, 0], point[1] - circles[i, 1]
    dx, dy = circles[i, 5], circles[i, 6]
    if dx != 0.0 or dy != 0.0:
        part = min(max((x * dx + y * dy) / (dx * dx + dy * dy), 0.0), 1.0)
        x, y = x - part * dx, y - part * dy
    return x, y, height


@njit(cache=True)
def _wall_distance(start: Vector, end: Vector, circles: FloatArray, i: int) -> float:
    """Return the level distance of a wall from a segment."""
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
def _crossed_walls(point: Vector, felt: Felt) -> tuple[bool, bool]:
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
    """Return the cell of a position, or the one nearest to it."""
    head, cells = nearby.head, nearby.cells
    # Before the conversion: numbers may be far outside.
    u = min(max((point[0] - head[0]) / head[2], 0.0), cells.shape[0] - 1.0)
    v = min(max((point[1] - head[1]) / head[2], 0.0), cells.shape[1] - 1.0)
    return int(u), int(v)


@njit(cache=True, forceinline=True)
def felt_at(point: Vector, around: Surroundings) -> Felt:
    """Return the circles near to a position."""
    nearby = around.nearby
    i, j = _cell(point, nearby)
    n = i * nearby.cells.shape[1] + j
    return Felt(around.circles, nearby.lists, nearby.lists[n], nearby.lists[n + 1])


@njit(cache=True)
def beyond_walls(point: Vector, around: Surroundings) -> bool:
    """Return whether a point is outside of the room that the walls enclose, if there are any."""
    nearby = around.nearby
    i, j = _cell(point, nearby)
    known = nearby.cells[i, j, 1]
    if known <= _BEYOND:
        return bool(known == _BEYOND)
    n = nearby.cells.shape[0] * nearby.cells.shape[1] + 1 + j
    walls = Felt(around.circles, nearby.lists, nearby.lists[n], nearby.lists[n + 1])
    return not _crossed_walls(point, walls)[1]


@njit(cache=True)
def all_felt(circles: FloatArray) -> Felt:
    """Return all circles, for a robot that minds each."""
    return Felt(circles, np.arange(circles.shape[0]), 0, circles.shape[0])


@njit(cache=True, forceinline=True)
def segment_distance(start: Vector, end: Vector, circles: FloatArray, i: int) -> float:
    """Return the distance of the centre of a circle, or of a wall, from a segment."""
    if circles[i, 5] != 0.0 or circles[i, 6] != 0.0:
        return _wall_distance(start, end, circles, i)
    way = minus(end, start)
    if circles[i, 4] <= 0.5:
        way = (way[0], way[1], 0.0)
    offset = from_centre(start, circles, i)
    square = dot(way, way)
    part = min(max(-dot(offset, way) / square, 0.0), 1.0) if square > 0.0 else 0.0
    return norm(plus(offset, part, way))


@njit(cache=True, forceinline=True)
def is_far(start: Vector, end: Vector, circles: FloatArray, i: int, reach: float) -> bool:
    """Return whether the boxes around a segment and a wall are more than `reach` apart."""
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
    for n in range(felt.first, felt.last):
        i = felt.rows[n]
        if cylinders_only and circles[i, 4] > 0.5:
            continue
        if is_far(start, end, circles, i, circles[i, 3] + extra):
            continue
        if segment_distance(start, end, circles, i) < circles[i, 3] + extra:
            return False
    return True


@njit(cache=True)
def is_visible(
    start: Vector, end: Vector, around: Surroundings, extra: float, cylinders_only: bool
) -> bool:
    """Do as `is_clear` for all circles: in strides as long as nothing is near."""
    nearby = around.nearby
    if nearby.cells.shape[0] * nearby.cells.shape[1] == 1:
        return is_clear(start, end, felt_at(start, around), extra, cylinders_only)
    size = nearby.head[2]
    way = minus(end, start)
    length, done, here = norm(way), 0.0, start
    while True:
        i, j = _cell(here, nearby)
        x = here[0] - nearby.head[0] - (i + 0.5) * size
        y = here[1] - nearby.head[1] - (j + 0.5) * size
        stride = nearby.cells[i, j, 0] - math.sqrt(x * x + y * y) - extra
        free = stride > 0.0
        stride = max(stride, 0.5 * size) if free else 0.5 * size
        done += stride
        there = plus(start, done / length, way) if done < length else end
        if not free and not is_clear(here, there, felt_at(here, around), extra, cylinders_only):
            return False
        if done >= length:
            return True
        here = there


@njit(cache=True)
def is_free_at(point: Vector, around: Surroundings) -> bool:
    """Return whether a robot at a position touches nothing and is inside of the walls."""
    clear = is_clear(point, point, felt_at(point, around), 0.0, False)
    return clear and not beyond_walls(point, around)


@njit(cache=True)
def _nearest_visible(
    position: Vector, to_goal: FloatArray, around: Surroundings, least: float
) -> tuple[int, float, float]:
    """Return the visible vertex on the shortest path, at least `least` away: its distance, the path.

    -1 where none is visible.
    """
    px, py, _ = position
    before, rejected = -np.inf, -1
    while True:
        # The next one by length of the path, as to see a vertex costs more than all these sums.
        best, index, away = np.inf, -1, 0.0
        for i in range(around.vertices.shape[0]):
            dx, dy = around.vertices[i, 0] - px, around.vertices[i, 1] - py
            near = math.sqrt(dx * dx + dy * dy)
            total = near + to_goal[i]
            later = total > before or (total == before and i > rejected)
            if near >= least and later and total < best:
                best, index, away = total, i, near
        if index < 0:
            return -1, away, best
        vertex = (around.vertices[index, 0], around.vertices[index, 1], 0.0)
        if is_visible((px, py, 0.0), vertex, around, 0.0, True):
            return index, away, best
        before, rejected = best, index


@njit(cache=True)
def _best_vertex(
    position: Vector, to_goal: FloatArray, around: Surroundings, before: int
) -> tuple[int, float, bool]:
    """Return the visible vertex on the shortest path, its length, and whether to approach closely.

    A vertex that is as good as reached gives way to the next one, if that is visible already;
    otherwise it must be approached closely. -1 where no vertex is visible. before: the vertex of
    the step before, or -1.
    """
    if before >= 0:
        vx, vy = around.vertices[before, 0], around.vertices[before, 1]
        away = math.hypot(vx - position[0], vy - position[1])
        seen = away >= 0.5 * around.clearance and is_visible(
            (position[0], position[1], 0.0), (vx, vy, 0.0), around, 0.0, True
        )
        if seen:
            return before, away + to_goal[before], False
    index, away, best = _nearest_visible(position, to_goal, around, 0.0)
    if away >= 0.5 * around.clearance:
        return index, best, False
    beyond_index, _, beyond = _nearest_visible(position, to_goal, around, 0.5 * around.clearance)
    if index >= 0 and beyond <= best + 0.5 * around.clearance:
        return beyond_index, beyond, False
    return index, best, True


@njit(cache=True, forceinline=True)
def _beside_sphere(
    position: Vector, target: Vector, sphere: int, around: Surroundings
) -> tuple[Vector, float]:
    """Return a target beside a sphere, where the line passes its centre, and the way to it."""
    way = minus(target, position)
    length = norm(way)
    way = (way[0] / length, way[1] / length, way[2] / length)
    offset = from_centre(position, around.circles, sphere)
    along = -dot(offset, way)
    # From the centre to where the line passes it.
    side = plus(offset, along, way)
    size = norm(side)
    if size < 1e-6:
        # Through the centre: choose a fixed side.
        side = (-way[1], way[0], 0.0)
        size = math.hypot(side[0], side[1])
        if size < 1e-6:
            side, size = (1.0, 0.0, 0.0), 1.0
    radius = around.circles[sphere, 3]
    reach = radius + around.clearance
    # Head for the tangent cone: the point beside the centre, scaled out when close.
    away = max(norm(offset), reach * 1.0000001)
    widen = min(reach * away / math.sqrt(away * away - radius**2), 5.0 * reach)
    way = plus((-offset[0], -offset[1], -offset[2]), widen / size, side)
    return plus(position, 1.0, way), norm(way)


@njit(cache=True)
def _back_inside(position: Vector, goal: Vector, around: Surroundings) -> Vector:
    """Return the point inside of the nearest wall, to which a robot beyond the walls leaves."""
    circles, nearest, out = around.circles, np.inf, position
    for i in range(circles.shape[0]):
        if circles[i, 5] != 0.0 or circles[i, 6] != 0.0:
            offset = from_centre(position, circles, i)
            away = norm(offset)
            if away < nearest:
                nearest = away
                reach = -(circles[i, 3] + around.clearance) / max(away, 1e-9)
                out = plus(minus(position, offset), reach, offset)
    return out[0], out[1], goal[2]


@njit(cache=True)
def clear_vertices(corners: FloatArray, around: Surroundings) -> FloatArray:
    """Return those of some corners (n, 2) at which a robot has half of its clearance."""
    kept, number = np.empty_like(corners), 0
    for x, y in corners:
        point = (x, y, 0.0)
        felt, extra = felt_at(point, around), 0.5 * around.clearance
        if is_clear(point, point, felt, extra, True) and not beyond_walls(point, around):
            kept[number, 0], kept[number, 1] = x, y
            number += 1
    return kept[:number].copy()


@njit(cache=True)
def length_to(position: Vector, goal: Vector, to_goal: FloatArray, around: Surroundings) -> float:
    """Return the length of the shortest path to a goal, level if it bends; inf: there is none."""
    if is_visible(position, goal, around, 0.0, True):
        return norm(minus(goal, position))
    return _nearest_visible(position, to_goal, around, 0.0)[2]


# How a robot moves: in the room; out of a zone to an exit that it was given; back into the room.
_WITHIN, _LEAVES, _RETURNS = range(3)


class Heading(NamedTuple):
    """Where a robot heads.

    target: next point of its path, the goal itself where the straight line is clear; left: length
    of the path [m]; manner: _WITHIN, _LEAVES or _RETURNS; vertex: that it heads for, or -1.
    """

    target: Vector
    left: float
    manner: int
    vertex: int


@njit(cache=True)
def _leaves(position: Vector, goal: Vector, around: Surroundings, inside: int) -> bool:
    """Return whether a goal is the exit of a zone: just outside of it, past what is solid.

    A robot that only touches the zone `inside` must not cross it: its exit is on its own side.
    """
    way = minus(position, goal)
    length = norm(way)
    part = min(3.0 * around.clearance / length, 1.0) if length > 0.0 else 0.0
    if is_free_at(plus(goal, part, way), around):
        return False
    if inside >= 0:
        offset = from_centre(position, around.circles, inside)
        touches = norm(offset) >= around.circles[inside, 3] - around.inflation
        if touches and dot(offset, way) > 0.0:
            return False
    return is_clear(position, goal, all_felt(around.solid), 0.0, False)


@njit(cache=True)
def head_for(
    position: Vector, goal: Vector, to_goal: FloatArray, around: Surroundings, before: int
) -> Heading:
    """Return where a robot heads on its path to a goal; before: vertex of the step before, or -1."""
    way = minus(goal, position)
    left, target, vertex = norm(way), goal, -1
    felt = felt_at(position, around)
    beyond = beyond_walls(position, around)
    inside, nearest = -1, np.inf
    if not beyond:
        for n in range(felt.first, felt.last):
            i = felt.rows[n]
            distance = norm(from_centre(position, felt.circles, i))
            if distance < felt.circles[i, 3]:
                inside, nearest = i, distance
                break
    if beyond or inside >= 0:
        if _leaves(position, goal, around, inside):
            return Heading(goal, left, _LEAVES, -1)
        if beyond:
            target = _back_inside(position, goal, around)
            return Heading(target, left + around.clearance, _RETURNS, -1)
        # A robot that was pushed into a circle leaves it.
        offset = from_centre(position, felt.circles, inside)
        if nearest < 1e-9:
            offset, nearest = (1.0, 0.0, 0.0), 1.0
        reach = (felt.circles[inside, 3] + around.clearance) / nearest
        target = plus(minus(position, offset), reach, offset)
        if felt.circles[inside, 4] <= 0.5:
            target = (target[0], target[1], goal[2])
        return Heading(target, left + around.clearance, _WITHIN, -1)
    if not is_visible(position, goal, around, 0.0, True):
        index, best, closely = _best_vertex(position, to_goal, around, before)
        if index >= 0:
            vx, vy = around.vertices[index, 0], around.vertices[index, 1]
            near = math.sqrt((vx - position[0]) ** 2 + (vy - position[1]) ** 2)
            share = near / best if best > 0.0 else 1.0
            target = (vx, vy, position[2] + share * way[2])
            left = math.sqrt(best * best + way[2] * way[2])
            if closely:
                left = min(left, 2.0 * near)
            elif around.vertices.shape[0] > MANY:
                vertex = index
    first, nearest = -1, np.inf
    for i in range(around.circles.shape[0] if around.spheres else 0):
        away = norm(from_centre(position, around.circles, i))
        if around.circles[i, 4] <= 0.5 or away >= nearest:
            continue
        if segment_distance(position, target, around.circles, i) < around.circles[i, 3]:
            first, nearest = i, away
    if first >= 0:
        target, beside = _beside_sphere(position, target, first, around)
        left = max(left, beside)
    return Heading(target, left, _WITHIN, vertex)


@njit(cache=True)
def minded(position: Vector, manner: int, around: Surroundings) -> tuple[Felt, bool]:
    """Return the circles that hold a robot back, and whether it is beyond their walls."""
    if manner == _WITHIN:
        return felt_at(position, around), False
    if manner == _RETURNS:
        return felt_at(position, around), True
    felt = all_felt(around.solid)
    walls, inside = _crossed_walls(position, felt)
    return felt, walls and not inside


@njit(cache=True)
def hold_back(position: Vector, felt: Felt, beyond: bool, rate: float, velocity: Vector) -> Vector:
    """Return `velocity` with limits on its part that points into circles.

    Towards a circle at distance d at most `rate` * d is left, and inside of one at least that
    much outwards. Walls do not hold back a robot that is beyond them.
    """
    shrink, circles = 1.0, felt.circles
    for attempt in range(9):
        changed = False
        for n in range(felt.first, felt.last):
            i = felt.rows[n]
            offset = from_centre(position, circles, i)
            size = norm(offset)
            if size < 1e-9 or (beyond and (circles[i, 5] != 0.0 or circles[i, 6] != 0.0)):
                continue
            outwards = dot(velocity, offset) / size
            least = -rate * (size - circles[i, 3])
            if outwards >= least:
                continue
            changed = True
            if attempt < 8:
                velocity = plus(velocity, (least - outwards) / size, offset)
            elif least <= 0.0:
                # The limits conflict: scale down, as standing still satisfies all.
                shrink = min(shrink, least / outwards)
        if not changed:
            break
    return velocity[0] * shrink, velocity[1] * shrink, velocity[2] * shrink
