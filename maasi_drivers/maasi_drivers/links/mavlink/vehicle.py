"""Phases of a vehicle's flight from its first heartbeat to the end. Without I/O and threads."""

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from maasi_drivers.agent.flight_rules import UNTIL_ARM, ArmPermission
from maasi_drivers.links.mavlink.autopilot import Autopilot
from maasi_drivers.links.mavlink.firmware import FailsafeCheck, Firmware
from maasi_drivers.links.mavlink.phases import COMMANDED, UNABLE, VehiclePhase
from maasi_drivers.links.mavlink.protocol import ERROR, INFO, WARNING, mavlink
from maasi_drivers.links.mavlink.setpoints import braking_lead
from maasi_drivers.settings.vehicles import Ending, MavlinkSettings
from maasi_filter.arrays import FloatArray
from maasi_filter.wording import number

_MODE, _TAKE_OFF = mavlink.MAV_CMD_DO_SET_MODE, mavlink.MAV_CMD_NAV_TAKEOFF
_SPEED, _GROUND_SPEED = mavlink.MAV_CMD_DO_CHANGE_SPEED, mavlink.SPEED_TYPE_GROUNDSPEED
_REJECTED = 2.0  # duration of a rejected set-point's fault, at standstill [s]
_SAME_TIME = 5.0  # a fence breach and a mode change within this time belong together [s]
# Modes that an autopilot enters by itself.
_FAILSAFE_MODES = frozenset({'RTL', 'LAND', 'BRAKE', 'SMART_RTL', 'AUTO_RTL', 'SURFACE'})
_ENDING_PERIOD = 0.3  # period of requests for the final mode [s]
_ARMING_PERIOD = 2.0  # period of arming attempts; the autopilot reports refusals [s]
_STREAM_AHEAD = 1.2  # duration of set-points before a mode that needs them [s]
# Height tolerance, and smallest change that counts as progress [m].
_REACHED, _PROGRESS = 0.2, 0.1


class Vehicle(Autopilot):
    """A vehicle from its first heartbeat to the end; times: steady clock [s]."""

    def __init__(
        self, settings: MavlinkSettings, start: list[float], sender: Any, memory: Path | None = None
    ) -> None:
        super().__init__(settings, start, sender, memory)
        # Height over its origin; a copter's on the ground [m].
        self.height = start[2] - settings.ground
        self.phase = VehiclePhase.CONNECTING
        self.active = False
        self._permission = ArmPermission(settings.arm_timeout)
        # Target position and yaw; none: it stops, and keeps its yaw.
        self._target: FloatArray | None = None
        self._yaw: float | None = None
        #: Largest speed [m/s]; none: the autopilot's.
        self.speed: float | None = None
        #: Planned deceleration [m/s^2]; none: any.
        self.braking: float | None = None
        self._speed_due = True
        #: The set-point (3,) that the autopilot has just rejected, or None.
        self.rejected: FloatArray | None = None
        self._rejected_at = self._released_at = -math.inf
        # Smallest distance to its height so far [m], and its time.
        self._least_left, self._nearer_at = math.inf, -math.inf
        self._detail = ''
        self._phase_at = self._tried_at = -math.inf
        self._fix_needed = False
        self._ending: Ending | None = None
        self._reason = ''  # why it lands by itself
        # Why its local frame is undefined: restarted after a flight, or not the only one.
        self._displaced = ''

    @property
    def flying(self) -> bool:
        """Whether it follows set-points, with a working link."""
        return self.phase is VehiclePhase.FLYING and not self.lost

    @property
    def in_air(self) -> bool:
        """Whether it is armed and not on the ground."""
        landed = self.estimate.landed == mavlink.MAV_LANDED_STATE_ON_GROUND
        return self.armed and not landed

    @property
    def at_rest(self) -> bool:
        """Whether the driver can end without a command."""
        if self.phase not in COMMANDED or not self.armed:
            return True
        return self.phase is VehiclePhase.ENDING and _MODE in self.accepted

    @property
    def fault(self) -> str:
        """Why it cannot fly to goals, or an empty text."""
        if self.lost:
            return f'link: no message from system {self.settings.system}'
        if self.flight_origin.problem:
            return f'vehicle: {self.flight_origin.problem}'
        flying = self.phase is VehiclePhase.FLYING
        problem = self.estimate.problem(self._fix_needed) or self.fence.problem if flying else ''
        phase = self._taken_over if self.phase is VehiclePhase.RELEASED else self.phase.value
        what = problem or ': '.join(part for part in (phase, self._detail) if part)
        return f'vehicle: {what}' if what else ''

    @property
    def _taken_over(self) -> str:
        if abs(self.breached_at - self._released_at) < _SAME_TIME:
            return 'fence breached: the autopilot has taken control'
        if self._firmware.mode_name(self.mode) in _FAILSAFE_MODES:
            return 'the pilot or a failsafe has taken control'
        return VehiclePhase.RELEASED.value

    @property
    def _firmware(self) -> Firmware:
        assert self.firmware is not None
        return self.firmware

    @property
    def _ending_mode(self) -> int:
        return self._firmware.land if self._ending == 'land' else self._firmware.hold

    @property
    def _top(self) -> float:
        return float(self.estimate.origin[2]) + self.height

    def _position(self) -> FloatArray:
        telemetry = self.estimate.telemetry
        return np.zeros(3) if telemetry is None else telemetry.position.copy()

    def set_target(self, position: ArrayLike, yaw: float) -> None:
        """Fly to a position (3,) [m] with a yaw [rad] and stay there."""
        target = np.array(position, dtype=float)
        if not np.isfinite([*target, yaw]).all():
            raise ValueError(
                f'setpoint: got {target.tolist()}, {yaw}, allowed are finite numbers [m, rad]'
            )
        if self.phase is VehiclePhase.FLYING and self.rejected is None:
            self._target, self._yaw = target, float(yaw)

    def brake(self) -> None:
        """Stop and stay there."""
        if self.phase is VehiclePhase.FLYING:
            self._target, self._yaw = None, None

    def lead(self, speed: float) -> float:
        """Return the lead of set-points for a speed [m/s] [m]."""
        lead, failsafes = self.settings.lead * speed, self.failsafes
        if failsafes is None or not self._firmware.limits:
            return lead
        braking = braking_lead(speed, failsafes.limit('acceleration'), failsafes.limit('jerk'))
        if self.speed is None or _SPEED not in self.accepted:
            return braking
        # Farther than for the speed only if the autopilot limits the speed.
        return braking + lead * min(speed / self.speed, 1.0) ** 2

    def permit(self, now: float) -> str:
        """Permit one take-off, or take control in the air; return why not, or nothing."""
        problem = self._permission.ask(now, self._objection(now))
        if not problem and self.phase is VehiclePhase.STOPPED:
            self._enter(VehiclePhase.PREPARING)
        return problem

    def forbid(self) -> None:
        """End the permission: arming is aborted, a flight continues."""
        self._permission.end()
        if self.phase in (VehiclePhase.STARTING, VehiclePhase.ARMING):
            self.commands.clear()
            self._enter(VehiclePhase.WAITING)

    def stop(self) -> None:
        """End the permission; abort a take-off and land; a flight continues."""
        if self.phase is VehiclePhase.RISING:
            self.finish('land', 'take-off stopped')
        self.forbid()

    def _objection(self, now: float) -> str:
        if self.phase in (VehiclePhase.RISING, VehiclePhase.FLYING):
            return 'it is in the air already'
        if self._displaced:
            return f'{self._displaced}: restart the driver'
        if self.lost or self.flight_origin.problem or self.phase in UNABLE:
            return self.fault
        if self.armed and self.firmware is not None and not self.in_external_mode:
            return f'it is flying in {self.firmware.mode_name(self.mode)}'
        if not (self.settings.arm or self.armed):
            return 'mavlink.arm is false'
        if self.phase is VehiclePhase.WAITING and self.failsafes is not None:
            return self.failsafes.problem(now) or self.fence.problem
        return ''

    def finish(self, ending: Ending, reason: str = '') -> None:
        """Hold or land if the driver controls it; afterwards never arm or move it."""
        self._permission.end()
        if self.phase is VehiclePhase.ENDING and self._ending == ending:
            return
        if self.armed and self.phase in COMMANDED:
            self._ending = ending
            self._reason = f', {reason}' if reason else ''
            self.commands.clear()
            what = 'landing' if ending == 'land' else 'holding its position'
            self._enter(VehiclePhase.ENDING, what + self._reason)
        self.forbid()

    def handle(self, message: Any, now: float) -> None:
        """Take a message."""
        before = self.receive(message, now)
        if before is not None:
            self._check_mode(*before, now)
        elif self.refusal and self.phase is not VehiclePhase.REFUSED:
            self._enter(VehiclePhase.REFUSED, self.refusal)

    def _check_mode(self, was_armed: bool, before: int, now: float) -> None:
        """Give up control if the pilot, a failsafe or a disarming took it."""
        firmware, mode, armed = self._firmware, self.mode, self.armed
        if self.phase is VehiclePhase.CONNECTING:
            self._enter(VehiclePhase.PREPARING)
        elif was_armed and not armed:
            self._on_disarmed(now)
        elif mode not in self._own_modes(before):
            name, self._released_at = firmware.mode_name(mode), now
            self.log.add(
                WARNING, f'{self._taken_over}: mode {name}; the driver releases the vehicle'
            )
            self.commands.clear()
            self._permission.end()
            self._target = None
            self._enter(VehiclePhase.RELEASED, f'mode {name}')
        elif self.phase is VehiclePhase.ENDING:
            self.accepted.discard(_MODE)
            if mode == self._ending_mode:
                self.accepted.add(_MODE)
                self.commands.clear()
        elif self.phase is VehiclePhase.RELEASED:
            name = firmware.mode_name(mode)
            if mode == firmware.external and armed and not firmware.px4:
                self.log.add(WARNING, f'the pilot returned control in {name}')
                self._begin_flying()
            elif mode == firmware.external and not armed:
                self.log.add(INFO, f'{name} is back: {UNTIL_ARM}')
                self._enter(VehiclePhase.PREPARING)
            elif mode != before:
                self._detail = f'mode {name}'

    def _own_modes(self, before: int) -> set[int]:
        external = self._firmware.external
        if self.phase in (VehiclePhase.ARMING, VehiclePhase.RISING, VehiclePhase.FLYING):
            return {external}
        if self.phase is VehiclePhase.STARTING:
            return {before, external}
        if self.phase is VehiclePhase.ENDING:
            return {before, external, self._ending_mode}
        return {self.mode}

    def _on_disarmed(self, now: float) -> None:
        self.commands.clear()
        self._permission.end()
        if self.phase is VehiclePhase.ENDING:
            self._enter(VehiclePhase.STOPPED, f'landed{self._reason}, {UNTIL_ARM}')
        elif self.phase not in (VehiclePhase.PREPARING, VehiclePhase.WAITING):
            text = self.log.recent_text(now, 2)
            why = f'by the autopilot or the pilot{f" ({text})" if text else ""}'
            self.log.add(WARNING, f'disarmed {why}')
            self._enter(VehiclePhase.STOPPED, f'{why}, {UNTIL_ARM}')

    def on_restart(self) -> None:
        """Start again with a restarted autopilot, whose local frame is new."""
        text = 'the autopilot has restarted'
        if self.estimate.several:
            text = (
                f'several autopilots answer as system {self.settings.system}: give each its own '
                'ID (ArduPilot: SYSID_THISMAV or MAV_SYSID, PX4: MAV_SYS_ID)'
            )
        if self._displaced == text:
            return
        self.log.add(ERROR if self.estimate.several else WARNING, text)
        self.commands.clear()
        self._permission.end()
        before = (VehiclePhase.CONNECTING, VehiclePhase.PREPARING, VehiclePhase.WAITING)
        if self.phase in before and not self.estimate.several:
            self.read_failsafes()
            self._enter(VehiclePhase.PREPARING)
        else:
            self._displaced = text
            self._enter(VehiclePhase.STOPPED, f'{text}: restart the driver')

    def tick(self, now: float) -> None:
        """Send due messages; to be called at least 50 times per second."""
        self.send_heartbeat(now)
        if self.firmware is None:
            return
        if self.check_link(now):
            if self.lost:
                self.forbid()
            elif self.phase is VehiclePhase.FLYING:
                self._begin_flying()
        self.request_data(now)
        self._continue(now)
        self.send_commands(now)
        if self._streams_setpoints:
            self._stream(now)

    def _stream(self, now: float) -> None:
        flying = self.phase is VehiclePhase.FLYING
        if flying:
            self._check_setpoint(now)
        if (self._target is None and not flying) or not self.send_setpoint(
            self._target, self._yaw, now
        ):
            return
        if self._target is None:
            self._speed_due = True
        elif flying and self._speed_due and self.speed is not None and self._firmware.limits:
            # Valid from the first position until a velocity is sent.
            self._speed_due = False
            self.command(_SPEED, (_GROUND_SPEED, self.speed, -1.0))

    def _check_setpoint(self, now: float) -> None:
        telemetry, check = self.estimate.telemetry, self.setpoints
        if telemetry is not None:
            check.observe(telemetry.position, telemetry.velocity, now)
        rejected = check.rejected(now)
        if rejected is not None:
            self.rejected, self._rejected_at = rejected, now
            self._target, self._yaw = check.other, None
            check.reset()
        elif now - self._rejected_at > _REJECTED:
            self.rejected = None

    @property
    def _streams_setpoints(self) -> bool:
        if self.phase is VehiclePhase.FLYING:
            return True
        if self.phase is VehiclePhase.RISING:
            return self._firmware.rise == 'setpoint'
        return self._firmware.px4 and self.phase in (VehiclePhase.STARTING, VehiclePhase.ARMING)

    def _continue(self, now: float) -> None:
        if self._phase_at == -math.inf:
            self._phase_at = now
        if self._permission.expired(now):
            # The client that requested it may no longer expect it.
            text = self.log.recent_text(now)
            why = f' ({text})' if text else ''
            limit = f'{self.settings.arm_timeout:g} s'
            self.log.add(WARNING, f'not armed within {limit}{why}, {UNTIL_ARM}')
            self.forbid()
        work = {
            VehiclePhase.PREPARING: self._prepare,
            VehiclePhase.WAITING: self._wait,
            VehiclePhase.STARTING: self._request_mode,
            VehiclePhase.ARMING: self._arm,
            VehiclePhase.RISING: self._rise,
            VehiclePhase.ENDING: self._end,
        }.get(self.phase)
        if work is not None:
            work(now)

    def _is_due(self, now: float, period: float) -> bool:
        if now - self._tried_at < period or self.commands:
            return False
        self._tried_at = now
        return True

    def _prepare(self, now: float) -> None:
        self._detail = self.log.recent_text(now)
        assert self.failsafes is not None
        estimate = self.estimate
        ready = estimate.telemetry is not None and not estimate.problem(fix_needed=False)
        if self.failsafes.complete and ready:
            self._compare_limits(self.failsafes)
            self._enter(VehiclePhase.WAITING)
            self._wait(now)

    def _compare_limits(self, failsafes: FailsafeCheck) -> None:
        """Warn if the vehicle is planned to be faster than its autopilot allows."""
        most = failsafes.limit('acceleration') if self._firmware.limits else math.inf
        if self.braking is not None and most < self.braking:
            name = next(iter(self._firmware.limits['acceleration']))
            self.log.add(
                WARNING,
                f'{name}: the autopilot accelerates with {most:g} m/s^2, less than '
                f'motion.acceleration, {self.braking:g}: it will arrive later than planned',
            )

    def _wait(self, now: float) -> None:
        assert self.failsafes is not None
        name = self._firmware.mode_name(self.mode)
        permitted = self.active and self._permission.holds(now)
        if self.armed and not self.in_external_mode:
            self._permission.end()
            self._detail = f'it is flying in {name}'
        elif self.armed and permitted:
            self.log.add(INFO, f'armed in {name}: taking control')
            self._permission.end()
            if self.in_air:
                self._begin_flying()
            else:
                self._begin_rising(now)
        elif self.armed:
            self._detail = f'armed in {name} by another program, {UNTIL_ARM}'
        elif not self.settings.arm:
            self._detail = 'arm is false'
        elif not self.active:
            self._detail = 'the driver is not active'
        else:
            problem = self.failsafes.problem(now) or self.fence.problem
            if problem:
                self._permission.end()
            elif permitted and not self.fence.busy:
                self._target, self._yaw = self._position(), None
                self._enter(VehiclePhase.STARTING)
                return
            self._detail = f'{problem}, {UNTIL_ARM}' if problem else UNTIL_ARM

    def _request_mode(self, now: float) -> None:
        if self._firmware.px4 and now - self._phase_at < _STREAM_AHEAD:
            return
        if self.in_external_mode:
            self._enter(VehiclePhase.ARMING)
        elif self._is_due(now, _ARMING_PERIOD):
            self.request_mode(self._firmware.external)

    def _arm(self, now: float) -> None:
        if self.armed:
            self._permission.end()
            self._begin_rising(now)
        elif self._is_due(now, _ARMING_PERIOD):
            self._detail = self.log.recent_text(now)
            self.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, (1.0,))

    def _begin_rising(self, now: float) -> None:
        # An unanswered arming request could arm it again after a pilot disarmed it.
        self.commands.clear()
        self._target = self._position()
        if self._firmware.kind == 'copter':
            # On the ground; the barometer may have drifted since the estimator's start.
            self.estimate.origin[2] = self._target[2]
            self.flight_origin.keep(self.estimate.origin, self.estimate.booted)
        self._least_left, self._nearer_at = math.inf, now
        self._enter(VehiclePhase.RISING)

    def _rise(self, now: float) -> None:
        estimate, top, timeout = self.estimate, self._top, self.settings.rise_timeout
        assert self._target is not None
        height = float(self._position()[2])
        left = abs(height - top)
        if left < self._least_left - _PROGRESS:
            self._least_left, self._nearer_at = left, now
        by_command = self._firmware.rise == 'command'
        # The autopilot's home may differ: set-points complete the climb after its take-off.
        taken_off = by_command and estimate.landed == mavlink.MAV_LANDED_STATE_IN_AIR
        if left <= _REACHED or taken_off:
            self._begin_flying()
        elif now - self._nearer_at > timeout:
            progress = f'at {number(round(height, 1))} m of {number(round(top, 1))} m'
            reason = f'no climb for {timeout:g} s: {progress}'
            self.log.add(ERROR, f'{reason}: landing')
            self.finish('land', reason)
        elif not by_command:
            self._target[2] = top
        elif _TAKE_OFF not in self.accepted and self._is_due(now, _ARMING_PERIOD):
            take_off = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, self.height)
            self.command(_TAKE_OFF, take_off)

    def _begin_flying(self) -> None:
        position = self._position()
        if self.phase is VehiclePhase.RISING:
            position[2] = self._top
        self._target, self._yaw = position, None
        if self.phase is not VehiclePhase.FLYING:
            self._fix_needed = self.estimate.has_fix
        self.commands.clear()
        self.setpoints.reset()
        self.rejected, self._speed_due = None, True
        self._enter(VehiclePhase.FLYING)

    def _end(self, now: float) -> None:
        # Not again once accepted: a pilot may have changed the mode since the last heartbeat.
        if _MODE not in self.accepted and self._is_due(now, _ENDING_PERIOD):
            self.request_mode(self._ending_mode)

    def _enter(self, phase: VehiclePhase, detail: str = '') -> None:
        self.accepted.clear()
        self.phase, self._detail = phase, detail
        self._phase_at = self._tried_at = -math.inf
