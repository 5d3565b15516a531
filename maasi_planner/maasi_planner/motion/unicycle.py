"""Unicycle (TurtleBot3) with a feedback controller on distance and heading.

000, section 7.1.3, after Khoukhi and Shahab (2013): in polar coordinates about the waypoint, with
distance rho and bearing error alpha,

    v = k_rho rho cos(alpha),    omega = k_alpha alpha + (v / rho) sin(alpha),

so that rho' = -v cos(alpha) <= 0 and alpha' = -k_alpha alpha from any heading. Speeds are cut to
the limits, and the robot turns on the spot while the waypoint is not ahead.

state (6,): position [m, map], heading [rad], forward speed [m/s], turn rate [rad/s].
"""

import math

import numpy as np
from numba import njit

from maasi_filter.arrays import FloatArray
from maasi_planner.motion.dynamic_window import way_ahead, window_command
from maasi_planner.motion.steering import Command, Steering, wrapped
from maasi_planner.obstacles import Surroundings, Vector, next_point

K_RHO = 1.5
K_ALPHA = 3.0
AHEAD = 0.6  # beyond this bearing error the robot turns on the spot


@njit(cache=True, forceinline=True)
def unicycle_step(state: FloatArray, command: Command, steering: Steering, dt: float) -> None:
    """Move for `dt`, in place, along the arc of the mean of old and new speeds."""
    yaw, forward, turn = state[3], state[4], state[5]
    acceleration, yaw_acceleration = steering.acceleration, steering.yaw_acceleration
    wanted = min(max(command[0], -steering.speed), steering.speed)
    wanted = min(max(wanted, forward - acceleration * dt), forward + acceleration * dt)
    mean = 0.5 * (wanted + forward) if acceleration < np.inf else wanted
    wanted_turn = min(max(command[3], -steering.yaw_rate), steering.yaw_rate)
    wanted_turn = min(max(wanted_turn, turn - yaw_acceleration * dt), turn + yaw_acceleration * dt)
    angle = (0.5 * (wanted_turn + turn) if yaw_acceleration < np.inf else wanted_turn) * dt
    chord = mean * dt
    if abs(angle) > 1e-6:
        chord *= math.sin(0.5 * angle) / (0.5 * angle)
    heading = yaw + 0.5 * angle
    state[0] += chord * math.cos(heading)
    state[1] += chord * math.sin(heading)
    state[3], state[4], state[5] = yaw + angle, wanted, wanted_turn


@njit(cache=True, forceinline=True)
def _drive(
    dx: float, dy: float, left: float, yaw: float, steering: Steering, least: float
) -> tuple[float, float]:
    """Return speed and turn rate towards a point; turning counts `left`, or at least `least` m."""
    rho = math.sqrt(dx * dx + dy * dy)
    if rho < 1e-9:
        return 0.0, 0.0
    alpha = wrapped(math.atan2(dy, dx) - yaw)
    forward, turn = 0.0, K_ALPHA * alpha
    if abs(alpha) < AHEAD:
        # cos(alpha) and sin(alpha) without trigonometry.
        cosine = (math.cos(yaw) * dx + math.sin(yaw) * dy) / rho
        sine = (math.cos(yaw) * dy - math.sin(yaw) * dx) / rho
        forward = min(steering.rate * left, steering.speed) * cosine
        forward = min(forward, steering.rate * max(rho, least))
        turn += forward / max(rho, 1e-3) * sine
    return forward, min(max(turn, -steering.yaw_rate), steering.yaw_rate)


@njit(cache=True, forceinline=True)
def drive_freely(state: FloatArray, goal: Vector, steering: Steering) -> Command:
    """Return the command straight towards a waypoint."""
    dx, dy = goal[0] - state[0], goal[1] - state[1]
    left = math.sqrt(dx * dx + dy * dy)
    forward, turn = _drive(dx, dy, left, state[3], steering, 0.0)
    return forward, 0.0, 0.0, turn


@njit(cache=True)
def drive_among(
    state: FloatArray, goal: Vector, to_goal: FloatArray, steering: Steering, around: Surroundings
) -> Command:
    """Return the command towards a waypoint around obstacles."""
    x, y, yaw = state[0], state[1], state[3]
    circles, clearance = around.circles, around.clearance
    target, left = next_point((x, y, goal[2]), goal, to_goal, around)
    if steering.window:
        forward, turn = window_command(state, target, left, steering, circles, clearance)
        return forward, 0.0, 0.0, turn
    forward, turn = _drive(target[0] - x, target[1] - y, left, yaw, steering, clearance)
    free = way_ahead(x, y, yaw, 4.0 * clearance + steering.speed, circles)
    return min(forward, steering.barrier * free), 0.0, 0.0, turn
