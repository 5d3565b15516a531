"""A fake autopilot, which answers MAVLink 2 as ArduCopter, ArduSub or PX4 do.

The behaviour of ArduCopter is that of its source: the height of NAV_TAKEOFF is above home
(`ModeGuided::do_user_takeoff_start_m`), home is set at arming (`AP_Arming_Copter::arm`), a take-off
is refused in the air (`Mode::do_user_takeoff_U_m`) and ends within a tenth of its height
(`_AutoTakeoff::run`), EXTENDED_SYS_STATE tells take-off from flight
(`GCS_MAVLINK_Copter::landed_state`), and the ground station failsafe looks at the system id of
heartbeats alone (`GCS::sysid_is_gcs`). Positions that it reports are from the EKF's origin, which
is where the vehicle is when the EKF starts, also after a restart. What comes on one link is passed
on to others, heartbeats only where their system and component are not known
(`MAVLink_routing::check_and_forward`, `handle_heartbeat`).
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from maasi_drivers.links.mavlink.estimate import (
    swap_enu_ned,
    swap_yaw,
)
from maasi_drivers.links.mavlink.firmware import ARDUCOPTER, ARDUSUB, PX4_COPTER
from maasi_drivers.links.mavlink.protocol import mavlink
from maasi_filter.arrays import FloatArray
from maasi_filter.models.pose import Pose
from maasi_sim.emulators.mavlink.autopilot_parameters import PARAMETERS, WHOLE_NUMBERS
from maasi_sim.emulators.mavlink.autopilot_reports import AutopilotReports, AutopilotState
from maasi_sim.emulators.mavlink.autopilot_settings import AutopilotSettings

# ArduCopter disarms on the ground after so long [s].
_DISARM_DELAY = 10.0
# PX4 wants setpoints for so long, and not so long ago, before OFFBOARD [s].
_OFFBOARD_STREAM, _OFFBOARD_AGE = 1.0, 0.5
_LANDING, _SURFACING = 0.5, 0.3
_POSITION_IGNORED, _VELOCITY_IGNORED, _YAW_IGNORED = 0b111, 0b111 << 3, 1 << 10


@dataclass
class _Setpoint:
    position: FloatArray
    velocity: FloatArray | None = None
    yaw: float | None = None


class FakeAutopilot(AutopilotState):
    """One vehicle with its autopilot, without a connection and a clock.

    A setpoint that is not finite crashes it, as it did ArduPilot: it reports that and is silent.

    Attributes
    ----------
    crashed : str
        Reason of a crash; else empty.
    """

    def __init__(
        self,
        settings: AutopilotSettings,
        sender: Any,
        yaw: float,
        generator: np.random.Generator,
    ) -> None:
        super().__init__(settings, yaw)
        self.parameters = {**PARAMETERS[settings.firmware], **settings.parameters}
        self.crashed = ''
        self._first_mode = self.mode
        self._sender = sender
        self._setpoint: _Setpoint | None = None
        # Start of the uninterrupted setpoint stream, and time of its last setpoint.
        self._streaming_since, self._streamed_at = math.inf, -math.inf
        # True height at arming [m].
        self._home = 0.0
        # System, component and link of what was heard; the driver is on link 0.
        self._routes: set[tuple[int, int, int]] = set()
        self._armed_at = -math.inf
        self._station_at = math.inf
        self._failed: set[str] = set()
        self._reported_ready = False
        self.reports = AutopilotReports(self, sender, generator)

    @property
    def mode_name(self) -> str:
        """Its mode."""
        return self.firmware.mode_name(self.mode)

    def pose(self) -> Pose:
        """Return the true pose in its local frame, ENU."""
        return Pose.from_yaw(self.body.position, self.body.yaw)

    def restart(self) -> None:
        """Restart, as after a brown-out: disarmed, with clock and message rates reset."""
        self.armed = self._reported_ready = False
        # The barometer is calibrated again.
        self.now = self.height_error = 0.0
        self._routes.clear()
        self._hold()
        self.mode = self._first_mode
        self.reports.restart()

    # ---- the clock ---------------------------------------------------------------------------

    def advance(self, dt: float) -> None:
        """Advance by `dt` seconds: move, check failsafes, send due messages."""
        self.now += dt
        if self.crashed:
            self.body.drift(dt)
            return
        if self.ready and not self._reported_ready:
            self._reported_ready = True
            self.origin = self.body.position.copy()
            if self.body.submarine:
                # Depths are from the surface.
                self.origin[2] = 0.0
            self.reports.say(6, 'EKF3 IMU0 is using GPS')
        self._move(dt)
        self._look_after_failsafes(dt)
        self.reports.publish()

    def _move(self, dt: float) -> None:
        body = self.body
        if not self.armed:
            self.height_error += self.settings.barometer_drift * dt
            if not body.grounded:
                body.drift(dt)
            return
        if body.grounded and self.rising_to is None and not self._lifts_off():
            if self.now - self._armed_at > _DISARM_DELAY:
                self._disarm('Disarming motors')
            return
        firmware, setpoint = self.firmware, self._setpoint
        if self.mode == firmware.land:
            self._come_down(dt)
        elif self.rising_to is not None:
            target = np.array([*body.position[:2], self.rising_to])
            body.fly_to(target, None, dt)
            if abs(body.position[2] - self.rising_to) < 0.1 * (self.rising_to - self._home):
                self._setpoint = _Setpoint(target)
                self.rising_to = None
        elif setpoint is not None and setpoint.velocity is not None:
            body.fly(setpoint.velocity, dt)
        elif setpoint is not None:
            body.fly_to(setpoint.position, setpoint.yaw, dt)
        else:
            body.fly(np.zeros(3), dt)

    def _lifts_off(self) -> bool:
        """Return whether a setpoint over the ground takes it off, as PX4 does."""
        return (
            self.firmware.rise == 'setpoint'
            and self._setpoint is not None
            and self.mode == self.firmware.external
            and bool(self._setpoint.position[2] > 0.1)
        )

    def _come_down(self, dt: float) -> None:
        body = self.body
        if body.submarine:
            body.fly(np.array([0.0, 0.0, _SURFACING]), dt)
            return
        body.fly(np.array([0.0, 0.0, -_LANDING]), dt)
        if body.grounded:
            self._disarm('Landed')

    def _disarm(self, text: str) -> None:
        self.armed = False
        self.rising_to = self._setpoint = None
        self.reports.say(6, text)

    def _hold(self) -> None:
        self.rising_to = None
        self._setpoint = _Setpoint(self.body.position.copy())

    def _look_after_failsafes(self, dt: float) -> None:
        if self.armed:
            self.charge = max(self.charge - dt / self.settings.endurance, 0.0)
        if not self.armed:
            self._failed.clear()
            return
        read = self.parameters.get
        silence = self.now - self._station_at
        if silence > read('FS_GCS_TIMEOUT', math.inf) and self._acts('link', 'FS_GCS_ENABLE'):
            action = int(self.parameters['FS_GCS_ENABLE'])
            if self.firmware is ARDUSUB and action in (1, 2):
                if action == 2:
                    self._disarm('GCS failsafe: disarmed')
            else:
                depth_hold = self.firmware is ARDUSUB and action == 3
                self._fail_to(self.firmware.hold if depth_hold else self.firmware.land)
        elif (
            self.firmware is PX4_COPTER
            and self.mode == self.firmware.external
            and self.now - self._streamed_at > read('COM_OF_LOSS_T', 1.0)
        ):
            self.reports.say(3, 'Failsafe: no offboard setpoints')
            hold = self.parameters['COM_OBL_RC_ACT'] == 5
            self._fail_to(self.firmware.hold if hold else self.firmware.land)
        if self.charge < 0.05 and self._acts('battery', 'BATT_FS_LOW_ACT', 'COM_LOW_BAT_ACT'):
            self._fail_to(self.firmware.land)

    def _acts(self, kind: str, *names: str) -> bool:
        """Return whether a failsafe acts now, for the first time since arming."""
        if kind in self._failed or not any(self.parameters.get(name, 0) for name in names):
            return False
        self._failed.add(kind)
        self.reports.say(3, f'{"GCS" if kind == "link" else "Battery"} Failsafe')
        return True

    def _fail_to(self, mode: int) -> None:
        self.mode = mode
        self._hold()

    # ---- receiving ---------------------------------------------------------------------------

    def handle(self, message: Any, link: int = 0) -> None:
        """Take a message from one of its links, 0 is the driver's."""
        if self.crashed:
            return
        self._route(message, link)
        target = getattr(message, 'target_system', self.settings.system)
        handler = _HANDLERS.get(message.get_type())
        if handler is not None and target in (0, self.settings.system):
            handler(self, message)

    def _route(self, message: Any, link: int) -> None:
        """Pass a message for all on to the driver, as ArduPilot does."""
        ids = message.get_srcSystem(), message.get_srcComponent()
        self._routes.add((*ids, link))
        if link == 0 or getattr(message, 'target_system', 0) != 0:
            return
        if message.get_type() == 'HEARTBEAT':
            passes = (*ids, 0) not in self._routes
        else:
            passes = any(route[2] == 0 for route in self._routes)
        if passes:
            self._sender.file.write(bytes(message.get_msgbuf()))

    def _on_heartbeat(self, message: Any) -> None:
        if message.get_srcSystem() == self.parameters.get('SYSID_MYGCS'):
            self._station_at = self.now

    def _on_read(self, message: Any) -> None:
        name = message.param_id.rstrip('\0')
        value = self.parameters.get(name)
        if value is None:
            return
        kind = mavlink.MAV_PARAM_TYPE_REAL32
        if self.firmware is PX4_COPTER and name in WHOLE_NUMBERS:
            kind = mavlink.MAV_PARAM_TYPE_INT32
            value = struct.unpack('<f', struct.pack('<i', int(value)))[0]
        names = list(self.parameters)
        self._sender.param_value_send(name.encode(), value, kind, len(names), names.index(name))

    def _on_command(self, message: Any) -> None:
        handler = _COMMANDS.get(message.command)
        if handler is None:
            result = mavlink.MAV_RESULT_UNSUPPORTED
        else:
            result = handler(self, message)
        self._sender.command_ack_send(message.command, result)

    def _set_interval(self, message: Any) -> int:
        name = mavlink.mavlink_map.get(int(message.param1))
        known = name is not None and self.reports.set_period(name.msgname, message.param2 * 1e-6)
        return int(mavlink.MAV_RESULT_ACCEPTED if known else mavlink.MAV_RESULT_UNSUPPORTED)

    def _set_mode(self, message: Any) -> int:
        mode = int(message.param2)
        if self.firmware is PX4_COPTER:
            mode = mode << 16 | int(message.param3) << 24
        if mode not in self.firmware.modes:
            return int(mavlink.MAV_RESULT_DENIED)
        refusal = ''
        if mode == self.firmware.external and not self.ready:
            refusal = 'requires position'
        elif mode == self.firmware.external and self.firmware.streams_first:
            too_short = self.now - self._streaming_since < _OFFBOARD_STREAM
            if too_short or self.now - self._streamed_at > _OFFBOARD_AGE:
                refusal = 'no offboard signal'
        if refusal:
            name = self.firmware.mode_name(mode)
            self.reports.say(4, f'Mode change to {name} failed: {refusal}')
            return int(mavlink.MAV_RESULT_FAILED)
        if mode != self.mode:
            self.mode = mode
            self._hold()
        return int(mavlink.MAV_RESULT_ACCEPTED)

    def _arm(self, message: Any) -> int:
        if message.param1 == 0.0:
            if not self.body.grounded and not self.body.submarine and message.param2 != 21196.0:
                return int(mavlink.MAV_RESULT_FAILED)
            self._disarm('Disarming motors')
            return int(mavlink.MAV_RESULT_ACCEPTED)
        refusal = ''
        if not self.ready:
            refusal = 'Need Position Estimate'
        elif self.charge < 0.05:
            refusal = 'Battery below minimum arming capacity'
        if refusal:
            self.reports.say(2, f'PreArm: {refusal}')
            return int(mavlink.MAV_RESULT_FAILED)
        if not self.armed:
            self.armed, self._armed_at = True, self.now
            self._home = float(self.body.position[2])
            self._station_at = min(self._station_at, self.now)
            self.reports.say(6, 'Arming motors')
        return int(mavlink.MAV_RESULT_ACCEPTED)

    def _take_off(self, message: Any) -> int:
        if (
            not self.armed
            or self.firmware is not ARDUCOPTER
            or self.mode != self.firmware.external
            or not message.param7 > 0.0
            or not self.body.grounded
        ):
            return int(mavlink.MAV_RESULT_FAILED)
        self._setpoint, self.rising_to = None, self._home + float(message.param7)
        return int(mavlink.MAV_RESULT_ACCEPTED)

    def _on_setpoint(self, message: Any) -> None:
        mask = message.type_mask
        position = (message.x, message.y, message.z)
        velocity = (message.vx, message.vy, message.vz)
        wants_position = not mask & _POSITION_IGNORED
        wants_velocity = not mask & _VELOCITY_IGNORED
        used = (position if wants_position else ()) + (velocity if wants_velocity else ())
        if not mask & _YAW_IGNORED:
            used += (message.yaw,)
        if not all(map(math.isfinite, used)):
            self.crashed = f'SET_POSITION_TARGET_LOCAL_NED: {used} is not finite'
            self.armed = False
            self.reports.say(0, 'floating point exception')
            return
        if message.coordinate_frame != mavlink.MAV_FRAME_LOCAL_NED:
            return
        if self.now - self._streamed_at > _OFFBOARD_AGE:
            self._streaming_since = self.now
        self._streamed_at = self.now
        if self.mode != self.firmware.external or self.rising_to is not None:
            return
        if not (wants_position or wants_velocity):
            return
        self._setpoint = _Setpoint(
            swap_enu_ned(position) - self.offset,
            None if wants_position else swap_enu_ned(velocity),
            None if mask & _YAW_IGNORED else swap_yaw(message.yaw),
        )


_HANDLERS: dict[str, Callable[[FakeAutopilot, Any], None]] = {
    'HEARTBEAT': FakeAutopilot._on_heartbeat,
    'PARAM_REQUEST_READ': FakeAutopilot._on_read,
    'COMMAND_LONG': FakeAutopilot._on_command,
    'SET_POSITION_TARGET_LOCAL_NED': FakeAutopilot._on_setpoint,
}
_COMMANDS: dict[int, Callable[[FakeAutopilot, Any], int]] = {
    mavlink.MAV_CMD_SET_MESSAGE_INTERVAL: FakeAutopilot._set_interval,
    mavlink.MAV_CMD_DO_SET_MODE: FakeAutopilot._set_mode,
    mavlink.MAV_CMD_COMPONENT_ARM_DISARM: FakeAutopilot._arm,
    mavlink.MAV_CMD_NAV_TAKEOFF: FakeAutopilot._take_off,
}
