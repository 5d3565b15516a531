"""Circular obstacles and ways around them.

An obstacle with two coordinates is a cylinder of any height (in 2D a disc), one with three is a
sphere. A robot's `KeepOut` holds them inflated by its radius. Ways around cylinders come from a
visibility graph, so that several of them close together are no trap.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from maasi_filter.arrays import BoolArray, FloatArray
from maasi_filter.settings import Obstacle

CORNERS = 12


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


@njit(cache=True)
def segment_distance(
    px: float, py: float, pz: float, qx: float, qy: float, qz: float, circle: FloatArray
) -> float:
    """Return the distance of the centre of `circle` (x, y, z, radius, sphere) from a segment."""
    flat = 1.0 if circle[4] > 0.5 else 0.0
    dx = qx - px
    dy = qy - py
    dz = (qz - pz) * flat
    ox = circle[0] - px
    oy = circle[1] - py
    oz = (circle[2] - pz) * flat
    square = dx * dx + dy * dy + dz * dz
    part = 0.0
    if square > 0.0:
        part = min(max((ox * dx + oy * dy + oz * dz) / square, 0.0), 1.0)
    ox -= part * dx
    oy -= part * dy
    oz -= part * dz
    return math.sqrt(ox * ox + oy * oy + oz * oz)


@njit(cache=True)
def is_clear(
    px: float,
    py: float,
    pz: float,
    qx: float,
    qy: float,
    qz: float,
    circles: FloatArray,
    extra: float,
    cylinders_only: bool,
) -> bool:
    """Return whether a segment keeps `extra` beyond the radius from every circle."""
    for i in range(circles.shape[0]):
        if cylinders_only and circles[i, 4] > 0.5:
            continue
        if segment_distance(px, py, pz, qx, qy, qz, circles[i]) < circles[i, 3] + extra:
            return False
    return True


@njit(cache=True)
def _all_pairs(vertices: FloatArray, circles: FloatArray, extra: float) -> FloatArray:
    number = vertices.shape[0]
    distance = np.full((number, number), np.inf)
    for i in range(number):
        distance[i, i] = 0.0
        for j in range(i):
            if is_clear(
                vertices[i, 0],
                vertices[i, 1],
                0.0,
                vertices[j, 0],
                vertices[j, 1],
                0.0,
                circles,
                extra,
                True,
            ):
                length = math.hypot(
                    vertices[i, 0] - vertices[j, 0], vertices[i, 1] - vertices[j, 1]
                )
                distance[i, j] = length
                distance[j, i] = length
    for k in range(number):
        for i in range(number):
            through = distance[i, k]
            if through < np.inf:
                for j in range(number):
                    total = through + distance[k, j]
                    if total < distance[i, j]:
                        distance[i, j] = total
    return distance


@njit(cache=True)
def goal_distances(
    goal: FloatArray, circles: FloatArray, vertices: FloatArray, pairs: FloatArray
) -> FloatArray:
    """Return the length of the shortest clear way from each vertex to `goal`, (m,), or inf."""
    number = vertices.shape[0]
    out = np.full(number, np.inf)
    for j in range(number):
        if is_clear(vertices[j, 0], vertices[j, 1], 0.0, goal[0], goal[1], 0.0, circles, 0.0, True):
            last = math.hypot(vertices[j, 0] - goal[0], vertices[j, 1] - goal[1])
            for i in range(number):
                total = pairs[i, j] + last
                if total < out[i]:
                    out[i] = total
    return out


# Inlined: counting references to array arguments costs more than these functions themselves.
@njit(cache=True, forceinline=True)
def _leave_circle(
    position: FloatArray, goal: FloatArray, circles: FloatArray, clearance: float, out: FloatArray
) -> bool:
    """Write the way out of the first circle that the position is in; return whether there is one.

    A robot can be in one if it was pushed.
    """
    for i in range(circles.shape[0]):
        sphere = circles[i, 4] > 0.5
        ox = position[0] - circles[i, 0]
        oy = position[1] - circles[i, 1]
        oz = (position[2] - circles[i, 2]) if sphere else 0.0
        distance = math.sqrt(ox * ox + oy * oy + oz * oz)
        if distance < circles[i, 3]:
            if distance < 1e-9:
                ox, oy, oz, distance = 1.0, 0.0, 0.0, 1.0
            reach = (circles[i, 3] + clearance) / distance
            out[0] = circles[i, 0] + ox * reach
            out[1] = circles[i, 1] + oy * reach
            out[2] = circles[i, 2] + oz * reach if sphere else goal[2]
            return True
    return False


@njit(cache=True, forceinline=True)
def _best_vertex(
    px: float,
    py: float,
    circles: FloatArray,
    vertices: FloatArray,
    to_goal: FloatArray,
    clearance: float,
) -> tuple[int, float, bool]:
    """Return the visible vertex on the shortest way, its length, and whether to approach closely.

    A vertex that is as good as reached gives way to the next one, if that is visible already;
    otherwise it must be approached closely. -1 where no vertex is visible.
    """
    best = np.inf
    index = -1
    beyond = np.inf
    beyond_index = -1
    for i in range(vertices.shape[0]):
        vx = vertices[i, 0]
        vy = vertices[i, 1]
        near = math.sqrt((vx - px) * (vx - px) + (vy - py) * (vy - py))
        total = near + to_goal[i]
        if total < best or (near >= 0.5 * clearance and total < beyond):
            if not is_clear(px, py, 0.0, vx, vy, 0.0, circles, 0.0, True):
                continue
            if total < best:
                best = total
                index = i
            if near >= 0.5 * clearance and total < beyond:
                beyond = total
                beyond_index = i
    if beyond_index == index:
        return index, best, False
    if beyond <= best + 0.5 * clearance:
        return beyond_index, beyond, False
    return index, best, True


@njit(cache=True, forceinline=True)
def _first_sphere(
    position: FloatArray, target: FloatArray, circles: FloatArray
) -> tuple[int, float]:
    """Return the nearest sphere that the way to `target` hits, or -1, and its centre's distance."""
    px, py, pz = position[0], position[1], position[2]
    first = -1
    nearest = np.inf
    for i in range(circles.shape[0]):
        if circles[i, 4] > 0.5:
            gap = segment_distance(px, py, pz, target[0], target[1], target[2], circles[i])
            if gap < circles[i, 3]:
                away = math.sqrt(
                    (circles[i, 0] - px) ** 2
                    + (circles[i, 1] - py) ** 2
                    + (circles[i, 2] - pz) ** 2
                )
                if away < nearest:
                    nearest = away
                    first = i
    return first, nearest


@njit(cache=True, forceinline=True)
def _pass_sphere(
    position: FloatArray, sphere: FloatArray, distance: float, clearance: float, target: FloatArray
) -> float:
    """Move `target` beside a sphere, on the side where the line passes its centre; return its way.

    `distance`: of the centre [m].
    """
    px, py, pz = position[0], position[1], position[2]
    tx = target[0] - px
    ty = target[1] - py
    tz = target[2] - pz
    length = math.sqrt(tx * tx + ty * ty + tz * tz)
    tx /= length
    ty /= length
    tz /= length
    cx = sphere[0] - px
    cy = sphere[1] - py
    cz = sphere[2] - pz
    along = cx * tx + cy * ty + cz * tz
    nx = along * tx - cx
    ny = along * ty - cy
    nz = along * tz - cz
    size = math.sqrt(nx * nx + ny * ny + nz * nz)
    if size < 1e-6:
        # Through the centre: choose a fixed side.
        nx, ny, nz = -ty, tx, 0.0
        size = math.hypot(nx, ny)
        if size < 1e-6:
            nx, ny, size = 1.0, 0.0, 1.0
    reach = sphere[3] + clearance
    # Head for the tangent cone: the point beside the centre, scaled out when close.
    away = max(distance, reach * 1.0000001)
    widen = reach * away / math.sqrt(away * away - sphere[3] ** 2)
    widen = min(widen, 5.0 * reach)
    ax = cx + widen * nx / size
    ay = cy + widen * ny / size
    az = cz + widen * nz / size
    target[0] = px + ax
    target[1] = py + ay
    target[2] = pz + az
    return math.sqrt(ax * ax + ay * ay + az * az)


@njit(cache=True)
def next_point(
    position: FloatArray,
    goal: FloatArray,
    circles: FloatArray,
    vertices: FloatArray,
    to_goal: FloatArray,
    clearance: float,
    out: FloatArray,
) -> float:
    """Write the point to head for into `out` (3,) and return the length of the way left.

    The point is the goal itself where the straight line is clear.
    """
    px, py, pz = position[0], position[1], position[2]
    dx = goal[0] - px
    dy = goal[1] - py
    dz = goal[2] - pz
    straight = math.sqrt(dx * dx + dy * dy + dz * dz)
    out[0] = goal[0]
    out[1] = goal[1]
    out[2] = goal[2]
    if circles.shape[0] == 0:
        return straight
    if _leave_circle(position, goal, circles, clearance, out):
        return straight + clearance
    left = straight
    if not is_clear(px, py, pz, goal[0], goal[1], goal[2], circles, 0.0, True):
        index, best, closely = _best_vertex(px, py, circles, vertices, to_goal, clearance)
        if index >= 0:
            vx = vertices[index, 0]
            vy = vertices[index, 1]
            near = math.sqrt((vx - px) * (vx - px) + (vy - py) * (vy - py))
            share = near / best if best > 0.0 else 1.0
            out[0] = vx
            out[1] = vy
            out[2] = pz + share * dz
            left = math.sqrt(best * best + dz * dz)
            if closely:
                left = min(left, 2.0 * near)
    first, distance = _first_sphere(position, out, circles)
    if first >= 0:
        left = max(left, _pass_sphere(position, circles[first], distance, clearance, out))
    return left


@njit(cache=True)
def hold_back(position: FloatArray, circles: FloatArray, rate: float, velocity: FloatArray) -> None:
    """Limit in place the part of `velocity` (3,) that points into circles.

    Towards a circle at distance d at most `rate` * d is left, and inside of one at least that
    much outwards.
    """
    shrink = 1.0
    for attempt in range(9):
        changed = False
        for i in range(circles.shape[0]):
            nx = position[0] - circles[i, 0]
            ny = position[1] - circles[i, 1]
            nz = (position[2] - circles[i, 2]) if circles[i, 4] > 0.5 else 0.0
            size = math.sqrt(nx * nx + ny * ny + nz * nz)
            if size < 1e-9:
                continue
            outwards = (velocity[0] * nx + velocity[1] * ny + velocity[2] * nz) / size
            least = -rate * (size - circles[i, 3])
            if outwards >= least:
                continue
            changed = True
            if attempt < 8:
                change = (least - outwards) / size
                velocity[0] += change * nx
                velocity[1] += change * ny
                velocity[2] += change * nz
            elif least <= 0.0:
                # The limits conflict: scale down, as standing still satisfies all.
                shrink = min(shrink, least / outwards)
        if not changed:
            break
    velocity[0] *= shrink
    velocity[1] *= shrink
    velocity[2] *= shrink


class KeepOut:
    """Obstacles as one robot must see them: inflated by its radius, with ways around.

    obstacles: in their own size; radius: of the robot, metres; clearance: kept beyond that by
    planned ways and by waypoints, metres; circles (n, 5): x, y, z, inflated radius with a tenth of
    the clearance, and 1 for a sphere. Robots stop short of these, so that rounding does not put
    them into an obstacle.
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
        for circle in self.circles:
            if circle[4] > 0.5:
                continue
            reach = (circle[3] + 0.9 * clearance) / math.cos(math.pi / CORNERS)
            for corner in range(CORNERS):
                angle = 2.0 * math.pi * corner / CORNERS
                point = (circle[0] + reach * math.cos(angle), circle[1] + reach * math.sin(angle))
                if is_clear(*point, 0.0, *point, 0.0, self.circles, 0.5 * clearance, True):
                    corners.append(point)
        self.vertices = np.array(corners, dtype=float).reshape(-1, 2)
        self.pairs = _all_pairs(self.vertices, self.circles, 0.4 * clearance)

    def __len__(self) -> int:
        return len(self.circles)

    def is_free(self, position: ArrayLike) -> bool:
        """Return whether a robot at `position` (3,) touches no obstacle."""
        x, y, z = (float(value) for value in np.asarray(position, dtype=float))
        return bool(is_clear(x, y, z, x, y, z, self.circles, 0.0, False))

    def to_goal(self, goal: FloatArray) -> FloatArray:
        """Return the table that `next_point` needs for a goal (3,)."""
        return goal_distances(goal, self.circles, self.vertices, self.pairs)

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
