"""Heading of a robot on its path around obstacles, and limits of its speed, at every step."""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from maasi_filter.arrays import FloatArray
from maasi_planner.obstacles import (
    Felt,
    Surroundings,
    Vector,
    all_felt,
    beyond_walls,
    clearance_at,
    crossed_walls,
    dot,
    felt_at,
    from_centre,
    is_clear,
    is_free_at,
    is_visible,
    minus,
    norm,
    plus,
    segment_distance,
)

# With more vertices than this, predictions search the next one again only where it is reached or
# hidden; with fewer they equal the controller bit for bit.
MANY = 100
_LAST = 1.6  # speed limit per distance close to an obstacle [1/s]
_ATTEMPTS = 40  # to satisfy the limits of several circles in turn


@njit(cache=True)
def _nearest_visible(
    position: Vector, to_goal: FloatArray, around: Surroundings, least: float
) -> tuple[int, float, float]:
    """Return the visible vertex on the shortest path, its distance and the path's length.

    It is at least `least` away; -1 if none is visible.
    """
    px, py, _ = position
    before, rejected = -np.inf, -1
    while True:
        # By length of the path first, as visibility is costly.
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


@njit(cache=True, forceinline=True)
def _same_vertex(
    position: Vector, to_goal: FloatArray, around: Surroundings, before: int
) -> tuple[int, float]:
    """Return the vertex of the step before and the length of its path, or -1."""
    vx, vy = around.vertices[before, 0], around.vertices[before, 1]
    away = math.hypot(vx - position[0], vy - position[1])
    if away < 0.5 * around.clearance:
        return -1, np.inf
    if clearance_at(position, around) <= 0.0 and not is_visible(
        (position[0], position[1], 0.0), (vx, vy, 0.0), around, 0.0, True
    ):
        return -1, np.inf
    return before, away + to_goal[before]


@njit(cache=True)
def _best_vertex(
    position: Vector, to_goal: FloatArray, around: Surroundings
) -> tuple[int, float, bool]:
    """Return the visible vertex on the shortest path, its length, and whether to approach closely.

    A vertex that is nearly reached is replaced by the next one if that is visible; otherwise it
    must be approached closely. -1 if no vertex is visible.
    """
    index, away, best = _nearest_visible(position, to_goal, around, 0.0)
    if away >= 0.5 * around.clearance:
        return index, best, False
    beyond_index, _, beyond = _nearest_visible(position, to_goal, around, 0.5 * around.clearance)
    if index >= 0 and beyond <= best + 0.5 * around.clearance:
        return beyond_index, beyond, False
    return index, best, True


@njit(cache=True, forceinline=True)
def _lateral_sphere(
    position: Vector, target: Vector, sphere: int, around: Surroundings
) -> tuple[Vector, float]:
    """Return a target next to a sphere where the line passes its centre, and the distance to it."""
    line = minus(target, position)
    length = norm(line)
    line = (line[0] / length, line[1] / length, line[2] / length)
    offset = from_centre(position, around.circles, sphere)
    along = -dot(offset, line)
    # From the centre to the nearest point of the line.
    side = plus(offset, along, line)
    size = norm(side)
    if size < 1e-6:
        # Through the centre: choose a fixed side.
        side = (-line[1], line[0], 0.0)
        size = math.hypot(side[0], side[1])
        if size < 1e-6:
            side, size = (1.0, 0.0, 0.0), 1.0
    radius = around.circles[sphere, 3]
    reach = radius + around.clearance
    # Head for the tangent cone: the point next to the centre, farther out when close.
    away = max(norm(offset), reach * 1.0000001)
    widen = min(reach * away / math.sqrt(away * away - radius**2), 5.0 * reach)
    line = plus((-offset[0], -offset[1], -offset[2]), widen / size, side)
    return plus(position, 1.0, line), norm(line)


@njit(cache=True)
def _back_inside(position: Vector, goal: Vector, around: Surroundings) -> Vector:
    """Return the point inside of the nearest wall for a robot beyond the walls."""
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
def length_to(position: Vector, goal: Vector, to_goal: FloatArray, around: Surroundings) -> float:
    """Return the length of the shortest path to a goal, horizontal if it bends, or inf."""
    if is_visible(position, goal, around, 0.0, True):
        return norm(minus(goal, position))
    return _nearest_visible(position, to_goal, around, 0.0)[2]


# A robot moves in free space, out of a zone to its exit, or back into free space.
_WITHIN, _LEAVES, _RETURNS = range(3)


class Heading(NamedTuple):
    """Heading of a robot.

    target: next point of its path, or the goal if the straight line is clear; left: length of the
    path [m]; manner: _WITHIN, _LEAVES or _RETURNS; vertex: the next one, or -1.
    """

    target: Vector
    left: float
    manner: int
    vertex: int


@njit(cache=True)
def _leaves(position: Vector, goal: Vector, around: Surroundings, inside: int) -> bool:
    """Return whether a goal is the exit of a zone, just outside of it.

    A robot that only touches the zone `inside` must not cross it: its exit is on the same side.
    """
    line = minus(position, goal)
    length = norm(line)
    part = min(3.0 * around.clearance / length, 1.0) if length > 0.0 else 0.0
    if is_free_at(plus(goal, part, line), around):
        return False
    if inside >= 0:
        offset = from_centre(position, around.circles, inside)
        touches = norm(offset) >= around.circles[inside, 3] - around.inflation
        if touches and dot(offset, line) > 0.0:
            return False
    return is_clear(position, goal, all_felt(around.solid), 0.0, False)


@njit(cache=True, forceinline=True)
def head_for(
    position: Vector, goal: Vector, to_goal: FloatArray, around: Surroundings, before: int
) -> Heading:
    """Return the heading of a robot; before: vertex of the step before, or -1."""
    line = minus(goal, position)
    left, target, vertex = norm(line), goal, -1
    felt = felt_at(position, around)
    beyond = beyond_walls(position, around)
    inside, nearest = -1, np.inf
    if not beyond:
        for n in range(felt.first, felt.last):
            i = felt.rows[n]
            if felt.gaps[n] > felt.off:
                break
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
        # A robot that was pushed into a circle leaves it again.
        offset = from_centre(position, felt.circles, inside)
        if nearest < 1e-9:
            offset, nearest = (1.0, 0.0, 0.0), 1.0
        reach = (felt.circles[inside, 3] + around.clearance) / nearest
        target = plus(minus(position, offset), reach, offset)
        if felt.circles[inside, 4] <= 0.5:
            target = (target[0], target[1], goal[2])
        return Heading(target, left + around.clearance, _WITHIN, -1)
    # At the vertex it sees the goal.
    index, best, closely = -1, np.inf, False
    if before >= 0:
        index, best = _same_vertex(position, to_goal, around, before)
    if index >= 0 or not is_visible(position, goal, around, 0.0, True):
        if index < 0:
            index, best, closely = _best_vertex(position, to_goal, around)
        if index >= 0:
            vx, vy = around.vertices[index, 0], around.vertices[index, 1]
            near = math.sqrt((vx - position[0]) ** 2 + (vy - position[1]) ** 2)
            share = near / best if best > 0.0 else 1.0
            target = (vx, vy, position[2] + share * line[2])
            left = math.sqrt(best * best + line[2] * line[2])
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
        target, lateral = _lateral_sphere(position, target, first, around)
        left = max(left, lateral)
    return Heading(target, left, _WITHIN, vertex)


@njit(cache=True, forceinline=True)
def minded(position: Vector, manner: int, around: Surroundings) -> tuple[Felt, bool]:
    """Return the circles that limit a robot, and whether it is beyond their walls."""
    if manner == _WITHIN:
        return felt_at(position, around), False
    if manner == _RETURNS:
        return felt_at(position, around), True
    felt = all_felt(around.solid)
    walls, inside = crossed_walls(position, felt)
    return felt, walls and not inside


@njit(cache=True, forceinline=True)
def approach_limit(distance: float, limits: tuple[float, float]) -> float:
    """Return the highest speed at a `distance` [m] towards an obstacle [m/s].

    Half of a limited acceleration stops the robot in time, except for the last half metre or so,
    which delays need.
    """
    rate, acceleration = limits
    if acceleration == np.inf or distance <= 0.0:
        return rate * distance
    return max(rate * distance, min(math.sqrt(0.5 * acceleration * distance), _LAST * distance))


@njit(cache=True)
def hold_back(
    position: Vector, felt: Felt, beyond: bool, limits: tuple[float, float], velocity: Vector
) -> Vector:
    """Return `velocity` with its component into circles limited.

    Towards a circle `approach_limit` remains, and inside of one at least as much outwards; limits:
    rate [1/s] and acceleration [m/s^2]. The velocity is turned along the circles, or reduced where
    that leads further. Walls do not limit a robot that is beyond them.
    """
    circles, wanted, slack = felt.circles, velocity, 0.0
    # Components of the original and the limited velocity.
    straight, shrink = 1.0, 1.0
    # Farther circles do not limit it, even if others increase it.
    enough = 1.5 * norm(velocity) / limits[0] + felt.off
    for attempt in range(_ATTEMPTS + 1):
        changed = False
        if attempt == 8:
            # Between two touching circles only the limit satisfies both exactly.
            slack = 1e-4 * norm(velocity)
        for n in range(felt.first, felt.last):
            i = felt.rows[n]
            if felt.gaps[n] > enough:
                break
            offset = from_centre(position, circles, i)
            size = norm(offset)
            if size < 1e-9 or (beyond and (circles[i, 5] != 0.0 or circles[i, 6] != 0.0)):
                continue
            least = -approach_limit(size - circles[i, 3], limits)
            if attempt == 0:
                before = dot(wanted, offset) / size
                if before < least:
                    straight = min(straight, max(least / before, 0.0)) if before < 0.0 else 0.0
            outwards = dot(velocity, offset) / size
            if outwards >= least - slack:
                continue
            changed = True
            if attempt < _ATTEMPTS:
                velocity = plus(velocity, (least - outwards) / size, offset)
            elif least <= 0.0:
                # Conflicting limits: scale down, as standing still satisfies all.
                shrink = min(shrink, least / outwards)
        if not changed:
            break
    if straight * dot(wanted, wanted) > shrink * dot(velocity, wanted):
        velocity, shrink = wanted, straight
    return velocity[0] * shrink, velocity[1] * shrink, velocity[2] * shrink
