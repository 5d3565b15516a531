"""Motion models of the suite with one compiled closed loop of controller and body."""

from __future__ import annotations

import math
from abc import abstractmethod
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from maasi_filter.arrays import FloatArray, IntArray
from maasi_filter.geometry.area import Area
from maasi_filter.models.pose import Pose
from maasi_planner.guidance import length_to
from maasi_planner.motion import mambo, quadrotor
from maasi_planner.motion.base import (
    Body,
    MotionModel,
    RobotState,
    Trajectories,
    check_command,
    check_step,
    check_waypoint,
)
from maasi_planner.motion.mambo import mambo_step
from maasi_planner.motion.quadrotor import quadrotor_step
from maasi_planner.motion.steering import (
    TERMS,
    Command,
    ObstacleTerm,
    Steering,
    fly_among,
    fly_freely,
    turned,
    with_obstacle_term,
)
from maasi_planner.motion.unicycle import K_RHO, drive_among, drive_freely, unicycle_step
from maasi_planner.obstacles import Surroundings, Vector, dot, is_free_at, norm
from maasi_planner.settings import MotionSettings

POINT, UNICYCLE, MAMBO, QUADROTOR = range(4)
APPROACH_RATE = 5.0
# Limits of the time of a path: factor on the time at full speed, and constant [1, s].
_SLOWEST, _AT_LEAST = 20.0, 60.0


class Kernel(NamedTuple):
    """Data of the compiled functions of a model, for steps of `periods` times `h` seconds.

    States are arrays that begin with the position [m, map] and the heading [rad]. obstructed:
    whether there are obstacles to avoid, or the obstacle term acts; parameters: body of a flying
    robot; table: result of `closed_loop` (Mambo); tolerance: distance of arrival [m].
    """

    kind: int
    steering: Steering
    obstructed: bool
    around: Surroundings
    term: ObstacleTerm
    parameters: FloatArray
    table: FloatArray
    tolerance: float
    periods: int
    h: float


@njit(cache=True, forceinline=True)
def _point_step(state: FloatArray, command: Command, steering: Steering, dt: float) -> None:
    """Move a point for `dt`, in place, with limited acceleration."""
    x, y = turned(command[0], command[1], state[3])
    wanted = (x, y, command[2])
    if dot(wanted, wanted) > steering.speed * steering.speed:
        scale = steering.speed / norm(wanted)
        wanted = (x * scale, y * scale, command[2] * scale)
    bounded = steering.acceleration < np.inf
    share = 1.0
    if bounded:
        change = norm((wanted[0] - state[4], wanted[1] - state[5], wanted[2] - state[6]))
        if change > steering.acceleration * dt:
            share = steering.acceleration * dt / change
    for axis in range(3):
        before = state[4 + axis]
        after = before + share * (wanted[axis] - before) if share < 1.0 else wanted[axis]
        state[axis] += 0.5 * dt * (before + after) if bounded else dt * after
        state[4 + axis] = after
    state[7] = min(max(command[3], -steering.yaw_rate), steering.yaw_rate)
    state[3] += dt * state[7]


# Arrays are passed only where needed: counting references to them costs more than a step.
@njit(cache=True, forceinline=True)
def _freely(kind: int, steering: Steering, state: FloatArray, goal: Vector) -> Command:
    if kind == UNICYCLE:
        return drive_freely(state, goal, steering)
    return fly_freely((state[0], state[1], state[2]), state[3], goal, steering)


@njit(cache=True)
def steer(
    kernel: Kernel, state: FloatArray, goal: Vector, to_goal: FloatArray, vertex: int
) -> tuple[Command, int]:
    """Return the controller's command towards a waypoint, and the vertex on its path.

    vertex: that of the step before, or -1.
    """
    position, yaw, steering = (state[0], state[1], state[2]), state[3], kernel.steering
    if kernel.obstructed and not kernel.term.kind:
        if kernel.kind == UNICYCLE:
            return drive_among(state, goal, to_goal, steering, kernel.around, vertex)
        return fly_among(position, yaw, goal, to_goal, steering, kernel.around, vertex)
    command = _freely(kernel.kind, steering, state, goal)
    if kernel.obstructed:
        return with_obstacle_term(position, yaw, command, kernel.term), -1
    return command, -1


@njit(cache=True, forceinline=True)
def _move(kind: int, steering: Steering, state: FloatArray, command: Command, h: float) -> float:
    if kind == UNICYCLE:
        unicycle_step(state, command, steering, h)
    else:
        _point_step(state, command, steering, h)
    return command[0] ** 2 + command[1] ** 2 + command[2] ** 2 + command[3] ** 2


@njit(cache=True)
def advance(kernel: Kernel, state: FloatArray, command: Command) -> float:
    """Move a body for a step, in place; return the sum of its squared inputs."""
    periods, h = kernel.periods, kernel.h
    if kernel.kind == MAMBO:
        return mambo_step(state, command, kernel.parameters, kernel.table, periods, h)
    if kernel.kind == QUADROTOR:
        return quadrotor_step(state, command, kernel.parameters, periods, h)
    return _move(kernel.kind, kernel.steering, state, command, h)


@njit(cache=True)
def _close_loop(
    kernel: Kernel,
    state: FloatArray,
    goal: Vector,
    to_goal: FloatArray,
    positions: FloatArray,
    yaws: FloatArray,
) -> tuple[int, float]:
    """Run controller and body on `state`; return steps, one too many if not arrived, and u'u.

    positions (K + 1, 3) and yaws (K + 1,) are filled for at most K steps.
    """
    kind, steering, obstructed, _, _, parameters, table, tolerance, periods, h = kernel
    cost, vertex = 0.0, -1
    for k in range(yaws.shape[0]):
        x, y, z = state[0], state[1], state[2]
        positions[k, 0], positions[k, 1], positions[k, 2], yaws[k] = x, y, z, state[3]
        height = 0.0 if kind == UNICYCLE else goal[2] - z
        square = (goal[0] - x) ** 2 + (goal[1] - y) ** 2 + height * height
        if square <= tolerance * tolerance:
            return k, cost
        if obstructed:
            command, vertex = steer(kernel, state, goal, to_goal, vertex)
        else:
            command = _freely(kind, steering, state, goal)
        if kind == MAMBO:
            cost += mambo_step(state, command, parameters, table, periods, h)
        elif kind == QUADROTOR:
            cost += quadrotor_step(state, command, parameters, periods, h)
        else:
            cost += _move(kind, steering, state, command, h)
    return yaws.shape[0], cost


@njit(cache=True)
def _go_straight(
    kernel: Kernel, state: FloatArray, goal: Vector, positions: FloatArray, yaws: FloatArray
) -> tuple[int, float]:
    """Do as `_close_loop` for a point without obstacles."""
    steering = kernel.steering
    x, y, z = goal[0] - state[0], goal[1] - state[1], goal[2] - state[2]
    left, cost = norm((x, y, z)), 0.0
    scale = 1.0 / left if left > 0.0 else 0.0
    x, y, z = x * scale, y * scale, z * scale
    for k in range(yaws.shape[0]):
        positions[k, 0], positions[k, 1] = goal[0] - x * left, goal[1] - y * left
        positions[k, 2], yaws[k] = goal[2] - z * left, state[3]
        if left <= kernel.tolerance:
            return k, cost
        forward = min(steering.rate * left, steering.speed)
        cost += forward * forward
        left -= kernel.h * forward
    return yaws.shape[0], cost


@njit(cache=True)
def _roll_out(
    kernel: Kernel,
    start: FloatArray,
    waypoints: FloatArray,
    tables: FloatArray,
    positions: FloatArray,
    yaws: FloatArray,
    lengths: IntArray,
    control_cost: FloatArray,
) -> None:
    steering = kernel.steering
    straight = kernel.kind == POINT and steering.acceleration == np.inf
    straight = straight and not (steering.face_travel or kernel.obstructed)
    here = (start[0], start[1], start[2])
    bound = kernel.obstructed and not kernel.term.kind and is_free_at(here, kernel.around)
    for w in range(waypoints.shape[0]):
        goal, last = (waypoints[w, 0], waypoints[w, 1], waypoints[w, 2]), yaws.shape[1]
        if bound:
            # Unreachable goals are skipped; others have a time limit.
            path = length_to(here, goal, tables[w], kernel.around)
            seconds = _SLOWEST * path / steering.speed + _AT_LEAST
            last = int(min(seconds / (kernel.periods * kernel.h), last)) if path < np.inf else 1
        if straight:
            result = _go_straight(kernel, start, goal, positions[w], yaws[w])
        else:
            state = start.copy()
            row, headings = positions[w, :last], yaws[w, :last]
            result = _close_loop(kernel, state, goal, tables[w], row, headings)
        lengths[w], control_cost[w] = result
        if lengths[w] >= last and last < yaws.shape[1]:
            lengths[w] = -last
        for axis in range(3):
            positions[w, 0, axis] = start[axis]


class CompiledBody(Body):
    """Body of a robot of the suite."""

    def __init__(self, motion: CompiledMotion, state: RobotState) -> None:
        self.motion = motion
        self.state = motion._to_array(state)

    def step(self, velocity_command: ArrayLike, dt: float) -> None:
        """See `Body.step`."""
        x, y, z, turn = check_command(velocity_command).tolist()
        kernel = self.motion.kernel(check_step(dt))
        advance(kernel, self.state, (x, y, z, turn))

    def robot_state(self) -> RobotState:
        """See `Body.robot_state`."""
        return self.motion._to_state(self.state)


class CompiledMotion(MotionModel):
    """Motion model with compiled controller and body, by their `kind`."""

    kind: int
    steering: Steering

    def __init__(
        self, settings: MotionSettings, area: Area | None = None, radius: float = 0.0
    ) -> None:
        self.settings = settings
        self.parameters = np.zeros(0)
        speed, barrier, acceleration = self._limits()
        self.steering = Steering(
            self.rate,
            speed,
            barrier,
            acceleration,
            settings.yaw_rate,
            settings.yaw_acceleration or math.inf,
            settings.heading == 'travel',
            settings.avoidance == 'dynamic_window',
        )
        super().__init__(settings, area, radius)

    def reach(self) -> float:
        """See `MotionModel.reach`."""
        speed, clearance = self.steering.speed, self.settings.clearance
        if self.settings.obstacle_term != 'none':
            return math.inf
        # Four times the stopping distance or, without a limit, the range of the barrier.
        braking = 2.0 * speed * speed / self.steering.acceleration
        barrier = 1.5 * speed / self.steering.barrier
        return max(min(braking, barrier) if braking else barrier, 1.5 * speed + 4.0 * clearance)

    def adopt_area(self, area: Area | None, radius: float) -> None:
        """See `MotionModel.adopt_area`."""
        super().adopt_area(area, radius)
        self.kernel = lru_cache(maxsize=4)(self._make_kernel)

    @abstractmethod
    def _limits(self) -> tuple[float, float, float]:
        """Set parameters and approach rate; return speed, barrier and acceleration for steering."""

    def _push(self, gain: float) -> Command:
        """Return the change of the velocity command that changes the input by `gain`."""
        return gain, gain, gain, gain

    @abstractmethod
    def _to_array(self, state: RobotState) -> FloatArray:
        """Return the state as an array."""

    @abstractmethod
    def _to_state(self, array: FloatArray) -> RobotState:
        """Return the state in an array."""

    def _make_kernel(self, step: float) -> Kernel:
        periods = max(1, round(step / mambo.PERIOD)) if self.kind >= MAMBO else 1
        h = step / periods
        settings, keep_out, table = self.settings, self.keep_out, np.zeros((0, 0))
        if self.kind == MAMBO:
            table = mambo.closed_loop(self.parameters, periods, h)
        return Kernel(
            self.kind,
            self.steering,
            len(keep_out) > 0,
            keep_out.around,
            ObstacleTerm(
                TERMS.index(settings.obstacle_term),
                settings.obstacle_distance,
                self._push(settings.obstacle_gain),
                keep_out.pushing(),
            ),
            self.parameters,
            table,
            settings.tolerance,
            periods,
            h,
        )

    def roll_out(
        self, state: RobotState, waypoints: FloatArray, step: float, out: Trajectories
    ) -> None:
        """See `MotionModel.roll_out`."""
        tables = np.zeros((len(waypoints), len(self.keep_out.around.vertices)))
        if tables.shape[1]:
            for table, waypoint in zip(tables, waypoints.tolist()):
                table[:] = self.table(tuple(waypoint))
        start, costs = self._to_array(state), out.control_cost
        kernel = self.kernel(step)
        _roll_out(kernel, start, waypoints, tables, out.positions, out.yaws, out.lengths, costs)

    def command(self, state: RobotState, waypoint: ArrayLike) -> FloatArray:
        """See `MotionModel.command`."""
        x, y, z = check_waypoint(waypoint).tolist()
        kernel = self.kernel(mambo.PERIOD)
        goal, table = (x, y, z), self.table((x, y, z))
        return np.array(steer(kernel, self._to_array(state), goal, table, -1)[0])

    def body(self, state: RobotState) -> CompiledBody:
        """See `MotionModel.body`."""
        return CompiledBody(self, state)


class ConstantSpeed(CompiledMotion):
    """A point with limited speed and optionally limited acceleration; its input is the command."""

    kind = POINT

    def _limits(self) -> tuple[float, float, float]:
        settings = self.settings
        self.rate = settings.approach_rate or APPROACH_RATE
        if settings.acceleration is None:
            return settings.speed, self.rate, math.inf
        # Slow enough for braking at the limit.
        self.rate = min(self.rate, settings.acceleration / settings.speed)
        return settings.speed, 0.25 * self.rate, settings.acceleration

    def _to_array(self, state: RobotState) -> FloatArray:
        pose = state.pose
        return np.array([*pose.position, pose.yaw, *state.velocity, state.angular_velocity[2]])

    def _to_state(self, array: FloatArray) -> RobotState:
        pose = Pose.from_yaw(array[:3], array[3])
        return RobotState(pose, array[4:7], np.array([0.0, 0.0, array[7]]))


class Unicycle(CompiledMotion):
    """A robot that drives forward and turns; its tolerance is horizontal."""

    kind = UNICYCLE

    def _limits(self) -> tuple[float, float, float]:
        settings = self.settings
        self.rate, braking = settings.approach_rate or K_RHO, 2.0
        if settings.acceleration is None:
            return settings.speed, braking, math.inf
        slowing = settings.acceleration / settings.speed
        self.rate = min(self.rate, slowing)
        return settings.speed, min(braking, 0.5 * slowing), settings.acceleration

    def _push(self, gain: float) -> Command:
        return gain, 0.0, 0.0, gain  # its inputs are forward speed and turn rate

    def _to_array(self, state: RobotState) -> FloatArray:
        yaw = state.pose.yaw
        forward = state.velocity[0] * math.cos(yaw) + state.velocity[1] * math.sin(yaw)
        return np.array([*state.pose.position, yaw, forward, state.angular_velocity[2]])

    def _to_state(self, array: FloatArray) -> RobotState:
        yaw, forward, turn = array[3:].tolist()
        velocity = np.array([forward * math.cos(yaw), forward * math.sin(yaw), 0.0])
        return RobotState(Pose.from_yaw(array[:3], yaw), velocity, np.array([0.0, 0.0, turn]))

    def squared_distance(self, position: ArrayLike, waypoint: ArrayLike) -> float:
        """Return the squared horizontal distance of two points (3,) [m^2]."""
        offset = np.asarray(position, dtype=float)[:2] - np.asarray(waypoint, dtype=float)[:2]
        return float(offset[0] * offset[0] + offset[1] * offset[1])


class Mambo(CompiledMotion):
    """The linear Mambo with 12 states, attitude and velocity loops at 200 Hz, and limits.

    Commands are limited so that the loop's overshoot does not exceed `speed`. The commanded tilt,
    which is followed without overshoot, is at most `tilt` and what `acceleration` allows.
    """

    kind = MAMBO

    def _limits(self) -> tuple[float, float, float]:
        settings = self.settings
        self.parameters = mambo.mambo_parameters(settings)
        own = self.parameters[mambo.RATE]
        slowing = mambo.GRAVITY * self.parameters[mambo.TILT] / settings.speed
        self.rate = float(min(settings.approach_rate or own, slowing))
        natural = mambo.GRAVITY * self.parameters[mambo.K_VX] / self.parameters[mambo.K_Q]
        barrier = float(min(0.18 * math.sqrt(natural), 0.5 * slowing))
        return float(self.parameters[mambo.SPEED]), barrier, math.inf

    def _push(self, gain: float) -> Command:
        # A roll torque of -k_obs tilts the robot to its left: the roll gain has the opposite sign.
        per_input = self.parameters[[mambo.K_VX, mambo.K_VY, mambo.K_VZ, mambo.K_R]].tolist()
        return tuple(gain / size for size in per_input)

    def _to_array(self, state: RobotState) -> FloatArray:
        w, x, y, z = state.pose.orientation.tolist()
        roll = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
        pitch = math.asin(min(max(2.0 * (w * y - z * x), -1.0), 1.0))
        return np.array(
            [
                *state.pose.position,
                state.pose.yaw,
                roll,
                pitch,
                *state.velocity,
                *state.angular_velocity,
            ]
        )

    def _to_state(self, array: FloatArray) -> RobotState:
        yaw, roll, pitch = array[3:6].tolist()
        return RobotState(Pose.from_rpy(array[:3], [roll, pitch, yaw]), array[6:9], array[9:])


class Quadrotor(CompiledMotion):
    """A rigid body with thrust along its axis and torques, and inner loops at 200 Hz."""

    kind = QUADROTOR

    def _limits(self) -> tuple[float, float, float]:
        settings = self.settings
        self.parameters = limits = np.zeros(6)
        acceleration = settings.acceleration or math.inf
        limits[quadrotor.SPEED] = settings.speed / 1.08
        # Horizontal and vertical acceleration share the limit.
        limits[quadrotor.LEVEL] = min(0.8 * acceleration, 100.0)
        limits[quadrotor.VERTICAL] = min(0.5 * acceleration, 0.5 * mambo.GRAVITY)
        limits[quadrotor.SLOPE] = math.tan(settings.tilt / 1.03)
        limits[quadrotor.YAW_RATE] = settings.yaw_rate
        limits[quadrotor.COUNT_FORCE] = settings.control_inputs == 'all'
        level, vertical, slope = limits[1:4]
        slowing = min(level, mambo.GRAVITY * slope, vertical)
        self.rate = float(min(settings.approach_rate or quadrotor.C1, slowing / settings.speed))
        barrier = float(min(0.15 * quadrotor.C2, 0.5 * slowing / settings.speed))
        return float(limits[quadrotor.SPEED]), barrier, math.inf

    def _push(self, gain: float) -> Command:
        # Inputs are the commanded force of the velocity stage, and the yaw torque.
        by_force = gain / (quadrotor.MASS * quadrotor.C2)
        return by_force, by_force, by_force, gain / (quadrotor.INERTIA[2] * quadrotor.C4)

    def _to_array(self, state: RobotState) -> FloatArray:
        pose = state.pose
        rest = [pose.orientation, state.velocity, state.angular_velocity]
        return np.concatenate([pose.position, [pose.yaw], *rest])

    def _to_state(self, array: FloatArray) -> RobotState:
        return RobotState(Pose(array[:3], array[4:8]), array[8:11], array[11:])
