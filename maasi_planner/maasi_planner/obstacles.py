"""Obstacles, keep-outs and the border of the area, and ways around them.

They are cylinders of any height (in 2D discs), spheres, and walls: the edges of polygons. A robot's
`KeepOut` holds them inflated by its radius. Ways around cylinders and between walls come from a
visibility graph, so that several of them close together are no trap.
"""

import math
from collections.abc import Sequence
from copy import copy
from functools import cached_property
from typing import NamedTuple

import numpy as np
import shapely
from numba import njit
from numpy.typing import ArrayLike
from shapely.geometry.base import BaseGeometry
from shapely.ops import nearest_points

from maasi_filter.area import Area, edges_of, level_shape
from maasi_filter.arrays import FloatArray

CORNERS = 12

Vector = tuple[float, float, float]


class Surroundings(NamedTuple):
    """Obstacles of a robot, inflated by its radius.

    circles (n, 7): x, y, z, radius [m, map], 1 for a sphere, and x and y from there to the other
    end of a wall [m]; vertices (m, 2): of the visibility graph [m, map]; clearance: kept beyond the
    radius by planned ways [m].
    """

    circles: FloatArray
    vertices: FloatArray
    clearance: float


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
def beyond_walls(point: Vector, circles: FloatArray) -> bool:
    """Return whether a point is outside of the room that the walls enclose, if there are any."""
    any_wall, inside = False, False
    for i in range(circles.shape[0]):
        dx, dy = circles[i, 5], circles[i, 6]
        if dx != 0.0 or dy != 0.0:
            any_wall = True
            y = point[1] - circles[i, 1]
            # Whether a ray along x crosses it.
            if (y < 0.0) != (y < dy) and (point[0] - circles[i, 0] < dx * y / dy):
                inside = not inside
    return any_wall and not inside


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
def is_clear(
    start: Vector, end: Vector, circles: FloatArray, extra: float, cylinders_only: bool
) -> bool:
    """Return whether a segment keeps `extra` beyond the radius from every circle."""
    for i in range(circles.shape[0]):
        if cylinders_only and circles[i, 4] > 0.5:
            continue
        if is_far(start, end, circles, i, circles[i, 3] + extra):
            continue
        if segment_distance(start, end, circles, i) < circles[i, 3] + extra:
            return False
    return True


@njit(cache=True)
def _all_pairs(vertices: FloatArray, circles: FloatArray, extra: float) -> FloatArray:
    """Return the lengths of the shortest clear ways between vertices, or inf (Floyd, Warshall)."""
    number = vertices.shape[0]
    distance = np.full((number, number), np.inf)
    for i in range(number):
        distance[i, i] = 0.0
        for j in range(i):
            a, b = (vertices[i, 0], vertices[i, 1], 0.0), (vertices[j, 0], vertices[j, 1], 0.0)
            if is_clear(a, b, circles, extra, True):
                distance[i, j] = distance[j, i] = math.hypot(a[0] - b[0], a[1] - b[1])
    for k in range(number):
        for i in range(number):
            if distance[i, k] < np.inf:
                for j in range(number):
                    distance[i, j] = min(distance[i, j], distance[i, k] + distance[k, j])
    return distance


@njit(cache=True)
def _goal_distances(
    goal: Vector, circles: FloatArray, vertices: FloatArray, pairs: FloatArray
) -> FloatArray:
    """Return the length of the shortest clear way from each vertex to `goal`, (m,), or inf."""
    out = np.full(vertices.shape[0], np.inf)
    for j in range(vertices.shape[0]):
        vertex = (vertices[j, 0], vertices[j, 1], 0.0)
        if is_clear(vertex, (goal[0], goal[1], 0.0), circles, 0.0, True):
            last = math.hypot(vertex[0] - goal[0], vertex[1] - goal[1])
            for i in range(out.shape[0]):
                out[i] = min(out[i], pairs[i, j] + last)
    return out


@njit(cache=True)
def _nearest_visible(
    position: Vector, to_goal: FloatArray, around: Surroundings, least: float
) -> tuple[int, float, float]:
    """Return the visible vertex on the shortest way, at least `least` away: its distance, the way.

    -1 where none is visible.
    """
    px, py, _ = position
    before, rejected = -np.inf, -1
    while True:
        # The next one by length of the way, as to see a vertex costs more than all these sums.
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
        if is_clear((px, py, 0.0), vertex, around.circles, 0.0, True):
            return index, away, best
        before, rejected = best, index


@njit(cache=True)
def _best_vertex(
    position: Vector, to_goal: FloatArray, around: Surroundings
) -> tuple[int, float, bool]:
    """Return the visible vertex on the shortest way, its length, and whether to approach closely.

    A vertex that is as good as reached gives way to the next one, if that is visible already;
    otherwise it must be approached closely. -1 where no vertex is visible.
    """
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
def next_point(
    position: Vector, goal: Vector, to_goal: FloatArray, around: Surroundings
) -> tuple[Vector, float]:
    """Return the point to head for and the length of the way left.

    The point is the goal itself where the straight line is clear.
    """
    circles = around.circles
    way = minus(goal, position)
    left, target = norm(way), goal
    if beyond_walls(position, circles):
        return _back_inside(position, goal, around), left + around.clearance
    for i in range(circles.shape[0]):
        # A robot that was pushed into a circle leaves it.
        offset = from_centre(position, circles, i)
        distance = norm(offset)
        if distance < circles[i, 3]:
            if distance < 1e-9:
                offset, distance = (1.0, 0.0, 0.0), 1.0
            reach = (circles[i, 3] + around.clearance) / distance
            target = plus(minus(position, offset), reach, offset)
            if circles[i, 4] <= 0.5:
                target = (target[0], target[1], goal[2])
            return target, left + around.clearance
    if not is_clear(position, goal, circles, 0.0, True):
        index, best, closely = _best_vertex(position, to_goal, around)
        if index >= 0:
            vx, vy = around.vertices[index, 0], around.vertices[index, 1]
            near = math.sqrt((vx - position[0]) ** 2 + (vy - position[1]) ** 2)
            share = near / best if best > 0.0 else 1.0
            target = (vx, vy, position[2] + share * way[2])
            left = math.sqrt(best * best + way[2] * way[2])
            if closely:
                left = min(left, 2.0 * near)
    first, nearest = -1, np.inf
    for i in range(circles.shape[0]):
        away = norm(from_centre(position, circles, i))
        if circles[i, 4] <= 0.5 or away >= nearest:
            continue
        if segment_distance(position, target, circles, i) < circles[i, 3]:
            first, nearest = i, away
    if first >= 0:
        target, beside = _beside_sphere(position, target, first, around)
        left = max(left, beside)
    return target, left


@njit(cache=True)
def hold_back(position: Vector, circles: FloatArray, rate: float, velocity: Vector) -> Vector:
    """Return `velocity` with limits on its part that points into circles.

    Towards a circle at distance d at most `rate` * d is left, and inside of one at least that
    much outwards. Walls do not hold back who is beyond them.
    """
    shrink, beyond = 1.0, beyond_walls(position, circles)
    for attempt in range(9):
        changed = False
        for i in range(circles.shape[0]):
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


class KeepOut:
    """What one robot must keep out of: inflated by its radius, with ways around.

    area: where robots may go; None: anywhere; radius: of the robot, metres; clearance: kept beyond
    that by planned ways and by waypoints, metres; circles (n, 7): as of `Surroundings`, with the
    inflated radius and a tenth of the clearance; around: the same with the ways. Robots stop short
    of `circles`, so that rounding does not put them into an obstacle.
    """

    def __init__(self, area: Area | None, radius: float, clearance: float) -> None:
        if not (math.isfinite(radius) and radius >= 0.0):
            raise ValueError(f'radius: got {radius}, allowed are finite numbers from 0')
        self.area, self.radius = area, radius
        self.clearance = float(clearance)
        round_ones = np.zeros((0, 5)) if area is None else area.circles
        room = None if area is None else area.room(radius + clearance)
        walls = edges_of([] if room is None else [room])
        self.circles = np.zeros((len(round_ones) + len(walls), 7))
        self.circles[: len(round_ones), :5] = round_ones
        self.circles[len(round_ones) :, [0, 1, 5, 6]] = walls
        self.circles[:, 3] += radius + 0.1 * clearance
        # Where waypoints may be; None: anywhere beside round ones.
        self._places = (
            None if room is None else room.buffer(-radius - clearance, join_style='mitre')
        )
        self._round = len(round_ones)
        vertices = self._vertices()
        self.around = Surroundings(self.circles, vertices, self.clearance)
        self._pairs = _all_pairs(vertices, self.circles, 0.4 * clearance)

    def __len__(self) -> int:
        return len(self.circles)

    def _vertices(self) -> FloatArray:
        """Return the vertices of the visibility graph, (m, 2): around cylinders and walls."""
        corners = []
        angles = 2.0 * math.pi * np.arange(CORNERS) / CORNERS
        for circle in self.circles[: self._round]:
            if circle[4] < 0.5:
                reach = (circle[3] + 0.9 * self.clearance) / math.cos(math.pi / CORNERS)
                corners += [
                    (circle[0] + reach * math.cos(angle), circle[1] + reach * math.sin(angle))
                    for angle in angles.tolist()
                ]
        if self._places is not None:
            outline = self._places.simplify(0.3 * self.clearance)
            corners += shapely.get_coordinates(outline.boundary).tolist()
        clear = [
            (x, y)
            for x, y in corners
            if is_clear((x, y, 0.0), (x, y, 0.0), self.circles, 0.5 * self.clearance, True)
            and not beyond_walls((x, y, 0.0), self.circles)
        ]
        return np.array(clear, dtype=float).reshape(-1, 2)

    @cached_property
    def _open(self) -> BaseGeometry:
        """Where robots that leave a zone may go: clear of everything by the clearance."""
        assert self.area is not None
        reach = self.circles[: self._round, 3] + 0.95 * self.clearance
        centres = shapely.points(self.circles[: self._round, :2])
        discs = shapely.buffer(centres, reach / math.cos(math.pi / 64), quad_segs=16)
        whole = self.area.border if self._places is None else self._places
        return whole.difference(shapely.union_all(discs))

    @cached_property
    def _solid(self) -> BaseGeometry:
        """Where a robot may be that leaves a zone: inside of the border, clear of what is solid."""
        assert self.area is not None
        solid = shapely.union_all(list(map(level_shape, self.area.settings.obstacles)))
        inside = self.area.border.difference(solid.buffer(self.radius))
        shapely.prepare(inside)
        return inside

    @property
    def _step(self) -> float:
        return max(self.radius + self.clearance, 1e-3)

    def is_free(self, position: ArrayLike) -> bool:
        """Return whether a robot at `position` (3,) touches no obstacle and is inside."""
        x, y, z = (float(value) for value in np.asarray(position, dtype=float))
        clear = is_clear((x, y, z), (x, y, z), self.circles, 0.0, False)
        return bool(clear and not beyond_walls((x, y, z), self.circles))

    def to_goal(self, goal: Vector) -> FloatArray:
        """Return the table that `next_point` needs for a goal."""
        return _goal_distances(goal, self.circles, self.around.vertices, self._pairs)

    def past(
        self, robot: FloatArray, goal: FloatArray, others: Sequence[tuple[FloatArray, float]]
    ) -> FloatArray:
        """Return the next point, (3,), of the way to a goal past others, by places and radii."""
        area = copy(self.area)
        if area is None:
            return goal
        # A quarter wider, for robots that cut corners.
        discs = [[*place, 1.25 * radius + 0.25 * self.radius, 0.0] for place, radius in others]
        area.circles = np.vstack([area.circles, discs])
        wide = KeepOut(area, self.radius, self.clearance)
        x, y, z = robot.tolist()
        to = (goal[0], goal[1], goal[2])
        return np.array(next_point((x, y, z), to, wide.to_goal(to), wide.around)[0])

    def exit_from(self, position: ArrayLike) -> FloatArray | None:
        """Return where a robot at a position (3,) leaves a zone that it is in, or None outside.

        It is the nearest position clear of all zones that a straight line reaches inside of the
        border and past solid obstacles; around these, the first point of the path there.
        """
        here = np.asarray(position, dtype=float)
        x, y, z = here.tolist()
        touching = self.circles.copy()
        touching[:, 3] -= 0.1 * self.clearance
        if is_clear((x, y, z), (x, y, z), touching, 0.0, False) and not beyond_walls(
            (x, y, z), self.circles
        ):
            return None
        if self._open.is_empty:
            return None
        point = shapely.Point(x, y)
        near = nearest_points(self._open, point)[0]
        if not self._solid.covers(shapely.LineString([point, near])):
            outline = shapely.get_coordinates(self._open.segmentize(0.5 * self._step))
            lines = shapely.linestrings([[(x, y), corner] for corner in outline.tolist()])
            straight = shapely.covers(self._solid, lines)
            if straight.any():
                rows = np.flatnonzero(straight)
                near = shapely.Point(outline[rows[np.argmin(shapely.length(lines[rows]))]])
            else:
                assert self.area is not None
                lasting = Area(self.area.settings.without_keep_outs())
                around = KeepOut(lasting, self.radius, self.clearance)
                goal = (near.x, near.y, z)
                (gx, gy, _), _ = next_point((x, y, z), goal, around.to_goal(goal), around.around)
                return np.array([gx, gy, z])
        return np.array([near.x, near.y, z])

    def moved_out(self, robot: ArrayLike, waypoint: ArrayLike) -> FloatArray | None:
        """Return a waypoint moved to the minimum admissible distance (001, section 4.3).

        It moves away from walls to the nearest place, and then out of round obstacles along the
        line that joins robot and waypoint, towards the robot.
        """
        start = np.asarray(robot, dtype=float)
        point = np.array(waypoint, dtype=float)
        if self._places is not None:
            if self._places.is_empty:
                return None
            near = nearest_points(self._places, shapely.Point(point[:2]))[0]
            if near.distance(shapely.Point(point[:2])) > 1e-9:
                point[:2] = near.x, near.y
        line = point - start
        part = 1.0
        round_ones = self.circles[: self._round]
        least = round_ones[:, 3] + 0.9 * self.clearance
        for _ in range(len(round_ones) + 1):
            here = start + part * line
            changed = False
            for circle, reach in zip(round_ones, least):
                keep = np.array([1.0, 1.0, circle[4]])
                offset = (here - circle[:3]) * keep
                if float(offset @ offset) >= reach * reach * (1.0 - 1e-12):
                    continue
                direction = line * keep
                from_start = (start - circle[:3]) * keep
                a = float(direction @ direction)
                b = float(direction @ from_start)
                c = float(from_start @ from_start) - reach * reach
                if c < 0.0 or a == 0.0:
                    return None
                part = (-b - math.sqrt(max(b * b - a * c, 0.0))) / a
                here = start + part * line
                changed = True
            if not changed:
                return point if part == 1.0 else here if self.is_free(here) else None
            if part <= 0.0:
                return None
        return None
