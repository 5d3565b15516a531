"""A point that moves at constant speed straight to its waypoint."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from maasi_filter.arrays import FloatArray
from maasi_filter.models.pose import Pose
from maasi_planner.motion.base import (
    Body,
    RobotState,
    SteeredMotion,
    Trajectories,
    TrajectoryArrays,
    add_position,
    check_command,
    check_step,
)
from maasi_planner.motion.steering import Steering, Surroundings, sideways_command, straight_command
from maasi_planner.obstacles import Obstacles
from maasi_planner.settings import MotionSettings

# Position and velocity [m and m/s, map] and heading [rad] of a point.
PointState = tuple[float, float, float, float, float, float, float]
APPROACH_RATE = 5.0


@njit(cache=True)
def point_step(
    state: PointState,
    command: tuple[float, float, float, float],
    speed: float,
    acceleration: float,
    yaw_rate: float,
    dt: float,
) -> PointState:
    """Move a point for `dt`; return its new state.

    The velocity changes by at most `acceleration` per second, and the position by its mean.
    """
    x, y, z, vx, vy, vz, yaw = state
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
    return (x + half * (vx + wx), y + half * (vy + wy), z + half * (vz + wz), wx, wy, wz, turned)


@njit(cache=True)
def _straight(
    start: PointState,
    goal: FloatArray,
    steering: Steering,
    dt: float,
    w: int,
    out: TrajectoryArrays,
) -> None:
    """Fill trajectory w of a point without obstacles, heading of travel or inertia.

    It goes straight at a speed that only depends on the distance left, which takes no square
    roots.
    """
    x, y, z, yaw = start[0], start[1], start[2], start[6]
    gx, gy, gz = goal[0], goal[1], goal[2]
    limit = out.positions.shape[1] - 1
    length = limit + 1
    cost = 0.0
    left = math.sqrt((gx - x) ** 2 + (gy - y) ** 2 + (gz - z) ** 2)
    scale = 1.0 / left if left > 0.0 else 0.0
    ux, uy, uz = (gx - x) * scale, (gy - y) * scale, (gz - z) * scale
    for k in range(limit + 1):
        add_position(out, w, k, gx - ux * left, gy - uy * left, gz - uz * left, yaw)
        if left <= steering.tolerance:
            length = k
            break
        forward = min(steering.rate * left, steering.speed)
        cost += forward * forward
        left -= dt * forward
    add_position(out, w, 0, x, y, z, yaw)
    out.lengths[w] = length
    out.control_cost[w] = cost


@njit(cache=True)
def _roll_out(
    start: PointState,
    waypoints: FloatArray,
    tables: FloatArray,
    steering: Steering,
    around: Surroundings,
    dt: float,
    out: TrajectoryArrays,
) -> None:
    work = np.zeros((2, 3))
    wanted = np.zeros(4)
    position = np.zeros(3)
    obstacles = around.circles.shape[0] > 0
    speed, yaw_rate, tolerance = steering.speed, steering.yaw_rate, steering.tolerance
    # The same limit brakes and accelerates.
    acceleration = steering.deceleration
    plain = not obstacles and not steering.face_travel and acceleration == np.inf
    limit = out.positions.shape[1] - 1
    for w in range(waypoints.shape[0]):
        goal = waypoints[w]
        if plain:
            _straight(start, goal, steering, dt, w, out)
            continue
        state = start
        length = limit + 1
        cost = 0.0
        for k in range(limit + 1):
            x, y, z, _, _, _, yaw = state
            add_position(out, w, k, x, y, z, yaw)
            dx = goal[0] - x
            dy = goal[1] - y
            dz = goal[2] - z
            if dx * dx + dy * dy + dz * dz <= tolerance * tolerance:
                length = k
                break
            if obstacles:
                position[0] = x
                position[1] = y
                position[2] = z
                sideways_command(position, yaw, goal, tables[w], steering, around, work, wanted)
                command = (wanted[0], wanted[1], wanted[2], wanted[3])
            else:
                command = straight_command(dx, dy, dz, yaw, steering)
            cost += command[0] ** 2 + command[1] ** 2 + command[2] ** 2 + command[3] ** 2
            state = point_step(state, command, speed, acceleration, yaw_rate, dt)
        out.lengths[w] = length
        out.control_cost[w] = cost


class ConstantSpeedBody(Body):
    """A point with a largest speed and, if wanted, a largest acceleration."""

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
            (*self.position, *self.velocity, self.yaw),
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


class ConstantSpeed(SteeredMotion):
    """Controller and prediction of `ConstantSpeedBody`; its input is the velocity command."""

    def __init__(
        self, settings: MotionSettings, obstacles: Obstacles | None = None, radius: float = 0.0
    ) -> None:
        super().__init__(settings, obstacles, radius)
        rate = settings.approach_rate or APPROACH_RATE
        if settings.acceleration is not None:
            # Slow enough that braking at the limit follows the approach.
            rate = min(rate, settings.acceleration / settings.speed)
        self.rate = rate
        self.barrier = 0.25 * rate if settings.acceleration is not None else rate
        self.steering = Steering(
            self.rate,
            settings.speed,
            self.barrier,
            settings.acceleration or math.inf,
            settings.heading == 'travel',
            settings.yaw_rate,
            settings.tolerance,
        )

    def roll_out(
        self, state: RobotState, waypoints: FloatArray, step: float, out: Trajectories
    ) -> None:
        """See `MotionModel.roll_out`."""
        _roll_out(
            (*state.pose.position, *state.velocity, state.pose.yaw),
            waypoints,
            self._tables(waypoints),
            self.steering,
            self.surroundings,
            step,
            out.arrays(),
        )

    def body(self, state: RobotState) -> ConstantSpeedBody:
        """See `MotionModel.body`."""
        return ConstantSpeedBody(self.settings, state)
