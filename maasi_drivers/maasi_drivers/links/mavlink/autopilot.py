"""An autopilot's messages: type, mode, parameters, and requests to it."""

import math
import re
import struct
from collections import deque
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from maasi_drivers.links.mavlink.estimate import Estimate, FlightOrigin, swap_enu_ned, swap_yaw
from maasi_drivers.links.mavlink.fence import FenceUpload
from maasi_drivers.links.mavlink.firmware import FailsafeCheck, Firmware, identify
from maasi_drivers.links.mavlink.protocol import DEBUG, ERROR, INFO, WARNING, ReportLog, mavlink
from maasi_drivers.links.mavlink.setpoints import SetpointCheck
from maasi_drivers.settings.vehicles import MavlinkSettings
from maasi_filter.arrays import FloatArray

_HEARTBEAT_PERIOD = 1.0
# After this time without attitude, position or status the messages are requested again [s].
_STREAM_PATIENCE = 2.0
# Rates of messages [Hz]; None: that of the settings.
_MESSAGES = {
    'LOCAL_POSITION_NED': None,
    'ATTITUDE_QUATERNION': None,
    'BATTERY_STATUS': 1.0,
    'SYS_STATUS': 1.0,
    'EXTENDED_SYS_STATE': 2.0,
    'EKF_STATUS_REPORT': 2.0,
    'GPS_RAW_INT': 2.0,
    'GPS2_RAW': 2.0,
}
# The same for firmwares with limited set-points, which reject some silently.
_OWN_MESSAGES = {'POSITION_TARGET_LOCAL_NED': 5.0, 'FENCE_STATUS': 2.0}
# Period and number of attempts of an unanswered command [s, 1].
_ANSWER_PATIENCE, _TRIES = 0.5, 5
# Masks: position and yaw only; velocity only; the former without yaw.
_POSITION_AND_YAW, _VELOCITY, _NO_YAW = 0x9F8, 0x9C7, 0x400


# Texts on a fence breach, of older and newer versions of ArduPilot.
_BREACH = re.compile('fence breach', re.IGNORECASE)


@dataclass
class _Command:
    number: int
    parameters: tuple[float, ...]
    sent: float = -math.inf
    tries: int = 0


class Autopilot:
    """An autopilot as described by its messages; times: steady clock [s]."""

    def __init__(
        self, settings: MavlinkSettings, start: list[float], sender: Any, memory: Path | None
    ) -> None:
        self.settings = settings
        self.log = ReportLog()
        self.flight_origin = FlightOrigin(settings, start, memory, self.log)
        self.firmware: Firmware | None = None
        self.failsafes: FailsafeCheck | None = None
        self.refusal = ''
        self.armed = False
        self.mode = -1
        self.lost = False
        self.estimate = Estimate(settings, self.flight_origin, self.on_restart)
        self.commands: deque[_Command] = deque()  #: unanswered commands
        #: Numbers of the commands accepted in this phase of the flight.
        self.accepted: set[int] = set()
        self.fence = FenceUpload(settings, sender, self.log)
        self.setpoints = SetpointCheck()
        self.breached_at = -math.inf  #: time of its last report of a fence breach
        self._sender = sender
        self._received_at = self._heartbeat_at = self._setpoint_at = -math.inf
        self._requested_at = -math.inf  # time of the last request for messages

    @property
    def in_external_mode(self) -> bool:
        """Whether it is in the mode for set-points."""
        return self.firmware is not None and self.mode == self.firmware.external

    def on_restart(self) -> None:
        """Handle a restart of the autopilot."""

    def receive(self, message: Any, now: float) -> tuple[bool, int] | None:
        """Handle a message; for a heartbeat return whether it was armed, and its mode before."""
        kind, source = message.get_type(), (message.get_srcSystem(), message.get_srcComponent())
        if self._shows_own_id(message):
            if self.failsafes is not None:
                self.failsafes.receive_own_id(now)
            return None
        if source != (self.settings.system, mavlink.MAV_COMP_ID_AUTOPILOT1):
            return None
        self._received_at = now
        if kind == 'HEARTBEAT':
            if self.refusal or (self.firmware is None and not self._recognise(message)):
                return None
            before = self.armed, self.mode
            self.armed = bool(message.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
            self.mode = int(message.custom_mode)
            return before
        if kind == 'STATUSTEXT':
            text = message.text.rstrip('\0').strip()
            self.log.add_text(int(message.severity), text, now)
            if _BREACH.search(text):
                self.breached_at = now
        elif kind == 'FENCE_STATUS':
            self.breached_at = now if message.breach_status else self.breached_at
        elif kind == 'PARAM_VALUE':
            self._handle_parameter(message)
        elif kind == 'COMMAND_ACK':
            if self.commands and self.commands[0].number == message.command:
                if message.result == mavlink.MAV_RESULT_IN_PROGRESS:
                    self.commands[0].sent = now
                else:
                    self._conclude(int(message.result))
        elif self.firmware is not None:
            self.fence.update(message, now)
            self.estimate.update(message, now, self.armed)
            if kind == 'POSITION_TARGET_LOCAL_NED':
                position = swap_enu_ned((message.x, message.y, message.z))
                self.setpoints.update(message, position, now)
        return None

    def _shows_own_id(self, message: Any) -> bool:
        """Return whether another program has the driver's id; routers only forward answers."""
        own = self.settings.own_system
        if message.get_srcSystem() == own:
            return True
        return (
            message.get_type() == 'COMMAND_ACK'
            and message.target_system == own
            and message.target_component not in (0, self._sender.srcComponent)
        )

    def _recognise(self, message: Any) -> bool:
        try:
            firmware = identify(int(message.autopilot), int(message.type))
            if firmware.kind != self.settings.vehicle:
                raise ValueError(
                    f'HEARTBEAT: read a {firmware.kind}, allowed is a {self.settings.vehicle}'
                )
        except ValueError as error:
            self.refusal = str(error)
            self.log.add(ERROR, self.refusal)
            return False
        self.firmware = firmware
        self.read_failsafes()
        self.log.add(INFO, f'{firmware.name} connected as system {self.settings.system}')
        return True

    def _handle_parameter(self, message: Any) -> None:
        if self.firmware is None or self.failsafes is None:
            return
        value = float(message.param_value)
        if self.firmware.px4 and message.param_type == mavlink.MAV_PARAM_TYPE_INT32:
            # PX4 sends the bytes of an integer as a float.
            value = float(struct.unpack('<i', struct.pack('<f', value))[0])
        self.failsafes.update(message.param_id.rstrip('\0'), value)

    def send_heartbeat(self, now: float) -> None:
        """Send the driver's heartbeat if it is due."""
        if now - self._heartbeat_at >= _HEARTBEAT_PERIOD:
            self._heartbeat_at = now
            self._sender.heartbeat_send(
                mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, mavlink.MAV_STATE_ACTIVE
            )

    def check_link(self, now: float) -> bool:
        """Update `lost`; return whether it changed."""
        silence, before = now - self._received_at, self.lost
        self.lost = silence > self.settings.link_timeout
        if self.lost != before:
            text = f'link lost: no message for {silence:.1f} s' if self.lost else 'link restored'
            self.log.add(WARNING, f'link: {text}')
        return self.lost != before

    def read_failsafes(self) -> None:
        """Read the failsafe parameters again and upload the fence."""
        assert self.firmware is not None
        self.fence.begin()
        self.failsafes = FailsafeCheck(self.firmware, self.settings, self._sender, self.log)

    def request_data(self, now: float) -> None:
        """Request parameters and messages that are missing."""
        if self.failsafes is not None:
            self.failsafes.read(now)
        if not self.lost:
            self.fence.tick(now)
        silence = now - max(self.estimate.silent_since, self._requested_at)
        known = self._requested_at > -math.inf
        if self.commands or self.lost or (known and silence < _STREAM_PATIENCE):
            return
        self._requested_at = now
        own = _OWN_MESSAGES if self.firmware is not None and self.firmware.limits else {}
        for name, rate in (_MESSAGES | own).items():
            number = getattr(mavlink, f'MAVLINK_MSG_ID_{name}')
            interval = 1e6 / (rate or self.settings.position_rate)
            self.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, (number, interval))

    def request_mode(self, mode: int) -> None:
        """Request a custom mode."""
        assert self.firmware is not None
        numbers = (mode >> 16 & 0xFF, mode >> 24 & 0xFF) if self.firmware.px4 else (mode, 0)
        flag = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
        self.command(mavlink.MAV_CMD_DO_SET_MODE, (flag, *numbers))

    def command(self, number: int, parameters: tuple[float, ...]) -> None:
        """Send a command until it is answered, after earlier ones; report a refusal."""
        self.commands.append(_Command(number, parameters))

    def _conclude(self, result: int | None) -> None:
        command = self.commands.popleft()
        if result == mavlink.MAV_RESULT_ACCEPTED:
            self.accepted.add(command.number)
            return
        known = mavlink.enums['MAV_RESULT'].get(result)
        why = f'result {result}' if known is None else known.name.removeprefix('MAV_RESULT_')
        why = 'not answered' if result is None else why
        if command.number == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
            name = mavlink.mavlink_map[int(command.parameters[0])].msgname
            self.log.add(DEBUG, f'{name}: rate not accepted: {why}')
        else:
            self.log.add(WARNING, f'{mavlink.enums["MAV_CMD"][command.number].name}: {why}')

    def send_commands(self, now: float) -> None:
        """Send what is due."""
        if not self.commands:
            return
        command = self.commands[0]
        if now - command.sent < _ANSWER_PATIENCE:
            return
        if command.tries == _TRIES:
            self._conclude(None)
            return
        parameters = [*command.parameters, *[0.0] * (7 - len(command.parameters))]
        self._sender.command_long_send(
            self.settings.system,
            mavlink.MAV_COMP_ID_AUTOPILOT1,
            command.number,
            command.tries,
            *parameters,
        )
        command.sent = now
        command.tries += 1

    def send_setpoint(self, position: FloatArray | None, yaw: float | None, now: float) -> bool:
        """Send the target position (3,) [m] if due, and return whether; None: stop.

        Without a yaw it keeps its own.
        """
        if now - self._setpoint_at < 1.0 / self.settings.setpoint_rate - 1e-6:
            return False
        self._setpoint_at = now
        if position is None:
            # Zero velocity is accepted inside every fence.
            self.setpoints.reset()
            mask, target = _VELOCITY, [0.0] * 3
        else:
            self.setpoints.note(position, now)
            mask, target = _POSITION_AND_YAW, swap_enu_ned(position).tolist()
        self._sender.set_position_target_local_ned_send(
            int(now * 1000.0) & 0xFFFFFFFF,
            self.settings.system,
            mavlink.MAV_COMP_ID_AUTOPILOT1,
            mavlink.MAV_FRAME_LOCAL_NED,
            mask | (_NO_YAW if yaw is None else 0),
            *target,
            *[0.0] * 6,
            0.0 if yaw is None else swap_yaw(yaw),
            0.0,
        )
        return True
