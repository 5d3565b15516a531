"""Unicycle (TurtleBot3) with a feedback controller on distance and heading, or a dynamic window.

000, section 7.1.3, after Khoukhi and Shahab (2013): in polar coordinates about the waypoint, with
distance rho and bearing error alpha,

    v = k_rho rho cos(alpha),    omega = k_alpha alpha + (v / rho) sin(alpha),

so that rho' = -v cos(alpha) <= 0 and alpha' = -k_alpha alpha from any heading. Speeds are limited,
and the robot turns on the spot while the waypoint is not ahead.

state (6,): position [m, map], heading [rad], forward speed [m/s], turn rate [rad/s].

Dynamic window (section 7.2): pairs of forward speed and turn rate within the acceleration limits
are simulated as arcs. Arcs that cannot stop before an obstacle are discarded; the best of the
others ends near the target point, faces it, and has clearance from obstacles.
"""

import math

import numpy as np
from numba import njit

from maasi_filter.arrays import FloatArray
from maasi_planner.guidance import approach_limit, head_for, hold_back, minded
from maasi_planner.motion.steering import Command, Steering, wrapped
from maasi_planner.obstacles import Felt, Surroundings, Vector, from_centre, is_far

# Seconds to the next command of the window, and of simulated arcs.
WINDOW = 0.2
LOOK_AHEAD = 1.2
ARC_STEPS = 8
FORWARD_SAMPLES = 6
TURN_SAMPLES = 13
# Largest turn during braking [rad], and share of the speed below which a robot stands.
_TURNS, _STANDS = 0.35, 0.05
_AWAY = 0.2  # turn away from a touched obstacle [rad]
_TOUCHES = 1e-9  # distance that counts as touching [m]


@njit(cache=True, forceinline=True)
def _before_disc(along: float, across: float, radius: float) -> float:
    if along > 0.0 and abs(across) < radius:
        return max(along - math.sqrt(radius * radius - across * across), 0.0)
    return np.inf


@njit(cache=True, forceinline=True)
def distance_ahead(x: float, y: float, yaw: float, reach: float, felt: Felt, beyond: bool) -> float:
    """Return the distance straight ahead that is free of circles, at most `reach` metres.

    beyond: whether the robot is beyond the walls, so that they do not count.
    """
    cos_yaw = math.cos(yaw)
    sin_yaw = math.sin(yaw)
    free, here, circles = reach, (x, y, 0.0), felt.circles
    for n in range(felt.first, felt.last):
        i = felt.rows[n]
        if felt.gaps[n] > reach + felt.off:
            break
        wall = circles[i, 5] != 0.0 or circles[i, 6] != 0.0
        if wall and beyond:
            continue
        out_x, out_y, _ = from_centre(here, circles, i)
        if math.hypot(out_x, out_y) <= circles[i, 3] + _TOUCHES:
            # A robot that touches a circle, or is inside, may move outwards.
            if out_x * cos_yaw + out_y * sin_yaw < 0.0:
                return 0.0
            continue
        ox = circles[i, 0] - x
        oy = circles[i, 1] - y
        along = ox * cos_yaw + oy * sin_yaw
        across = ox * sin_yaw - oy * cos_yaw
        radius = circles[i, 3]
        free = min(free, _before_disc(along, across, radius))
        if wall and not is_far(here, here, circles, i, reach + circles[i, 3]):
            ahead = circles[i, 5] * cos_yaw + circles[i, 6] * sin_yaw
            aside = circles[i, 5] * sin_yaw - circles[i, 6] * cos_yaw
            free = min(free, _before_disc(along + ahead, across + aside, radius))
            # Both long sides of a wall across the path.
            length = math.hypot(ahead, aside)
            for side in (-radius / length, radius / length):
                start, start_across = along - side * aside, across + side * ahead
                if aside != 0.0 and 0.0 <= -start_across / aside <= 1.0:
                    hit = start - start_across / aside * ahead
                    if hit > 0.0:
                        free = min(free, hit)
    return free


@njit(cache=True, forceinline=True)
def _speed_ahead(
    position: tuple[float, float], yaw: float, steering: Steering, felt: Felt, beyond: bool
) -> float:
    # Farther obstacles allow full speed.
    reach = 1.001 * steering.speed / steering.barrier
    free = distance_ahead(position[0], position[1], yaw, reach, felt, beyond)
    return approach_limit(free, (steering.barrier, steering.acceleration))


@njit(cache=True, forceinline=True)
def _along(
    here: Vector, line: tuple[float, float], steering: Steering, felt: Felt
) -> tuple[float, float]:
    """Return the direction along what the robot touches, and slightly away from it."""
    share = steering.speed / max(math.hypot(line[0], line[1]), 1e-9)
    limits = steering.barrier, steering.acceleration
    x, y, _ = hold_back(here, felt, False, limits, (share * line[0], share * line[1], 0.0))
    if math.hypot(x, y) < _STANDS * steering.speed:
        return line
    away = math.copysign(_AWAY, x * line[1] - y * line[0])
    return x + away * y, y - away * x


@njit(cache=True)
def _arc(
    state: FloatArray, v: float, w: float, time: float, stopping: float, felt: Felt
) -> tuple[float, float, float, float]:
    """Return the end of an arc and its clearance, -inf if the robot cannot stop in time."""
    px, py, heading = state[0], state[1], state[3]
    margin, circles = np.inf, felt.circles
    dt = time / ARC_STEPS
    for k in range(ARC_STEPS):
        heading += 0.5 * w * dt
        px += v * dt * math.cos(heading)
        py += v * dt * math.sin(heading)
        heading += 0.5 * w * dt
        travelled = v * dt * (k + 1)
        for n in range(felt.first, felt.last):
            c = felt.rows[n]
            ox, oy, _ = from_centre((px, py, 0.0), circles, c)
            gap = math.hypot(ox, oy) - circles[c, 3]
            margin = min(margin, gap)
            if gap < 0.0 and v > 0.0 and travelled <= stopping + v * dt:
                return px, py, heading, -np.inf
        if margin < 0.0 and v > 0.0:
            break
    return px, py, heading, margin


@njit(cache=True)
def window_command(
    state: FloatArray,
    target: Vector,
    left: float,
    steering: Steering,
    felt: Felt,
    clearance: float,
) -> tuple[float, float]:
    """Return forward speed and turn rate of a unicycle with `left` metres to go by `target`."""
    x, y, _, yaw, forward, turn = state
    speed, change = steering.speed, steering.acceleration * WINDOW
    deceleration = min(steering.acceleration, 2.0 * speed)
    low = max(0.0, forward - change)
    high = max(low, min(speed, steering.rate * left, forward + change))
    turn_low = max(-steering.yaw_rate, turn - steering.yaw_acceleration * WINDOW)
    turn_high = min(steering.yaw_rate, turn + steering.yaw_acceleration * WINDOW)
    away = math.hypot(target[0] - x, target[1] - y)
    time = min(LOOK_AHEAD, max(0.3, away / max(speed, 1e-9)))
    best = -np.inf
    best_forward = best_turn = 0.0
    for i in range(FORWARD_SAMPLES + 1):
        # Zero forward speed is always included: turning on the spot is safe.
        v = low + (high - low) * (i - 1) / (FORWARD_SAMPLES - 1) if i > 0 else 0.0
        stopping = 0.5 * v * v / deceleration + v * WINDOW
        for j in range(TURN_SAMPLES):
            w = turn_low + (turn_high - turn_low) * j / (TURN_SAMPLES - 1)
            px, py, heading, margin = _arc(state, v, w, time, stopping, felt)
            if margin == -np.inf:
                continue
            gap = math.hypot(target[0] - px, target[1] - py)
            off = wrapped(math.atan2(target[1] - py, target[0] - px) - heading)
            score = (away - gap) / (speed * time)
            score -= 0.3 * abs(off) / math.pi * min(1.0, gap / clearance)
            score += 0.2 * min(max(margin, -clearance), clearance) / clearance
            score -= 0.01 * abs(w) / steering.yaw_rate
            if score > best:
                best, best_forward, best_turn = score, v, w
    return min(best_forward, _speed_ahead((x, y), yaw, steering, felt, False)), best_turn


K_RHO = 1.5
K_ALPHA = 3.0
AHEAD = 0.6  # beyond this bearing error the robot turns on the spot


@njit(cache=True, forceinline=True)
def unicycle_step(state: FloatArray, command: Command, steering: Steering, dt: float) -> None:
    """Move for `dt`, in place, on the arc of the mean of old and new speeds."""
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
    """Return speed and turn rate towards a point, with at least `least` metres for turning."""
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


@njit(cache=True, forceinline=True)
def drive_among(
    state: FloatArray,
    goal: Vector,
    to_goal: FloatArray,
    steering: Steering,
    around: Surroundings,
    vertex: int,
) -> tuple[Command, int]:
    """Return the command towards a waypoint around obstacles, and the next vertex.

    vertex: that of the step before, or -1.
    """
    x, y, yaw, clearance = state[0], state[1], state[3], around.clearance
    here = (x, y, goal[2])
    target, left, manner, vertex = head_for(here, goal, to_goal, around, vertex)
    felt, beyond = minded(here, manner, around)
    if steering.window and not beyond:
        forward, turn = window_command(state, target, left, steering, felt, clearance)
        return (forward, 0.0, 0.0, turn), vertex
    dx, dy = target[0] - x, target[1] - y
    allowed = _speed_ahead((x, y), yaw, steering, felt, beyond)
    stands = _STANDS * steering.speed
    if allowed < stands and not beyond:
        dx, dy = _along(here, (dx, dy), steering, felt)
    forward, turn = _drive(dx, dy, left, yaw, steering, clearance)
    forward = min(forward, allowed)
    if state[4] > stands:
        # It brakes before it turns towards obstacles, also at the end of a turn.
        ahead = yaw + 0.5 * state[5] * abs(state[5]) / steering.yaw_acceleration
        off = wrapped(math.atan2(dy, dx) - ahead)
        off = min(max(off, -_TURNS), _TURNS)
        aside = np.inf
        for part in (0.0, 0.5, 1.0):
            heading = ahead + part * off
            aside = min(aside, _speed_ahead((x, y), heading, steering, felt, beyond))
        if aside < state[4]:
            forward, turn = min(forward, aside), 0.0
    return (forward, 0.0, 0.0, turn), vertex
