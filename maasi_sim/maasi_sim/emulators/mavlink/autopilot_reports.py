"""The state of the fake autopilot, how its vehicle moves, and the messages that report them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from maasi_drivers.links.mavlink.estimate import swap_enu_ned, swap_flu_frd, swap_orientation
from maasi_drivers.links.mavlink.firmware import PX4_COPTER
from maasi_drivers.links.mavlink.protocol import mavlink
from maasi_filter.arrays import FloatArray
from maasi_filter.models.pose import Pose
from maasi_sim.emulators.mavlink.autopilot_parameters import FIRMWARES
from maasi_sim.emulators.mavlink.autopilot_settings import AutopilotSettings


@dataclass(frozen=True)
class FlightLimits:
    """What a vehicle and its position controller can do.

    Attributes
    ----------
    speed, climb : float
        Largest speeds, level and up or down [m/s].
    acceleration : float
        Largest [m/s^2].
    gain : float
        Speed for each metre of way left, of the position controller [1/s].
    yaw_rate : float
        Largest [rad/s].
    buoyancy : float
        Speed at which it rises without power; below 0 it falls [m/s].
    """

    speed: float = 2.0
    climb: float = 1.0
    acceleration: float = 1.0
    gain: float = 1.0
    yaw_rate: float = 1.0
    buoyancy: float = -3.0


class FlightModel:
    """A vehicle in its local frame, ENU, with the ground or the surface at height 0."""

    def __init__(
        self, limits: FlightLimits, submarine: bool, position: FloatArray, yaw: float
    ) -> None:
        self.limits = limits
        self.submarine = submarine
        self.position = np.array(position, dtype=float)
        self.velocity = np.zeros(3)
        self.yaw = yaw
        self.yaw_rate = 0.0

    @property
    def grounded(self) -> bool:
        """Whether it stands on the ground; a submarine does not."""
        return not self.submarine and bool(self.position[2] <= 0.0)

    def fly_to(self, target: FloatArray, yaw: float | None, dt: float) -> None:
        """Go on for `dt` seconds under the position controller, to a place and a heading."""
        error = target - self.position
        left = float(np.sqrt((error * error).sum()))
        limits = self.limits
        wish = np.zeros(3)
        if left > 0.0:
            # What can be braked in time, as the autopilots' square root controllers have it.
            reach = limits.acceleration / (limits.gain * limits.gain)
            speed = (
                limits.gain * left
                if left <= reach
                else math.sqrt(2.0 * limits.acceleration * (left - 0.5 * reach))
            )
            wish = error * (speed / left)
        self.fly(wish, dt)
        self._turn(yaw, dt)

    def fly(self, velocity: FloatArray, dt: float) -> None:
        """Go on for `dt` seconds with a wished velocity [m/s]."""
        limits = self.limits
        wish = np.array(velocity, dtype=float)
        level = math.hypot(wish[0], wish[1])
        if level > limits.speed:
            wish[:2] *= limits.speed / level
        wish[2] = min(max(wish[2], -limits.climb), limits.climb)
        self._accelerate(wish, dt)

    def drift(self, dt: float) -> None:
        """Go on for `dt` seconds without power."""
        self._accelerate(np.array([0.0, 0.0, self.limits.buoyancy]), dt)
        self.yaw_rate = 0.0

    def _accelerate(self, wish: FloatArray, dt: float) -> None:
        change = wish - self.velocity
        size = float(np.sqrt((change * change).sum()))
        most = self.limits.acceleration * dt
        if size > most:
            change *= most / size
        before = self.velocity
        self.velocity = before + change
        self.position = self.position + 0.5 * dt * (before + self.velocity)
        beyond = self.position[2] > 0.0 if self.submarine else self.position[2] < 0.0
        if beyond:
            self.position[2] = 0.0
            self.velocity = self.velocity * (0.0 if not self.submarine else np.array([1, 1, 0]))

    def _turn(self, yaw: float | None, dt: float) -> None:
        self.yaw_rate = 0.0
        if yaw is not None:
            left = math.atan2(math.sin(yaw - self.yaw), math.cos(yaw - self.yaw))
            most = self.limits.yaw_rate * dt
            step = min(max(left, -most), most)
            self.yaw += step
            self.yaw_rate = step / dt


_HEARTBEAT_PERIOD, _STATUS_PERIOD = 1.0, 1.0
_COMMON_RATES = {'LOCAL_POSITION_NED': 4.0, 'ATTITUDE_QUATERNION': 4.0}
_EKF_GOOD = 1 | 2 | 4 | 8 | 16 | 32
_EKF_START = 1 | 128
# From the loss of GNSS to that of the position estimate [s].
_DEAD_RECKONING = 8.0


class AutopilotState:
    """State of an autopilot and its vehicle, which the messages report.

    Attributes
    ----------
    now : float
        Time since its start [s].
    gnss_lost_at : float
        When the first receiver lost its fix; the position estimate is lost later [s].
    rising_to : float or None
        Height of a take-off [m].
    height_error : float
        Of the estimated height [m].
    origin : ndarray, shape (3,)
        True place of the EKF's origin [m].
    """

    def __init__(self, settings: AutopilotSettings, yaw: float) -> None:
        self.settings = settings
        self.firmware = FIRMWARES[settings.firmware]
        submarine = self.firmware.kind == 'submarine'
        self.body = FlightModel(
            FlightLimits(
                speed=settings.speed,
                acceleration=settings.acceleration,
                buoyancy=0.1 if submarine else -3.0,
            ),
            submarine,
            np.array([0.0, 0.0, -settings.depth if submarine else 0.0]),
            yaw,
        )
        self.now = 0.0
        self.armed = False
        self.charge = settings.charge
        self.mode = next(
            number
            for number, name in self.firmware.modes.items()
            if name in ('STABILIZE', 'MANUAL')
        )
        self.gnss_lost_at = math.inf
        self.rising_to: float | None = None
        self.height_error = 0.0
        self.origin = np.zeros(3)

    @property
    def ready(self) -> bool:
        """Whether it has started to estimate its position."""
        return self.now >= self.settings.estimator_time

    @property
    def estimating(self) -> bool:
        """Whether its position estimate is good."""
        lost = self.now - self.gnss_lost_at >= _DEAD_RECKONING
        return self.ready and (self.settings.second_gnss or not lost)

    @property
    def has_fix(self) -> bool:
        """Whether its first GNSS receiver has a fix."""
        return self.now < self.gnss_lost_at

    @property
    def offset(self) -> FloatArray:
        """The position that it believes, less the true one, ENU [m]."""
        return np.array([0.0, 0.0, self.height_error]) - self.origin

    def landed_state(self) -> int:
        """Return MAV_LANDED_STATE."""
        if self.body.grounded:
            return int(mavlink.MAV_LANDED_STATE_ON_GROUND)
        if self.mode == self.firmware.land:
            return int(mavlink.MAV_LANDED_STATE_LANDING)
        if self.rising_to is not None:
            return int(mavlink.MAV_LANDED_STATE_TAKEOFF)
        return int(mavlink.MAV_LANDED_STATE_IN_AIR)


class AutopilotReports:
    """Sends the messages that are due.

    Attributes
    ----------
    muted : set of str
        Messages that do not come any more.
    frozen : tuple of float or None
        Position and velocity that are sent instead of the true ones.
    """

    def __init__(self, pilot: AutopilotState, sender: Any, generator: np.random.Generator) -> None:
        self._pilot = pilot
        self._sender = sender
        self._generator = generator
        self.muted: set[str] = set()
        self.frozen: tuple[float, ...] | None = None
        self.restart()

    def restart(self) -> None:
        """Reset to the messages that are sent by default."""
        self._last: dict[str, float] = {}
        self._periods = {
            'HEARTBEAT': _HEARTBEAT_PERIOD,
            'BATTERY_STATUS': _STATUS_PERIOD,
            'EXTENDED_SYS_STATE': _STATUS_PERIOD,
            'GPS_RAW_INT': _STATUS_PERIOD,
            **{name: 1.0 / rate for name, rate in _COMMON_RATES.items()},
        }
        if self._pilot.firmware is not PX4_COPTER:
            self._periods['EKF_STATUS_REPORT'] = _STATUS_PERIOD

    def set_period(self, name: str, period: float) -> bool:
        """Send a message at another period [s], unless that is 0; return whether it is known."""
        if name not in _MESSAGES:
            return False
        if period > 0.0:
            self._periods[name] = period
        return True

    def freeze(self) -> None:
        """Send the same position from now on, with new stamps."""
        self.frozen = self._position()

    def publish(self) -> None:
        """Send what is due."""
        for name, send in _MESSAGES.items():
            period = self._periods.get(name, math.inf)
            since = self._pilot.now - self._last.get(name, -math.inf)
            if math.isinf(period) or since < period - 1e-6 or name in self.muted:
                continue
            self._last[name] = self._pilot.now
            send(self)

    def say(self, severity: int, text: str) -> None:
        """Send a text."""
        self._sender.statustext_send(severity, text.encode()[:50])

    @property
    def _milliseconds(self) -> int:
        return round(self._pilot.now * 1000.0)

    def _position(self) -> tuple[float, ...]:
        pilot = self._pilot
        noise = self._generator.normal(0.0, pilot.settings.noise or 1e-9, 6)
        return (
            *(swap_enu_ned(pilot.body.position + pilot.offset) + noise[:3]).tolist(),
            *(swap_enu_ned(pilot.body.velocity) + noise[3:]).tolist(),
        )

    def _send_heartbeat(self) -> None:
        pilot = self._pilot
        flags = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
        if pilot.armed:
            flags |= mavlink.MAV_MODE_FLAG_SAFETY_ARMED
        submarine = pilot.firmware.kind == 'submarine'
        kind = mavlink.MAV_TYPE_SUBMARINE if submarine else mavlink.MAV_TYPE_QUADROTOR
        state = mavlink.MAV_STATE_ACTIVE if pilot.armed else mavlink.MAV_STATE_STANDBY
        self._sender.heartbeat_send(kind, pilot.firmware.autopilot, flags, pilot.mode, state)

    def _send_position(self) -> None:
        # ArduPilot sends no position before it has an estimate.
        if self._pilot.ready:
            values = self.frozen or self._position()
            self._sender.local_position_ned_send(self._milliseconds, *values)

    def _send_attitude(self) -> None:
        body = self._pilot.body
        orientation = Pose.from_yaw(np.zeros(3), body.yaw).orientation
        rates = swap_flu_frd([0.0, 0.0, body.yaw_rate])
        self._sender.attitude_quaternion_send(
            self._milliseconds, *swap_orientation(orientation).tolist(), *rates.tolist()
        )

    def _send_battery(self) -> None:
        pilot = self._pilot
        unknown = [0xFFFF] * 9
        for number, charge in enumerate([pilot.charge, *pilot.settings.more_batteries]):
            voltage = round(12_000 + 4_800 * charge)
            self._sender.battery_status_send(
                number, 0, 0, 0x7FFF, [voltage, *unknown], -1, -1, -1, round(100.0 * charge)
            )

    def _send_landed(self) -> None:
        self._sender.extended_sys_state_send(
            mavlink.MAV_VTOL_STATE_UNDEFINED, self._pilot.landed_state()
        )

    def _send_estimator(self) -> None:
        flags = _EKF_GOOD if self._pilot.estimating else _EKF_START
        self._sender.ekf_status_report_send(flags, 0.1, 0.1, 0.1, 0.1, 0.0)

    def _send_gnss(self) -> None:
        fix = mavlink.GPS_FIX_TYPE_3D_FIX if self._pilot.has_fix else mavlink.GPS_FIX_TYPE_NO_FIX
        self._sender.gps_raw_int_send(
            self._milliseconds * 1000, fix, 0, 0, 0, 100, 100, 0, 0xFFFF, 12
        )

    def _send_second_gnss(self) -> None:
        if self._pilot.settings.second_gnss:
            fix = mavlink.GPS_FIX_TYPE_3D_FIX
            self._sender.gps2_raw_send(
                self._milliseconds * 1000, fix, 0, 0, 0, 100, 100, 0, 0xFFFF, 12, 0, 0
            )


_MESSAGES: dict[str, Callable[[AutopilotReports], None]] = {
    'HEARTBEAT': AutopilotReports._send_heartbeat,
    'ATTITUDE_QUATERNION': AutopilotReports._send_attitude,
    'LOCAL_POSITION_NED': AutopilotReports._send_position,
    'BATTERY_STATUS': AutopilotReports._send_battery,
    'EXTENDED_SYS_STATE': AutopilotReports._send_landed,
    'EKF_STATUS_REPORT': AutopilotReports._send_estimator,
    'GPS_RAW_INT': AutopilotReports._send_gnss,
    'GPS2_RAW': AutopilotReports._send_second_gnss,
}
