"""What the driver says to an autopilot, and what it makes of the answers: no wire, no thread."""

from __future__ import annotations

import math
import struct
from collections import Counter, deque
from collections.abc import Callable, Mapping
from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from maasi_drivers.agent.arm_permission import UNTIL_ARM, ArmPermission
from maasi_drivers.links.mavlink.commands import CommandQueue, command_name, result_name
from maasi_drivers.links.mavlink.estimate import Estimate, Telemetry
from maasi_drivers.links.mavlink.failsafes import FailsafeCheck
from maasi_drivers.links.mavlink.firmware import Firmware, identify
from maasi_drivers.links.mavlink.frames import swap_enu_ned, swap_yaw
from maasi_drivers.links.mavlink.protocol import mavlink
from maasi_drivers.links.mavlink.settings import Ending, MavlinkSettings

FloatArray = NDArray[np.float64]

_HEARTBEAT_PERIOD = 1.0
# Without attitude and position for so long their messages are asked for again [s].
_STREAM_PATIENCE = 2.0
# The mode in which it is to end is asked for until it shows.
_ENDING_PERIOD = 0.3
# Between two tries to arm; the autopilot says why not [s].
_ARMING_PERIOD = 2.0
# How long setpoints go ahead of the mode where they must [s].
_STREAM_AHEAD = 1.2
# Height is reached within this; a shorter way is no progress [m].
_RISEN, _PROGRESS = 0.2, 0.1
# Texts of the autopilot that are younger explain a refusal [s].
_TEXT_AGE = 6.0
# Position only, and yaw: no velocity, acceleration, yaw rate.
_SETPOINT_MASK = 0x9F8
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
    active : bool
        Whether the driver is; while it is not, nothing is armed.

    """

    def __init__(self, settings: MavlinkSettings, height: float, sender: Any) -> None:
        self.settings = settings
        self.height = height
        self.phase = Phase.CONNECTING
        self.firmware: Firmware | None = None
        self.active = False
        self.armed = False
        self.mode = -1
        self._permission = ArmPermission(settings.arm_timeout)
        self._estimate = Estimate(settings, self._on_restart)
        self._sender = sender
        self._reports: deque[tuple[int, str]] = deque(maxlen=200)
        self._texts: deque[tuple[float, str]] = deque(maxlen=8)
        self._commands = CommandQueue(settings.system, sender)
        self._detail = ''
        self._beat_at = self._phase_at = self._sent_at = -math.inf
        self._tried_at = self._heard_at = -math.inf
        self._lost = False
        self._failsafes: FailsafeCheck | None = None
        self._fix_needed = False
        self._asked_at = -math.inf
        # Least way left to its height so far, and when [m, s].
        self._nearest, self._nearer_at = math.inf, -math.inf
        # Whether the autopilot has accepted the take-off: it refuses another one.
        self._taking_off = False
        self._setpoint: FloatArray | None = None
        self._yaw: float | None = None
        self._ending: Ending | None = None
        self._ending_taken = False
        # Why it lands by itself.
        self._reason = ''
        # Its local frame is another one since it was restarted after a flight.
        self._displaced = False

    # ---- what the driver wants ---------------------------------------------------------------

    @property
    def flying(self) -> bool:
        """Whether it follows setpoints, with a link that works."""
        return self.phase is Phase.FLYING and not self._lost

    @property
    def telemetry(self) -> Telemetry | None:
        """Where it is; None before it is known."""
        return self._estimate.telemetry

    @property
    def origin(self) -> FloatArray:
        """Of the settings, in the local frame of the autopilot, ENU, (3,) [m].

        Its height is that of the ground when a copter is armed: the estimate drifts until then.
        """
        return self._estimate.origin

    @property
    def dropped(self) -> Counter[str]:
        """Messages that could not be used: kind to number."""
        return self._estimate.dropped

    @property
    def _blind(self) -> str:
        """Why its position is not to be trusted in flight; empty where it is."""
        return self._estimate.problem(self._fix_needed)

    @property
    def charge(self) -> float:
        """Of the battery that counts, 0 to 1; -1 where it is not known."""
        return self._estimate.charge

    @property
    def charge_reports(self) -> int:
        """Messages on batteries so far."""
        return self._estimate.charge_reports

    @property
    def parameters(self) -> Mapping[str, float | None]:
        """Of the failsafes, as read; None where the autopilot does not have it."""
        return {} if self._failsafes is None else self._failsafes.values

    @property
    def at_rest(self) -> bool:
        """Whether nothing is left to say to it when the driver ends."""
        if not self._is_ours or not self.armed:
            return True
        return self.phase is Phase.ENDING and (self._ending_taken or self.mode == self._ending_mode)

    @property
    def _is_ours(self) -> bool:
        return self.phase in (
            Phase.STARTING,
            Phase.ARMING,
            Phase.RISING,
            Phase.FLYING,
            Phase.ENDING,
        )

    @property
    def fault(self) -> str:
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

    def permit(self, now: float) -> str:
        """
        Let it take off once, or be taken over where it flies; return why not, empty where it may.

        Parameters
        ----------
        now : float
            On the steady clock [s].

        """
        problem = self._objection(now)
        if problem:
            self._permission.end()
            return problem
        self._permission.give(now)
        if self.phase is Phase.STOPPED:
            self._enter(Phase.PREPARING)
        return ''

    def forbid(self) -> None:
        """End the permission; what is being armed is left alone, what flies goes on."""
        self._permission.end()
        if self.phase in (Phase.STARTING, Phase.ARMING):
            self._commands.clear()
            self._enter(Phase.WAITING)

    def _objection(self, now: float) -> str:
        """Return why it must not be armed, or taken over."""
        if self.phase in (Phase.RISING, Phase.FLYING):
            return 'it is in the air already'
        if self._displaced:
            return 'the autopilot has restarted: start the driver again'
        if self._lost or self.phase in (Phase.RELEASED, Phase.ENDING, Phase.REFUSED):
            return self.fault
        if self.armed and self.firmware is not None and self.mode != self.firmware.external:
            return f'it is flown in {self.firmware.mode_name(self.mode)}'
        if not (self.settings.arm or self.armed):
            return 'mavlink.arm is false'
        if self.phase is Phase.WAITING and self._failsafes is not None:
            return self._failsafes.problem(now)
        return ''

    @property
    def _is_theirs(self) -> bool:
        """Whether it is armed in the mode for setpoints, but not by this driver."""
        waits = self.phase is Phase.WAITING and self.armed
        return waits and self.firmware is not None and self.mode == self.firmware.external

    def finish(self, ending: Ending, reason: str = '') -> None:
        """Have it hold its position or land, and send it nowhere any more.

        To one that others fly nothing is said, and on the ground it just is not armed any more.

        Parameters
        ----------
        ending : {'hold', 'land'}
            What it is to do.
        reason : str
            For the planner.
        """
        self._permission.end()
        if self.phase is Phase.ENDING and self._ending == ending:
            return
        if self.armed and self._is_ours:
            self._ending, self._ending_taken = ending, False
            self._reason = f', {reason}' if reason else ''
            self._commands.clear()
            what = 'it lands' if ending == 'land' else 'it holds its position'
            self._enter(Phase.ENDING, what + self._reason)
        self.forbid()

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
        elif self.firmware is not None:
            self._estimate.take(message, now, self.armed)

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
            self._on_disarmed(now)
        elif mode not in self._own_modes(before):
            self._let_go(mode)
        elif self.phase is Phase.RELEASED:
            if mode == self.firmware.external and armed and self.firmware.returns:
                self._report(_WARNING, f'the pilot gives {self.firmware.mode_name(mode)} back')
                self._begin_flying()
            elif mode == self.firmware.external and not armed:
                self._report(_INFO, f'{self.firmware.mode_name(mode)} is back: {UNTIL_ARM}')
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
        self._report(_INFO, f'{firmware.name} is there as system {self.settings.system}')
        return True

    def _ask_messages(self, now: float) -> None:
        """Ask for messages, again after a restart: an autopilot forgets their rates."""
        silence = now - max(self._estimate.heard_at, self._asked_at)
        known = self._asked_at > -math.inf
        if self._commands or self._lost or (known and silence < _STREAM_PATIENCE):
            return
        self._asked_at = now
        for name, rate in _MESSAGES.items():
            number = getattr(mavlink, f'MAVLINK_MSG_ID_{name}')
            interval = 1e6 / (rate or self.settings.position_rate)
            self._ask(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, (number, interval))

    def _on_disarmed(self, now: float) -> None:
        self._commands.clear()
        self._permission.end()
        if self.phase is Phase.ENDING:
            self._enter(Phase.STOPPED, f'it has landed{self._reason}, {UNTIL_ARM}')
        elif self.phase not in (Phase.PREPARING, Phase.WAITING):
            text = self._recent_text(now, 2)
            why = f'by the autopilot or the pilot{f" ({text})" if text else ""}'
            self._report(_WARNING, f'it has been disarmed {why}')
            self._enter(Phase.STOPPED, f'{why}, {UNTIL_ARM}')

    def _let_go(self, mode: int) -> None:
        assert self.firmware is not None
        name = self.firmware.mode_name(mode)
        self._report(
            _WARNING, f'the pilot or a failsafe has taken over: mode {name}; the driver lets go'
        )
        self._commands.clear()
        self._permission.end()
        self._setpoint = None
        self._enter(Phase.RELEASED, f'mode {name}')

    def _on_restart(self) -> None:
        """Begin anew with an autopilot that was restarted: its local frame is another one."""
        text = 'the autopilot has restarted'
        self._report(_WARNING, text)
        self._commands.clear()
        self._permission.end()
        self._asked_at = -math.inf
        if self.phase in (Phase.CONNECTING, Phase.PREPARING, Phase.WAITING):
            assert self.firmware is not None
            self._failsafes = FailsafeCheck(
                self.firmware, self.settings, self._sender, self._report
            )
            self._enter(Phase.PREPARING)
        else:
            # After a flight it may stand anywhere.
            self._displaced = True
            self._enter(Phase.STOPPED, f'{text}: start the driver again')

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
        self._commands.take_answer(message, now)

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
        self._ask_messages(now)
        self._go_on(now)
        self._commands.say(now)
        self._say_setpoint(now)

    def _judge_link(self, now: float) -> None:
        lost = now - self._heard_at > self.settings.link_timeout
        if lost and not self._lost:
            self._report(_WARNING, f'link: nothing heard for {now - self._heard_at:.1f} s')
            self.forbid()
        elif self._lost and not lost:
            self._report(_WARNING, 'link: it is back')
            if self.phase is Phase.FLYING:
                self._begin_flying()
        self._lost = lost

    def _go_on(self, now: float) -> None:
        if self._phase_at == -math.inf:
            self._phase_at = now
        if self._permission.expired(now):
            self._expire(now)
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

    def _expire(self, now: float) -> None:
        """Give the take-off up: who asked for it may not expect it any more."""
        text = self._recent_text(now)
        self._report(
            _WARNING,
            f'not armed within {self.settings.arm_timeout:g} s{f" ({text})" if text else ""}, '
            + UNTIL_ARM,
        )
        self.forbid()

    def _prepare(self, now: float) -> None:
        self._detail = self._recent_text(now)
        assert self._failsafes is not None
        if self._failsafes.complete and self._estimate.ready:
            self._enter(Phase.WAITING)
            self._wait(now)

    def _wait(self, now: float) -> None:
        assert self.firmware is not None and self._failsafes is not None
        name = self.firmware.mode_name(self.mode)
        permitted = self.active and self._permission.holds(now)
        if self.armed and not self._is_theirs:
            self._permission.end()
            self._detail = f'it is flown in {name}'
        elif self.armed and permitted:
            self._report(_INFO, f'it is armed, in {name}: taken over')
            self._permission.end()
            if self._estimate.landed == mavlink.MAV_LANDED_STATE_ON_GROUND:
                self._begin_rising(now)
            else:
                self._begin_flying()
        elif self.armed:
            self._detail = f'it is armed in {name}, not by this driver, {UNTIL_ARM}'
        elif not self.settings.arm:
            self._detail = 'arm is false'
        elif not self.active:
            self._detail = 'the driver is not active'
        else:
            problem = self._failsafes.problem(now)
            if problem:
                self._permission.end()
            elif permitted:
                self._setpoint, self._yaw = self._here(), None
                self._enter(Phase.STARTING)
                return
            self._detail = f'{problem}, {UNTIL_ARM}' if problem else UNTIL_ARM

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
            self._permission.end()
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
            self._estimate.origin[2] = self._setpoint[2]
        self._nearest, self._nearer_at = math.inf, now
        self._taking_off = False
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
            self.firmware.rise == 'command'
            and self._estimate.landed == mavlink.MAV_LANDED_STATE_IN_AIR
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
        elif now - self._tried_at >= _ARMING_PERIOD and not self._commands and not self._taking_off:
            self._tried_at = now
            self._ask(mavlink.MAV_CMD_NAV_TAKEOFF, (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, self.height))

    def _begin_flying(self) -> None:
        self._setpoint, self._yaw = self._here(), None
        if self.phase is Phase.RISING:
            self._setpoint[2] = self._top
        if self.phase is not Phase.FLYING:
            self._fix_needed = self._estimate.has_fix
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
                elif number == mavlink.MAV_CMD_NAV_TAKEOFF:
                    self._taking_off = True
                return
            if number == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
                name = mavlink.mavlink_map[int(parameters[0])].msgname
                self._report(7, f'{name} at another rate: {result_name(result)}')
                return
            self._report(_WARNING, f'{command_name(number)}: {result_name(result)}')

        self._commands.ask(number, parameters, answer)

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

    def _recent_text(self, now: float, most: int = 8) -> str:
        """Return what the autopilot has just said, the last of it."""
        texts = list(dict.fromkeys(text for time, text in self._texts if now - time < _TEXT_AGE))
        return '; '.join(texts[-most:])


_HANDLERS: dict[str, Callable[[Vehicle, Any, float], None]] = {
    'HEARTBEAT': Vehicle._on_heartbeat,
    'STATUSTEXT': Vehicle._on_text,
    'PARAM_VALUE': Vehicle._on_parameter,
    'COMMAND_ACK': Vehicle._on_answer,
}
