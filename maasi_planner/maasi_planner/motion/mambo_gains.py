"""Gains of the Mambo's discrete LQR, and the parameter array that its kernels take."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from maasi_filter.arrays import FloatArray
from maasi_planner.settings import MotionSettings

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

    The 12-state model decomposes into these chains, and with diagonal weights so does its LQR.
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


def _dot(a: list[float], b: list[float]) -> float:
    return sum(x * y for x, y in zip(a, b, strict=True))


def _response_size(a: FloatArray, b: FloatArray, gain: FloatArray) -> tuple[FloatArray, float]:
    """Return the impulse response from velocity command to velocity, and the tilt's peak gain."""
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
