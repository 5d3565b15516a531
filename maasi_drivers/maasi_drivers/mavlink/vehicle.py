"""What the driver says to an autopilot, and what it makes of the answers: no wire, no thread."""

from __future__ import annotations

import math
import struct
from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from maasi_drivers.mavlink.failsafes import FailsafeCheck
from maasi_drivers.mavlink.firmware import Firmware, identify
from maasi_drivers.mavlink.frames import swap_enu_ned, swap_flu_frd, swap_orientation, swap_yaw
from maasi_drivers.mavlink.protocol import mavlink
from maasi_drivers.mavlink.settings import Ending, MavlinkSettings

FloatArray = NDArray[np.float64]

_HEARTBEAT_PERIOD = 1.0
# A command that is not answered is said again after so long, so often [s, 1].
_ANSWER_PATIENCE, _TRIES = 0.5, 5
# The mode in which it is to end is asked for until it shows.
_ENDING_PERIOD = 0.3
# Between two tries to arm; the autopilot says why not [s].
_ARMING_PERIOD = 2.0
# How long setpoints go ahead of the mode where they must [s].
_STREAM_AHEAD = 1.2
# Height is reached within this; a shorter way is no progress [m].
_RISEN, _PROGRESS = 0.2, 0.1
# Of GPS_RAW_INT: the least fix with a height.
_FIX_3D = 3
# Texts of the autopilot that are younger explain a refusal [s].
_TEXT_AGE = 6.0
# Position only, and yaw: no velocity, acceleration, yaw rate.
_SETPOINT_MASK = 0x9F8
# Of EKF_STATUS_REPORT: a level or absolute position, and none that is only assumed.
_EKF_POSITION, _EKF_ASSUMED = 8 | 16, 128
_ERROR, _WARNING, _INFO = 3, 4, 6

_MESSAGES = {
    'LOCAL_POSITION_NED': None,
    'ATTITUDE_QUATERNION': None,
    'BATTERY_STATUS': 1.0,
    'SYS_STATUS': 1.0,
    'EXTENDED_SYS_STATE': 2.0,
    'EKF_STATUS_REPORT': 2.0,
    'GPS_RAW_INT': 2.0,
}


class Phase(Enum):
    """How far the driver is with a vehicle; the value says why it does not go on from there."""

    CONNECTING = 'nothing heard yet'
    PREPARING = 'no position estimate yet'
    WAITING = 'not armed'
    STARTING = 'takes the mode'
    ARMING = 'is being armed'
    RISING = 'is on its way to its height'
    FLYING = ''
    RELEASED = 'the pilot has taken over'
    ENDING = 'ends'
    STOPPED = 'is disarmed'
    REFUSED = 'is left alone'


@dataclass(frozen=True)
class Telemetry:
    """
    Where a vehicle was, in the local frame of its autopilot turned to ENU.

    Attributes
    ----------
    number : int
        Of the message; one that says nothing new does not count.
    arrival : float
        On the steady clock [s].
    position, velocity : ndarray, shape (3,)
        [m, m/s].
    orientation : ndarray, shape (4,)
        Of FLU in ENU, w first.
    rates : ndarray, shape (3,)
        Angular velocity in FLU [rad/s].

    """

    number: int
    arrival: float
    position: FloatArray
    velocity: FloatArray
    orientation: FloatArray
    rates: FloatArray


@dataclass
class _Command:
    number: int
    parameters: tuple[float, ...]
    answer: Callable[[int | None], None]
    sent: float = -math.inf
    tries: int = 0


class Vehicle:
    """
    One vehicle, from the first heartbeat to the end.

    Parameters
    ----------
    settings : MavlinkSettings
        Of the link.
    height : float
        To which it rises, over its origin; a copter's origin is on the ground [m].
    sender : MAVLink
        Packs messages and writes them to the wire.

    Attributes
    ----------
    phase : Phase
        How far it is.
    firmware : Firmware or None
        Once it is known.
    telemetry : Telemetry or None
        Newest.
    origin : ndarray, shape (3,)
        Of the settings, in the local frame of the autopilot, ENU [m]. Its height is that of the
        ground when a copter is armed: the estimate drifts until then.
    wanted : bool
        Whether it may be armed now; set while the driver is active.

    """

    def __init__(self, settings: MavlinkSettings, height: float, sender: Any) -> None:
        self.settings = settings
        self.height = height
        self.phase = Phase.CONNECTING
        self.firmware: Firmware | None = None
        self.telemetry: Telemetry | None = None
        self.origin = np.zeros(3)
        self.wanted = False
        self.armed = False
        self.mode = -1
        self.dropped: Counter[str] = Counter()
        self._sender = sender
        self._reports: deque[tuple[int, str]] = deque(maxlen=200)
        self._texts: deque[tuple[float, str]] = deque(maxlen=8)
        self._commands: deque[_Command] = deque()
        self._detail = ''
        self._beat_at = self._phase_at = self._sent_at = -math.inf
        self._tried_at = self._heard_at = -math.inf
        self._lost = False
        self._failsafes: FailsafeCheck | None = None
        self._estimates: bool | None = None
        self._fix: int | None = None
        self._fix_needed = False
        self._landed = mavlink.MAV_LANDED_STATE_UNDEFINED
        self._charges: dict[int, float] = {}
        # Least way left to its height so far, and when [m, s].
        self._nearest, self._nearer_at = math.inf, -math.inf
        self._local: tuple[Any, ...] | None = None
        self._attitude = (np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(3))
        self._setpoint: FloatArray | None = None
        self._yaw: float | None = None
        self._ending: Ending | None = None
        self._ending_taken = False
        # Why it lands by itself.
        self._reason = ''

    # ---- what the driver wants ---------------------------------------------------------------

    @property
    def flying(self) -> bool:
        """Whether it follows setpoints, with a link that works."""
        return self.phase is Phase.FLYING and not self._lost

    @property
    def _blind(self) -> str:
        """Why its position is not to be trusted in flight; empty where it is."""
        if self._estimates is False:
            return 'the autopilot has lost its position estimate'
        if self._fix_needed and self._fix is not None and self._fix < _FIX_3D:
            return f'GNSS is lost (GPS_RAW_INT.fix_type {self._fix})'
        return ''

    @property
    def charge(self) -> float:
        """Of the battery that counts, 0 to 1; -1 where it is not known."""
        if self.settings.battery >= 0:
            return self._charges.get(self.settings.battery, -1.0)
        return min((value for value in self._charges.values() if value >= 0.0), default=-1.0)

    @property
    def parameters(self) -> Mapping[str, float | None]:
        """Of the failsafes, as read; None where the autopilot does not have it."""
        return {} if self._failsafes is None else self._failsafes.values

    @property
    def at_rest(self) -> bool:
        """Whether nothing is left to say to it when the driver ends."""
        if self.phase in (Phase.RELEASED, Phase.STOPPED, Phase.REFUSED) or not self.armed:
            return True
        return self.phase is Phase.ENDING and (self._ending_taken or self.mode == self._ending_mode)

    @property
    def trouble(self) -> str:
        """Why it cannot go anywhere; empty where it can."""
        if self._lost:
            return f'link: nothing heard from system {self.settings.system}'
        if self.phase is Phase.FLYING and self._blind:
            return f'vehicle: {self._blind}'
        what = ': '.join(part for part in (self.phase.value, self._detail) if part)
        return f'vehicle: {what}' if what else ''

    def reports(self) -> list[tuple[int, str]]:
        """Return what happened since the last call: severity as in MAVLink, and text."""
        reports = list(self._reports)
        self._reports.clear()
        return reports

    def set_target(self, position: ArrayLike, yaw: float) -> None:
        """
        Have it go to a place and stay there.

        Parameters
        ----------
        position : array_like, shape (3,)
            In its local frame, ENU [m].
        yaw : float
            From east [rad].

        Raises
        ------
        ValueError
            If a number is not finite: autopilots have crashed over that.

        """
        target = np.array(position, dtype=float)
        if target.shape != (3,) or not np.isfinite([*target, yaw]).all():
            raise ValueError(
                f'setpoint: got {target.tolist()}, {yaw}, allowed are finite numbers [m, rad]'
            )
        if self.phase is Phase.FLYING:
            self._setpoint, self._yaw = target, float(yaw)

    def finish(self, ending: Ending, reason: str = '') -> None:
        """Have it hold its position or land, and send it nowhere any more.

        With a pilot's mode nothing is said, and on the ground it just is not armed any more.

        Parameters
        ----------
        ending : {'hold', 'land'}
            What it is to do.
        reason : str
            For the planner.
        """
        self.wanted = False
        if self.phase is Phase.ENDING and self._ending == ending:
            return
        if self.armed and self.phase not in (Phase.RELEASED, Phase.STOPPED, Phase.REFUSED):
            self._ending, self._ending_taken = ending, False
            self._reason = f', {reason}' if reason else ''
            self._commands.clear()
            what = 'it lands' if ending == 'land' else 'it holds its position'
            self._enter(Phase.ENDING, what + self._reason)

    # ---- what comes in -----------------------------------------------------------------------

    def handle(self, message: Any, now: float) -> None:
        """Take a message; of others only heartbeats with the driver's own id matter."""
        if message.get_srcSystem() == self.settings.own_system:
            # What the driver sends does not come back.
            if message.get_type() == 'HEARTBEAT' and self._failsafes is not None:
                self._failsafes.hear_own_id(now)
            return
        if (
            message.get_srcSystem() != self.settings.system
            or message.get_srcComponent() != mavlink.MAV_COMP_ID_AUTOPILOT1
        ):
            return
        self._heard_at = now
        handler = _HANDLERS.get(message.get_type())
        if handler is not None:
            handler(self, message, now)

    def _on_heartbeat(self, message: Any, now: float) -> None:
        if self.phase is Phase.REFUSED:
            return
        if self.firmware is None and not self._recognise(message):
            return
        armed = bool(message.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
        mode, before = int(message.custom_mode), self.mode
        was_armed, self.armed, self.mode = self.armed, armed, mode
        if self.phase is Phase.CONNECTING:
            self._enter(Phase.PREPARING)
            return
        assert self.firmware is not None
        if was_armed and not armed:
            self._on_disarmed()
        elif mode not in self._own_modes(before):
            self._let_go(mode)
        elif self.phase is Phase.RELEASED:
            if mode == self.firmware.external and armed and self.firmware.returns:
                self._report(_WARNING, f'the pilot gives {self.firmware.mode_name(mode)} back')
                self._begin_flying()
            elif mode == self.firmware.external and not armed:
                self._report(_INFO, f'{self.firmware.mode_name(mode)} is back: it may be armed')
                self._enter(Phase.PREPARING)
            elif mode != before:
                self._detail = f'mode {self.firmware.mode_name(mode)}'

    def _own_modes(self, before: int) -> set[int]:
        """Return the modes, of which any other is the pilot's or a failsafe's."""
        assert self.firmware is not None
        external = self.firmware.external
        if self.phase in (Phase.ARMING, Phase.RISING, Phase.FLYING):
            return {external}
        if self.phase is Phase.STARTING:
            return {before, external}
        if self.phase is Phase.ENDING:
            return {before, external, self._ending_mode}
        return {self.mode}

    def _recognise(self, message: Any) -> bool:
        try:
            firmware = identify(int(message.autopilot), int(message.type))
            if firmware.kind != self.settings.vehicle:
                raise ValueError(
                    f'HEARTBEAT: read a {firmware.kind}, allowed is a {self.settings.vehicle}'
                )
        except ValueError as error:
            self._report(_ERROR, str(error))
            self._enter(Phase.REFUSED, str(error))
            return False
        self.firmware = firmware
        self._failsafes = FailsafeCheck(firmware, self.settings, self._sender, self._report)
        for name, rate in _MESSAGES.items():
            number = getattr(mavlink, f'MAVLINK_MSG_ID_{name}')
            interval = 1e6 / (rate or self.settings.position_rate)
            self._ask(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, (number, interval))
        self._report(_INFO, f'{firmware.name} is there as system {self.settings.system}')
        return True

    def _on_disarmed(self) -> None:
        self._commands.clear()
        if self.phase is Phase.ENDING:
            self._enter(Phase.STOPPED, f'it has landed{self._reason}')
        elif self.phase not in (Phase.PREPARING, Phase.WAITING):
            self._report(_WARNING, 'the autopilot or the pilot has disarmed it')
            self._enter(Phase.STOPPED, 'by the autopilot or the pilot')
        self.wanted = False

    def _let_go(self, mode: int) -> None:
        assert self.firmware is not None
        name = self.firmware.mode_name(mode)
        self._report(
            _WARNING, f'the pilot or a failsafe has taken over: mode {name}; the driver lets go'
        )
        self._commands.clear()
        self._setpoint = None
        self._enter(Phase.RELEASED, f'mode {name}')

    def _on_position(self, message: Any, now: float) -> None:
        values = (message.x, message.y, message.z, message.vx, message.vy, message.vz)
        if not all(map(math.isfinite, values)):
            self.dropped['LOCAL_POSITION_NED that is not finite'] += 1
            return
        before = self._local
        if before is not None and message.time_boot_ms <= before[0]:
            # Heard again, or an autopilot that was started again: then the frame is another.
            if before[0] - message.time_boot_ms < 1000:
                return
            self._on_restart()
        self._local = (message.time_boot_ms, values)
        if before is not None and before[1] == values and self.armed:
            # An estimate that moves at all never says the same twice: it is frozen.
            self.dropped['LOCAL_POSITION_NED that is frozen'] += 1
            return
        if self.telemetry is None and self.settings.origin == 'here':
            self.origin = swap_enu_ned(values[:3])
        self.telemetry = Telemetry(
            0 if self.telemetry is None else self.telemetry.number + 1,
            now,
            swap_enu_ned(values[:3]),
            swap_enu_ned(values[3:]),
            *self._attitude,
        )

    def _on_restart(self) -> None:
        """Leave an autopilot alone that was restarted: its local frame is another one."""
        text = 'the autopilot has restarted'
        self._report(_WARNING, text)
        if self.phase not in (Phase.CONNECTING, Phase.PREPARING, Phase.WAITING):
            self._commands.clear()
            self._enter(Phase.STOPPED, text)
            self.wanted = False

    def _on_attitude(self, message: Any, now: float) -> None:
        quaternion = np.array([message.q1, message.q2, message.q3, message.q4])
        rates = np.array([message.rollspeed, message.pitchspeed, message.yawspeed])
        norm = float(np.sqrt((quaternion * quaternion).sum()))
        if not (np.isfinite(rates).all() and math.isfinite(norm) and 0.9 < norm < 1.1):
            self.dropped['ATTITUDE_QUATERNION that is none'] += 1
            return
        self._attitude = (swap_orientation(quaternion / norm), swap_flu_frd(rates))

    def _on_battery(self, message: Any, now: float) -> None:
        left = message.battery_remaining
        self._charges[int(message.id)] = left / 100.0 if 0 <= left <= 100 else -1.0

    def _on_status(self, message: Any, now: float) -> None:
        """Take the first battery's charge, where BATTERY_STATUS does not come."""
        left = message.battery_remaining
        if 0 not in self._charges and 0 <= left <= 100:
            self._charges[0] = left / 100.0

    def _on_landed(self, message: Any, now: float) -> None:
        self._landed = int(message.landed_state)

    def _on_gnss(self, message: Any, now: float) -> None:
        self._fix = int(message.fix_type)

    def _on_estimator(self, message: Any, now: float) -> None:
        self._estimates = bool(message.flags & _EKF_POSITION) and not message.flags & _EKF_ASSUMED

    def _on_text(self, message: Any, now: float) -> None:
        text = message.text.rstrip('\0').strip()
        self._texts.append((now, text))
        self._report(int(message.severity), f'autopilot: {text}')

    def _on_parameter(self, message: Any, now: float) -> None:
        if self.firmware is None or self._failsafes is None:
            return
        value = float(message.param_value)
        if self.firmware.name == 'PX4' and message.param_type == mavlink.MAV_PARAM_TYPE_INT32:
            # PX4 sends the bytes of an integer in the place of a float.
            value = float(struct.unpack('<i', struct.pack('<f', value))[0])
        self._failsafes.take(message.param_id.rstrip('\0'), value)

    def _on_answer(self, message: Any, now: float) -> None:
        if not self._commands or self._commands[0].number != message.command:
            return
        if message.result == mavlink.MAV_RESULT_IN_PROGRESS:
            self._commands[0].sent = now
            return
        self._commands.popleft().answer(int(message.result))

    # ---- what goes out -----------------------------------------------------------------------

    def tick(self, now: float) -> None:
        """Say what is due; at least 50 times a second."""
        if now - self._beat_at >= _HEARTBEAT_PERIOD:
            self._beat_at = now
            self._sender.heartbeat_send(
                mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, mavlink.MAV_STATE_ACTIVE
            )
        if self.firmware is None or self._failsafes is None:
            return
        self._judge_link(now)
        self._failsafes.read(now)
        self._go_on(now)
        self._say_command(now)
        self._say_setpoint(now)

    def _judge_link(self, now: float) -> None:
        lost = now - self._heard_at > self.settings.link_timeout
        if lost and not self._lost:
            self._report(_WARNING, f'link: nothing heard for {now - self._heard_at:.1f} s')
        elif self._lost and not lost:
            self._report(_WARNING, 'link: it is back')
            if self.phase is Phase.FLYING:
                self._begin_flying()
        self._lost = lost

    def _go_on(self, now: float) -> None:
        if self._phase_at == -math.inf:
            self._phase_at = now
        phase = self.phase
        if phase is Phase.PREPARING:
            self._prepare(now)
        elif phase is Phase.WAITING:
            self._wait(now)
        elif phase is Phase.STARTING:
            self._take_mode(now)
        elif phase is Phase.ARMING:
            self._arm(now)
        elif phase is Phase.RISING:
            self._rise(now)
        elif phase is Phase.ENDING:
            self._end(now)

    def _prepare(self, now: float) -> None:
        self._detail = self._recent_text(now)
        assert self._failsafes is not None
        if self._failsafes.complete and self.telemetry is not None and self._estimates is not False:
            self._enter(Phase.WAITING)

    def _wait(self, now: float) -> None:
        assert self.firmware is not None
        if self.armed:
            if self.mode == self.firmware.external:
                name = self.firmware.mode_name(self.mode)
                self._report(_INFO, f'it is armed, in {name}: taken over')
                self._begin_flying()
            else:
                self._detail = f'it is flown in {self.firmware.mode_name(self.mode)}'
            return
        if not self.settings.arm:
            self._detail = 'arm is false'
        elif not self.wanted:
            self._detail = 'the driver is not active'
        else:
            assert self._failsafes is not None
            self._detail = self._failsafes.problem(now)
            if not self._detail:
                self._setpoint, self._yaw = self._here(), None
                self._enter(Phase.STARTING)

    def _take_mode(self, now: float) -> None:
        assert self.firmware is not None
        if self.firmware.streams_first and now - self._phase_at < _STREAM_AHEAD:
            return
        if self.mode == self.firmware.external:
            self._enter(Phase.ARMING)
        elif now - self._tried_at >= _ARMING_PERIOD and not self._commands:
            self._tried_at = now
            self._ask_mode(self.firmware.external)

    def _arm(self, now: float) -> None:
        if self.armed:
            self._begin_rising(now)
        elif now - self._tried_at >= _ARMING_PERIOD and not self._commands:
            self._tried_at = now
            self._detail = self._recent_text(now)
            self._ask(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, (1.0,))

    def _begin_rising(self, now: float) -> None:
        assert self.firmware is not None
        self._setpoint = self._here()
        if self.firmware.kind == 'copter':
            # It stands on the ground; the barometer may have drifted since the estimator started.
            self.origin[2] = self._setpoint[2]
        self._nearest, self._nearer_at = math.inf, now
        self._enter(Phase.RISING)

    @property
    def _top(self) -> float:
        """Height to which it rises, in its local frame [m]."""
        return float(self.origin[2]) + self.height

    def _rise(self, now: float) -> None:
        assert self.firmware is not None and self.telemetry is not None
        assert self._setpoint is not None
        height = float(self.telemetry.position[2])
        left = abs(height - self._top)
        if left < self._nearest - _PROGRESS:
            self._nearest, self._nearer_at = left, now
        # Home may be elsewhere: what the take-off leaves over is flown by set-point.
        taken_off = (
            self.firmware.rise == 'command' and self._landed == mavlink.MAV_LANDED_STATE_IN_AIR
        )
        if left <= _RISEN or taken_off:
            self._begin_flying()
        elif now - self._nearer_at > self.settings.rise_timeout:
            reason = (
                f'it came no nearer to its height in {self.settings.rise_timeout:g} s: at '
                f'{height:.1f} m of {self._top:.1f} m'
            )
            self._report(_ERROR, f'{reason}: it lands')
            self.finish('land', reason)
        elif self.firmware.rise == 'setpoint':
            self._setpoint[2] = self._top
        elif (
            now - self._tried_at >= _ARMING_PERIOD
            and not self._commands
            and abs(height - float(self.origin[2])) < _RISEN
        ):
            # ArduCopter refuses it once it is in the air.
            self._tried_at = now
            self._ask(mavlink.MAV_CMD_NAV_TAKEOFF, (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, self.height))

    def _begin_flying(self) -> None:
        self._setpoint, self._yaw = self._here(), None
        if self.phase is Phase.RISING:
            self._setpoint[2] = self._top
        if self.phase is not Phase.FLYING:
            self._fix_needed = self._fix is not None and self._fix >= _FIX_3D
        self._commands.clear()
        self._enter(Phase.FLYING)

    @property
    def _ending_mode(self) -> int:
        assert self.firmware is not None
        return self.firmware.land if self._ending == 'land' else self.firmware.hold

    def _end(self, now: float) -> None:
        if (
            self.mode != self._ending_mode
            and not self._commands
            and now - self._tried_at >= _ENDING_PERIOD
        ):
            self._tried_at = now
            self._ask_mode(self._ending_mode)

    def _here(self) -> FloatArray:
        return np.zeros(3) if self.telemetry is None else self.telemetry.position.copy()

    def _ask_mode(self, mode: int) -> None:
        assert self.firmware is not None
        flag = float(mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED)
        if self.firmware.name == 'PX4':
            parameters = (flag, float(mode >> 16 & 0xFF), float(mode >> 24 & 0xFF))
        else:
            parameters = (flag, float(mode), 0.0)
        self._ask(mavlink.MAV_CMD_DO_SET_MODE, parameters)

    def _ask(self, number: int, parameters: tuple[float, ...]) -> None:
        def answer(result: int | None) -> None:
            if result == mavlink.MAV_RESULT_ACCEPTED:
                if number == mavlink.MAV_CMD_DO_SET_MODE:
                    self._ending_taken = self.phase is Phase.ENDING
                return
            if number == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
                name = mavlink.mavlink_map[int(parameters[0])].msgname
                self._report(7, f'{name} at another rate: {_result_name(result)}')
                return
            self._report(_WARNING, f'{_command_name(number)}: {_result_name(result)}')

        self._commands.append(_Command(number, parameters, answer))

    def _say_command(self, now: float) -> None:
        if not self._commands:
            return
        command = self._commands[0]
        if now - command.sent < _ANSWER_PATIENCE:
            return
        if command.tries == _TRIES:
            self._commands.popleft().answer(None)
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

    def _say_setpoint(self, now: float) -> None:
        assert self.firmware is not None
        target = self._setpoint
        if target is None or now - self._sent_at < 1.0 / self.settings.setpoint_rate - 1e-6:
            return
        rises = self.phase is Phase.RISING and self.firmware.rise == 'setpoint'
        if not (
            rises
            or self.phase is Phase.FLYING
            or (self.firmware.streams_first and self.phase in (Phase.STARTING, Phase.ARMING))
        ):
            return
        self._sent_at = now
        north, east, down = swap_enu_ned(target).tolist()
        yaw = 0.0 if self._yaw is None else swap_yaw(self._yaw)
        self._sender.set_position_target_local_ned_send(
            int(now * 1000.0) & 0xFFFFFFFF,
            self.settings.system,
            mavlink.MAV_COMP_ID_AUTOPILOT1,
            mavlink.MAV_FRAME_LOCAL_NED,
            # Before the driver has said where it looks, it looks where it does.
            _SETPOINT_MASK | (0x400 if self._yaw is None else 0),
            north,
            east,
            down,
            *[0.0] * 6,
            yaw,
            0.0,
        )

    # ---- what happened -----------------------------------------------------------------------

    def _enter(self, phase: Phase, detail: str = '') -> None:
        self.phase, self._detail = phase, detail
        self._phase_at = self._tried_at = -math.inf

    def _report(self, severity: int, text: str) -> None:
        self._reports.append((severity, text))

    def _recent_text(self, now: float) -> str:
        return '; '.join(
            dict.fromkeys(text for time, text in self._texts if now - time < _TEXT_AGE)
        )


def _command_name(number: int) -> str:
    return str(mavlink.enums['MAV_CMD'][number].name)


def _result_name(result: int | None) -> str:
    if result is None:
        return 'not answered'
    item = mavlink.enums['MAV_RESULT'].get(result)
    return f'result {result}' if item is None else str(item.name).removeprefix('MAV_RESULT_')


_HANDLERS: dict[str, Callable[[Vehicle, Any, float], None]] = {
    'HEARTBEAT': Vehicle._on_heartbeat,
    'LOCAL_POSITION_NED': Vehicle._on_position,
    'ATTITUDE_QUATERNION': Vehicle._on_attitude,
    'BATTERY_STATUS': Vehicle._on_battery,
    'SYS_STATUS': Vehicle._on_status,
    'EXTENDED_SYS_STATE': Vehicle._on_landed,
    'GPS_RAW_INT': Vehicle._on_gnss,
    'EKF_STATUS_REPORT': Vehicle._on_estimator,
    'STATUSTEXT': Vehicle._on_text,
    'PARAM_VALUE': Vehicle._on_parameter,
    'COMMAND_ACK': Vehicle._on_answer,
}
