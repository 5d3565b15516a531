"""Velocity commands of robots that can move in any direction, also around obstacles."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from maasi_filter.arrays import FloatArray
from maasi_planner.obstacles import hold_back, next_point, segment_distance


class Surroundings(NamedTuple):
    """Obstacles of a robot, inflated by its radius.

    circles (n, 5): x, y, z, radius [m, map], 1 for a sphere; vertices (m, 2): of the visibility
    graph [m, map]; clearance: kept beyond the radius by planned ways [m].
    """

    circles: FloatArray
    vertices: FloatArray
    clearance: float


class Steering(NamedTuple):
    """How a robot approaches its waypoint.

    rate: speed per distance left [1/s]; speed: at most [m/s]; barrier: speed towards an obstacle
    per distance to it, at most [1/s]; deceleration: next to obstacles the speed is what this can
    stop [m/s^2]; infinite: no such limit; face_travel: whether the heading turns to the direction
    of travel; yaw_rate: at most [rad/s]; tolerance: distance at which the waypoint is reached [m].
    """

    rate: float
    speed: float
    barrier: float
    deceleration: float
    face_travel: bool
    yaw_rate: float
    tolerance: float


@njit(cache=True)
def turn_towards(dx: float, dy: float, yaw: float, yaw_rate: float) -> float:
    """Return the yaw rate that turns the heading towards (dx, dy)."""
    turn = math.atan2(dy, dx) - yaw
    turn -= 2.0 * math.pi * math.floor((turn + math.pi) / (2.0 * math.pi))
    return min(max(2.0 * turn, -yaw_rate), yaw_rate)


@njit(cache=True)
def straight_command(
    dx: float, dy: float, dz: float, yaw: float, steering: Steering
) -> tuple[float, float, float, float]:
    """Return the command vx, vy, vz (body axes), yaw rate towards a waypoint at (dx, dy, dz).

    The speed is `rate` times the distance, at most `speed`.
    """
    size = math.sqrt(dx * dx + dy * dy + dz * dz)
    scale = steering.rate
    if scale * size > steering.speed:
        scale = steering.speed / size
    vx = scale * dx
    vy = scale * dy
    turn = 0.0
    if steering.face_travel and dx * dx + dy * dy > 1e-6:
        turn = turn_towards(dx, dy, yaw, steering.yaw_rate)
    if yaw == 0.0:
        return vx, vy, scale * dz, turn
    cos_yaw = math.cos(yaw)
    sin_yaw = math.sin(yaw)
    return cos_yaw * vx + sin_yaw * vy, cos_yaw * vy - sin_yaw * vx, scale * dz, turn


@njit(cache=True, forceinline=True)
def _room(position: FloatArray, circles: FloatArray) -> float:
    """Return the distance of a position (3,) from the nearest circle, negative inside."""
    x, y, z = position[0], position[1], position[2]
    room = np.inf
    for i in range(circles.shape[0]):
        room = min(room, segment_distance(x, y, z, x, y, z, circles[i]) - circles[i, 3])
    return room


@njit(cache=True)
def sideways_command(
    position: FloatArray,
    yaw: float,
    goal: FloatArray,
    to_goal: FloatArray,
    steering: Steering,
    around: Surroundings,
    work: FloatArray,
    out: FloatArray,
) -> None:
    """Write the command of a robot that can move in any direction into `out` (4,), body axes."""
    if around.circles.shape[0] == 0:
        out[0], out[1], out[2], out[3] = straight_command(
            goal[0] - position[0], goal[1] - position[1], goal[2] - position[2], yaw, steering
        )
    else:
        _command_among(position, yaw, goal, to_goal, steering, around, work, out)


@njit(cache=True, forceinline=True)
def _command_among(
    position: FloatArray,
    yaw: float,
    goal: FloatArray,
    to_goal: FloatArray,
    steering: Steering,
    around: Surroundings,
    work: FloatArray,
    out: FloatArray,
) -> None:
    """Write the command among obstacles, see `sideways_command`."""
    circles = around.circles
    speed = steering.speed
    target = work[0]
    velocity = work[1]
    left = next_point(position, goal, circles, around.vertices, to_goal, around.clearance, target)
    dx = target[0] - position[0]
    dy = target[1] - position[1]
    dz = target[2] - position[2]
    size = math.sqrt(dx * dx + dy * dy + dz * dz)
    if steering.deceleration < np.inf:
        room = max(_room(position, circles), 0.0)
        speed = min(speed, math.sqrt(steering.deceleration * room) + 0.05 * speed)
    scale = 0.0
    if size > 0.0:
        scale = min(steering.rate * left, speed) / size
    velocity[0] = scale * dx
    velocity[1] = scale * dy
    velocity[2] = scale * dz
    hold_back(position, circles, steering.barrier, velocity)
    after = math.sqrt(velocity[0] ** 2 + velocity[1] ** 2 + velocity[2] ** 2)
    if after > speed:
        velocity[0] *= speed / after
        velocity[1] *= speed / after
        velocity[2] *= speed / after
    cos_yaw = math.cos(yaw)
    sin_yaw = math.sin(yaw)
    out[0] = cos_yaw * velocity[0] + sin_yaw * velocity[1]
    out[1] = cos_yaw * velocity[1] - sin_yaw * velocity[0]
    out[2] = velocity[2]
    out[3] = 0.0
    if steering.face_travel and dx * dx + dy * dy > 1e-6:
        out[3] = turn_towards(dx, dy, yaw, steering.yaw_rate)
