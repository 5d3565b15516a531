"""Where a Mambo is between its position events, by a model of the commands. Without ROS.

Position events come twice a second. In between, a model flies the commands that were sent (dead
reckoning), and each event corrects it where it was when the event was made.

Roll and pitch of a command are shares of the largest tilt. A tilt accelerates by g tan(tilt), and
drag opposes the speed, in proportion to it (R. Mahony, V. Kumar, P. Corke, "Multirotor
aerial vehicles", IEEE Robotics & Automation Magazine 19(3), 2012). So one measured number is
enough: the steady speed at the largest tilt. A command acts after a delay.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from maasi_drivers.links.mambo.link import PositionEvent
from maasi_drivers.settings.vehicles import MamboSettings
from maasi_filter.arrays import FloatArray
from maasi_filter.models.pose import Pose
from maasi_planner.motion import RobotState
from maasi_planner.motion.mambo import pose_of

_GRAVITY = 9.81
# Approximate rate at which the firmware brakes without roll and pitch [1/s].
_HOVER_RATE = 2.0
_STILL_AIR = np.zeros(2)


@dataclass(frozen=True)
class Course:
    """Where a drone is and how it moves.

    Attributes
    ----------
    position, velocity : ndarray, shape (3,)
        In the map [m], [m/s].
    yaw : float
        From the map's x axis [rad].
    """

    position: FloatArray
    velocity: FloatArray
    yaw: float


@dataclass(frozen=True)
class TiltModel:
    """Response of a Mambo to piloting commands.

    Attributes
    ----------
    tilt : float
        Of 100 per cent roll or pitch [rad].
    full_speed : float
        Steady speed under it [m/s].
    climb, turn : float
        Of 100 per cent [m/s], [rad/s].
    """

    tilt: float
    full_speed: float
    climb: float
    turn: float

    @property
    def thrust(self) -> float:
        """Acceleration by the largest tilt [m/s^2]."""
        return _GRAVITY * math.tan(self.tilt)

    @property
    def drag(self) -> float:
        """Deceleration for each m/s of speed [1/s]."""
        return self.thrust / self.full_speed

    def advance(
        self, course: Course, shares: FloatArray, h: float, push: FloatArray = _STILL_AIR
    ) -> Course:
        """Return the course after `h` seconds under shares (4,): forward, left, up, turn.

        `push` (2,) is a steady acceleration by what is not commanded [m/s^2, map].
        """
        forward, left, up, turn = shares.tolist()
        cosine, sine = math.cos(course.yaw), math.sin(course.yaw)
        rate = self.drag if forward or left else self.drag + _HOVER_RATE
        pull = self.thrust / rate
        steady = np.array(
            [
                pull * (cosine * forward - sine * left) + push[0] / rate,
                pull * (sine * forward + cosine * left) + push[1] / rate,
                self.climb * up,
            ]
        )
        lag = course.velocity - steady
        # The firmware controls the vertical speed: no lag is assumed.
        lag[2] = 0.0
        decay = math.exp(-rate * h)
        return Course(
            course.position + h * steady + (1.0 - decay) / rate * lag,
            steady + decay * lag,
            course.yaw + h * self.turn * turn,
        )

    def shares(self, acceleration: FloatArray) -> FloatArray:
        """Return the shares forward and left (2,) that make an acceleration [m/s^2, heading]."""
        return np.clip(acceleration / self.thrust, -1.0, 1.0)


# Share of the difference to an event by which position and velocity are corrected.
_POSITION_GAIN, _VELOCITY_GAIN = 0.8, 0.25
_EVENT_PERIOD = 0.5
# Above this difference an event replaces the estimate [m].
_JUMP = 0.5
# Longest time of one prediction [s].
_LONGEST = 1.0
_HISTORY = 64
_STILL = np.zeros(4)
# Share of a position event's error that is the push; with poses of another system the time in
# which it is learnt [s]; the largest [m/s^2]; and the speed above which the model's errors are
# larger than it [m/s].
_PUSH_GAIN, _PUSH_TIME, _MOST_PUSH, _SLOW = 0.08, 2.0, 0.5, 0.1


class DeadReckoning:
    """Where the drone is between its position events."""

    def __init__(self, model: TiltModel, origin: Pose, settings: MamboSettings) -> None:
        self.model = model
        self.origin = origin
        self.settings = settings
        self.course = Course(origin.position, np.zeros(3), origin.yaw)
        #: Steady acceleration by wind, or by a level that is off, (2,) [m/s^2, map].
        self.push = np.zeros(2)
        #: Time of flight since the last correction [s].
        self.age = 0.0
        self._turn = origin.rotation()
        # By the last event [m].
        self._measured = origin.position
        # Recent commands, and the time at which each takes effect.
        self._sent: deque[tuple[float, FloatArray]] = deque([(-math.inf, _STILL)])
        self._now: float | None = None
        # Recent (time, position, yaw) samples, monotonic clock.
        self._past: deque[tuple[float, FloatArray, float]] = deque(maxlen=_HISTORY)

    @property
    def state(self) -> RobotState:
        """Pose, velocity and angular velocity in the map; tilted as commanded."""
        course, shares = self.course, self._acting()
        state = np.zeros(12)
        state[:3] = course.position
        state[3:6] = -self.model.tilt * shares[1], self.model.tilt * shares[0], course.yaw
        turn = np.array([0.0, 0.0, self.model.turn * shares[3]])
        return RobotState(pose_of(state), course.velocity, turn)

    def covariance(self) -> FloatArray:
        """Return that of the pose, (6, 6): x, y, z [m^2], rotations about the map's axes."""
        settings = self.settings
        position = settings.position_noise**2 + (settings.position_growth * self.age) ** 2
        attitude = settings.attitude_noise**2
        tilt = attitude + self._tilt_doubt() ** 2
        return np.diag([position] * 3 + [tilt, tilt, attitude])

    def _tilt_doubt(self) -> float:
        """Return the uncertainty of the tilt from the uncertain delay of commands [rad]."""
        now, delay = self._now or 0.0, self.settings.delay
        recent = [shares[:2] for acts, shares in self._sent if abs(now - acts) <= delay]
        if not recent:
            return 0.0
        spread = np.abs(np.array(recent) - self._acting()[:2]).max()
        # Standard deviation of a uniform distribution of that half-width.
        return float(self.model.tilt * spread) / math.sqrt(3.0)

    def _acting(self) -> FloatArray:
        """Return the shares that the drone flies now."""
        now = -math.inf if self._now is None else self._now
        return next(shares for acts, shares in reversed(self._sent) if acts <= now)

    def command(self, now: float, shares: FloatArray) -> None:
        """Take a command, (4,): forward, left, up, turn as shares of the largest."""
        delay, sent = self.settings.delay, self._sent
        sent.append((now + delay, shares))
        while len(sent) > 1 and sent[1][0] <= now - delay:
            sent.popleft()

    def go_on(self, now: float, flying: bool) -> None:
        """Reckon up to `now` of the monotonic clock [s]; on the ground it stays where it is."""
        before = now if self._now is None else max(self._now, now - _LONGEST)
        self._now = now
        if now <= before:
            return
        self.age += now - before
        if flying:
            self.course = self._fly(self.course, before, now)
        self._past.append((now, self.course.position, self.course.yaw))

    def ahead(self) -> Course:
        """Return where it will be when a command that is sent now acts."""
        now = 0.0 if self._now is None else self._now
        return self._fly(self.course, now, now + self.settings.delay)

    def _fly(self, course: Course, begin: float, end: float) -> Course:
        sent = list(self._sent)
        ends = [acts for acts, _ in sent[1:]] + [math.inf]
        for (acts, shares), until in zip(sent, ends, strict=True):
            h = min(until, end) - max(acts, begin)
            if h > 0.0:
                course = self.model.advance(course, shares, h, self.push)
        return course

    def take(self, state: RobotState, now: float, flying: bool) -> None:
        """Take the pose of another system, of `now` on the monotonic clock [s]."""
        self._now = now
        if flying:
            change = (state.velocity - self.course.velocity) / _PUSH_TIME
            self._learn(change, state.velocity)
        self.course = Course(state.pose.position, state.velocity, state.pose.yaw)

    def correct(self, event: PositionEvent, flying: bool) -> None:
        """Take a position event."""
        measured = self.origin.position + self._turn @ event.position
        heading = self.origin.yaw + event.yaw
        self.age = self.settings.latency
        position, yaw = self._at(event.received - self.settings.latency)
        error = measured - position
        if not flying or float(np.abs(error).max()) > _JUMP:
            velocity = self.course.velocity if flying else np.zeros(3)
            self.course = Course(measured, velocity, heading)
            self._past.clear()
            return
        change = _PUSH_GAIN / _EVENT_PERIOD**2 * error
        self._learn(change, (measured - self._measured) / _EVENT_PERIOD)
        self._measured = measured
        turn = _wrapped(heading - yaw)
        move = _POSITION_GAIN * error
        course = self.course
        self.course = Course(
            course.position + move,
            course.velocity + _VELOCITY_GAIN / _EVENT_PERIOD * error,
            course.yaw + turn,
        )
        moved = [(at, place + move, yaw + turn) for at, place, yaw in self._past]
        self._past = deque(moved, maxlen=_HISTORY)

    def _learn(self, change: FloatArray, measured: FloatArray) -> None:
        """Correct the push by what the last prediction missed, at a measured velocity."""
        if float(np.hypot(*measured[:2])) < _SLOW:
            self.push = np.clip(self.push + change[:2], -_MOST_PUSH, _MOST_PUSH)

    def _at(self, now: float) -> tuple[FloatArray, float]:
        """Return position and heading at a time of the monotonic clock."""
        later: tuple[float, FloatArray, float] | None = None
        for item in reversed(self._past):
            if item[0] <= now:
                if later is None:
                    ahead = min(now - item[0], _LONGEST)
                    return item[1] + ahead * self.course.velocity, item[2]
                share = (now - item[0]) / (later[0] - item[0])
                turn = share * _wrapped(later[2] - item[2])
                return item[1] + share * (later[1] - item[1]), item[2] + turn
            later = item
        if later is not None:
            return later[1], later[2]
        return self.course.position, self.course.yaw


def _wrapped(angle: float) -> float:
    return (angle + math.pi) % (2.0 * math.pi) - math.pi
