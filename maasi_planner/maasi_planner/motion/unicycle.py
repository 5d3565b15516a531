"""Unicycle (TurtleBot3) with a feedback controller on distance and heading.

000, section 7.1.3, after Khoukhi and Shahab (2013): in polar coordinates about the waypoint, with
distance rho and bearing error alpha,

    v = k_rho rho cos(alpha),    omega = k_alpha alpha + (v / rho) sin(alpha),

so that rho' = -v cos(alpha) <= 0 and alpha' = -k_alpha alpha from any heading. Speeds are cut to
the limits, and the robot turns on the spot while the waypoint is not ahead.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from maasi_filter.pose import Pose
from maasi_planner.motion.base import (
    Body,
    MotionModel,
    RobotState,
    Trajectories,
    check_command,
    check_step,
    check_waypoints,
    trimmed,
)
from maasi_planner.obstacles import Obstacles, next_point
from maasi_planner.settings import MotionSettings

FloatArray = NDArray[np.float64]
K_RHO = 1.5
K_ALPHA = 3.0
# Beyond this bearing error the robot turns on the spot.
AHEAD = 0.6


@njit(cache=True)
def unicycle_step(
    state: FloatArray,
    forward: float,
    turn: float,
    speed: float,
    acceleration: float,
    yaw_rate: float,
    yaw_acceleration: float,
    dt: float,
) -> None:  # pragma: no cover - compiled
    """Move for `dt`, in place; `state` (5,) is x, y, heading, speed, turn rate.

    Both speeds change by at most their acceleration, and the robot follows the arc of the mean
    of old and new.
    """
    forward = min(max(forward, -speed), speed)
    turn = min(max(turn, -yaw_rate), yaw_rate)
    forward = min(max(forward, state[3] - acceleration * dt), state[3] + acceleration * dt)
    turn = min(max(turn, state[4] - yaw_acceleration * dt), state[4] + yaw_acceleration * dt)
    if acceleration < np.inf:
        mean = 0.5 * (forward + state[3])
    else:
        mean = forward
    angle = (0.5 * (turn + state[4]) if yaw_acceleration < np.inf else turn) * dt
    chord = mean * dt
    if abs(angle) > 1e-9:
        chord *= math.sin(0.5 * angle) / (0.5 * angle)
    heading = state[2] + 0.5 * angle
    state[0] += chord * math.cos(heading)
    state[1] += chord * math.sin(heading)
    state[2] += angle
    state[3] = forward
    state[4] = turn


@njit(cache=True)
def way_ahead(
    x: float, y: float, yaw: float, reach: float, circles: FloatArray
) -> float:  # pragma: no cover - compiled
    """Return how far straight ahead is free of circles, at most `reach` metres."""
    cos_yaw = math.cos(yaw)
    sin_yaw = math.sin(yaw)
    free = reach
    for i in range(circles.shape[0]):
        if circles[i, 4] > 0.5 and abs(circles[i, 2]) > circles[i, 3]:
            continue
        ox = circles[i, 0] - x
        oy = circles[i, 1] - y
        along = ox * cos_yaw + oy * sin_yaw
        across = ox * sin_yaw - oy * cos_yaw
        radius = circles[i, 3]
        if along > 0.0 and abs(across) < radius:
            inside = ox * ox + oy * oy < radius * radius
            entry = along - math.sqrt(radius * radius - across * across)
            free = min(free, 0.0 if inside else max(entry, 0.0))
    return free


@njit(cache=True)
def unicycle_command(
    x: float,
    y: float,
    yaw: float,
    goal: FloatArray,
    rate: float,
    speed: float,
    braking: float,
    yaw_rate: float,
    circles: FloatArray,
    vertices: FloatArray,
    to_goal: FloatArray,
    clearance: float,
    work: FloatArray,
    out: FloatArray,
) -> None:  # pragma: no cover - compiled
    """Write the command into `out` (4,): forward speed, 0, 0, turn rate."""
    position = work[0]
    target = work[1]
    position[0] = x
    position[1] = y
    position[2] = goal[2]
    left = next_point(position, goal, circles, vertices, to_goal, clearance, target)
    dx = target[0] - x
    dy = target[1] - y
    rho = math.hypot(dx, dy)
    out[0] = 0.0
    out[1] = 0.0
    out[2] = 0.0
    out[3] = 0.0
    if rho < 1e-9:
        return
    alpha = math.atan2(dy, dx) - yaw
    alpha -= 2.0 * math.pi * math.floor((alpha + math.pi) / (2.0 * math.pi))
    forward = 0.0
    if abs(alpha) < AHEAD:
        forward = min(rate * left, speed) * math.cos(alpha)
        # Never faster than the robot can turn towards the point.
        forward = min(forward, rate * max(rho, clearance))
        if circles.shape[0] > 0:
            free = way_ahead(x, y, yaw, 4.0 * clearance + speed, circles)
            forward = min(forward, braking * free)
    turn = K_ALPHA * alpha + forward / max(rho, 1e-3) * math.sin(alpha)
    out[0] = forward
    out[3] = min(max(turn, -yaw_rate), yaw_rate)


@njit(cache=True)
def _roll_out(
    start: FloatArray,
    height: float,
    waypoints: FloatArray,
    rate: float,
    speed: float,
    acceleration: float,
    braking: float,
    yaw_rate: float,
    yaw_acceleration: float,
    tolerance: float,
    circles: FloatArray,
    vertices: FloatArray,
    tables: FloatArray,
    clearance: float,
    dt: float,
    limit: int,
    positions: FloatArray,
    yaws: FloatArray,
    lengths: NDArray[np.int64],
    costs: FloatArray,
) -> None:  # pragma: no cover - compiled
    work = np.zeros((2, 3))
    command = np.zeros(4)
    state = np.zeros(5)
    for w in range(waypoints.shape[0]):
        state[:] = start
        goal = waypoints[w]
        length = limit + 1
        cost = 0.0
        for k in range(limit + 1):
            positions[w, k, 0] = state[0]
            positions[w, k, 1] = state[1]
            positions[w, k, 2] = height
            yaws[w, k] = state[2]
            if math.hypot(state[0] - goal[0], state[1] - goal[1]) <= tolerance:
                length = k
                break
            unicycle_command(
                state[0],
                state[1],
                state[2],
                goal,
                rate,
                speed,
                braking,
                yaw_rate,
                circles,
                vertices,
                tables[w],
                clearance,
                work,
                command,
            )
            cost += command[0] ** 2 + command[3] ** 2
            unicycle_step(
                state,
                command[0],
                command[3],
                speed,
                acceleration,
                yaw_rate,
                yaw_acceleration,
                dt,
            )
        lengths[w] = length
        costs[w] = cost


class UnicycleBody(Body):
    """A robot that drives forward and turns, with largest speeds and accelerations.

    Parameters
    ----------
    settings : MotionSettings
        `speed`, `acceleration`, `yaw_rate` and `yaw_acceleration` are its limits.
    state : RobotState
        Where it starts; its height is kept.

    Attributes
    ----------
    state : (5,) array
        x, y [m, map], heading [rad], forward speed [m/s], turn rate [rad/s].
    """

    def __init__(self, settings: MotionSettings, state: RobotState) -> None:
        self.settings = settings
        self.height = float(state.pose.position[2])
        self.state = five_states(state)

    def step(self, velocity_command: ArrayLike, dt: float) -> None:
        """See `Body.step`; sideways and vertical speeds are ignored."""
        command = check_command(velocity_command)
        settings = self.settings
        unicycle_step(
            self.state,
            float(command[0]),
            float(command[3]),
            settings.speed,
            settings.acceleration or math.inf,
            settings.yaw_rate,
            settings.yaw_acceleration or math.inf,
            check_step(dt),
        )

    def robot_state(self) -> RobotState:
        """See `Body.robot_state`."""
        x, y, yaw, forward, turn = (float(value) for value in self.state)
        return RobotState(
            Pose.from_yaw(np.array([x, y, self.height]), yaw),
            np.array([forward * math.cos(yaw), forward * math.sin(yaw), 0.0]),
            np.array([0.0, 0.0, turn]),
        )


def five_states(state: RobotState) -> FloatArray:
    """Return x, y, heading, forward speed and turn rate of a robot state."""
    yaw = state.pose.yaw
    forward = state.velocity[0] * math.cos(yaw) + state.velocity[1] * math.sin(yaw)
    return np.array(
        [
            state.pose.position[0],
            state.pose.position[1],
            yaw,
            forward,
            state.angular_velocity[2],
        ]
    )


class Unicycle(MotionModel):
    """Controller and prediction of `UnicycleBody`; the tolerance is horizontal."""

    def __init__(
        self,
        settings: MotionSettings,
        obstacles: Obstacles | None = None,
        radius: float = 0.0,
    ) -> None:
        super().__init__(settings, obstacles, radius)
        self.rate = settings.approach_rate or K_RHO
        self.braking = 2.0
        if settings.acceleration is not None:
            slowing = settings.acceleration / settings.speed
            self.rate = min(self.rate, slowing)
            self.braking = min(self.braking, 0.5 * slowing)

    def arrived(self, position: ArrayLike, waypoint: ArrayLike) -> bool:
        """Return whether `position` is within the tolerance of `waypoint`, horizontally."""
        offset = np.asarray(position, dtype=float) - np.asarray(waypoint, dtype=float)
        return math.hypot(float(offset[0]), float(offset[1])) <= self.settings.tolerance

    def predict(self, state: RobotState, waypoints: ArrayLike, step: float) -> Trajectories:
        """See `MotionModel.predict`."""
        goals = check_waypoints(waypoints)
        dt = check_step(step)
        limit = self.steps_limit(state, goals, dt)
        number = len(goals)
        positions = np.empty((number, limit + 1, 3))
        yaws = np.empty((number, limit + 1))
        lengths = np.empty(number, np.int64)
        costs = np.empty(number)
        settings = self.settings
        _roll_out(
            five_states(state),
            float(state.pose.position[2]),
            goals,
            self.rate,
            settings.speed,
            settings.acceleration or math.inf,
            self.braking,
            settings.yaw_rate,
            settings.yaw_acceleration or math.inf,
            settings.tolerance,
            self.keep_out.circles,
            self.keep_out.vertices,
            self._tables(goals),
            self.keep_out.clearance,
            dt,
            limit,
            positions,
            yaws,
            lengths,
            costs,
        )
        return trimmed(positions, yaws, lengths, costs, limit)

    def command(self, state: RobotState, waypoint: ArrayLike) -> FloatArray:
        """See `MotionModel.command`."""
        goal = check_waypoints(np.asarray(waypoint, dtype=float)[None, :])[0]
        out = np.zeros(4)
        unicycle_command(
            float(state.pose.position[0]),
            float(state.pose.position[1]),
            state.pose.yaw,
            goal,
            self.rate,
            self.settings.speed,
            self.braking,
            self.settings.yaw_rate,
            self.keep_out.circles,
            self.keep_out.vertices,
            self._table(goal),
            self.keep_out.clearance,
            np.zeros((2, 3)),
            out,
        )
        return out

    def body(self, state: RobotState) -> UnicycleBody:
        """See `MotionModel.body`."""
        return UnicycleBody(self.settings, state)
