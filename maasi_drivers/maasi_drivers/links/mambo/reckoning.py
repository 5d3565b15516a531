"""Dead reckoning of a Mambo between position events (two per second), from its commands.

Each event corrects the past position at its time. A tilt accelerates by g tan(tilt), and drag
opposes the speed in proportion to it (R. Mahony, V. Kumar, P. Corke, "Multirotor aerial vehicles",
IEEE Robotics & Automation Magazine 19(3), 2012), so one measured number suffices: the steady speed
at the largest tilt. A command acts after a delay.
"""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from maasi_drivers.links.mambo.link import PositionEvent
from maasi_drivers.settings.vehicles import MamboSettings
from maasi_filter.arrays import FloatArray
from maasi_filter.models.pose import Pose
from maasi_planner.motion import RobotState

_GRAVITY = 9.81
# Approximate rate at which the firmware brakes without roll and pitch [1/s].
_HOVER_RATE = 2.0
_STILL_AIR = np.zeros(2)


class Course(NamedTuple):
    """Position and velocity (3,) in the map, yaw [rad]."""

    position: FloatArray
    velocity: FloatArray
    yaw: float


@dataclass(frozen=True)
class TiltModel:
    """Response of a Mambo to piloting commands."""

    tilt: float  # at 100 % roll or pitch [rad]
    full_speed: float  # steady speed at that tilt [m/s]
    climb: float  # at 100 % [m/s]
    turn: float  # at 100 % [rad/s]

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
        """Return the course `h` s later, under shares (4,) and a push (2,) [m/s^2, map]."""
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

    def follow(
        self,
        course: Course,
        commands: Sequence[tuple[float, FloatArray]],
        begin: float,
        end: float,
        push: FloatArray = _STILL_AIR,
    ) -> Course:
        """Return the course at `end` [s], under commands that act each from a time on."""
        ends = [acts for acts, _ in commands[1:]] + [math.inf]
        for (acts, shares), until in zip(commands, ends, strict=True):
            h = min(until, end) - max(acts, begin)
            if h > 0.0:
                course = self.advance(course, shares, h, push)
        return course


# Weight of an event's difference in position and velocity.
_POSITION_GAIN, _VELOCITY_GAIN = 0.8, 0.25
_EVENT_PERIOD = 0.5
_JUMP = 0.5  # above this difference an event replaces the estimate [m]
# Longest time of one prediction [s].
_LONGEST = 1.0
_HISTORY = 64
# Weight of an event's error in the push; with poses of another system its time constant [s]; its
# largest value [m/s^2]; and the speed above which the model's errors exceed it [m/s].
_PUSH_GAIN, _PUSH_TIME, _MOST_PUSH, _SLOW = 0.08, 2.0, 0.5, 0.1


class DeadReckoning:
    """Estimates the drone's state between position events; times: monotonic clock [s]."""

    def __init__(self, model: TiltModel, origin: Pose, settings: MamboSettings) -> None:
        self.model, self.origin, self.settings = model, origin, settings
        self.course = Course(origin.position, np.zeros(3), origin.yaw)
        #: Steady acceleration by wind or a tilted level, (2,) [m/s^2, map].
        self.push = np.zeros(2)
        #: Time of flight since the last correction [s].
        self.age = 0.0
        self._turn = origin.rotation()
        self._measured = origin.position  # from the last event [m]
        # Recent commands with the times at which they take effect.
        self._sent: deque[tuple[float, FloatArray]] = deque([(-math.inf, np.zeros(4))])
        self._now = -math.inf
        # Recent times, positions and headings.
        self._past: deque[tuple[float, FloatArray, float]] = deque(maxlen=_HISTORY)

    @property
    def state(self) -> RobotState:
        """Pose, velocity and angular velocity in the map; tilted as commanded."""
        course, (forward, left, _, turn) = self.course, self._acting()
        angles = -self.model.tilt * left, self.model.tilt * forward, course.yaw
        rates = np.array([0.0, 0.0, self.model.turn * turn])
        return RobotState(Pose.from_rpy(course.position, angles), course.velocity, rates)

    def covariance(self) -> FloatArray:
        """Return the covariance of the pose, (6, 6): x, y, z [m^2], rotations about map axes."""
        settings, acting = self.settings, self._acting()[:2]
        position = settings.position_noise**2 + (settings.position_growth * self.age) ** 2
        attitude = settings.attitude_noise**2
        # The delay of commands is uncertain: deviation of a uniform distribution.
        near = [
            shares[:2] - acting
            for acts, shares in self._sent
            if abs(self._now - acts) <= settings.delay
        ]
        uncertainty = self.model.tilt * float(np.abs(near).max(initial=0.0)) / math.sqrt(3.0)
        tilt = attitude + uncertainty**2
        return np.diag([position] * 3 + [tilt, tilt, attitude])

    def _acting(self) -> FloatArray:
        return next(shares for acts, shares in reversed(self._sent) if acts <= self._now)

    def command(self, now: float, shares: FloatArray) -> None:
        """Add a command (4,): forward, left, up, turn as shares of the largest."""
        delay, sent = self.settings.delay, self._sent
        sent.append((now + delay, shares))
        while len(sent) > 1 and sent[1][0] <= now - delay:
            sent.popleft()

    def go_on(self, now: float, flying: bool) -> None:
        """Predict to `now`; on the ground it stays."""
        before = max(self._now, now - _LONGEST) if math.isfinite(self._now) else now
        self._now = now
        if now <= before:
            return
        self.age += now - before
        if flying:
            self.course = self._fly(self.course, before, now)
        self._past.append((now, self.course.position, self.course.yaw))

    def ahead(self) -> Course:
        """Return the course when a command that is sent now takes effect."""
        return self._fly(self.course, self._now, self._now + self.settings.delay)

    def _fly(self, course: Course, begin: float, end: float) -> Course:
        return self.model.follow(course, list(self._sent), begin, end, self.push)

    def update(self, state: RobotState, now: float, flying: bool) -> None:
        """Correct by the pose of another system at `now`."""
        self._now = now
        if flying:
            change = (state.velocity - self.course.velocity) / _PUSH_TIME
            self._learn(change, state.velocity)
        self.course = Course(state.pose.position, state.velocity, state.pose.yaw)

    def correct(self, event: PositionEvent, flying: bool) -> None:
        """Correct by a position event."""
        course, latency = self.course, self.settings.latency
        measured = self.origin.position + self._turn @ event.position
        heading = self.origin.yaw + event.yaw
        self.age = latency
        position, yaw = self._at(event.received - latency)
        error = measured - position
        if not flying or float(np.abs(error).max()) > _JUMP:
            self.course = Course(measured, course.velocity if flying else np.zeros(3), heading)
            self._past.clear()
            return
        change = _PUSH_GAIN / _EVENT_PERIOD**2 * error
        self._learn(change, (measured - self._measured) / _EVENT_PERIOD)
        self._measured = measured
        turn, move = math.remainder(heading - yaw, math.tau), _POSITION_GAIN * error
        speed = _VELOCITY_GAIN / _EVENT_PERIOD * error
        self.course = Course(course.position + move, course.velocity + speed, course.yaw + turn)
        moved = [(at, position + move, yaw + turn) for at, position, yaw in self._past]
        self._past = deque(moved, maxlen=_HISTORY)

    def _learn(self, change: FloatArray, measured: FloatArray) -> None:
        """Correct the push by the error of the last prediction at a measured velocity."""
        if float(np.hypot(*measured[:2])) < _SLOW:
            self.push = np.clip(self.push + change[:2], -_MOST_PUSH, _MOST_PUSH)

    def _at(self, time: float) -> tuple[FloatArray, float]:
        if not self._past:
            return self.course.position, self.course.yaw
        earlier = (item for item in reversed(self._past) if item[0] <= time)
        at, position, yaw = next(earlier, self._past[0])
        passed = min(max(time - at, 0.0), _LONGEST)
        return position + passed * self.course.velocity, yaw
