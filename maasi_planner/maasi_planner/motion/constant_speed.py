"""A point that moves at constant speed straight to its waypoint."""

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
    sideways_command,
    trimmed,
)
from maasi_planner.obstacles import Obstacles
from maasi_planner.settings import MotionSettings

FloatArray = NDArray[np.float64]
APPROACH_RATE = 5.0


@njit(cache=True)
def point_step(
    position: FloatArray,
    velocity: FloatArray,
    yaw: float,
    command: FloatArray,
    speed: float,
    acceleration: float,
    yaw_rate: float,
    dt: float,
) -> float:  # pragma: no cover - compiled
    """Move a point for `dt`, in place, and return its new heading.

    The velocity changes by at most `acceleration` per second, and the position by its mean.
    """
    cos_yaw = math.cos(yaw)
    sin_yaw = math.sin(yaw)
    wx = cos_yaw * command[0] - sin_yaw * command[1]
    wy = sin_yaw * command[0] + cos_yaw * command[1]
    wz = command[2]
    size = math.sqrt(wx * wx + wy * wy + wz * wz)
    if size > speed:
        wx *= speed / size
        wy *= speed / size
        wz *= speed / size
    if acceleration < np.inf:
        ax = wx - velocity[0]
        ay = wy - velocity[1]
        az = wz - velocity[2]
        change = math.sqrt(ax * ax + ay * ay + az * az)
        share = 1.0
        if change > acceleration * dt:
            share = acceleration * dt / change
        wx = velocity[0] + share * ax
        wy = velocity[1] + share * ay
        wz = velocity[2] + share * az
        position[0] += 0.5 * dt * (velocity[0] + wx)
        position[1] += 0.5 * dt * (velocity[1] + wy)
        position[2] += 0.5 * dt * (velocity[2] + wz)
    else:
        position[0] += dt * wx
        position[1] += dt * wy
        position[2] += dt * wz
    velocity[0] = wx
    velocity[1] = wy
    velocity[2] = wz
    turn = min(max(command[3], -yaw_rate), yaw_rate)
    return yaw + dt * turn


@njit(cache=True)
def _roll_out(
    start: FloatArray,
    start_velocity: FloatArray,
    start_yaw: float,
    waypoints: FloatArray,
    rate: float,
    speed: float,
    acceleration: float,
    barrier: float,
    face_travel: bool,
    yaw_rate: float,
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
    position = np.zeros(3)
    velocity = np.zeros(3)
    for w in range(waypoints.shape[0]):
        position[:] = start
        velocity[:] = start_velocity
        yaw = start_yaw
        goal = waypoints[w]
        length = limit + 1
        cost = 0.0
        for k in range(limit + 1):
            positions[w, k, 0] = position[0]
            positions[w, k, 1] = position[1]
            positions[w, k, 2] = position[2]
            yaws[w, k] = yaw
            gap = math.sqrt(
                (position[0] - goal[0]) ** 2
                + (position[1] - goal[1]) ** 2
                + (position[2] - goal[2]) ** 2
            )
            if gap <= tolerance:
                length = k
                break
            sideways_command(
                position,
                yaw,
                goal,
                rate,
                speed,
                barrier,
                face_travel,
                yaw_rate,
                circles,
                vertices,
                tables[w],
                clearance,
                work,
                command,
            )
            cost += command[0] ** 2 + command[1] ** 2 + command[2] ** 2 + command[3] ** 2
            yaw = point_step(position, velocity, yaw, command, speed, acceleration, yaw_rate, dt)
        lengths[w] = length
        costs[w] = cost


class ConstantSpeedBody(Body):
    """A point with a largest speed and, if wanted, a largest acceleration.

    Parameters
    ----------
    settings : MotionSettings
        `speed`, `acceleration` and `yaw_rate` are its limits.
    state : RobotState
        Where it starts.
    """

    def __init__(self, settings: MotionSettings, state: RobotState) -> None:
        self.settings = settings
        self.position = np.array(state.pose.position)
        self.velocity = state.velocity.copy()
        self.yaw = state.pose.yaw
        self._turn = 0.0

    def step(self, velocity_command: ArrayLike, dt: float) -> None:
        """See `Body.step`."""
        command = check_command(velocity_command)
        limit = self.settings.yaw_rate
        self._turn = min(max(float(command[3]), -limit), limit)
        self.yaw = float(
            point_step(
                self.position,
                self.velocity,
                self.yaw,
                command,
                self.settings.speed,
                self.settings.acceleration or math.inf,
                limit,
                check_step(dt),
            )
        )

    def robot_state(self) -> RobotState:
        """See `Body.robot_state`."""
        return RobotState(
            Pose.from_yaw(self.position, self.yaw),
            self.velocity.copy(),
            np.array([0.0, 0.0, self._turn]),
        )


class ConstantSpeed(MotionModel):
    """Controller and prediction of `ConstantSpeedBody`; its input is the velocity command."""

    def __init__(
        self,
        settings: MotionSettings,
        obstacles: Obstacles | None = None,
        radius: float = 0.0,
    ) -> None:
        super().__init__(settings, obstacles, radius)
        self._acceleration = settings.acceleration or math.inf
        rate = settings.approach_rate or APPROACH_RATE
        if settings.acceleration is not None:
            # Slow enough that braking at the limit follows the approach.
            rate = min(rate, settings.acceleration / settings.speed)
        self.rate = rate
        self.barrier = 0.25 * rate if settings.acceleration is not None else rate

    def _arguments(self) -> tuple[float, float, float, bool, float]:
        settings = self.settings
        return (
            self.rate,
            settings.speed,
            self.barrier,
            settings.heading == 'travel',
            settings.yaw_rate,
        )

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
        rate, speed, barrier, face, yaw_rate = self._arguments()
        _roll_out(
            np.array(state.pose.position),
            state.velocity,
            state.pose.yaw,
            goals,
            rate,
            speed,
            self._acceleration,
            barrier,
            face,
            yaw_rate,
            self.settings.tolerance,
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
        rate, speed, barrier, face, yaw_rate = self._arguments()
        out = np.zeros(4)
        sideways_command(
            np.array(state.pose.position),
            state.pose.yaw,
            goal,
            rate,
            speed,
            barrier,
            face,
            yaw_rate,
            self.keep_out.circles,
            self.keep_out.vertices,
            self._table(goal),
            self.keep_out.clearance,
            np.zeros((2, 3)),
            out,
        )
        return out

    def body(self, state: RobotState) -> ConstantSpeedBody:
        """See `MotionModel.body`."""
        return ConstantSpeedBody(self.settings, state)
