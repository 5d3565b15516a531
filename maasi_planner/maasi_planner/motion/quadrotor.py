"""Nonlinear quadrotor under backstepping (003, section 4, after Sun and others, 2014).

Each stage is the virtual control of the one before:

    position      v_d = -c1 (p - p_d)                              the velocity command
    velocity      a_d = c2 (v_d - v),  f = m (a_d + g e3)          commanded force
    attitude      omega_d = c3 (b3 x f / |f|)                      rotates the thrust b3 towards f
    turn rates    tau = omega x J omega + J c4 (omega_d - omega)   torques

The first stage is the controller's (`command`); the others follow any velocity command. Derivatives
of the virtual controls are neglected, as c1 < c2 < c3 < c4 are far enough apart. The papers do not
print mass, inertia and gains; those here are of a quadrotor of 1.2 kg.

state (14,): position [m, map], heading [rad], quaternion w x y z, velocity [m/s, map], angular
velocity [rad/s, body].
"""

import math

from numba import njit

from maasi_filter.arrays import FloatArray
from maasi_planner.motion.mambo import GRAVITY
from maasi_planner.motion.steering import Command
from maasi_planner.obstacles import Vector, dot, norm

MASS = 1.2
INERTIA = (0.0123, 0.0123, 0.0224)
C1, C2, C3, C4 = 0.8, 2.5, 10.0, 45.0
SPEED, LEVEL, VERTICAL, SLOPE, YAW_RATE, COUNT_FORCE = range(6)  # entries of the array of limits


@njit(cache=True)
def _cross(a: Vector, b: Vector) -> Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@njit(cache=True, forceinline=True)
def _axes(state: FloatArray) -> tuple[Vector, Vector, Vector]:
    w, x, y, z = state[4], state[5], state[6], state[7]
    return (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)),
        (2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x)),
        (2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)),
    )


@njit(cache=True, forceinline=True)
def _force(state: FloatArray, command: Command, limits: FloatArray) -> Vector:
    """Return the limited force per mass for a velocity command [m/s^2]."""
    size = norm(command[:3])
    scale = limits[SPEED] / size if size > limits[SPEED] else 1.0
    b1x, b1y, _ = _axes(state)[0]
    level = math.sqrt(b1x * b1x + b1y * b1y)
    cos_yaw = b1x / level if level > 1e-9 else 1.0
    sin_yaw = b1y / level if level > 1e-9 else 0.0
    ax = C2 * (scale * (cos_yaw * command[0] - sin_yaw * command[1]) - state[8])
    ay = C2 * (scale * (sin_yaw * command[0] + cos_yaw * command[1]) - state[9])
    az = C2 * (scale * command[2] - state[10])
    az = min(max(az, -limits[VERTICAL]), limits[VERTICAL])
    most = min(limits[LEVEL], limits[SLOPE] * (GRAVITY + az))
    asked = math.sqrt(ax * ax + ay * ay)
    share = most / asked if asked > most else 1.0
    return ax * share, ay * share, GRAVITY + az


@njit(cache=True, forceinline=True)
def _inputs(state: FloatArray, force: Vector, turn: float) -> tuple[float, Vector]:
    """Return thrust [N] and torques [N m] that rotate the thrust towards `force`."""
    forward, left, up = _axes(state)
    strength = norm(force)
    thrust = MASS * max(0.0, dot(force, up))
    # Rotation from the thrust to the force.
    turn_axis = _cross(up, (force[0] / strength, force[1] / strength, force[2] / strength))
    p, q, r = state[11], state[12], state[13]
    jx, jy, jz = INERTIA
    return thrust, (
        jx * C4 * (C3 * dot(forward, turn_axis) - p) + (jz - jy) * q * r,
        jy * C4 * (C3 * dot(left, turn_axis) - q) + (jx - jz) * r * p,
        jz * C4 * (turn - r) + (jy - jx) * p * q,
    )


@njit(cache=True, forceinline=True)
def _move(state: FloatArray, thrust: float, torque: Vector, h: float) -> None:
    """Integrate the rigid body for `h` seconds, in place: velocities before positions."""
    p, q, r = state[11], state[12], state[13]
    jx, jy, jz = INERTIA
    new_p = p + h * (torque[0] - (jz - jy) * q * r) / jx
    new_q = q + h * (torque[1] - (jx - jz) * r * p) / jy
    new_r = r + h * (torque[2] - (jy - jx) * p * q) / jz
    up = _axes(state)[2]
    for axis in range(3):
        change = h * thrust / MASS * up[axis]
        if axis == 2:
            change -= h * GRAVITY
        state[axis] += h * (state[8 + axis] + 0.5 * change)
        state[8 + axis] += change
    # Turn by the mean rate over the period.
    _rotate(state, (0.5 * (p + new_p), 0.5 * (q + new_q), 0.5 * (r + new_r)), h)
    state[11], state[12], state[13] = new_p, new_q, new_r


@njit(cache=True, forceinline=True)
def _rotate(state: FloatArray, rates: Vector, h: float) -> None:
    w, x, y, z = state[4], state[5], state[6], state[7]
    rate = norm(rates)
    half = 0.5 * rate * h
    c = math.cos(half)
    s = 0.5 * h if half < 1e-9 else math.sin(half) / rate
    gx, gy, gz = rates[0] * s, rates[1] * s, rates[2] * s
    nw = w * c - x * gx - y * gy - z * gz
    nx = w * gx + x * c + y * gz - z * gy
    ny = w * gy - x * gz + y * c + z * gx
    nz = w * gz + x * gy - y * gx + z * c
    size = math.sqrt(nw * nw + nx * nx + ny * ny + nz * nz)
    state[4], state[5], state[6], state[7] = nw / size, nx / size, ny / size, nz / size


@njit(cache=True)
def quadrotor_step(
    state: FloatArray, command: Command, limits: FloatArray, periods: int, h: float
) -> float:
    """Fly `periods` control periods of `h` seconds, in place; return the sum of u'u."""
    turn = min(max(command[3], -limits[YAW_RATE]), limits[YAW_RATE])
    cost = 0.0
    for _ in range(periods):
        thrust, torque = _inputs(state, _force(state, command, limits), turn)
        extra = thrust - MASS * GRAVITY
        cost += dot(torque, torque) + limits[COUNT_FORCE] * extra * extra
        _move(state, thrust, torque, h)
    forward = _axes(state)[0]
    state[3] = math.atan2(forward[1], forward[0])
    return cost
