"""Flight control of a Mambo from take-off to landing. Without ROS."""

import math
from dataclasses import dataclass
from enum import Enum

import numpy as np

from maasi_drivers.agent.flight_rules import UNTIL_ARM, ArmPermission
from maasi_drivers.links.mambo.link import MamboLink, PositionEvent
from maasi_drivers.links.mambo.reckoning import Course, DeadReckoning, TiltModel
from maasi_drivers.settings.vehicles import MamboSettings
from maasi_filter.arrays import FloatArray
from maasi_filter.geometry.operating_volume import OperatingVolume
from maasi_filter.models.pose import Pose
from maasi_planner.motion import MotionModel, RobotState

_SPEED_GAIN = 2.5  # acceleration per speed error [1/s]
_RAMP = 0.4  # acceleration of the desired speed; low, as images need little tilt [m/s^2]
_DESIRED_AGE = 0.5  # older desired velocities are discarded [s]
# Share of the largest acceleration for stopping before the geofence; the rest is for wind.
_BRAKE_SHARE = 0.5
# Largest speed per metre to the geofence, well below the bandwidth of the speed [1/s].
_NEAR_RATE = 1.0
# Placeholder until the speed at the largest tilt is measured; never used in flight [m/s].
_UNKNOWN_SPEED = 1.0
ALTITUDE_TOLERANCE = 0.1  # altitude tolerance after take-off [m]
# Under a faster command, a bit-identical event is no new position [m/s].
_LEAST_SPEED = 0.05
_STILL = np.zeros(4)
NOT_ALLOWED = 'on the ground: take-off is disabled (parameter mambo.arm)'


class MamboPhase(Enum):
    """Phase of a flight."""

    CONNECTING = 'connecting'
    GROUND = 'on the ground'
    TAKING_OFF = 'taking off'
    CLIMBING = 'climbing'
    FLYING = 'flying'
    LANDING = 'landing'


@dataclass(eq=False)
class MamboPilot:
    """Flies a Mambo from take-off to landing in a volume; lands it on a fault."""

    link: MamboLink
    motion: MotionModel
    settings: MamboSettings
    home: Pose
    volume: OperatingVolume

    def __post_init__(self) -> None:
        link, settings, home = self.link, self.settings, self.home
        self.phase = MamboPhase.CONNECTING
        self.problem = 'connecting to the Mambo'
        speed = settings.full_speed or _UNKNOWN_SPEED
        model = TiltModel(link.tilt, speed, link.climb, settings.full_turn)
        position = [*home.position[:2], settings.ground]
        self.reckoning = DeadReckoning(model, Pose.from_yaw(position, home.yaw), settings)
        self._event: PositionEvent | None = None
        # Last position: its time, and the time of its last change.
        self._position: FloatArray | None = None
        self._placed_at = self._moved_at = -math.inf
        # Unchanged in spite of commands: only a changed position is accepted.
        self._stuck = False
        self._command = _STILL
        self._now = -math.inf
        # Time and value of the last desired velocity in the map [m/s].
        self._desired: tuple[float, FloatArray] = (-math.inf, np.zeros(2))
        self._since = -math.inf
        self._lost_since: float | None = None
        self._cancelled_at: float | None = None
        # Reason of the final landing.
        self._ended = ''
        self._permission = ArmPermission(settings.arm_timeout)

    @property
    def flying(self) -> bool:
        """Whether it follows commands."""
        return self.phase in (MamboPhase.CLIMBING, MamboPhase.FLYING)

    @property
    def state(self) -> RobotState | None:
        """Its state, or None if unknown."""
        return self.reckoning.state if math.isfinite(self._placed_at) else None

    def ahead(self) -> RobotState:
        """Return its level state when a command that is sent now takes effect."""
        course = self.reckoning.ahead()
        return RobotState(Pose.from_yaw(course.position, course.yaw), course.velocity)

    @property
    def has_pose(self) -> bool:
        """Whether the position is known and recent enough for flight."""
        return math.isfinite(self._placed_at) and self._lost_since is None

    def update_pose(self, now: float, state: RobotState) -> None:
        """Update the pose from another system."""
        self._now = now
        self._note_position(now, state.pose.position)
        self.reckoning.update(state, now, self.flying)

    def _note_position(self, now: float, position: FloatArray) -> None:
        commanded = float(np.abs(self._command[:3]).max()) > _LEAST_SPEED
        if self._position is None or not np.array_equal(position, self._position):
            self._stuck = False
            self._moved_at = now
        elif not commanded and not self._stuck:
            self._moved_at = now
        self._position, self._placed_at = position, now

    def fly(self, command: FloatArray) -> None:
        """Fly a velocity command (4,), once; without a next one the drone hovers."""
        if not np.isfinite(command).all():
            self.hover()
            raise ValueError(f'command: got {command.tolist()}, allowed are finite numbers')
        if self.phase is MamboPhase.FLYING and self.has_pose:
            self._steer(command)

    def hover(self) -> None:
        """Stop: the drone holds its position by its own camera."""
        if self.flying:
            self._desired = -math.inf, np.zeros(2)
            self._send(_STILL, _STILL)

    def _steer(self, command: FloatArray) -> None:
        model, course = self.reckoning.model, self.reckoning.ahead()
        cosine, sine = math.cos(course.yaw), math.sin(course.yaw)
        turned = np.array([[cosine, sine], [-sine, cosine]])
        # Ramped in the map, from the previous velocity.
        passed = self._now - self._desired[0]
        before = self._desired[1] if passed <= _DESIRED_AGE else course.velocity[:2]
        change = turned.T @ command[:2] - before
        size, most = float(np.hypot(*change)), _RAMP * min(passed, _DESIRED_AGE)
        ramped = before + change * (min(size, most) / size if size > 0.0 else 0.0)
        self._desired = self._now, self._stoppable(course, ramped)
        desired = turned @ self._desired[1]
        speed = turned @ course.velocity[:2]
        against = turned @ self.reckoning.push
        wanted = model.drag * desired + _SPEED_GAIN * (desired - speed) - against
        rest = [command[2] / model.climb, command[3] / model.turn]
        self._send(command, np.clip([*wanted / model.thrust, *rest], -1.0, 1.0))

    def _stoppable(self, course: Course, desired: FloatArray) -> FloatArray:
        """Return a velocity in the map (2,) that can be stopped before the geofence."""
        brake = 2.0 * _BRAKE_SHARE * self.reckoning.model.thrust
        low, high = self.volume.limits[:2].T
        margin = np.abs([low - course.position[:2], high - course.position[:2]])
        inside = (course.position[:2] > low, course.position[:2] < high)
        most = inside * np.minimum(np.sqrt(brake * margin), _NEAR_RATE * margin)
        return np.clip(desired, -most[0], most[1])

    def _send(self, command: FloatArray, shares: FloatArray) -> None:
        self._command = command
        self.reckoning.command(self._now, shares)
        self.link.steer(*shares.tolist())

    def permit(self, now: float) -> str:
        """Permit one take-off; return why not, or an empty text."""
        problem = self._permission.ask(now, self._objection(now))
        if not problem:
            self._ended, self._cancelled_at = '', None
        return problem

    def _objection(self, now: float) -> str:
        if self.phase is MamboPhase.LANDING:
            return 'it is landing'
        if self.phase not in (MamboPhase.CONNECTING, MamboPhase.GROUND):
            return 'it is in the air already'
        unheard = self.problem if self.phase is MamboPhase.CONNECTING else ''
        silent = self._missing(now) if self._is_silent(now) else ''
        return self.link.error or self._unfit() or self._low_battery() or unheard or silent

    def _unfit(self) -> str:
        if not self.settings.arm:
            return NOT_ALLOWED
        if self.settings.full_speed is None:
            return (
                'on the ground: the speed at the largest tilt is unknown (set mambo.full_speed; '
                'measure_mambo measures it)'
            )
        return ''

    def on_new_goal(self) -> None:
        """Note that it has a goal."""
        self._cancelled_at = None

    def goal_cancelled(self, now: float) -> None:
        """Note that its goal was cancelled: it hovers, and lands if no other follows."""
        if self.phase in (MamboPhase.CONNECTING, MamboPhase.GROUND):
            self._permission.end()
        self.hover()
        self._cancelled_at = now

    def stop(self, now: float) -> None:
        """Abort a take-off and land; in flight as after a cancelled goal."""
        if self.phase in (MamboPhase.TAKING_OFF, MamboPhase.CLIMBING):
            self.end('take-off stopped')
        else:
            self.goal_cancelled(now)

    def end(self, reason: str) -> str:
        """Land and do not take off again; return the reason."""
        self._ended = self._ended or reason
        if self.phase not in (MamboPhase.CONNECTING, MamboPhase.GROUND):
            self._land()
        return reason

    def _land(self) -> None:
        self.phase = MamboPhase.LANDING
        self._command = _STILL
        self.reckoning.command(self._now, _STILL)
        self.link.land()

    def update(self, now: float) -> None:
        """Advance to `now`; to be called at least ten times per second."""
        self._now = now
        self.reckoning.go_on(now, self.flying)
        event = self.link.position
        if event is not None and event is not self._event and self.settings.pose == 'events':
            self._event = event
            self.reckoning.correct(event, self.flying)
            self._note_position(event.received, event.position)
        self.problem = self._advance(now)

    def _advance(self, now: float) -> str:
        link = self.link
        if self.phase is MamboPhase.CONNECTING:
            if not link.connected:
                return link.error or 'connecting to the Mambo'
            self.phase = MamboPhase.GROUND
        if link.error:
            self._ended = link.error
            return self._ended
        recent = now - self._placed_at <= self.settings.link_timeout
        self._stuck |= recent and now - self._moved_at > self.settings.link_timeout
        if not self._missing(now):
            self._lost_since = None
        elif self._lost_since is None:
            self._lost_since = now
        if self.phase is MamboPhase.GROUND:
            return self._stand(now)
        if self.phase is MamboPhase.LANDING:
            if link.flying_state != 'landed':
                return f'landing: {self._ended or "its goal was cancelled"}'
            self.phase = MamboPhase.GROUND
            self._ended = f'landed: {self._ended}' if self._ended else ''
            return f'{self._ended or "landed: its goal was cancelled"}, {UNTIL_ARM}'
        if link.flying_state == 'emergency':
            return self._emergency()
        return self._stay_up(now)

    def _emergency(self) -> str:
        self._ended = 'the Mambo is in emergency: restart it'
        return self._ended

    def _stand(self, now: float) -> str:
        state, low = self.link.flying_state, self._low_battery()
        if low or self._is_silent(now):
            self._permission.end()
        if self._ended:
            return f'{self._ended}, {UNTIL_ARM}'
        if problem := self._unfit():
            return problem
        if state == 'emergency':
            return self._emergency()
        if low:
            return low
        flies = state in ('hovering', 'flying', 'takingoff')
        if not self._permission.holds(now):
            return f'{"in the air, not by this driver" if flies else "on the ground"}, {UNTIL_ARM}'
        if not flies:
            if state != 'landed' or self.link.battery < 0.0:
                what = 'state' if state != 'landed' else 'battery'
                return f'on the ground: no {what} received yet'
            if not self.has_pose:
                return f'on the ground: {self._missing(now) or "no position yet"}'
            self.link.take_off()
        # It was in the air before this driver started.
        return self._begin(MamboPhase.TAKING_OFF, now)

    def _begin(self, phase: MamboPhase, now: float) -> str:
        self._permission.end()
        self.phase, self._since = phase, now
        return phase.value

    def _stay_up(self, now: float) -> str:
        if low := self._low_battery():
            return self.end(low)
        if self._lost_since is not None:
            self.hover()
            text = self._missing(now)
            too_long = now - self._lost_since >= self.settings.land_after
            return self.end(text) if too_long else text
        flying_state, timeout = self.link.flying_state, self.settings.take_off_timeout
        late = now - self._since > timeout
        if self.phase is MamboPhase.TAKING_OFF:
            if flying_state in ('hovering', 'flying'):
                self._begin(MamboPhase.CLIMBING, now)
            elif late:
                return self.end(f'no take-off within {timeout:g} s: {flying_state}')
            return MamboPhase.TAKING_OFF.value
        if flying_state in ('landed', 'landing'):
            return self.end(f'the Mambo is {flying_state} by itself')
        if outside := self.volume.drift_problem(self.reckoning.course.position):
            return self.end(outside)
        if self.phase is MamboPhase.CLIMBING:
            offset = self.reckoning.course.position[2] - self.home.position[2]
            if abs(offset) <= ALTITUDE_TOLERANCE:
                self._begin(MamboPhase.FLYING, now)
                return ''
            if late:
                return self.end(f'altitude not reached within {timeout:g} s')
            ahead = self.ahead()
            above = np.array([*ahead.pose.position[:2], self.home.position[2]])
            self._steer(self.motion.command(ahead, above))
            return f'{MamboPhase.CLIMBING.value}, {offset:+.2f} m from its altitude'
        cancelled = self._cancelled_at
        if cancelled is not None and now - cancelled >= self.settings.cancel_landing:
            self._cancelled_at = None
            self._land()
            return 'landing: its goal was cancelled'
        return ''

    def _low_battery(self) -> str:
        charge, minimum = self.link.battery, self.settings.battery_minimum
        return (
            f'battery at {100.0 * charge:.0f} %, below {100.0 * minimum:.0f} %'
            if 0.0 <= charge < minimum
            else ''
        )

    def _missing(self, now: float) -> str:
        for text, since in (
            ('link lost: no data from the Mambo', self.link.received_at),
            ('no position', self._placed_at),
            ('the position has not changed', self._moved_at),
        ):
            age = now - since
            if age > self.settings.link_timeout:
                return f'{text} for {f"{age:.1f} s" if math.isfinite(age) else "the whole time"}'
        return ''

    def _is_silent(self, now: float) -> bool:
        return now - self.link.received_at > self.settings.link_timeout
