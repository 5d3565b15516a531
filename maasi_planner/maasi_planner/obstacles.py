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
from numpy.typing import ArrayLike, NDArray

from maasi_filter.settings import Obstacle

FloatArray = NDArray[np.float64]
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
    spheres: NDArray[np.bool_]

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
    px = position[0]
    py = position[1]
    pz = position[2]
    dx = goal[0] - px
    dy = goal[1] - py
    dz = goal[2] - pz
    straight = math.sqrt(dx * dx + dy * dy + dz * dz)
    out[0] = goal[0]
    out[1] = goal[1]
    out[2] = goal[2]
    if circles.shape[0] == 0:
        return straight
    # Leave a circle first, in case the robot was pushed into one.
    for i in range(circles.shape[0]):
        ox = px - circles[i, 0]
        oy = py - circles[i, 1]
        oz = (pz - circles[i, 2]) if circles[i, 4] > 0.5 else 0.0
        distance = math.sqrt(ox * ox + oy * oy + oz * oz)
        if distance < circles[i, 3]:
            if distance < 1e-9:
                ox = 1.0
                oy = 0.0
                oz = 0.0
                distance = 1.0
            reach = (circles[i, 3] + clearance) / distance
            out[0] = circles[i, 0] + ox * reach
            out[1] = circles[i, 1] + oy * reach
            out[2] = circles[i, 2] + oz * reach if circles[i, 4] > 0.5 else goal[2]
            return straight + clearance
    left = straight
    if not is_clear(px, py, pz, goal[0], goal[1], goal[2], circles, 0.0, True):
        best = np.inf
        index = -1
        # Best vertex that is not as good as reached, if it is visible already.
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
        if index >= 0:
            slow = False
            if beyond_index != index:
                if beyond <= best + 0.5 * clearance:
                    best = beyond
                    index = beyond_index
                else:
                    slow = True
            vx = vertices[index, 0]
            vy = vertices[index, 1]
            near = math.sqrt((vx - px) * (vx - px) + (vy - py) * (vy - py))
            share = near / best if best > 0.0 else 1.0
            out[0] = vx
            out[1] = vy
            out[2] = pz + share * dz
            left = math.sqrt(best * best + dz * dz)
            if slow:
                # The vertex must be approached closely: the next one is not visible yet.
                left = min(left, 2.0 * near)
    # Around the first sphere in the way, on the side where the line passes its centre.
    first = -1
    nearest = np.inf
    for i in range(circles.shape[0]):
        if circles[i, 4] > 0.5:
            gap = segment_distance(px, py, pz, out[0], out[1], out[2], circles[i])
            if gap < circles[i, 3]:
                away = math.sqrt(
                    (circles[i, 0] - px) ** 2
                    + (circles[i, 1] - py) ** 2
                    + (circles[i, 2] - pz) ** 2
                )
                if away < nearest:
                    nearest = away
                    first = i
    if first >= 0:
        tx = out[0] - px
        ty = out[1] - py
        tz = out[2] - pz
        length = math.sqrt(tx * tx + ty * ty + tz * tz)
        tx /= length
        ty /= length
        tz /= length
        cx = circles[first, 0] - px
        cy = circles[first, 1] - py
        cz = circles[first, 2] - pz
        along = cx * tx + cy * ty + cz * tz
        nx = along * tx - cx
        ny = along * ty - cy
        nz = along * tz - cz
        size = math.sqrt(nx * nx + ny * ny + nz * nz)
        if size < 1e-6:
            # Through the centre: choose a fixed side.
            nx = -ty
            ny = tx
            nz = 0.0
            size = math.hypot(nx, ny)
            if size < 1e-6:
                nx = 1.0
                ny = 0.0
                size = 1.0
        reach = circles[first, 3] + clearance
        # Head for the tangent cone: the point beside the centre, scaled out when close.
        away = max(nearest, reach * 1.0000001)
        widen = reach * away / math.sqrt(away * away - circles[first, 3] ** 2)
        widen = min(widen, 5.0 * reach)
        ax = cx + widen * nx / size
        ay = cy + widen * ny / size
        az = cz + widen * nz / size
        part = math.sqrt(ax * ax + ay * ay + az * az)
        out[0] = px + ax
        out[1] = py + ay
        out[2] = pz + az
        left = max(left, part)
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

    Parameters
    ----------
    obstacles : Obstacles
        In their own size.
    radius : float
        Of the robot, metres.
    clearance : float
        Kept beyond that by planned ways and by waypoints, metres.

    Attributes
    ----------
    circles : (n, 5) array
        x, y, z, inflated radius with a tenth of the clearance, and 1 for a sphere. Robots stop
        short of these, so that rounding does not put them into an obstacle.
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

        Returns
        -------
        (3,) array or None
            The waypoint itself if it is far enough from every obstacle; None if there is no such
            point on the line.
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
