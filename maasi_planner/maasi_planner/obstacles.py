"""Circular obstacles and ways around them.

An obstacle with two coordinates is a cylinder of any height (in 2D a disc), one with three is a
sphere. A robot's `KeepOut` holds them inflated by its radius. Ways around cylinders come from a
visibility graph, so that several of them close together are no trap.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from maasi_filter.arrays import BoolArray, FloatArray
from maasi_filter.settings import Obstacle

CORNERS = 12

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Obstacles:
    """Obstacles in their own size.

    Parameters
    ----------
    centres : (n, 3) array
        Metres, frame `map`; z counts for spheres only.
    radii : (n,) array
        Metres.
    spheres : (n,) array of bool
        Which are spheres; the others are cylinders.
    """

    centres: FloatArray
    radii: FloatArray
    spheres: BoolArray

    @classmethod
    def from_settings(cls, obstacles: Sequence[Obstacle]) -> Obstacles:
        """Return the obstacles of an environment file."""
        centres = np.zeros((len(obstacles), 3))
        for index, obstacle in enumerate(obstacles):
            centres[index, : len(obstacle.centre)] = obstacle.centre
        return cls(
            centres,
            np.array([obstacle.radius for obstacle in obstacles], dtype=float),
            np.array([len(obstacle.centre) == 3 for obstacle in obstacles], dtype=bool),
        )

    @classmethod
    def none(cls) -> Obstacles:
        """Return no obstacles."""
        return cls(np.zeros((0, 3)), np.zeros(0), np.zeros(0, dtype=bool))

    def __len__(self) -> int:
        return len(self.radii)

    def distances(self, position: ArrayLike) -> FloatArray:
        """Return the distance of a position (3,) from each surface, (n,), negative inside."""
        offset = np.asarray(position, dtype=float)[None, :] - self.centres
        offset[~self.spheres, 2] = 0.0
        return np.sqrt((offset * offset).sum(axis=1)) - self.radii


class Surroundings(NamedTuple):
    """Obstacles of a robot, inflated by its radius.

    circles (n, 5): x, y, z, radius [m, map], 1 for a sphere; vertices (m, 2): of the visibility
    graph [m, map]; clearance: kept beyond the radius by planned ways [m].
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
    """Return the offset of a point from the centre of a circle, level for a cylinder."""
    height = point[2] - circles[i, 2] if circles[i, 4] > 0.5 else 0.0
    return point[0] - circles[i, 0], point[1] - circles[i, 1], height


@njit(cache=True, forceinline=True)
def segment_distance(start: Vector, end: Vector, circles: FloatArray, i: int) -> float:
    """Return the distance of the centre of a circle from a segment."""
    way = minus(end, start)
    if circles[i, 4] <= 0.5:
        way = (way[0], way[1], 0.0)
    offset = from_centre(start, circles, i)
    square = dot(way, way)
    part = min(max(-dot(offset, way) / square, 0.0), 1.0) if square > 0.0 else 0.0
    return norm(plus(offset, part, way))


@njit(cache=True)
def is_clear(
    start: Vector, end: Vector, circles: FloatArray, extra: float, cylinders_only: bool
) -> bool:
    """Return whether a segment keeps `extra` beyond the radius from every circle."""
    for i in range(circles.shape[0]):
        if cylinders_only and circles[i, 4] > 0.5:
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


@njit(cache=True, forceinline=True)
def _best_vertex(
    position: Vector, to_goal: FloatArray, around: Surroundings
) -> tuple[int, float, bool]:
    """Return the visible vertex on the shortest way, its length, and whether to approach closely.

    A vertex that is as good as reached gives way to the next one, if that is visible already;
    otherwise it must be approached closely. -1 where no vertex is visible.
    """
    px, py, _ = position
    best = beyond = np.inf
    index = beyond_index = -1
    for i in range(around.vertices.shape[0]):
        vx, vy = around.vertices[i, 0], around.vertices[i, 1]
        near = math.sqrt((vx - px) * (vx - px) + (vy - py) * (vy - py))
        total = near + to_goal[i]
        far = near >= 0.5 * around.clearance
        if total < best or (far and total < beyond):
            if not is_clear((px, py, 0.0), (vx, vy, 0.0), around.circles, 0.0, True):
                continue
            if total < best:
                best, index = total, i
            if far and total < beyond:
                beyond, beyond_index = total, i
    if beyond_index == index:
        return index, best, False
    if beyond <= best + 0.5 * around.clearance:
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
def next_point(
    position: Vector, goal: Vector, to_goal: FloatArray, around: Surroundings
) -> tuple[Vector, float]:
    """Return the point to head for and the length of the way left.

    The point is the goal itself where the straight line is clear.
    """
    circles = around.circles
    way = minus(goal, position)
    left, target = norm(way), goal
    for i in range(circles.shape[0]):
        # A robot that was pushed into a circle leaves it.
        offset = from_centre(position, circles, i)
        distance = norm(offset)
        if distance < circles[i, 3]:
            if distance < 1e-9:
                offset, distance = (1.0, 0.0, 0.0), 1.0
            reach = (circles[i, 3] + around.clearance) / distance
            target = plus((circles[i, 0], circles[i, 1], circles[i, 2]), reach, offset)
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
    much outwards.
    """
    shrink = 1.0
    for attempt in range(9):
        changed = False
        for i in range(circles.shape[0]):
            offset = from_centre(position, circles, i)
            size = norm(offset)
            if size < 1e-9:
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
    """Obstacles as one robot must see them: inflated by its radius, with ways around.

    obstacles: in their own size; radius: of the robot, metres; clearance: kept beyond that by
    planned ways and by waypoints, metres; circles (n, 5): x, y, z, inflated radius with a tenth of
    the clearance, and 1 for a sphere; around: the same with the ways. Robots stop short of
    `circles`, so that rounding does not put them into an obstacle.
    """

    def __init__(self, obstacles: Obstacles, radius: float, clearance: float) -> None:
        if not (math.isfinite(radius) and radius >= 0.0):
            raise ValueError(f'radius: got {radius}, allowed are finite numbers from 0')
        self.obstacles = obstacles
        self.radius = radius
        self.clearance = float(clearance)
        number = len(obstacles)
        self.circles = np.zeros((number, 5))
        self.circles[:, :3] = obstacles.centres
        self.circles[:, 3] = obstacles.radii + radius + 0.1 * clearance
        self.circles[:, 4] = obstacles.spheres
        corners = []
        for circle in self.circles[self.circles[:, 4] < 0.5]:
            reach = (circle[3] + 0.9 * clearance) / math.cos(math.pi / CORNERS)
            for corner in range(CORNERS):
                angle = 2.0 * math.pi * corner / CORNERS
                x, y = circle[0] + reach * math.cos(angle), circle[1] + reach * math.sin(angle)
                if is_clear((x, y, 0.0), (x, y, 0.0), self.circles, 0.5 * clearance, True):
                    corners.append((x, y))
        vertices = np.array(corners, dtype=float).reshape(-1, 2)
        self.around = Surroundings(self.circles, vertices, self.clearance)
        self._pairs = _all_pairs(vertices, self.circles, 0.4 * clearance)

    def __len__(self) -> int:
        return len(self.circles)

    def is_free(self, position: ArrayLike) -> bool:
        """Return whether a robot at `position` (3,) touches no obstacle."""
        x, y, z = (float(value) for value in np.asarray(position, dtype=float))
        return bool(is_clear((x, y, z), (x, y, z), self.circles, 0.0, False))

    def to_goal(self, goal: Vector) -> FloatArray:
        """Return the table that `next_point` needs for a goal."""
        return _goal_distances(goal, self.circles, self.around.vertices, self._pairs)

    def moved_out(self, robot: ArrayLike, waypoint: ArrayLike) -> FloatArray | None:
        """Return a waypoint moved to the minimum admissible distance (001, section 4.3).

        It moves along the line that joins robot and waypoint, towards the robot.
        """
        start = np.asarray(robot, dtype=float)
        point = np.array(waypoint, dtype=float)
        line = point - start
        part = 1.0
        least = self.circles[:, 3] + 0.9 * self.clearance
        for _ in range(len(self.circles) + 1):
            here = start + part * line
            changed = False
            for circle, reach in zip(self.circles, least):
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
                return point if part == 1.0 else here
            if part <= 0.0:
                return None
        return None
