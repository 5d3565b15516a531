"""Parrot Mambo: linear model of 12 states under a discrete LQR (000, section 5.1).

The set-point of the LQR leads the position by a limited distance. The position then cancels in the
feedback, u = -K_v (velocity - v) - K_a angles - K_w rates, with v = (K_p / K_v) lead: a velocity
command and a set-point at limited distance are equivalent. The controller turns a waypoint into the
velocity command of the driver, and the body follows any such command.

Frames: `map` is ENU, body axes are forward, left, up; roll and pitch are right-handed about them,
so that pitch > 0 accelerates forward and roll > 0 to the right.

state (12,): position [m, map], yaw, roll, pitch [rad], velocity [m/s, map], angular velocity
[rad/s].
"""

import math

import numpy as np
from numba import njit

from maasi_filter.arrays import FloatArray
from maasi_planner.motion.steering import Command, turned
from maasi_planner.obstacles import norm
from maasi_planner.settings import MotionSettings

GRAVITY = 9.81
MASS = 0.063
INERTIA = (0.5829e-4, 0.7169e-4, 1.0e-4)
PERIOD = 0.005


@njit(cache=True)
def _product(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return a b in plain sums, independent of linear algebra libraries."""
    out = np.zeros((a.shape[0], b.shape[1]))
    for i in range(a.shape[0]):
        for j in range(b.shape[1]):
            for k in range(a.shape[1]):
                out[i, j] += a[i, k] * b[k, j]
    return out


@njit(cache=True)
def _riccati(a: FloatArray, b: FloatArray, q: FloatArray, r: float) -> FloatArray:
    """Return the gain of a discrete LQR with one input, by iterating the Riccati equation."""
    p, gain, column = np.diag(q), np.zeros(len(q)), b.reshape(-1, 1)
    for _ in range(200_000):
        pa, pb, size = _product(p, a), _product(p, column), r
        for i in range(len(q)):
            size += b[i] * pb[i, 0]
        before, gain = gain, _product(b.reshape(1, -1), pa)[0] / size
        p = _product(a.T.copy(), pa) - np.outer(gain, gain) * size + np.diag(q)
        # Symmetric in spite of rounding.
        p = np.tril(p) + np.tril(p, -1).T
        if (np.abs(gain - before) / (np.abs(gain) + 1e-300)).max() < 1e-13:
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

    The 12-state model decomposes into these chains and, with diagonal weights, so does its LQR. The
    paper prints four weights, 1/15, 1000, 1000, 100, without naming them. They are read as weights
    of the inputs with an error in the first one (roll would be 15,000 times cheaper than pitch):
    roll has the weight of pitch, and states have weight 1.
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


def _dot(a: list[float], b: list[float]) -> float:
    return sum(x * y for x, y in zip(a, b, strict=True))


def _response_size(a: FloatArray, b: FloatArray, gain: FloatArray) -> tuple[FloatArray, float]:
    """Return the impulse response from commanded to actual velocity, and the tilt's peak gain."""
    # Lists: many small steps are slow in NumPy.
    rows, inputs, weights = a[1:, 1:].tolist(), b[1:].tolist(), gain.tolist()
    state = [0.0, 0.0, 0.0]
    responses = []
    tilt = 0.0
    for k in range(40_000):
        push = -_dot(weights, state) + (weights[0] if k == 0 else 0.0)
        state = [_dot(row, state) + size * push for row, size in zip(rows, inputs, strict=True)]
        responses.append(state[0])
        if k > 400 and max(map(abs, state)) < 1e-12:
            break
    angle, rate = 0.0, 0.0
    for k in range(4000):
        push = -(weights[1] * angle + weights[2] * rate)
        if k == 0:
            push += weights[1]
        angle, rate = angle + rows[1][2] * rate + inputs[1] * push, rate + inputs[2] * push
        tilt += abs(angle)
    return np.array(responses), tilt


# Entries of the parameter array of `mambo_step`.
K_VX, K_PITCH, K_Q, K_VY, K_ROLL, K_P, K_VZ, K_R = range(8)
TILT, LIFT, SPEED, YAW_RATE, COUNT_FORCE = range(8, 13)
RATE = 13  # speed per remaining distance of the position loop [1/s]


_PARAMETERS: dict[str, FloatArray] = {}


def mambo_parameters(settings: MotionSettings) -> FloatArray:
    """Return the parameter array of `mambo_step`."""
    key = settings.model_dump_json(exclude={'clearance'})
    if key in _PARAMETERS:
        return _PARAMETERS[key].copy()
    gains = lqr_gains(settings)
    out = np.zeros(14)
    out[K_VX], out[K_PITCH], out[K_Q] = gains['pitch'][1:]
    # Roll is positive to the right, velocity to the left: the gain changes its sign.
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
    # Slightly less, as the axes differ and may turn.
    out[SPEED] = settings.speed / (1.015 * overshoot)
    out[YAW_RATE] = settings.yaw_rate
    out[COUNT_FORCE] = 1.0 if settings.control_inputs == 'all' else 0.0
    out[RATE] = min(gains[chain][0] / gains[chain][1] for chain in ('pitch', 'roll', 'height'))
    _PARAMETERS[key] = out
    return out.copy()


# Rows of the tables of `closed_loop`: the chains, and the entries of each.
PITCH_CHAIN, ROLL_CHAIN, HEIGHT_CHAIN = range(3)
MATRIX, TRAVEL, COST, BOUND, ENTRIES = 0, 9, 12, 21, 24


@njit(cache=True)
def _chain(
    row: FloatArray, gains: FloatArray, gravity: float, inertia: float, periods: int, h: float
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
    """Return the effect of `periods` control periods without saturation, (3, 24).

    For deviations s = (velocity - command, angle, rate) of a chain: the matrix of the deviations
    afterwards, the travel beyond command times time, the sum of u'u as a quadratic form, and the
    largest |velocity - command| for each unit deviation.
    """
    out = np.zeros((3, ENTRIES))
    _chain(out[PITCH_CHAIN], parameters[0:3], GRAVITY, INERTIA[1], periods, h)
    _chain(out[ROLL_CHAIN], parameters[3:6], -GRAVITY, INERTIA[0], periods, h)
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
def _most(row: FloatArray, v: float, a: float, w: float) -> float:
    return row[BOUND] * abs(v) + row[BOUND + 1] * abs(a) + row[BOUND + 2] * abs(w)


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
    command: Command,
    parameters: FloatArray,
    table: FloatArray,
    periods: int,
    h: float,
) -> float:
    """Fly `periods` control periods of `h` seconds, in place; return the sum of u'u."""
    size = norm(command[:3])
    scale = parameters[SPEED] / size if size > parameters[SPEED] else 1.0
    turn = min(max(command[3], -parameters[YAW_RATE]), parameters[YAW_RATE])
    wanted = (command[0] * scale, command[1] * scale, command[2] * scale, turn)
    if turn == 0.0 and state[11] == 0.0:
        cost = _step_at_once(state, wanted, parameters, table, periods * h)
        if cost >= 0.0:
            return cost
    return _step_in_periods(state, wanted, parameters, periods, h)


@njit(cache=True)
def _step_at_once(
    state: FloatArray, wanted: Command, parameters: FloatArray, table: FloatArray, time: float
) -> float:
    """Fly all periods without turning, in place; return the sum of u'u, or -1 at a limit."""
    cx, cy, cz, _ = wanted
    yaw, roll, pitch = state[3], state[4], state[5]
    # Velocity deviations along the heading, to its left, and upwards.
    df, dl = turned(state[6], state[7], -yaw)
    df, dl, dz = df - cx, dl - cy, state[8] - cz
    front, side, up = table[PITCH_CHAIN], table[ROLL_CHAIN], table[HEIGHT_CHAIN]
    most_pitch = abs(parameters[K_VX] / parameters[K_PITCH]) * _most(front, df, pitch, state[10])
    most_roll = abs(parameters[K_VY] / parameters[K_ROLL]) * _most(side, dl, roll, state[9])
    tilt, most_force = parameters[TILT], parameters[K_VZ] * abs(dz)
    if not (most_pitch <= tilt and most_roll <= tilt and most_force <= parameters[LIFT]):
        return -1.0
    df, state[5], state[10], forward, pitch_cost = _lateral(front, df, pitch, state[10])
    dl, state[4], state[9], left, roll_cost = _lateral(side, dl, roll, state[9])
    dx, dy = turned(forward + cx * time, left + cy * time, yaw)
    state[0] += dx
    state[1] += dy
    state[2] += cz * time + up[TRAVEL] * dz
    state[6], state[7] = turned(cx + df, cy + dl, yaw)
    state[8] = cz + up[MATRIX] * dz
    return pitch_cost + roll_cost + parameters[COUNT_FORCE] * up[COST] * dz * dz


@njit(cache=True)
def _step_in_periods(
    state: FloatArray, wanted: Command, parameters: FloatArray, periods: int, h: float
) -> float:
    """Fly one period after another within the limits, in place; return the sum of u'u."""
    cx, cy, cz, cr = wanted
    x, y, z, yaw, roll, pitch = state[0], state[1], state[2], state[3], state[4], state[5]
    p, q, r = state[9], state[10], state[11]
    # Velocity along the heading, to its left, and upwards.
    vf, vl = turned(state[6], state[7], -yaw)
    vz = state[8]
    to_pitch = parameters[K_VX] / parameters[K_PITCH]
    to_roll = parameters[K_VY] / parameters[K_ROLL]
    tilt, lift = parameters[TILT], parameters[LIFT]
    h2 = h * h / 2.0
    h3 = h * h * h / 6.0
    h4 = h * h * h * h / 24.0
    turning = cr != 0.0 or r != 0.0
    cos_yaw, sin_yaw = math.cos(yaw), math.sin(yaw)
    cost = 0.0
    for _ in range(periods):
        pitch_wanted = min(max(to_pitch * (cx - vf), -tilt), tilt)
        roll_wanted = min(max(to_roll * (cy - vl), -tilt), tilt)
        u_pitch = parameters[K_PITCH] * (pitch_wanted - pitch) - parameters[K_Q] * q
        u_roll = parameters[K_ROLL] * (roll_wanted - roll) - parameters[K_P] * p
        force = min(max(parameters[K_VZ] * (cz - vz), -lift), lift)
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
            # The velocity is constant in the map while the axes turn.
            vf, vl = turned(vf, vl, -turn)
            cos_yaw, sin_yaw = math.cos(yaw), math.sin(yaw)
    state[0], state[1], state[2], state[3], state[4], state[5] = x, y, z, yaw, roll, pitch
    state[6] = cos_yaw * vf - sin_yaw * vl
    state[7] = sin_yaw * vf + cos_yaw * vl
    state[8], state[9], state[10], state[11] = vz, p, q, r
    return cost
