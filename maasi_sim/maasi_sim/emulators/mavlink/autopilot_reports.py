"""What the fake autopilot sends: the messages of its streams, and texts."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from maasi_drivers.links.mavlink.estimate import swap_enu_ned, swap_flu_frd, swap_orientation
from maasi_drivers.links.mavlink.firmware import PX4_COPTER, Firmware
from maasi_drivers.links.mavlink.protocol import mavlink
from maasi_filter.models.pose import Pose
from maasi_sim.emulators.mavlink.autopilot_settings import AutopilotSettings
from maasi_sim.emulators.mavlink.flight_model import FlightModel

_HEARTBEAT_PERIOD, _STATUS_PERIOD = 1.0, 1.0
_COMMON_RATES = {'LOCAL_POSITION_NED': 4.0, 'ATTITUDE_QUATERNION': 4.0}
_EKF_GOOD = 1 | 2 | 4 | 8 | 16 | 32
_EKF_START = 1 | 128


class AutopilotState(Protocol):
    """State of an autopilot that the messages report."""

    now: float
    settings: AutopilotSettings
    firmware: Firmware
    body: FlightModel
    mode: int
    armed: bool
    charge: float

    @property
    def ready(self) -> bool:
        """Whether it has started to estimate its position."""

    @property
    def estimating(self) -> bool:
        """Whether its position estimate is good."""

    @property
    def has_fix(self) -> bool:
        """Whether its first GNSS receiver has a fix."""

    def landed_state(self) -> int:
        """Return MAV_LANDED_STATE."""

    def believed_position(self) -> NDArray[np.float64]:
        """Return the position that it believes, ENU [m]."""


class AutopilotReports:
    """Sends the messages that are due.

    Parameters
    ----------
    pilot : AutopilotState
        Whose state is sent.
    sender : MAVLink
        Packs messages and writes them to the wire.
    generator : Generator
        Of the noise of positions.

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
            *(swap_enu_ned(pilot.believed_position()) + noise[:3]).tolist(),
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
