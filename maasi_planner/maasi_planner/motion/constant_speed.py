"""A point that moves at constant speed straight to its waypoint."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from maasi_filter.models.pose import Pose
from maasi_planner.motion.base import (
    Body,
    MotionModel,
    RobotState,
    Trajectories,
    check_command,
    check_step,
    check_waypoints,
    sideways_command,
    straight_command,
)
from maasi_planner.obstacles import Obstacles
from maasi_planner.settings import MotionSettings

FloatArray = NDArray[np.float64]
APPROACH_RATE = 5.0


@njit(cache=True)
def point_step(
    x: float,
    y: float,
    z: float,
    vx: float,
    vy: float,
    vz: float,
    yaw: float,
    command: tuple[float, float, float, float],
    speed: float,
    acceleration: float,
    yaw_rate: float,
    dt: float,
) -> tuple[float, float, float, float, float, float, float]:
    """Move a point for `dt`; return its new position, velocity and heading.

    The velocity changes by at most `acceleration` per second, and the position by its mean.
    """
    wx = command[0]
    wy = command[1]
    wz = command[2]
    if yaw != 0.0:
        cos_yaw = math.cos(yaw)
        sin_yaw = math.sin(yaw)
        wx = cos_yaw * command[0] - sin_yaw * command[1]
        wy = sin_yaw * command[0] + cos_yaw * command[1]
    square = wx * wx + wy * wy + wz * wz
    if square > speed * speed:
        scale = speed / math.sqrt(square)
        wx *= scale
        wy *= scale
        wz *= scale
    turned = yaw + dt * min(max(command[3], -yaw_rate), yaw_rate)
    if acceleration == np.inf:
        return x + dt * wx, y + dt * wy, z + dt * wz, wx, wy, wz, turned
    ax = wx - vx
    ay = wy - vy
    az = wz - vz
    change = math.sqrt(ax * ax + ay * ay + az * az)
    if change > acceleration * dt:
        share = acceleration * dt / change
        wx = vx + share * ax
        wy = vy + share * ay
        wz = vz + share * az
    half = 0.5 * dt
    return (
        x + half * (vx + wx),
        y + half * (vy + wy),
        z + half * (vz + wz),
        wx,
        wy,
        wz,
        turned,
    )


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
) -> None:
    work = np.zeros((2, 3))
    out = np.zeros(4)
    position = np.zeros(3)
    obstacles = circles.shape[0] > 0
    plain = not obstacles and not face_travel and acceleration == np.inf
    for w in range(waypoints.shape[0]):
        x, y, z = start[0], start[1], start[2]
        vx, vy, vz = start_velocity[0], start_velocity[1], start_velocity[2]
        yaw = start_yaw
        gx, gy, gz = waypoints[w, 0], waypoints[w, 1], waypoints[w, 2]
        length = limit + 1
        cost = 0.0
        if plain:
            # Straight at a speed that only depends on the distance left: the same without
            # square roots.
            left = math.sqrt((gx - x) ** 2 + (gy - y) ** 2 + (gz - z) ** 2)
            scale = 1.0 / left if left > 0.0 else 0.0
            ux, uy, uz = (gx - x) * scale, (gy - y) * scale, (gz - z) * scale
            for k in range(limit + 1):
                positions[w, k, 0] = gx - ux * left
                positions[w, k, 1] = gy - uy * left
                positions[w, k, 2] = gz - uz * left
                yaws[w, k] = yaw
                if left <= tolerance:
                    length = k
                    break
                forward = min(rate * left, speed)
                cost += forward * forward
                left -= dt * forward
            positions[w, 0, 0] = x
            positions[w, 0, 1] = y
            positions[w, 0, 2] = z
            lengths[w] = length
            costs[w] = cost
            continue
        for k in range(limit + 1):
            positions[w, k, 0] = x
            positions[w, k, 1] = y
            positions[w, k, 2] = z
            yaws[w, k] = yaw
            dx = gx - x
            dy = gy - y
            dz = gz - z
            if dx * dx + dy * dy + dz * dz <= tolerance * tolerance:
                length = k
                break
            if obstacles:
                position[0] = x
                position[1] = y
                position[2] = z
                sideways_command(
                    position,
                    yaw,
                    waypoints[w],
                    rate,
                    speed,
                    barrier,
                    acceleration,
                    face_travel,
                    yaw_rate,
                    circles,
                    vertices,
                    tables[w],
                    clearance,
                    work,
                    out,
                )
                command = (out[0], out[1], out[2], out[3])
            else:
                command = straight_command(dx, dy, dz, yaw, rate, speed, face_travel, yaw_rate)
            cost += command[0] ** 2 + command[1] ** 2 + command[2] ** 2 + command[3] ** 2
            x, y, z, vx, vy, vz, yaw = point_step(
                x, y, z, vx, vy, vz, yaw, command, speed, acceleration, yaw_rate, dt
            )
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
        moved = point_step(
            self.position[0],
            self.position[1],
            self.position[2],
            self.velocity[0],
            self.velocity[1],
            self.velocity[2],
            self.yaw,
            (command[0], command[1], command[2], command[3]),
            self.settings.speed,
            self.settings.acceleration or math.inf,
            limit,
            check_step(dt),
        )
        self.position[:] = moved[:3]
        self.velocity[:] = moved[3:6]
        self.yaw = float(moved[6])

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

    def roll_out(
        self, state: RobotState, waypoints: FloatArray, step: float, out: Trajectories
    ) -> None:
        """See `MotionModel.roll_out`."""
        rate, speed, barrier, face, yaw_rate = self._arguments()
        _roll_out(
            np.array(state.pose.position),
            state.velocity,
            state.pose.yaw,
            waypoints,
            rate,
            speed,
            self._acceleration,
            barrier,
            face,
            yaw_rate,
            self.settings.tolerance,
            self.keep_out.circles,
            self.keep_out.vertices,
            self._tables(waypoints),
            self.keep_out.clearance,
            step,
            out.positions.shape[1] - 1,
            out.positions,
            out.yaws,
            out.lengths,
            out.control_cost,
        )

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
            self._acceleration,
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
