"""Parrot Mambo: linear model of 12 states under a discrete LQR (000, section 5.1).

The set-point of the LQR leads the position by a limited distance. Then position drops out of the
feedback, u = -K_v (velocity - v) - K_a angles - K_w rates, with v = (K_p / K_v) lead: a velocity
command and a set-point at limited distance are the same thing. So the controller here turns a
waypoint into the velocity command that a driver publishes, and the body flies any such command.

Frames: `map` is ENU, body axes are forward, left, up; roll and pitch are right-handed about
them, so that pitch > 0 accelerates forward and roll > 0 to the right.
"""

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
)
from maasi_planner.motion.obstacle_term import add_obstacle_term
from maasi_planner.obstacles import Obstacles
from maasi_planner.settings import MotionSettings

FloatArray = NDArray[np.float64]

GRAVITY = 9.81
MASS = 0.063
INERTIA = (0.5829e-4, 0.7169e-4, 1.0e-4)
PERIOD = 0.005


@njit(cache=True)
def _riccati(a: FloatArray, b: FloatArray, q: FloatArray, r: float) -> FloatArray:
    """Return the gain of a discrete LQR with one input, by iterating the Riccati equation.

    Plain loops in a fixed order, so that the gain does not depend on a linear algebra library.
    """
    n = a.shape[0]
    p = np.zeros((n, n))
    for i in range(n):
        p[i, i] = q[i]
    gain = np.zeros(n)
    pa = np.zeros((n, n))
    pb = np.zeros(n)
    for _ in range(200_000):
        for i in range(n):
            pb[i] = 0.0
            for k in range(n):
                pb[i] += p[i, k] * b[k]
            for j in range(n):
                pa[i, j] = 0.0
                for k in range(n):
                    pa[i, j] += p[i, k] * a[k, j]
        size = r
        for i in range(n):
            size += b[i] * pb[i]
        change = 0.0
        for j in range(n):
            value = 0.0
            for k in range(n):
                value += b[k] * pa[k, j]
            value /= size
            change = max(change, abs(value - gain[j]) / (abs(value) + 1e-300))
            gain[j] = value
        for i in range(n):
            for j in range(i + 1):
                value = 0.0
                for k in range(n):
                    value += a[k, i] * pa[k, j]
                value -= gain[j] * gain[i] * size
                if i == j:
                    value += q[i]
                p[i, j] = value
                p[j, i] = value
        if change < 1e-13:
            break
    return gain


def lateral_system(inertia: float, sign: float) -> tuple[FloatArray, FloatArray]:
    """Return A (4, 4) and B (4,) of position, velocity, angle and rate on one axis, per PERIOD."""
    h = PERIOD
    g = sign * GRAVITY
    a = np.array(
        [
            [1.0, h, g * h**2 / 2, g * h**3 / 6],
            [0.0, 1.0, g * h, g * h**2 / 2],
            [0.0, 0.0, 1.0, h],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )
    b = np.array([g * h**4 / 24, g * h**3 / 6, h**2 / 2, h]) / inertia
    return a, b


def double_integrator(inertia: float) -> tuple[FloatArray, FloatArray]:
    """Return A (2, 2) and B (2,) of a position and its velocity, per PERIOD."""
    h = PERIOD
    return np.array([[1.0, h], [0.0, 1.0]]), np.array([h**2 / 2, h]) / inertia


def lqr_gains(settings: MotionSettings) -> dict[str, FloatArray]:
    """Return the LQR gains by chain: `pitch` and `roll` (4,), `yaw` and `height` (2,).

    The 12-state model falls apart into these chains, and with diagonal weights so does its LQR.
    The paper prints four weights, 1/15, 1000, 1000, 100, and does not say which; read here as
    those of the inputs with the first one garbled (it would make roll 15,000 times cheaper than
    pitch), so that roll has the weight of pitch, and states have weight 1.
    """
    q = settings.state_weights
    r = settings.input_weights
    a, b = lateral_system(INERTIA[1], 1.0)
    pitch = _riccati(a, b, np.array([q[0], q[6], q[4], q[10]]), r[1])
    a, b = lateral_system(INERTIA[0], -1.0)
    roll = _riccati(a, b, np.array([q[1], q[7], q[3], q[9]]), r[0])
    a, b = double_integrator(MASS)
    height = _riccati(a, b, np.array([q[2], q[8]]), r[3])
    a, b = double_integrator(INERTIA[2])
    yaw = _riccati(a, b, np.array([q[5], q[11]]), r[2])
    return {'pitch': pitch, 'roll': roll, 'height': height, 'yaw': yaw}


def _response_size(a: FloatArray, b: FloatArray, gain: FloatArray) -> tuple[FloatArray, float]:
    """Return the impulse response from velocity command to velocity, and the tilt's peak gain."""
    state = np.zeros(3)
    a3, b3 = a[1:, 1:], b[1:]
    responses = []
    tilt = 0.0
    drive = gain[0]
    for k in range(40_000):
        push = -sum(float(gain[i] * state[i]) for i in range(3)) + (drive if k == 0 else 0.0)
        state = np.array(
            [sum(float(a3[i, j] * state[j]) for j in range(3)) + b3[i] * push for i in range(3)]
        )
        responses.append(float(state[0]))
        if k > 400 and abs(state).max() < 1e-12:
            break
    angle = np.zeros(2)
    for k in range(4000):
        push = -float(gain[1] * angle[0] + gain[2] * angle[1])
        if k == 0:
            push += float(gain[1])
        angle = np.array([angle[0] + a3[1, 2] * angle[1] + b3[1] * push, angle[1] + b3[2] * push])
        tilt += abs(float(angle[0]))
    return np.array(responses), tilt


# Entries of the parameter array of `mambo_step`.
K_VX, K_PITCH, K_Q, K_VY, K_ROLL, K_P, K_VZ, K_R = range(8)
TILT, LIFT, SPEED, YAW_RATE, COUNT_FORCE = range(8, 13)


# Rows of the tables of `closed_loop`: the chains, and the entries of each.
PITCH_CHAIN, ROLL_CHAIN, HEIGHT_CHAIN = range(3)
MATRIX, TRAVEL, COST, BOUND, ENTRIES = 0, 9, 12, 21, 24


@njit(cache=True)
def _chain(
    row: FloatArray,
    gains: FloatArray,
    gravity: float,
    inertia: float,
    periods: int,
    h: float,
) -> None:
    """Fill one row of `closed_loop` from the response to each unit deviation."""
    states = np.zeros((3, 3))
    inputs = np.zeros(3)
    for j in range(3):
        states[j, j] = 1.0
    for _ in range(periods):
        for j in range(3):
            v, a, w = states[j, 0], states[j, 1], states[j, 2]
            row[BOUND + j] = max(row[BOUND + j], abs(v))
            u = -gains[0] * v - gains[1] * a - gains[2] * w
            inputs[j] = u
            s = u / inertia
            row[TRAVEL + j] += v * h + gravity * (
                a * h * h / 2.0 + w * h * h * h / 6.0 + s * h * h * h * h / 24.0
            )
            states[j, 0] = v + gravity * (a * h + w * h * h / 2.0 + s * h * h * h / 6.0)
            states[j, 1] = a + w * h + s * h * h / 2.0
            states[j, 2] = w + s * h
        for i in range(3):
            for j in range(3):
                row[COST + 3 * i + j] += inputs[i] * inputs[j]
    for i in range(3):
        for j in range(3):
            row[MATRIX + 3 * i + j] = states[j, i]


@njit(cache=True)
def closed_loop(parameters: FloatArray, periods: int, h: float) -> FloatArray:
    """Return what `periods` control periods do at once while nothing is cut off, (3, 24).

    For deviations s = (velocity - command, angle, rate) of a chain: the matrix of the deviations
    afterwards, the travel beyond command times time, the sum of u'u as a quadratic form, and the
    largest |velocity - command| on the way for each unit deviation.
    """
    out = np.zeros((3, ENTRIES))
    gains = np.zeros(3)
    gains[:] = parameters[0:3]
    _chain(out[PITCH_CHAIN], gains, GRAVITY, INERTIA[1], periods, h)
    gains[:] = parameters[3:6]
    _chain(out[ROLL_CHAIN], gains, -GRAVITY, INERTIA[0], periods, h)
    # The height has one deviation only.
    v = 1.0
    height = out[HEIGHT_CHAIN]
    for _ in range(periods):
        force = -parameters[6] * v
        height[COST] += force * force
        height[TRAVEL] += v * h + force / MASS * h * h / 2.0
        v += force / MASS * h
    height[MATRIX] = v
    height[BOUND] = 1.0
    return out


@njit(cache=True)
def _lateral(
    row: FloatArray, v: float, a: float, w: float
) -> tuple[float, float, float, float, float]:
    """Return the deviations afterwards, the travel, and the sum of u'u of one chain."""
    return (
        row[0] * v + row[1] * a + row[2] * w,
        row[3] * v + row[4] * a + row[5] * w,
        row[6] * v + row[7] * a + row[8] * w,
        row[9] * v + row[10] * a + row[11] * w,
        row[12] * v * v
        + row[16] * a * a
        + row[20] * w * w
        + 2.0 * (row[13] * v * a + row[14] * v * w + row[17] * a * w),
    )


@njit(cache=True)
def mambo_step(
    state: FloatArray,
    command: FloatArray,
    parameters: FloatArray,
    table: FloatArray,
    periods: int,
    h: float,
) -> float:
    """Fly `periods` control periods of `h` seconds, in place; return the sum of u'u.

    Parameters
    ----------
    state : (12,) array
        Position, roll pitch yaw, velocity (map), angular velocity (body).
    command : (4,) array
        vx, vy, vz [m/s, axes turned by the heading], yaw rate [rad/s].
    parameters : (13,) array
        Gains and limits.
    table : (3, 24) array
        From `closed_loop` for the same periods: where no limit acts, all periods at once.
    """
    cx = command[0]
    cy = command[1]
    cz = command[2]
    size = math.sqrt(cx * cx + cy * cy + cz * cz)
    if size > parameters[SPEED]:
        scale = parameters[SPEED] / size
        cx *= scale
        cy *= scale
        cz *= scale
    cr = min(max(command[3], -parameters[YAW_RATE]), parameters[YAW_RATE])
    x = state[0]
    y = state[1]
    z = state[2]
    roll = state[3]
    pitch = state[4]
    yaw = state[5]
    vz = state[8]
    p = state[9]
    q = state[10]
    r = state[11]
    cos_yaw = math.cos(yaw)
    sin_yaw = math.sin(yaw)
    # Velocity along the heading and to its left.
    vf = cos_yaw * state[6] + sin_yaw * state[7]
    vl = cos_yaw * state[7] - sin_yaw * state[6]
    to_pitch = parameters[K_VX] / parameters[K_PITCH]
    to_roll = parameters[K_VY] / parameters[K_ROLL]
    tilt = parameters[TILT]
    h2 = h * h / 2.0
    h3 = h * h * h / 6.0
    h4 = h * h * h * h / 24.0
    turning = cr != 0.0 or r != 0.0
    cost = 0.0
    if not turning:
        df = vf - cx
        dl = vl - cy
        dz = vz - cz
        front = table[PITCH_CHAIN]
        side = table[ROLL_CHAIN]
        up = table[HEIGHT_CHAIN]
        most_front = (
            front[BOUND] * abs(df) + front[BOUND + 1] * abs(pitch) + front[BOUND + 2] * abs(q)
        )
        most_side = side[BOUND] * abs(dl) + side[BOUND + 1] * abs(roll) + side[BOUND + 2] * abs(p)
        if (
            abs(to_pitch) * most_front <= tilt
            and abs(to_roll) * most_side <= tilt
            and parameters[K_VZ] * abs(dz) <= parameters[LIFT]
        ):
            time = periods * h
            df, pitch, q, forward, spent = _lateral(front, df, pitch, q)
            cost += spent
            dl, roll, p, left, spent = _lateral(side, dl, roll, p)
            cost += spent
            cost += parameters[COUNT_FORCE] * up[COST] * dz * dz
            forward += cx * time
            left += cy * time
            state[0] = x + cos_yaw * forward - sin_yaw * left
            state[1] = y + sin_yaw * forward + cos_yaw * left
            state[2] = z + cz * time + up[TRAVEL] * dz
            vf = cx + df
            vl = cy + dl
            state[3] = roll
            state[4] = pitch
            state[6] = cos_yaw * vf - sin_yaw * vl
            state[7] = sin_yaw * vf + cos_yaw * vl
            state[8] = cz + up[MATRIX] * dz
            state[9] = p
            state[10] = q
            return cost
    for _ in range(periods):
        pitch_wanted = min(max(to_pitch * (cx - vf), -tilt), tilt)
        roll_wanted = min(max(to_roll * (cy - vl), -tilt), tilt)
        u_pitch = parameters[K_PITCH] * (pitch_wanted - pitch) - parameters[K_Q] * q
        u_roll = parameters[K_ROLL] * (roll_wanted - roll) - parameters[K_P] * p
        force = parameters[K_VZ] * (cz - vz)
        force = min(max(force, -parameters[LIFT]), parameters[LIFT])
        u_yaw = parameters[K_R] * (cr - r)
        cost += u_roll * u_roll + u_pitch * u_pitch + u_yaw * u_yaw
        cost += parameters[COUNT_FORCE] * force * force
        aq = u_pitch / INERTIA[1]
        ap = u_roll / INERTIA[0]
        ar = u_yaw / INERTIA[2]
        az = force / MASS
        forward = vf * h + GRAVITY * (pitch * h2 + q * h3 + aq * h4)
        left = vl * h - GRAVITY * (roll * h2 + p * h3 + ap * h4)
        x += cos_yaw * forward - sin_yaw * left
        y += sin_yaw * forward + cos_yaw * left
        z += vz * h + az * h2
        vf += GRAVITY * (pitch * h + q * h2 + aq * h3)
        vl -= GRAVITY * (roll * h + p * h2 + ap * h3)
        vz += az * h
        pitch += q * h + aq * h2
        q += aq * h
        roll += p * h + ap * h2
        p += ap * h
        if turning:
            turn = r * h + ar * h2
            yaw += turn
            r += ar * h
            # The velocity stays what it is in the map while the axes turn under it.
            ct = math.cos(turn)
            st = math.sin(turn)
            forward = ct * vf + st * vl
            vl = ct * vl - st * vf
            vf = forward
            cos_yaw = math.cos(yaw)
            sin_yaw = math.sin(yaw)
    state[0] = x
    state[1] = y
    state[2] = z
    state[3] = roll
    state[4] = pitch
    state[5] = yaw
    state[6] = cos_yaw * vf - sin_yaw * vl
    state[7] = sin_yaw * vf + cos_yaw * vl
    state[8] = vz
    state[9] = p
    state[10] = q
    state[11] = r
    return cost


@njit(cache=True)
def _roll_out(
    start: FloatArray,
    waypoints: FloatArray,
    parameters: FloatArray,
    rate: float,
    barrier: float,
    face_travel: bool,
    tolerance: float,
    circles: FloatArray,
    vertices: FloatArray,
    tables: FloatArray,
    clearance: float,
    term: int,
    term_distance: float,
    term_gain: float,
    table: FloatArray,
    periods: int,
    h: float,
    limit: int,
    positions: FloatArray,
    yaws: FloatArray,
    lengths: NDArray[np.int64],
    costs: FloatArray,
) -> None:
    work = np.zeros((2, 3))
    command = np.zeros(4)
    state = np.zeros(12)
    none = np.zeros((0, 5))
    for w in range(waypoints.shape[0]):
        state[:] = start
        goal = waypoints[w]
        length = limit + 1
        cost = 0.0
        for k in range(limit + 1):
            positions[w, k, 0] = state[0]
            positions[w, k, 1] = state[1]
            positions[w, k, 2] = state[2]
            yaws[w, k] = state[5]
            gap = math.sqrt(
                (state[0] - goal[0]) ** 2 + (state[1] - goal[1]) ** 2 + (state[2] - goal[2]) ** 2
            )
            if gap <= tolerance:
                length = k
                break
            sideways_command(
                state[:3],
                state[5],
                goal,
                rate,
                parameters[SPEED],
                barrier,
                np.inf,
                face_travel,
                parameters[YAW_RATE],
                circles if term == 0 else none,
                vertices,
                tables[w],
                clearance,
                work,
                command,
            )
            if term > 0:
                add_obstacle_term(
                    state[:3],
                    state[5],
                    circles,
                    term,
                    term_distance,
                    term_gain,
                    parameters,
                    command,
                )
            cost += mambo_step(state, command, parameters, table, periods, h)
        lengths[w] = length
        costs[w] = cost


def control_periods(dt: float) -> tuple[int, float]:
    """Return how many control periods make `dt` [s], and their length, about PERIOD [s]."""
    periods = max(1, round(dt / PERIOD))
    return periods, dt / periods


class MamboBody(Body):
    """The 12-state linear Mambo, its attitude and velocity loops at 200 Hz, and its limits.

    Speed, acceleration and tilt stay within the settings: commands are cut to a speed that the
    loop's overshoot cannot carry beyond `speed`, and the tilt asked for to the smaller of `tilt`
    and what `acceleration` allows; the tilt follows it without overshoot.

    Parameters
    ----------
    settings : MotionSettings
        Limits and weights.
    state : RobotState
        Where it starts, hovering or moving.

    Attributes
    ----------
    state : (12,) array
        Position [m, map], roll pitch yaw [rad], velocity [m/s, map], angular velocity [rad/s].
    """

    def __init__(self, settings: MotionSettings, state: RobotState) -> None:
        self.settings = settings
        self.parameters = mambo_parameters(settings)
        self.state = twelve_states(state)
        self._periods = (0, 0.0)
        self._table = np.zeros((3, ENTRIES))

    def step(self, velocity_command: ArrayLike, dt: float) -> None:
        """See `Body.step`."""
        periods, h = control_periods(check_step(dt))
        if (periods, h) != self._periods:
            self._periods = (periods, h)
            self._table = closed_loop(self.parameters, periods, h)
        mambo_step(
            self.state,
            check_command(velocity_command),
            self.parameters,
            self._table,
            periods,
            h,
        )

    def robot_state(self) -> RobotState:
        """See `Body.robot_state`."""
        return RobotState(pose_of(self.state), self.state[6:9].copy(), self.state[9:12].copy())


def pose_of(state: FloatArray) -> Pose:
    """Return the pose of a (12,) state."""
    half = 0.5 * state[3:6]
    (cr, cp, cy), (sr, sp, sy) = np.cos(half), np.sin(half)
    return Pose(
        state[:3].copy(),
        np.array(
            [
                cr * cp * cy + sr * sp * sy,
                sr * cp * cy - cr * sp * sy,
                cr * sp * cy + sr * cp * sy,
                cr * cp * sy - sr * sp * cy,
            ]
        ),
    )


def twelve_states(state: RobotState) -> FloatArray:
    """Return the (12,) state of a robot state."""
    w, x, y, z = state.pose.orientation
    out = np.zeros(12)
    out[:3] = state.pose.position
    out[3] = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    out[4] = math.asin(min(max(2.0 * (w * y - z * x), -1.0), 1.0))
    out[5] = state.pose.yaw
    out[6:9] = state.velocity
    out[9:12] = state.angular_velocity
    return out


_PARAMETERS: dict[str, FloatArray] = {}


def mambo_parameters(settings: MotionSettings) -> FloatArray:
    """Return the parameter array of `mambo_step` for settings."""
    key = settings.model_dump_json()
    if key not in _PARAMETERS:
        _PARAMETERS[key] = _mambo_parameters(settings)
    return _PARAMETERS[key].copy()


def _mambo_parameters(settings: MotionSettings) -> FloatArray:
    gains = lqr_gains(settings)
    out = np.zeros(13)
    out[K_VX], out[K_PITCH], out[K_Q] = gains['pitch'][1:]
    # Roll to the right is positive, left is positive: the sign of the velocity gain turns.
    out[K_VY], out[K_ROLL], out[K_P] = gains['roll'][1:]
    out[K_VZ] = gains['height'][1]
    out[K_R] = gains['yaw'][1]
    pitch_response, pitch_tilt = _response_size(
        *lateral_system(INERTIA[1], 1.0), gains['pitch'][1:]
    )
    roll_response, roll_tilt = _response_size(*lateral_system(INERTIA[0], -1.0), gains['roll'][1:])
    overshoot = max(float(np.abs(pitch_response).sum()), float(np.abs(roll_response).sum()), 1.0)
    acceleration = settings.acceleration or math.inf
    # Both axes together stay below the limits.
    tilt = min(settings.tilt, acceleration / GRAVITY / math.sqrt(2.0))
    out[TILT] = tilt / max(pitch_tilt, roll_tilt)
    out[LIFT] = MASS * min(acceleration, GRAVITY)
    # A little less, as the axes differ and may turn under a command.
    out[SPEED] = settings.speed / (1.015 * overshoot)
    out[YAW_RATE] = settings.yaw_rate
    out[COUNT_FORCE] = 1.0 if settings.control_inputs == 'all' else 0.0
    return out


class Mambo(MotionModel):
    """Controller and prediction of `MamboBody`."""

    def __init__(
        self,
        settings: MotionSettings,
        obstacles: Obstacles | None = None,
        radius: float = 0.0,
    ) -> None:
        super().__init__(settings, obstacles, radius)
        self.parameters = mambo_parameters(settings)
        gains = lqr_gains(settings)
        own = min(
            gains['pitch'][0] / gains['pitch'][1],
            gains['roll'][0] / gains['roll'][1],
            gains['height'][0] / gains['height'][1],
        )
        slowing = GRAVITY * self.parameters[TILT] / settings.speed
        self.rate = float(min(settings.approach_rate or own, slowing))
        natural = math.sqrt(GRAVITY * self.parameters[K_VX] / self.parameters[K_Q])
        self.barrier = float(min(0.18 * natural, 0.5 * slowing))
        self._term = ('none', 'printed', 'away').index(settings.obstacle_term)

    def roll_out(
        self, state: RobotState, waypoints: FloatArray, step: float, out: Trajectories
    ) -> None:
        """See `MotionModel.roll_out`."""
        periods, h = control_periods(step)
        _roll_out(
            twelve_states(state),
            waypoints,
            self.parameters,
            self.rate,
            self.barrier,
            self.settings.heading == 'travel',
            self.settings.tolerance,
            self.keep_out.circles,
            self.keep_out.vertices,
            self._tables(waypoints),
            self.keep_out.clearance,
            self._term,
            self.settings.obstacle_distance,
            self.settings.obstacle_gain,
            closed_loop(self.parameters, periods, h),
            periods,
            h,
            out.positions.shape[1] - 1,
            out.positions,
            out.yaws,
            out.lengths,
            out.control_cost,
        )

    def command(self, state: RobotState, waypoint: ArrayLike) -> FloatArray:
        """See `MotionModel.command`: the LQR's set-point as a velocity command."""
        goal = check_waypoints(np.asarray(waypoint, dtype=float)[None, :])[0]
        out = np.zeros(4)
        position = np.array(state.pose.position)
        yaw = state.pose.yaw
        circles = self.keep_out.circles
        sideways_command(
            position,
            yaw,
            goal,
            self.rate,
            self.parameters[SPEED],
            self.barrier,
            math.inf,
            self.settings.heading == 'travel',
            self.parameters[YAW_RATE],
            circles if self._term == 0 else np.zeros((0, 5)),
            self.keep_out.vertices,
            self._table(goal),
            self.keep_out.clearance,
            np.zeros((2, 3)),
            out,
        )
        if self._term:
            add_obstacle_term(
                position,
                yaw,
                circles,
                self._term,
                self.settings.obstacle_distance,
                self.settings.obstacle_gain,
                self.parameters,
                out,
            )
        return out

    def body(self, state: RobotState) -> MamboBody:
        """See `MotionModel.body`."""
        return MamboBody(self.settings, state)
