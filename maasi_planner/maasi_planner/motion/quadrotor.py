"""Full nonlinear quadrotor under backstepping (003, section 4, after Sun and others, 2014).

The stages of the backstepping, each the virtual control of the one before:

    position      v_d = -c1 (p - p_d)                              the velocity command
    velocity      a_d = c2 (v_d - v),  f = m (a_d + g e3)          force asked for
    attitude      omega_d = c3 (b3 x f / |f|)                      turns the thrust b3 towards f
    turn rates    tau = omega x J omega + J c4 (omega_d - omega)   torques

The first stage is the controller's (`command`), the others fly any velocity command. Derivatives
of the virtual controls are left out, as c1 < c2 < c3 < c4 are far enough apart. The papers do not
print mass, inertia and gains; those here are of a quadrotor of 1.2 kg.
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
    RobotState,
    SteeredMotion,
    Trajectories,
    TrajectoryArrays,
    add_position,
    check_command,
    check_step,
)
from maasi_planner.motion.mambo_dynamics import GRAVITY, control_periods
from maasi_planner.motion.steering import Steering, Surroundings, sideways_command
from maasi_planner.obstacles import Obstacles
from maasi_planner.settings import MotionSettings

Vector = tuple[float, float, float]

MASS = 1.2
INERTIA = (0.0123, 0.0123, 0.0224)
C1, C2, C3, C4 = 0.8, 2.5, 10.0, 45.0
# Entries of the array of limits.
SPEED, LEVEL, VERTICAL, SLOPE, YAW_RATE, COUNT_FORCE = range(6)


@njit(cache=True, forceinline=True)
def _rotation(state: FloatArray) -> tuple[Vector, Vector, Vector]:
    """Return the body axes forward, left and up in the map: columns of the rotation matrix."""
    w, x, y, z = state[3], state[4], state[5], state[6]
    return (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)),
        (2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x)),
        (2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)),
    )


@njit(cache=True, forceinline=True)
def _force(state: FloatArray, command: FloatArray, limits: FloatArray) -> Vector:
    """Return the force per mass that a velocity command asks for, within the limits [m/s^2]."""
    size = math.sqrt(command[0] ** 2 + command[1] ** 2 + command[2] ** 2)
    scale = 1.0
    if size > limits[SPEED]:
        scale = limits[SPEED] / size
    b1x, b1y, _ = _rotation(state)[0]
    level = math.sqrt(b1x * b1x + b1y * b1y)
    cos_yaw = b1x / level if level > 1e-9 else 1.0
    sin_yaw = b1y / level if level > 1e-9 else 0.0
    vx = scale * (cos_yaw * command[0] - sin_yaw * command[1])
    vy = scale * (sin_yaw * command[0] + cos_yaw * command[1])
    vz = scale * command[2]
    ax = C2 * (vx - state[7])
    ay = C2 * (vy - state[8])
    az = C2 * (vz - state[9])
    az = min(max(az, -limits[VERTICAL]), limits[VERTICAL])
    most = min(limits[LEVEL], limits[SLOPE] * (GRAVITY + az))
    asked = math.sqrt(ax * ax + ay * ay)
    if asked > most:
        ax *= most / asked
        ay *= most / asked
    return ax, ay, GRAVITY + az


@njit(cache=True, forceinline=True)
def _inputs(state: FloatArray, force: Vector, turn: float) -> tuple[float, Vector]:
    """Return thrust [N] and torques [N m] that turn the thrust towards `force`."""
    (b1x, b1y, b1z), (b2x, b2y, b2z), (b3x, b3y, b3z) = _rotation(state)
    ax, ay, fz = force
    strength = math.sqrt(ax * ax + ay * ay + fz * fz)
    nx = ax / strength
    ny = ay / strength
    nz = fz / strength
    thrust = MASS * max(0.0, ax * b3x + ay * b3y + fz * b3z)
    # The way from b3 to the force, b3 x n, in body axes.
    ex = b3y * nz - b3z * ny
    ey = b3z * nx - b3x * nz
    ez = b3x * ny - b3y * nx
    wanted_x = C3 * (b1x * ex + b1y * ey + b1z * ez)
    wanted_y = C3 * (b2x * ex + b2y * ey + b2z * ez)
    p, q, r = state[10], state[11], state[12]
    return thrust, (
        INERTIA[0] * C4 * (wanted_x - p) + (INERTIA[2] - INERTIA[1]) * q * r,
        INERTIA[1] * C4 * (wanted_y - q) + (INERTIA[0] - INERTIA[2]) * r * p,
        INERTIA[2] * C4 * (turn - r) + (INERTIA[1] - INERTIA[0]) * p * q,
    )


@njit(cache=True, forceinline=True)
def _move(state: FloatArray, thrust: float, torque: Vector, h: float) -> None:
    """Integrate the rigid body for `h` seconds, in place: speeds before positions."""
    p, q, r = state[10], state[11], state[12]
    new_p = p + h * (torque[0] - (INERTIA[2] - INERTIA[1]) * q * r) / INERTIA[0]
    new_q = q + h * (torque[1] - (INERTIA[0] - INERTIA[2]) * r * p) / INERTIA[1]
    new_r = r + h * (torque[2] - (INERTIA[1] - INERTIA[0]) * p * q) / INERTIA[2]
    b3x, b3y, b3z = _rotation(state)[2]
    dvx = h * thrust / MASS * b3x
    dvy = h * thrust / MASS * b3y
    dvz = h * (thrust / MASS * b3z - GRAVITY)
    state[0] += h * (state[7] + 0.5 * dvx)
    state[1] += h * (state[8] + 0.5 * dvy)
    state[2] += h * (state[9] + 0.5 * dvz)
    state[7] += dvx
    state[8] += dvy
    state[9] += dvz
    # Turn by the mean rate over the period.
    _rotate(state, 0.5 * (p + new_p), 0.5 * (q + new_q), 0.5 * (r + new_r), h)
    state[10] = new_p
    state[11] = new_q
    state[12] = new_r


@njit(cache=True, forceinline=True)
def _rotate(state: FloatArray, p: float, q: float, r: float, h: float) -> None:
    """Turn the attitude in place by constant rates p, q, r [rad/s, body] for `h` seconds."""
    w, x, y, z = state[3], state[4], state[5], state[6]
    rate = math.sqrt(p * p + q * q + r * r)
    half = 0.5 * rate * h
    c = math.cos(half)
    s = 0.5 * h if half < 1e-9 else math.sin(half) / rate
    gx = p * s
    gy = q * s
    gz = r * s
    nw = w * c - x * gx - y * gy - z * gz
    nx = w * gx + x * c + y * gz - z * gy
    ny = w * gy - x * gz + y * c + z * gx
    nz = w * gz + x * gy - y * gx + z * c
    norm = math.sqrt(nw * nw + nx * nx + ny * ny + nz * nz)
    state[3] = nw / norm
    state[4] = nx / norm
    state[5] = ny / norm
    state[6] = nz / norm


@njit(cache=True)
def quadrotor_step(
    state: FloatArray, command: FloatArray, limits: FloatArray, periods: int, h: float
) -> float:
    """Fly `periods` control periods of `h` seconds, in place; return the sum of u'u."""
    turn = min(max(command[3], -limits[YAW_RATE]), limits[YAW_RATE])
    cost = 0.0
    for _ in range(periods):
        thrust, torque = _inputs(state, _force(state, command, limits), turn)
        tx, ty, tz = torque
        cost += tx * tx + ty * ty + tz * tz
        extra = thrust - MASS * GRAVITY
        cost += limits[COUNT_FORCE] * extra * extra
        _move(state, thrust, torque, h)
    return cost


@njit(cache=True)
def heading_of(state: FloatArray) -> float:
    """Return the heading of a (13,) state, radians."""
    w, x, y, z = state[3], state[4], state[5], state[6]
    return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


@njit(cache=True)
def _roll_out(
    start: FloatArray,
    waypoints: FloatArray,
    tables: FloatArray,
    steering: Steering,
    around: Surroundings,
    limits: FloatArray,
    periods: int,
    h: float,
    out: TrajectoryArrays,
) -> None:
    work = np.zeros((2, 3))
    command = np.zeros(4)
    state = np.zeros(13)
    limit = out.positions.shape[1] - 1
    for w in range(waypoints.shape[0]):
        state[:] = start
        goal = waypoints[w]
        length = limit + 1
        cost = 0.0
        for k in range(limit + 1):
            yaw = heading_of(state)
            add_position(out, w, k, state[0], state[1], state[2], yaw)
            square = 0.0
            for axis in range(3):
                square += (state[axis] - goal[axis]) ** 2
            if square <= steering.tolerance * steering.tolerance:
                length = k
                break
            sideways_command(state, yaw, goal, tables[w], steering, around, work, command)
            cost += quadrotor_step(state, command, limits, periods, h)
        out.lengths[w] = length
        out.control_cost[w] = cost


def thirteen_states(state: RobotState) -> FloatArray:
    """Return the (13,) state of a robot state."""
    return np.concatenate(
        [state.pose.position, state.pose.orientation, state.velocity, state.angular_velocity]
    )


def quadrotor_limits(settings: MotionSettings) -> FloatArray:
    """Return the array of limits of `quadrotor_step`.

    Level and vertical acceleration share the limit, so that together they stay within it.
    """
    out = np.zeros(6)
    out[SPEED] = settings.speed / 1.08
    acceleration = settings.acceleration or math.inf
    out[LEVEL] = min(0.8 * acceleration, 100.0)
    out[VERTICAL] = min(0.5 * acceleration, 0.5 * GRAVITY)
    out[SLOPE] = math.tan(settings.tilt / 1.03)
    out[YAW_RATE] = settings.yaw_rate
    out[COUNT_FORCE] = 1.0 if settings.control_inputs == 'all' else 0.0
    return out


class QuadrotorBody(Body):
    """A rigid body with thrust along its axis and torques, and its inner loops at 200 Hz.

    state (13,): position [m, map], quaternion w x y z,
    velocity [m/s, map], angular velocity [rad/s, body].
    """

    def __init__(self, settings: MotionSettings, state: RobotState) -> None:
        self.settings = settings
        self.limits = quadrotor_limits(settings)
        self.state = thirteen_states(state)

    def step(self, velocity_command: ArrayLike, dt: float) -> None:
        """See `Body.step`."""
        periods, h = control_periods(check_step(dt))
        quadrotor_step(self.state, check_command(velocity_command), self.limits, periods, h)

    def robot_state(self) -> RobotState:
        """See `Body.robot_state`."""
        return RobotState(
            Pose(self.state[:3].copy(), self.state[3:7].copy()),
            self.state[7:10].copy(),
            self.state[10:13].copy(),
        )


class Quadrotor(SteeredMotion):
    """Controller and prediction of `QuadrotorBody`."""

    def __init__(
        self, settings: MotionSettings, obstacles: Obstacles | None = None, radius: float = 0.0
    ) -> None:
        super().__init__(settings, obstacles, radius)
        self.limits = quadrotor_limits(settings)
        slowing = min(self.limits[LEVEL], GRAVITY * self.limits[SLOPE], self.limits[VERTICAL])
        self.rate = float(min(settings.approach_rate or C1, slowing / settings.speed))
        self.barrier = float(min(0.15 * C2, 0.5 * slowing / settings.speed))
        self.steering = Steering(
            self.rate,
            float(self.limits[SPEED]),
            self.barrier,
            math.inf,
            settings.heading == 'travel',
            float(self.limits[YAW_RATE]),
            settings.tolerance,
        )

    def roll_out(
        self, state: RobotState, waypoints: FloatArray, step: float, out: Trajectories
    ) -> None:
        """See `MotionModel.roll_out`."""
        periods, h = control_periods(step)
        _roll_out(
            thirteen_states(state),
            waypoints,
            self._tables(waypoints),
            self.steering,
            self.surroundings,
            self.limits,
            periods,
            h,
            out.arrays(),
        )

    def body(self, state: RobotState) -> QuadrotorBody:
        """See `MotionModel.body`."""
        return QuadrotorBody(self.settings, state)
