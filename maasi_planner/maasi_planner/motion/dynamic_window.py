"""Dynamic window: the best of the speeds that a ground robot can reach next (000, section 7.2).

Pairs of forward speed and turn rate within the acceleration limits are simulated as arcs. Those
that could not stop before an obstacle are discarded; of the others the one is chosen that ends
nearest to the target point, facing it, with clearance from obstacles.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from maasi_filter.arrays import FloatArray

# x, y [m, map], heading [rad], forward speed [m/s], turn rate [rad/s].
UnicycleState = tuple[float, float, float, float, float]

# Entries of the array of limits.
RATE, SPEED, BRAKING, YAW_RATE, ACCELERATION, YAW_ACCELERATION = range(6)

# Seconds until the next command at which the window is taken, and for which arcs are followed.
WINDOW = 0.2
LOOK_AHEAD = 1.2
ARC_STEPS = 8
FORWARD_SAMPLES = 6
TURN_SAMPLES = 13


@njit(cache=True)
def way_ahead(x: float, y: float, yaw: float, reach: float, circles: FloatArray) -> float:
    """Return how far straight ahead is free of circles, at most `reach` metres."""
    cos_yaw = math.cos(yaw)
    sin_yaw = math.sin(yaw)
    free = reach
    for i in range(circles.shape[0]):
        ox = circles[i, 0] - x
        oy = circles[i, 1] - y
        along = ox * cos_yaw + oy * sin_yaw
        across = ox * sin_yaw - oy * cos_yaw
        radius = circles[i, 3]
        if along > 0.0 and abs(across) < radius:
            free = min(free, max(along - math.sqrt(radius * radius - across * across), 0.0))
    return free


@njit(cache=True)
def _arc(
    state: UnicycleState,
    v: float,
    w: float,
    time: float,
    stopping: float,
    circles: FloatArray,
) -> tuple[float, float, float, float]:
    """Return x, y and heading at the end of an arc, and the least distance from circles on it.

    Minus infinity if the robot could not stop within `stopping` before a circle.
    """
    px, py, heading = state[0], state[1], state[2]
    room = np.inf
    dt = time / ARC_STEPS
    for k in range(ARC_STEPS):
        heading += 0.5 * w * dt
        px += v * dt * math.cos(heading)
        py += v * dt * math.sin(heading)
        heading += 0.5 * w * dt
        travelled = v * dt * (k + 1)
        for c in range(circles.shape[0]):
            gap = math.hypot(px - circles[c, 0], py - circles[c, 1]) - circles[c, 3]
            room = min(room, gap)
            if gap < 0.0 and v > 0.0 and travelled <= stopping + v * dt:
                return px, py, heading, -np.inf
        if room < 0.0 and v > 0.0:
            break
    return px, py, heading, room


@njit(cache=True)
def window_command(
    state: UnicycleState,
    target_x: float,
    target_y: float,
    left: float,
    limits: FloatArray,
    circles: FloatArray,
    clearance: float,
) -> tuple[float, float]:
    """Return forward speed and turn rate."""
    x, y, yaw, forward, turn = state
    fastest = min(limits[SPEED], limits[RATE] * left)
    deceleration = min(limits[ACCELERATION], 2.0 * limits[SPEED])
    low = max(0.0, forward - limits[ACCELERATION] * WINDOW)
    high = max(low, min(fastest, forward + limits[ACCELERATION] * WINDOW))
    low = min(low, high)
    turn_low = max(-limits[YAW_RATE], turn - limits[YAW_ACCELERATION] * WINDOW)
    turn_high = min(limits[YAW_RATE], turn + limits[YAW_ACCELERATION] * WINDOW)
    away = math.hypot(target_x - x, target_y - y)
    time = min(LOOK_AHEAD, max(0.3, away / max(limits[SPEED], 1e-9)))
    best = -np.inf
    best_forward = 0.0
    best_turn = 0.0
    for i in range(FORWARD_SAMPLES + 1):
        # Zero forward speed is always a choice: turning on the spot is safe.
        v = 0.0
        if i > 0:
            v = low + (high - low) * (i - 1) / (FORWARD_SAMPLES - 1)
        stopping = 0.5 * v * v / deceleration + v * WINDOW
        for j in range(TURN_SAMPLES):
            w = turn_low + (turn_high - turn_low) * j / (TURN_SAMPLES - 1)
            px, py, heading, room = _arc(state, v, w, time, stopping, circles)
            if room == -np.inf:
                continue
            gap = math.hypot(target_x - px, target_y - py)
            off = math.atan2(target_y - py, target_x - px) - heading
            off -= 2.0 * math.pi * math.floor((off + math.pi) / (2.0 * math.pi))
            closer = (away - gap) / (limits[SPEED] * time)
            score = closer - 0.3 * abs(off) / math.pi * min(1.0, gap / clearance)
            score += 0.2 * min(max(room, -clearance), clearance) / clearance
            score -= 0.01 * abs(w) / limits[YAW_RATE]
            if score > best:
                best = score
                best_forward = v
                best_turn = w
    # Limit the speed by the free distance straight ahead.
    ahead = way_ahead(x, y, yaw, 4.0 * clearance + limits[SPEED], circles)
    return min(best_forward, limits[BRAKING] * ahead), best_turn
