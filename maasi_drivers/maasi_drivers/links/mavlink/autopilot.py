"""The messages of an autopilot: its type, mode and parameters, and requests to it."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from maasi_drivers.links.mavlink.estimate import Estimate, FlightOrigin
from maasi_drivers.links.mavlink.firmware import FailsafeCheck, Firmware, identify
from maasi_drivers.links.mavlink.protocol import (
    DEBUG,
    ERROR,
    INFO,
    WARNING,
    CommandQueue,
    ReportLog,
    command_name,
    mavlink,
    result_name,
)
from maasi_drivers.settings.vehicles import MavlinkSettings

_HEARTBEAT_PERIOD = 1.0
# Without attitude, position or their status for so long the messages are requested again [s].
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


@dataclass(frozen=True)
class ModeChange:
    """What a heartbeat says, and what the one before said: armed or not, and custom mode."""

    was_armed: bool
    armed: bool
    before: int
    mode: int


class Autopilot:
    """One autopilot, as its messages describe it."""

    def __init__(
        self,
        settings: MavlinkSettings,
        sender: Any,
        log: ReportLog,
        place: FlightOrigin,
        on_restart: Callable[[], None],
    ) -> None:
        self.firmware: Firmware | None = None
        self.failsafes: FailsafeCheck | None = None
        self.refusal = ''
        self.armed = False
        self.mode = -1
        self.lost = False
        self.estimate = Estimate(settings, place, on_restart)
        self.commands = CommandQueue(settings.system, sender)
        self._settings = settings
        self._sender = sender
        self._log = log
        self._received_at = self._heartbeat_at = self._requested_at = -math.inf

    @property
    def mode_name(self) -> str:
        """Of the present mode."""
        assert self.firmware is not None
        return self.firmware.mode_name(self.mode)

    @property
    def in_external_mode(self) -> bool:
        """Whether it is in the mode in which it takes set-points."""
        return self.firmware is not None and self.mode == self.firmware.external

    # ---- what comes in -----------------------------------------------------------------------

    def handle(self, message: Any, now: float) -> ModeChange | None:
        """Take a message; return what a heartbeat says.

        Of other systems only messages with the driver's own id count.
        """
        kind = message.get_type()
        if self._shows_own_id(message):
            if self.failsafes is not None:
                self.failsafes.hear_own_id(now)
            return None
        if (
            message.get_srcSystem() != self._settings.system
            or message.get_srcComponent() != mavlink.MAV_COMP_ID_AUTOPILOT1
        ):
            return None
        self._received_at = now
        if kind == 'HEARTBEAT':
            return self._take_heartbeat(message)
        if kind == 'STATUSTEXT':
            self._log.add_text(int(message.severity), message.text.rstrip('\0').strip(), now)
        elif kind == 'PARAM_VALUE':
            self._take_parameter(message)
        elif kind == 'COMMAND_ACK':
            self.commands.take_answer(message, now)
        elif self.firmware is not None:
            self.estimate.take(message, now, self.armed)
        return None

    def _shows_own_id(self, message: Any) -> bool:
        """Return whether another program has the driver's system id.

        The driver does not receive its own messages. Behind a router that keeps programs apart,
        the answers to the other one's commands are all that comes.
        """
        own = self._settings.own_system
        if message.get_srcSystem() == own:
            return True
        return (
            message.get_type() == 'COMMAND_ACK'
            and message.target_system == own
            and message.target_component not in (0, self._sender.srcComponent)
        )

    def _take_heartbeat(self, message: Any) -> ModeChange | None:
        if self.refusal or (self.firmware is None and not self._recognise(message)):
            return None
        was_armed, before = self.armed, self.mode
        self.armed = bool(message.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
        self.mode = int(message.custom_mode)
        return ModeChange(was_armed, self.armed, before, self.mode)

    def _recognise(self, message: Any) -> bool:
        try:
            firmware = identify(int(message.autopilot), int(message.type))
            if firmware.kind != self._settings.vehicle:
                raise ValueError(
                    f'HEARTBEAT: read a {firmware.kind}, allowed is a {self._settings.vehicle}'
                )
        except ValueError as error:
            self.refusal = str(error)
            self._log.add(ERROR, self.refusal)
            return False
        self.firmware = firmware
        self.read_failsafes()
        self._log.add(INFO, f'{firmware.name} is there as system {self._settings.system}')
        return True

    def _take_parameter(self, message: Any) -> None:
        if self.firmware is None or self.failsafes is None:
            return
        value = float(message.param_value)
        if self.firmware.name == 'PX4' and message.param_type == mavlink.MAV_PARAM_TYPE_INT32:
            # PX4 sends the bytes of an integer in the place of a float.
            value = float(struct.unpack('<i', struct.pack('<f', value))[0])
        self.failsafes.take(message.param_id.rstrip('\0'), value)

    # ---- what goes out -----------------------------------------------------------------------

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
        self.lost = silence > self._settings.link_timeout
        if self.lost and not before:
            self._log.add(WARNING, f'link: nothing heard for {silence:.1f} s')
        elif before and not self.lost:
            self._log.add(WARNING, 'link: it is back')
        return self.lost != before

    def read_failsafes(self) -> None:
        """Read the failsafe parameters from the beginning."""
        assert self.firmware is not None
        self.failsafes = FailsafeCheck(self.firmware, self._settings, self._sender, self._log.add)

    def forget_requests(self) -> None:
        """Discard open commands, and request messages anew: a restart resets their rates."""
        self.commands.clear()
        self._requested_at = -math.inf

    def request_data(self, now: float) -> None:
        """Request parameters and messages that are missing."""
        if self.failsafes is not None:
            self.failsafes.read(now)
        silence = now - max(self.estimate.silent_since, self._requested_at)
        known = self._requested_at > -math.inf
        if self.commands or self.lost or (known and silence < _STREAM_PATIENCE):
            return
        self._requested_at = now
        for name, rate in _MESSAGES.items():
            number = getattr(mavlink, f'MAVLINK_MSG_ID_{name}')
            interval = 1e6 / (rate or self._settings.position_rate)
            self.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, (number, interval))

    def request_mode(self, mode: int, on_accepted: Callable[[], None] | None = None) -> None:
        """Request a custom mode."""
        assert self.firmware is not None
        flag = float(mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED)
        if self.firmware.name == 'PX4':
            parameters = (flag, float(mode >> 16 & 0xFF), float(mode >> 24 & 0xFF))
        else:
            parameters = (flag, float(mode), 0.0)
        self.command(mavlink.MAV_CMD_DO_SET_MODE, parameters, on_accepted)

    def command(
        self,
        number: int,
        parameters: tuple[float, ...],
        on_accepted: Callable[[], None] | None = None,
    ) -> None:
        """Send a command until it is answered; report a refusal."""

        def answer(result: int | None) -> None:
            if result == mavlink.MAV_RESULT_ACCEPTED:
                if on_accepted is not None:
                    on_accepted()
            elif number == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
                name = mavlink.mavlink_map[int(parameters[0])].msgname
                self._log.add(DEBUG, f'{name} at another rate: {result_name(result)}')
            else:
                self._log.add(WARNING, f'{command_name(number)}: {result_name(result)}')

        self.commands.ask(number, parameters, answer)
