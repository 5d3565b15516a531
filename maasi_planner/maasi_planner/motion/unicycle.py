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
from numpy.typing import ArrayLike

from maasi_filter.arrays import FloatArray
from maasi_filter.models.pose import Pose
from maasi_planner.motion.base import (
    Body,
    MotionModel,
    RobotState,
    Trajectories,
    TrajectoryArrays,
    add_position,
    check_command,
    check_step,
    check_waypoint,
)
from maasi_planner.motion.dynamic_window import (
    ACCELERATION,
    BRAKING,
    RATE,
    SPEED,
    YAW_ACCELERATION,
    YAW_RATE,
    UnicycleState,
    way_ahead,
    window_command,
)
from maasi_planner.motion.steering import Surroundings
from maasi_planner.obstacles import Obstacles, next_point
from maasi_planner.settings import MotionSettings

K_RHO = 1.5
K_ALPHA = 3.0
# Beyond this bearing error the robot turns on the spot.
AHEAD = 0.6


@njit(cache=True)
def unicycle_step(
    state: UnicycleState, command: tuple[float, float], limits: FloatArray, dt: float
) -> UnicycleState:
    """Move for `dt`; return the new state.

    Forward speed and turn rate change by at most their acceleration towards those of `command`,
    and the robot follows the arc of the mean of old and new. `limits` (6,): see
    `unicycle_limits`.
    """
    x, y, yaw, forward, turn = state
    command_forward, command_turn = command
    speed, yaw_rate = limits[SPEED], limits[YAW_RATE]
    acceleration, yaw_acceleration = limits[ACCELERATION], limits[YAW_ACCELERATION]
    wanted = min(max(command_forward, -speed), speed)
    change = acceleration * dt
    wanted = min(max(wanted, forward - change), forward + change)
    mean = 0.5 * (wanted + forward) if acceleration < np.inf else wanted
    wanted_turn = min(max(command_turn, -yaw_rate), yaw_rate)
    change = yaw_acceleration * dt
    wanted_turn = min(max(wanted_turn, turn - change), turn + change)
    angle = (0.5 * (wanted_turn + turn) if yaw_acceleration < np.inf else wanted_turn) * dt
    chord = mean * dt
    if abs(angle) > 1e-6:
        chord *= math.sin(0.5 * angle) / (0.5 * angle)
    heading = yaw + 0.5 * angle
    return (
        x + chord * math.cos(heading),
        y + chord * math.sin(heading),
        yaw + angle,
        wanted,
        wanted_turn,
    )


@njit(cache=True)
def drive(
    dx: float,
    dy: float,
    left: float,
    yaw: float,
    rate: float,
    speed: float,
    yaw_rate: float,
    least: float,
) -> tuple[float, float]:
    """Return forward speed and turn rate towards a point at (dx, dy), with `left` m to go.

    At a point on the way the robot keeps its speed, but for turning it counts at least `least`.
    """
    rho = math.sqrt(dx * dx + dy * dy)
    if rho < 1e-9:
        return 0.0, 0.0
    alpha = math.atan2(dy, dx) - yaw
    alpha -= 2.0 * math.pi * math.floor((alpha + math.pi) / (2.0 * math.pi))
    forward = 0.0
    turn = K_ALPHA * alpha
    if abs(alpha) < AHEAD:
        # cos(alpha) and sin(alpha) without trigonometry.
        cosine = (math.cos(yaw) * dx + math.sin(yaw) * dy) / rho
        sine = (math.cos(yaw) * dy - math.sin(yaw) * dx) / rho
        forward = min(rate * left, speed) * cosine
        forward = min(forward, rate * max(rho, least))
        turn += forward / max(rho, 1e-3) * sine
    return forward, min(max(turn, -yaw_rate), yaw_rate)


@njit(cache=True)
def unicycle_command(
    state: UnicycleState,
    goal: FloatArray,
    to_goal: FloatArray,
    limits: FloatArray,
    window: bool,
    around: Surroundings,
    work: FloatArray,
) -> tuple[float, float]:
    """Return the command of a robot among obstacles: forward speed and turn rate."""
    x, y, yaw = state[0], state[1], state[2]
    circles = around.circles
    clearance = around.clearance
    position = work[0]
    target = work[1]
    position[0] = x
    position[1] = y
    position[2] = goal[2]
    left = next_point(position, goal, circles, around.vertices, to_goal, clearance, target)
    if window:
        return window_command(state, target[0], target[1], left, limits, circles, clearance)
    ahead, turning = drive(
        target[0] - x,
        target[1] - y,
        left,
        yaw,
        limits[RATE],
        limits[SPEED],
        limits[YAW_RATE],
        clearance,
    )
    free = way_ahead(x, y, yaw, 4.0 * clearance + limits[SPEED], circles)
    return min(ahead, limits[BRAKING] * free), turning


@njit(cache=True)
def _roll_out(
    start: UnicycleState,
    height: float,
    waypoints: FloatArray,
    tables: FloatArray,
    limits: FloatArray,
    window: bool,
    tolerance: float,
    around: Surroundings,
    dt: float,
    out: TrajectoryArrays,
) -> None:
    work = np.zeros((2, 3))
    obstacles = around.circles.shape[0] > 0
    rate, speed, yaw_rate = limits[RATE], limits[SPEED], limits[YAW_RATE]
    limit = out.positions.shape[1] - 1
    for w in range(waypoints.shape[0]):
        state = start
        goal = waypoints[w]
        length = limit + 1
        cost = 0.0
        for k in range(limit + 1):
            x, y, yaw, _, _ = state
            add_position(out, w, k, x, y, height, yaw)
            dx = goal[0] - x
            dy = goal[1] - y
            square = dx * dx + dy * dy
            if square <= tolerance * tolerance:
                length = k
                break
            if obstacles:
                command = unicycle_command(state, goal, tables[w], limits, window, around, work)
            else:
                command = drive(dx, dy, math.sqrt(square), yaw, rate, speed, yaw_rate, 0.0)
            cost += command[0] * command[0] + command[1] * command[1]
            state = unicycle_step(state, command, limits, dt)
        out.lengths[w] = length
        out.control_cost[w] = cost


def unicycle_limits(settings: MotionSettings) -> FloatArray:
    """Return approach rate, speed, braking rate, yaw rate and both accelerations, (6,)."""
    rate = settings.approach_rate or K_RHO
    braking = 2.0
    if settings.acceleration is not None:
        slowing = settings.acceleration / settings.speed
        rate = min(rate, slowing)
        braking = min(braking, 0.5 * slowing)
    out = np.zeros(6)
    out[RATE] = rate
    out[SPEED] = settings.speed
    out[BRAKING] = braking
    out[YAW_RATE] = settings.yaw_rate
    out[ACCELERATION] = settings.acceleration or math.inf
    out[YAW_ACCELERATION] = settings.yaw_acceleration or math.inf
    return out


class UnicycleBody(Body):
    """A robot that drives forward and turns, with largest speeds and accelerations.

    Its height is kept. state (5,): x, y [m, map], heading [rad], forward speed
    [m/s], turn rate [rad/s].
    """

    def __init__(self, settings: MotionSettings, state: RobotState) -> None:
        self.height = float(state.pose.position[2])
        self.limits = unicycle_limits(settings)
        self.state = five_states(state)

    def step(self, velocity_command: ArrayLike, dt: float) -> None:
        """See `Body.step`; sideways and vertical speeds are ignored."""
        command = check_command(velocity_command)
        self.state[:] = unicycle_step(
            as_tuple(self.state), (command[0], command[3]), self.limits, check_step(dt)
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
        [state.pose.position[0], state.pose.position[1], yaw, forward, state.angular_velocity[2]]
    )


def as_tuple(state: FloatArray) -> UnicycleState:
    """Return a (5,) state as kernels take it."""
    x, y, yaw, forward, turn = state.tolist()
    return x, y, yaw, forward, turn


class Unicycle(MotionModel):
    """Controller and prediction of `UnicycleBody`; the tolerance is horizontal."""

    def __init__(
        self, settings: MotionSettings, obstacles: Obstacles | None = None, radius: float = 0.0
    ) -> None:
        super().__init__(settings, obstacles, radius)
        self.limits = unicycle_limits(settings)
        self.rate = float(self.limits[RATE])
        self._window = settings.avoidance == 'dynamic_window'

    def squared_distance(self, position: ArrayLike, waypoint: ArrayLike) -> float:
        """Return the squared horizontal distance of two points (3,) [m^2]."""
        offset = np.asarray(position, dtype=float)[:2] - np.asarray(waypoint, dtype=float)[:2]
        return float(offset[0] * offset[0] + offset[1] * offset[1])

    def roll_out(
        self, state: RobotState, waypoints: FloatArray, step: float, out: Trajectories
    ) -> None:
        """See `MotionModel.roll_out`."""
        _roll_out(
            as_tuple(five_states(state)),
            float(state.pose.position[2]),
            waypoints,
            self._tables(waypoints),
            self.limits,
            self._window,
            self.settings.tolerance,
            self.surroundings,
            step,
            out.arrays(),
        )

    def command(self, state: RobotState, waypoint: ArrayLike) -> FloatArray:
        """See `MotionModel.command`."""
        goal = check_waypoint(waypoint)
        here = as_tuple(five_states(state))
        out = np.zeros(4)
        if len(self.keep_out):
            out[0], out[3] = unicycle_command(
                here,
                goal,
                self._table(goal),
                self.limits,
                self._window,
                self.surroundings,
                np.zeros((2, 3)),
            )
        else:
            dx, dy = float(goal[0]) - here[0], float(goal[1]) - here[1]
            rate, speed, _, yaw_rate, _, _ = (float(value) for value in self.limits)
            left = math.sqrt(dx * dx + dy * dy)
            out[0], out[3] = drive(dx, dy, left, here[2], rate, speed, yaw_rate, 0.0)
        return out

    def body(self, state: RobotState) -> UnicycleBody:
        """See `MotionModel.body`."""
        return UnicycleBody(self.settings, state)
