"""Velocity commands of robots that move in any direction, also around obstacles.

The obstacle term of 001, eq. (14) and (15), subtracts k_obs from each input while an obstacle is
nearer than d_l. Inputs are proportional to the velocity command, so that the term is a change of
the command. As printed it has no direction; `away` directs it from the obstacle to the robot.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from maasi_filter.arrays import FloatArray
from maasi_planner.guidance import head_for, hold_back, minded
from maasi_planner.obstacles import Felt, Surroundings, Vector, dot, from_centre, minus, norm

# vx, vy, vz [m/s, axes turned by the heading], yaw rate [rad/s].
Command = tuple[float, float, float, float]


class Steering(NamedTuple):
    """Approach of a waypoint.

    rate: speed per remaining distance [1/s]; speed: limit [m/s]; barrier: limit of the speed
    towards an obstacle per distance [1/s]; acceleration: limit [m/s^2], by which the robot stops
    before obstacles; yaw_rate, yaw_acceleration: limits [rad/s and rad/s^2]; inf disables a limit;
    face_travel: the heading turns to the direction of travel; window: a ground robot uses the
    dynamic window.
    """

    rate: float
    speed: float
    barrier: float
    acceleration: float
    yaw_rate: float
    yaw_acceleration: float
    face_travel: bool
    window: bool


@njit(cache=True, forceinline=True)
def wrapped(angle: float) -> float:
    """Return an angle in [-pi, pi)."""
    return angle - 2.0 * math.pi * math.floor((angle + math.pi) / (2.0 * math.pi))


@njit(cache=True, forceinline=True)
def turned(x: float, y: float, yaw: float) -> tuple[float, float]:
    """Return a horizontal vector rotated by `yaw`."""
    if yaw == 0.0:
        return x, y
    cos_yaw, sin_yaw = math.cos(yaw), math.sin(yaw)
    return cos_yaw * x - sin_yaw * y, sin_yaw * x + cos_yaw * y


@njit(cache=True, forceinline=True)
def _stoppable(
    position: Vector, line: Vector, steering: Steering, felt: Felt, beyond: bool
) -> float:
    """Return the speed, at most the limit, that can be stopped before the nearest circle.

    A circle that the robot is in, or walls that it is beyond, are left at full speed.
    """
    free, circles = np.inf, felt.circles
    for n in range(felt.first, felt.last):
        i = felt.rows[n]
        offset = from_centre(position, circles, i)
        gap = norm(offset)
        if circles[i, 5] != 0.0 or circles[i, 6] != 0.0:
            # Motion along a wall needs no stop.
            towards = -dot(offset, line) / max(gap * norm(line), 1e-9)
            if towards > 0.0 and not beyond:
                free = min(free, (gap - circles[i, 3]) / towards)
        elif gap >= circles[i, 3] or dot(offset, line) < 0.0:
            free = min(free, gap - circles[i, 3])
    speed = steering.speed
    return min(speed, math.sqrt(steering.acceleration * max(free, 0.0)) + 0.05 * speed)


@njit(cache=True, forceinline=True)
def _towards(line: Vector, velocity: Vector, yaw: float, steering: Steering) -> Command:
    turn = 0.0
    if steering.face_travel and line[0] * line[0] + line[1] * line[1] > 1e-6:
        turn = 2.0 * wrapped(math.atan2(line[1], line[0]) - yaw)
        turn = min(max(turn, -steering.yaw_rate), steering.yaw_rate)
    forward, side = turned(velocity[0], velocity[1], -yaw)
    return forward, side, velocity[2], turn


@njit(cache=True, forceinline=True)
def fly_freely(position: Vector, yaw: float, goal: Vector, steering: Steering) -> Command:
    """Return the command towards a waypoint: `rate` times the distance, at most `speed`."""
    line = minus(goal, position)
    size, scale = norm(line), steering.rate
    if scale * size > steering.speed:
        scale = steering.speed / size
    return _towards(line, (scale * line[0], scale * line[1], scale * line[2]), yaw, steering)


@njit(cache=True)
def fly_among(
    position: Vector,
    yaw: float,
    goal: Vector,
    to_goal: FloatArray,
    steering: Steering,
    around: Surroundings,
    vertex: int,
) -> tuple[Command, int]:
    """Return the command towards a waypoint around obstacles, and the next vertex.

    vertex: that of the step before, or -1.
    """
    target, left, manner, vertex = head_for(position, goal, to_goal, around, vertex)
    felt, beyond = minded(position, manner, around)
    line, speed = minus(target, position), steering.speed
    size = norm(line)
    if steering.acceleration < np.inf:
        speed = _stoppable(position, line, steering, felt, beyond)
    scale = min(steering.rate * left, speed) / size if size > 0.0 else 0.0
    velocity = (scale * line[0], scale * line[1], scale * line[2])
    limits = steering.barrier, steering.acceleration
    velocity = hold_back(position, felt, beyond, limits, velocity)
    fastest = norm(velocity)
    share = speed / fastest if fastest > speed else 1.0
    velocity = (velocity[0] * share, velocity[1] * share, velocity[2] * share)
    return _towards(line, velocity, yaw, steering), vertex


TERMS = ('none', 'printed', 'away')
PRINTED = 1


class ObstacleTerm(NamedTuple):
    """Obstacle term of a robot.

    kind: index in TERMS; distance: d_l [m]; push: change of the velocity command for an input of
    k_obs [m/s, rad/s], 0 to the left for a robot that cannot move sideways; circles (n, 5): x, y,
    z, radius, 1 for a sphere, of which the nearest surface counts.
    """

    kind: int
    distance: float
    push: Command
    circles: FloatArray


@njit(cache=True)
def with_obstacle_term(
    position: Vector, yaw: float, command: Command, term: ObstacleTerm
) -> Command:
    """Return a command with the obstacle term."""
    nearest, line = np.inf, (0.0, 0.0, 0.0)
    for i in range(term.circles.shape[0]):
        offset = from_centre(position, term.circles, i)
        size = norm(offset)
        if size - term.circles[i, 3] < nearest:
            nearest, size = size - term.circles[i, 3], max(size, 1e-9)
            line = (offset[0] / size, offset[1] / size, offset[2] / size)
    if nearest >= term.distance:
        return command
    x, y, z, turn = command
    by_x, by_y, by_z, by_turn = term.push
    if term.kind == PRINTED:
        return x - by_x, y - by_y, z - by_z, turn - by_turn
    forward, left = turned(line[0], line[1], -yaw)
    # A robot that cannot move sideways turns to that side.
    turn += by_turn * left if by_y == 0.0 else 0.0
    return x + abs(by_x) * forward, y + abs(by_y) * left, z + by_z * line[2], turn
