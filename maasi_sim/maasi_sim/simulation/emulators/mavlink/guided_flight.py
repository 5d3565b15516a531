"""How ArduCopter flies in guided mode: to a position, where it stops, or with a velocity.

Both are shaped as in its source (ArduPilot, master of 2025): `ModeGuided::pos_control_run` hands
positions to `AC_PosControl::input_pos_NEU_m`, `ModeGuided::velaccel_control_run` hands velocities
to `input_vel_accel_NE_m`, and `shape_pos_vel_accel_xy`, `shape_vel_accel_xy`, `sqrt_controller` and
`sqrt_controller_accel` of `AP_Math/control.cpp` turn them into accelerations within WPNAV_ACCEL and
PSC_JERK_XY. A velocity counts for GUID_TIMEOUT, a position for ever. The speed limit is WPNAV_SPEED
each time that the kind of set-point changes (`pva_control_start`), and MAV_CMD_DO_CHANGE_SPEED
changes it until then (`ModeGuided::set_speed_xy_cms`). The vehicle follows the shaped motion
exactly.
"""

import math
from collections.abc import Mapping

import numpy as np

from maasi_filter.arrays import FloatArray
from maasi_sim.simulation.emulators.mavlink.flight_model import FlightModel

Level = tuple[float, float]

_RETURN_HEIGHT, _LANDING = 15.0, -0.5  # RTL_ALT of the factory, and speed of the landing [m, m/s]


def square_root_speed(error: float, gain: float, acceleration: float, dt: float) -> float:
    """Return the speed at which a distance can still be braked in time; `sqrt_controller`."""
    linear = acceleration / gain**2
    if error > linear:
        speed = math.sqrt(2.0 * acceleration * (error - 0.5 * linear))
    else:
        speed = gain * error
    return min(speed, error / dt)


def _speed_change(error: float, wish: float, closing: float, gain: float, most: float) -> float:
    """Return the change of that speed during the approach [m/s^2]; `sqrt_controller_accel`."""
    if not wish * closing > 0.0:
        return 0.0
    if error <= most / gain**2:
        return -gain * closing
    return -(most / wish) * closing


def _within(vector: Level, most: float) -> Level:
    size = math.hypot(*vector)
    return vector if size <= most else (vector[0] * most / size, vector[1] * most / size)


def _turning(velocity: Level, wish: Level, most: float) -> Level:
    """Return a wished acceleration within its limit; `limit_accel_corner_xy`."""
    speed = math.hypot(*velocity)
    if speed == 0.0:
        return _within(wish, most)
    wish = _within(wish, 2.0 * most)
    ahead = velocity[0] / speed, velocity[1] / speed
    along = wish[0] * ahead[0] + wish[1] * ahead[1]
    cross = wish[0] - along * ahead[0], wish[1] - along * ahead[1]
    if along > 0.0:
        cross = _within(cross, most)
        along = min(along, math.sqrt(max(most**2 - cross[0] ** 2 - cross[1] ** 2, 0.0)))
    else:
        along = max(along, -most)
        cross = _within(cross, math.sqrt(max(most**2 - along**2, 0.0)))
    return cross[0] + along * ahead[0], cross[1] + along * ahead[1]


def _to(value: float, wish: float, step: float) -> float:
    return value + min(max(wish - value, -step), step)


class GuidedFlight:
    """The guided mode of one copter.

    target: position that it goes to, (3,), or velocity that it has, (3,), as `by_velocity` says
    [m, m/s, local, ENU]; none: it stops.
    """

    def __init__(self, body: FlightModel, parameters: Mapping[str, float]) -> None:
        self._body, self._parameters = body, parameters
        self.begin()

    def begin(self) -> None:
        """Enter the mode: it stops, as with a velocity of zero (`ModeGuided::init`)."""
        self._set_kind(True)
        self.target = np.zeros(3)
        self._sent_at = -math.inf
        self._yaw: float | None = None

    def hold(self, position: FloatArray) -> None:
        """Stay at a position, where a take-off has ended."""
        self._set_kind(False)
        self.target = position

    def _set_kind(self, by_velocity: bool) -> None:
        self.by_velocity = by_velocity
        self.speed = 0.01 * self._parameters['WPNAV_SPEED']
        self._acceleration = np.zeros(3)

    def accept(self, target: FloatArray, by_velocity: bool, yaw: float | None, now: float) -> None:
        """Accept a set-point, and a yaw; without one the vehicle keeps its own."""
        if by_velocity != self.by_velocity:
            self._set_kind(by_velocity)
        self.target, self._yaw, self._sent_at = target, yaw, now

    def run(self, now: float, dt: float) -> None:
        """Fly for `dt` seconds."""
        body, before = self._body, self._acceleration
        body.position = body.position + dt * body.velocity + 0.5 * dt**2 * before
        body.velocity = body.velocity + dt * before
        if body.position[2] < 0.0:
            body.position[2], body.velocity = 0.0, np.zeros(3)
        if self.by_velocity:
            lasts = now - self._sent_at <= max(self._parameters['GUID_TIMEOUT'], 0.1)
            self._keep_velocity(self.target if lasts else np.zeros(3), dt)
        else:
            self._go_to(self.target, dt)
        body.turn(self._yaw, dt)

    @property
    def _limits(self) -> tuple[float, float]:
        """Level acceleration and jerk, at most."""
        return 0.01 * self._parameters['WPNAV_ACCEL'], self._parameters['PSC_JERK_XY']

    @property
    def _vertical_limits(self) -> tuple[float, float]:
        return 0.01 * self._parameters['WPNAV_ACCEL_Z'], self._parameters['PSC_JERK_Z']

    def _keep_velocity(self, velocity: FloatArray, dt: float) -> None:
        most, jerk = self._limits
        vx, vy, vz = self._body.velocity.tolist()
        error = float(velocity[0]) - vx, float(velocity[1]) - vy
        size = math.hypot(*error)
        share = square_root_speed(size, jerk / most, jerk, dt) / size if size > 0.0 else 0.0
        wish = _turning((vx, vy), (share * error[0], share * error[1]), most)
        self._change(wish, jerk, dt)
        most, jerk = self._vertical_limits
        error_z = float(velocity[2]) - vz
        up = math.copysign(square_root_speed(abs(error_z), jerk / most, jerk, dt), error_z)
        self._acceleration[2] = _to(self._acceleration[2], min(max(up, -most), most), jerk * dt)

    def _go_to(self, target: FloatArray, dt: float) -> None:
        body = self._body
        x, y, z = (target - body.position).tolist()
        vx, vy, vz = body.velocity.tolist()
        away, level = math.sqrt(x * x + y * y + z * z), math.hypot(x, y)
        # What takes it there in a straight line; `kinematic_limit`.
        fastest = math.inf if away > 0.0 else 0.0
        if level > 0.0:
            fastest = min(fastest, self.speed * away / level)
        if z != 0.0:
            fastest = min(fastest, body.climb * away / abs(z))
        most, jerk = self._limits
        gain, wish = jerk / most, 0.0
        if level > 0.0:
            closing = (vx * x + vy * y) / level
            wish = square_root_speed(level, gain, most, dt)
            wish += _speed_change(level, wish, closing, gain, most) / gain
            wish = min(max(wish, -fastest * level / away), fastest * level / away) / level
        change = (wish * x - vx) * gain, (wish * y - vy) * gain
        self._change(_turning((vx, vy), change, most), jerk, dt)
        most, jerk = self._vertical_limits
        gain, side = jerk / most, math.copysign(1.0, z)
        up = square_root_speed(abs(z), gain, most, dt)
        up += _speed_change(abs(z), up, side * vz, gain, most) / gain
        limit = fastest * abs(z) / away if away > 0.0 else 0.0
        change_z = (side * min(max(up, -limit), limit) - vz) * gain
        change_z = min(max(change_z, -most), most)
        self._acceleration[2] = _to(self._acceleration[2], change_z, jerk * dt)

    def _change(self, wish: Level, jerk: float, dt: float) -> None:
        """Take a level acceleration within the jerk; `shape_accel_xy`."""
        ax, ay, _ = self._acceleration.tolist()
        step = _within((wish[0] - ax, wish[1] - ay), jerk * dt)
        self._acceleration[:2] += step


class ReturnFlight:
    """The mode RTL: it climbs, flies to where it was armed, and lands (`ModeRTL`)."""

    def __init__(self, body: FlightModel) -> None:
        self._body, self._home = body, body.position.copy()
        self._height = float(self._home[2]) + _RETURN_HEIGHT

    def run(self, dt: float) -> bool:
        """Fly for `dt` seconds; return whether it has landed."""
        body, home = self._body, self._home
        if math.hypot(*(body.position - home)[:2]) < 0.5:
            body.fly(np.array([0.0, 0.0, _LANDING]), dt)
            return body.grounded
        self._height = max(self._height, float(body.position[2]))
        climbs = body.position[2] < self._height - 0.5
        body.fly_to(np.array([*(body.position if climbs else home)[:2], self._height]), None, dt)
        return False
