"""A Mambo's flight: where it is between its position events, and what it is told. Without ROS.

Position events come twice a second. In between, the motion model flies the commands that were
sent (dead reckoning), and each event corrects it where it was when the event was made.
"""

from __future__ import annotations

import math
from collections import deque
from enum import Enum
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from maasi_drivers.mambo_link import PositionEvent
from maasi_drivers.mambo_settings import LEAST_TILT, MOST_TILT, MamboSettings
from maasi_filter.pose import Pose, quaternion_product
from maasi_planner.motion import MotionModel, RobotState
from maasi_planner.motion.mambo import K_PITCH, K_VX, mambo_parameters
from maasi_planner.settings import MotionSettings

FloatArray = NDArray[np.float64]

# Share of the difference to an event by which position and velocity are corrected.
_POSITION_GAIN, _VELOCITY_GAIN = 0.8, 0.25
# A difference beyond this is no error of dead reckoning: the event is taken as it is [m].
_JUMP = 0.5
# Longest time that is reckoned at once [s].
_LONGEST = 1.0
_HISTORY = 64
# How far from its altitude the drone counts as there after take-off [m].
_ALTITUDE_TOLERANCE = 0.1
# How far outside the geofence it may drift before it lands [m].
_FENCE_MARGIN = 0.5
# An event that says the same to the bit under a command faster than this is no new position [m/s].
_LEAST_SPEED = 0.05
_STILL = np.zeros(4)


class Link(Protocol):
    """What the pilot needs of a `MamboLink`."""

    error: str
    flying_state: str
    battery: float
    heard_at: float
    tilt: float
    climb: float

    @property
    def connected(self) -> bool:
        """Whether the drone has answered."""

    @property
    def position(self) -> PositionEvent | None:
        """The last position event, or None."""

    def take_off(self) -> None:
        """Have it take off."""

    def land(self) -> None:
        """Have it land."""

    def steer(self, forward: float, left: float, up: float, turn: float) -> None:
        """Send one piloting command, in shares of the largest."""


def tilt_limit(motion: MotionSettings) -> float:
    """Return the tilt to set in the drone for a robot's settings [rad]."""
    return min(max(motion.tilt, LEAST_TILT), MOST_TILT)


def full_speed(motion: MotionSettings, tilt: float) -> float:
    """Return the steady speed at a tilt [m/s]: drag holds against it as in the motion model."""
    if motion.model != 'mambo':
        return motion.speed
    parameters = mambo_parameters(motion)
    return float(tilt * parameters[K_PITCH] / parameters[K_VX])


class DeadReckoning:
    """
    Where the drone is between its position events.

    Parameters
    ----------
    motion : MotionModel
        That flies the commands.
    origin : Pose
        Of the take-off point, in the map: what the events are relative to.
    settings : MamboSettings
        Latency and noise.

    """

    def __init__(self, motion: MotionModel, origin: Pose, settings: MamboSettings) -> None:
        self.motion = motion
        self.origin = origin
        self.settings = settings
        self.state = RobotState.at_rest(origin.position, origin.yaw)
        #: Time of flight since the last correction [s].
        self.age = 0.0
        self._turn = origin.rotation()
        self._body = motion.body(self.state)
        self._command = _STILL
        self._time: float | None = None
        # Monotonic time, position and heading of late.
        self._past: deque[tuple[float, FloatArray, float]] = deque(maxlen=_HISTORY)

    def covariance(self) -> FloatArray:
        """Return that of the pose, (6, 6): x, y, z [m^2], rotations about the map's axes."""
        settings = self.settings
        position = settings.position_noise**2 + (settings.position_growth * self.age) ** 2
        return np.diag([position] * 3 + [settings.attitude_noise**2] * 3)

    def command(self, command: FloatArray) -> None:
        """Take the velocity command that is flown from now on, (4,)."""
        self._command = command

    def go_on(self, now: float, time: float, flying: bool) -> None:
        """
        Reckon up to a time.

        Parameters
        ----------
        now : float
            Monotonic clock, that of the events [s].
        time : float
            Of the flight; a simulated one may pass slower [s].
        flying : bool
            Whether it follows commands; if not it is where the last event says.

        """
        passed = 0.0 if self._time is None else min(max(time - self._time, 0.0), _LONGEST)
        self._time = time
        self.age += passed
        if flying and passed > 0.0:
            self._body.step(self._command, passed)
            self.state = self._body.robot_state()
        self._past.append((now, self.state.pose.position, self.state.pose.yaw))

    def correct(self, event: PositionEvent, flying: bool) -> None:
        """Take a position event."""
        measured = self.origin.position + self._turn @ event.position
        heading = self.origin.yaw + event.yaw
        self.age = self.settings.latency
        position, yaw = self._at(event.received - self.settings.latency)
        error = measured - position
        if not flying or float(np.abs(error).max()) > _JUMP:
            self._reset(RobotState.at_rest(measured, heading))
            return
        state = self.state
        turn = _wrapped(heading - yaw)
        half = 0.5 * turn
        turned = np.array([math.cos(half), 0.0, 0.0, math.sin(half)])
        orientation = quaternion_product(turned, state.pose.orientation)
        self._reset(
            RobotState(
                Pose(state.pose.position + _POSITION_GAIN * error, orientation),
                state.velocity + _VELOCITY_GAIN * error / 0.5,
                state.angular_velocity,
            ),
            _POSITION_GAIN * error,
            turn,
        )

    def _reset(self, state: RobotState, move: FloatArray | None = None, turn: float = 0.0) -> None:
        self.state = state
        self._body = self.motion.body(state)
        if move is None:
            self._past.clear()
        else:
            moved = [(at, place + move, yaw + turn) for at, place, yaw in self._past]
            self._past = deque(moved, maxlen=_HISTORY)

    def _at(self, now: float) -> tuple[FloatArray, float]:
        """Return position and heading at a time of the monotonic clock."""
        later: tuple[float, FloatArray, float] | None = None
        for item in reversed(self._past):
            if item[0] <= now:
                if later is None:
                    ahead = min(now - item[0], _LONGEST)
                    return item[1] + ahead * self.state.velocity, item[2]
                share = (now - item[0]) / (later[0] - item[0])
                turn = share * _wrapped(later[2] - item[2])
                return item[1] + share * (later[1] - item[1]), item[2] + turn
            later = item
        if later is not None:
            return later[1], later[2]
        return self.state.pose.position, self.state.pose.yaw


def _wrapped(angle: float) -> float:
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


class Phase(Enum):
    """Of a flight."""

    CONNECTING = 'connecting'
    GROUND = 'on the ground'
    TAKING_OFF = 'taking off'
    CLIMBING = 'climbing'
    FLYING = 'flying'
    LANDING = 'landing'


class MamboPilot:
    """
    Flies a Mambo from take-off to landing, and lands it when something is wrong.

    Parameters
    ----------
    link : Link
        To the drone.
    motion : MotionModel
        Its controller and model.
    settings : MamboSettings
        Limits and times.
    home : Pose
        Where it hovers after take-off, in the map; it stands below that at the start.
    fence : ndarray, shape (3, 2)
        Lowest and highest x, y, z [m, map].

    Attributes
    ----------
    phase : Phase
        Of the flight.
    problem : str
        Why it takes no goals now; empty where it does.

    """

    def __init__(
        self,
        link: Link,
        motion: MotionModel,
        settings: MamboSettings,
        home: Pose,
        fence: FloatArray,
    ) -> None:
        self.link = link
        self.motion = motion
        self.settings = settings
        self.home = home
        self.fence = fence
        self.phase = Phase.CONNECTING
        self.problem = 'connecting to the Mambo'
        place = home.position.copy()
        place[2] = settings.ground
        self.reckoning = DeadReckoning(motion, Pose.from_yaw(place, home.yaw), settings)
        self.full_speed = settings.full_speed or full_speed(motion.settings, link.tilt)
        # Pose of another system, and when it came.
        self._other: RobotState | None = None
        self._other_at = -math.inf
        self._event: PositionEvent | None = None
        # Since when the position is what it is; monotonic clock.
        self._moved_at = -math.inf
        self._place: FloatArray | None = None
        # Once it was the same in spite of commands, only another one is believed.
        self._stuck = False
        self._command = _STILL
        self._since = -math.inf
        self._lost_since: float | None = None
        self._cancelled_at: float | None = None
        # Why it landed for good.
        self._ended = ''
        self._resting = False

    # ---- where it is -------------------------------------------------------------------------

    @property
    def flying(self) -> bool:
        """Whether it follows commands."""
        return self.phase in (Phase.CLIMBING, Phase.FLYING)

    @property
    def state(self) -> RobotState | None:
        """Where it is; None where that is not known."""
        if self.settings.pose != 'events':
            return self._other
        return None if self._event is None else self.reckoning.state

    @property
    def has_pose(self) -> bool:
        """Whether the position is known, and new enough to fly by."""
        return self.state is not None and self._lost_since is None

    def take_pose(self, now: float, state: RobotState) -> None:
        """Take a pose of another system, at `now` of the monotonic clock [s]."""
        self._note_place(now, state.pose.position)
        self._other, self._other_at = state, now

    def _note_place(self, now: float, place: FloatArray) -> None:
        told_to_move = float(np.abs(self._command[:3]).max()) > _LEAST_SPEED
        if self._place is None or not np.array_equal(place, self._place):
            self._stuck = False
            self._moved_at = now
        elif not told_to_move and not self._stuck:
            self._moved_at = now
        self._place = place

    # ---- what it is to do --------------------------------------------------------------------

    def fly(self, command: FloatArray) -> None:
        """
        Fly a velocity command, once; without another one the drone hovers.

        Parameters
        ----------
        command : ndarray, shape (4,)
            vx, vy, vz [m/s, axes turned by the heading], yaw rate [rad/s].

        Raises
        ------
        ValueError
            If a number is not finite; then it hovers.

        """
        if not np.isfinite(command).all():
            self.hover()
            raise ValueError(f'command: got {command.tolist()}, allowed are finite numbers')
        if self.phase is Phase.FLYING and self.has_pose:
            self._steer(command)

    def hover(self) -> None:
        """Stop: the drone keeps its place by its own camera."""
        if self.phase in (Phase.CLIMBING, Phase.FLYING):
            self._steer(_STILL)

    def _steer(self, command: FloatArray) -> None:
        vx, vy, vz, turn = command.tolist()
        self._command = command
        self.reckoning.command(command)
        self.link.steer(
            vx / self.full_speed,
            vy / self.full_speed,
            vz / self.link.climb,
            turn / self.settings.full_turn,
        )

    def goal_taken(self) -> None:
        """Note that it has somewhere to go: if it rests on the ground it takes off again."""
        self._cancelled_at = None
        self._resting = False

    def goal_cancelled(self, now: float) -> None:
        """Note that its goal was cancelled: it hovers, and lands if no other follows."""
        self._resting |= self.phase in (Phase.CONNECTING, Phase.GROUND)
        self.hover()
        self._cancelled_at = now

    def end(self, reason: str) -> None:
        """Land, and do not take off again."""
        self._ended = self._ended or reason
        if self.phase not in (Phase.CONNECTING, Phase.GROUND):
            self._land()

    def _land(self) -> None:
        self.phase = Phase.LANDING
        self._command = _STILL
        self.reckoning.command(_STILL)
        self.link.land()

    # ---- the flight --------------------------------------------------------------------------

    def update(self, now: float, time: float) -> None:
        """
        Go on: call it at least ten times a second.

        Parameters
        ----------
        now : float
            Monotonic clock [s].
        time : float
            Of the flight; a simulated one may pass slower [s].

        """
        self.reckoning.go_on(now, time, self.flying)
        event = self.link.position
        if event is not None and event is not self._event:
            self._event = event
            self.reckoning.correct(event, self.flying)
            if self.settings.pose == 'events':
                self._note_place(event.received, event.position)
        self.problem = self._go_on(now)

    def _go_on(self, now: float) -> str:
        """Do what the phase asks for; return why it takes no goals, or nothing."""
        link = self.link
        if self.phase is Phase.CONNECTING:
            if not link.connected:
                return link.error or 'connecting to the Mambo'
            self.phase = Phase.GROUND
        if link.error:
            return self._give_up(link.error)
        lost = self._see_to_pose(now)
        if self.phase is Phase.GROUND:
            return self._stand(now)
        if self.phase is Phase.LANDING:
            return self._come_down()
        return self._stay_up(now, lost)

    def _give_up(self, reason: str) -> str:
        self._ended = reason
        return reason

    def _stand(self, now: float) -> str:
        """Take off if nothing speaks against it."""
        state = self.link.flying_state
        if self._ended:
            return self._ended
        if not self.settings.arm:
            return 'on the ground: it may not take off (parameter mambo.arm)'
        if self._resting:
            # Where its goal was cancelled it waits for another one.
            return ''
        if state == 'emergency':
            return self._give_up('the Mambo is in emergency: restart it')
        if state != 'landed':
            if state in ('hovering', 'flying', 'takingoff'):
                # Of a driver before this one.
                self._begin(Phase.TAKING_OFF, now)
                return Phase.TAKING_OFF.value
            return 'on the ground: nothing heard of its state yet'
        if self.link.battery < 0.0:
            return 'on the ground: nothing heard of its battery yet'
        if self._battery_low:
            return self._battery_text()
        if not self.has_pose:
            return f'on the ground: {self._lost_text(now) or "no position yet"}'
        self._begin(Phase.TAKING_OFF, now)
        self.link.take_off()
        return Phase.TAKING_OFF.value

    def _begin(self, phase: Phase, now: float) -> None:
        self.phase, self._since = phase, now

    def _come_down(self) -> str:
        if self.link.flying_state != 'landed':
            return f'landing: {self._ended or "its goal was cancelled"}'
        self.phase = Phase.GROUND
        self._resting = not self._ended
        if self._ended:
            self._ended = f'landed: {self._ended}'
        return self._ended

    def _stay_up(self, now: float, lost: float | None) -> str:
        flying_state = self.link.flying_state
        if flying_state == 'emergency':
            return self._give_up('the Mambo is in emergency: restart it')
        if self._battery_low:
            return self._end_flight(self._battery_text())
        if lost is not None:
            self.hover()
            text = self._lost_text(now)
            return self._end_flight(text) if lost >= self.settings.land_after else text
        if self.phase is Phase.TAKING_OFF:
            return self._rise(now)
        if flying_state in ('landed', 'landing'):
            return self._end_flight(f'the Mambo is {flying_state} by itself')
        state = self.state
        if state is None:
            return 'no position'
        outside = self._outside(state.pose.position)
        if outside:
            return self._end_flight(outside)
        if self.phase is Phase.CLIMBING:
            return self._climb(now, state)
        cancelled = self._cancelled_at
        if cancelled is not None and now - cancelled >= self.settings.cancel_landing:
            self._cancelled_at = None
            self._land()
            return 'landing: its goal was cancelled'
        return ''

    def _end_flight(self, reason: str) -> str:
        self.end(reason)
        return reason

    def _rise(self, now: float) -> str:
        if self.link.flying_state in ('hovering', 'flying'):
            self._begin(Phase.CLIMBING, now)
        elif now - self._since > self.settings.take_off_timeout:
            return self._end_flight(
                f'it did not take off in {self.settings.take_off_timeout:g} s: '
                f'{self.link.flying_state}'
            )
        return Phase.TAKING_OFF.value

    def _climb(self, now: float, state: RobotState) -> str:
        offset = state.pose.position[2] - self.home.position[2]
        if abs(offset) <= _ALTITUDE_TOLERANCE:
            self._begin(Phase.FLYING, now)
            return ''
        if now - self._since > self.settings.take_off_timeout:
            return self._end_flight(
                f'it did not come to its altitude in {self.settings.take_off_timeout:g} s'
            )
        above = state.pose.position.copy()
        above[2] = self.home.position[2]
        self._steer(self.motion.command(state, above))
        return f'{Phase.CLIMBING.value}, {offset:+.2f} m from its altitude'

    # ---- what can be wrong -------------------------------------------------------------------

    @property
    def _battery_low(self) -> bool:
        return 0.0 <= self.link.battery < self.settings.battery_minimum

    def _battery_text(self) -> str:
        return f'battery at {self.link.battery:.2f}, below {self.settings.battery_minimum:.2f}'

    def _see_to_pose(self, now: float) -> float | None:
        """Return for how long link or position have been missing, beyond the timeout [s]."""
        timeout = self.settings.link_timeout
        self._stuck |= now - self._moved_at > timeout and now - self._positioned_at() <= timeout
        age = max(now - self.link.heard_at, now - self._positioned_at(), now - self._moved_at)
        if age <= timeout:
            self._lost_since = None
            return None
        if self._lost_since is None:
            self._lost_since = now
        return now - self._lost_since

    def _positioned_at(self) -> float:
        if self.settings.pose != 'events':
            return self._other_at
        return -math.inf if self._event is None else self._event.received

    def _lost_text(self, now: float) -> str:
        timeout = self.settings.link_timeout
        silent = now - self.link.heard_at
        if silent > timeout:
            return f'link lost: nothing from the Mambo for {_seconds(silent)}'
        silent = now - self._positioned_at()
        if silent > timeout:
            return f'no position for {_seconds(silent)}'
        still = now - self._moved_at
        return f'the position has not changed for {_seconds(still)}' if still > timeout else ''

    def _outside(self, position: FloatArray) -> str:
        for axis, (low, high) in enumerate(self.fence.tolist()):
            # On the floor below it nothing is wrong.
            lowest = -math.inf if axis == 2 else low - _FENCE_MARGIN
            if not lowest <= position[axis] <= high + _FENCE_MARGIN:
                return (
                    f'{"xyz"[axis]} at {position[axis]:.2f} m, outside the geofence, '
                    f'{low:g} to {high:g} m'
                )
        return ''


def _seconds(age: float) -> str:
    return f'{age:.1f} s' if math.isfinite(age) else 'all the time'
