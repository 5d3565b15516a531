"""What a Mambo's own computer does with commands: take-off, flight, landing, and its watchdogs.

Stands in for Parrot's firmware, which is not public. A piloting command "executes once and goes
back to hovering without new commands coming in" (pyparrot, `Minidrone.fly_direct`). When the
connection is lost it hovers on, says pyparrot's author (amymcgovern/pyparrot, issue 165), and
Parrot's manual that it lands: a setting here, as the times are. The body is that of `tilt_body`.

Frames: the position is relative to the take-off point and heading, x forward, y left, z up.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from maasi_filter.models.pose import Pose
from maasi_filter.settings import Settings
from maasi_planner.motion import RobotState
from maasi_sim.emulators.mambo.tilt_body import TiltBody, TiltBodySettings, TiltCommand
from maasi_sim.world.odometry import OdometryModel, OdometrySettings
from maasi_sim.world.robots import Battery, BatterySettings

FloatArray = NDArray[np.float64]

# Commands act from one piece of time to the next [s].
_PIECE = 0.02
_TAKE_OFF_SPEED, _LANDING_SPEED = 0.5, 0.4
_DEGREE = math.pi / 180.0
# Ranges of the settings that a controller may make: tilt [degrees], speed [m/s], turn [degrees/s].
TILT_RANGE, CLIMB_RANGE, TURN_RANGE = (5.0, 25.0), (0.5, 2.0), (50.0, 360.0)


class FlyingState(IntEnum):
    """Values of the event FlyingStateChanged."""

    LANDED = 0
    TAKING_OFF = 1
    HOVERING = 2
    FLYING = 3
    LANDING = 4
    EMERGENCY = 5


AIRBORNE = (
    FlyingState.TAKING_OFF,
    FlyingState.HOVERING,
    FlyingState.FLYING,
    FlyingState.LANDING,
)


class FirmwareSettings(Settings):
    """How the fake's firmware behaves."""

    take_off_height: float = Field(
        default=0.8, gt=0.0, description='At which it hovers after take-off [m]'
    )
    command_timeout: float = Field(
        default=0.5, gt=0.0, description='After which the last piloting command is void: hover [s]'
    )
    delay: float = Field(
        default=0.1, ge=0.0, le=2.0, description='From a piloting command to its tilt set-point [s]'
    )
    lost_link: Literal['hover', 'land'] = Field(
        default='hover', description='What it does when it hears nothing from its controller'
    )
    landing_timeout: float = Field(
        default=3.0,
        gt=0.0,
        description='Without anything from the controller until it lands, with lost_link land [s]',
    )
    critical_charge: float = Field(
        default=0.03, ge=0.0, lt=1.0, description='At which it lands by itself [1]'
    )
    body: TiltBodySettings = Field(
        default_factory=TiltBodySettings, description='How it answers its set-points'
    )


@dataclass(frozen=True)
class Piloting:
    """
    A piloting command (PCMD), each in whole per cent of the largest.

    Attributes
    ----------
    roll, pitch, yaw, climb : int
        To the right, forward, clockwise, up.

    """

    roll: int = 0
    pitch: int = 0
    yaw: int = 0
    climb: int = 0

    @property
    def moves(self) -> bool:
        """Whether it is anything but a hover."""
        return bool(self.roll or self.pitch or self.yaw or self.climb)


@dataclass(frozen=True)
class Estimate:
    """
    What the firmware believes of its flight.

    Attributes
    ----------
    position : ndarray, shape (3,)
        From the take-off point, forward, left, up [m].
    yaw : float
        From the heading at take-off, anticlockwise [rad].
    velocity : ndarray, shape (3,)
        Forward, left, up, axes turned by the heading only [m/s].
    roll, pitch : float
        Right-handed about forward and left [rad].

    """

    position: FloatArray
    yaw: float
    velocity: FloatArray
    roll: float
    pitch: float


@dataclass
class Limits:
    """What 100 per cent of a piloting command are: tilt [rad], climb [m/s], turn [rad/s]."""

    tilt: float = 15.0 * _DEGREE
    climb: float = 1.0
    turn: float = 150.0 * _DEGREE


@dataclass
class MamboFirmware:
    """
    A Mambo's flight, without its network.

    Parameters
    ----------
    start : Pose
        Where it stands on the floor, in the map.
    settings : FirmwareSettings
        Body, heights and watchdogs.
    battery : BatterySettings
        Capacity and drain; the motors drain only in flight.
    odometry : OdometrySettings
        Noise and drift of what it believes.
    seed : int
        Of that noise.
    name : str
        Keys it.
    on_change : callable
        Called when the flying state or the battery's percentage has changed.

    """

    start: Pose
    settings: FirmwareSettings = field(default_factory=FirmwareSettings)
    battery: BatterySettings = field(default_factory=BatterySettings)
    odometry: OdometrySettings = field(default_factory=OdometrySettings)
    seed: int = 1
    name: str = 'mambo'
    on_change: Callable[[], None] = lambda: None

    def __post_init__(self) -> None:
        self.floor = float(self.start.position[2])
        self.time = 0.0
        self.flying_state = FlyingState.LANDED
        self.limits = Limits()
        self.charge = Battery(self.battery)
        self.take_offs = 0
        self._body = TiltBody(self.settings.body, self.start)
        self._odometry = OdometryModel(self.odometry, self.start, self.seed, self.name)
        self._readings = 0
        # Piloting commands, and the time at which they take effect.
        self._piloted: deque[tuple[float, Piloting]] = deque([(-math.inf, Piloting())])
        self._heard_at = -math.inf
        self._percent = self.percent

    @property
    def percent(self) -> int:
        """Reported battery charge, 0 to 100."""
        return round(100.0 * self.charge.charge)

    @property
    def state(self) -> RobotState:
        """True state, in the map."""
        return self._body.robot_state()

    @property
    def height(self) -> float:
        """Above the floor [m]."""
        return float(self._body.position[2]) - self.floor

    # ---- commands ----------------------------------------------------------------------------

    def hear(self) -> None:
        """Note the time of a message from the controller."""
        self._heard_at = self.time

    def take_off(self) -> None:
        """Take off, if it stands on the floor with a battery that is not empty."""
        if self.flying_state == FlyingState.LANDED and not self._critical:
            self.take_offs += 1
            self._set(FlyingState.TAKING_OFF)

    def land(self) -> None:
        """Land where it is."""
        if self.flying_state in AIRBORNE:
            self._set(FlyingState.LANDING)

    def emergency(self) -> None:
        """Cut the motors."""
        self._rest()
        self._set(FlyingState.EMERGENCY)

    def pilot(self, piloting: Piloting) -> None:
        """Take a piloting command, which holds until the next one or its time is up."""
        self._piloted.append((self.time + self.settings.delay, piloting))

    def limit_tilt(self, degrees: float) -> None:
        """Set the tilt of 100 per cent [degrees], cut to what is allowed."""
        self.limits.tilt = float(np.clip(degrees, *TILT_RANGE)) * _DEGREE

    def limit_climb(self, speed: float) -> None:
        """Set the climb of 100 per cent [m/s], cut to what is allowed."""
        self.limits.climb = float(np.clip(speed, *CLIMB_RANGE))

    def limit_turn(self, degrees: float) -> None:
        """Set the turn rate of 100 per cent [degrees/s], cut to what is allowed."""
        self.limits.turn = float(np.clip(degrees, *TURN_RANGE)) * _DEGREE

    # ---- time --------------------------------------------------------------------------------

    def advance(self, dt: float) -> None:
        """Advance by `dt` seconds."""
        pieces = max(1, math.ceil(dt / _PIECE - 1e-9))
        for _ in range(pieces):
            self._piece(dt / pieces)

    def _piece(self, h: float) -> None:
        self.time += h
        self._look_after()
        if self.flying_state in AIRBORNE:
            self._body.step(self._command(), self.limits.tilt, h)
            self.charge.drain(float(np.linalg.norm(self._body.velocity)), h)
            self._touch()
        if self.percent != self._percent:
            self._percent = self.percent
            self.on_change()

    @property
    def _critical(self) -> bool:
        return self.charge.charge <= self.settings.critical_charge

    def _look_after(self) -> None:
        """Land, or change the flying state, without a command."""
        state = self.flying_state
        if state in (FlyingState.LANDED, FlyingState.LANDING, FlyingState.EMERGENCY):
            return
        settings = self.settings
        silent = self.time - self._heard_at > settings.landing_timeout
        if (silent and settings.lost_link == 'land') or self._critical:
            self._set(FlyingState.LANDING)
        elif state == FlyingState.TAKING_OFF:
            if self.height >= settings.take_off_height:
                self._set(FlyingState.HOVERING)
        else:
            moves = self._current().moves
            self._set(FlyingState.FLYING if moves else FlyingState.HOVERING)

    def _current(self) -> Piloting:
        piloted = self._piloted
        while len(piloted) > 1 and piloted[1][0] <= self.time:
            piloted.popleft()
        began, piloting = piloted[0]
        acts = 0.0 <= self.time - began <= self.settings.command_timeout
        return piloting if acts else Piloting()

    def _command(self) -> TiltCommand:
        """Return the command of the body."""
        if self.flying_state == FlyingState.TAKING_OFF:
            return TiltCommand(climb=_TAKE_OFF_SPEED)
        if self.flying_state == FlyingState.LANDING:
            return TiltCommand(climb=-_LANDING_SPEED)
        piloting, limits = self._current(), self.limits
        return TiltCommand(
            pitch=0.01 * limits.tilt * piloting.pitch,
            roll=0.01 * limits.tilt * piloting.roll,
            climb=0.01 * limits.climb * piloting.climb,
            turn=-0.01 * limits.turn * piloting.yaw,
        )

    def _touch(self) -> None:
        """Stand on the floor instead of sinking into it."""
        if self.height > 0.0 or self._body.velocity[2] > 0.0:
            return
        landing = self.flying_state == FlyingState.LANDING
        self._rest()
        if landing:
            self._set(FlyingState.LANDED)

    def _rest(self) -> None:
        position = self._body.position.copy()
        position[2] = self.floor
        self._body.rest_at(Pose.from_yaw(position, self._body.yaw))

    def _set(self, state: FlyingState) -> None:
        if state != self.flying_state:
            self.flying_state = state
            self.on_change()

    # ---- estimate ----------------------------------------------------------------------------

    def estimate(self) -> Estimate:
        """Return the estimate of the firmware; each call draws new noise."""
        state = self.state
        self._readings += 1
        reading = self._odometry.step(state, self._readings)
        cosine, sine = math.cos(self._body.yaw), math.sin(self._body.yaw)
        vx, vy, vz = state.velocity.tolist()
        return Estimate(
            position=reading.pose.position,
            yaw=reading.pose.yaw,
            velocity=np.array([cosine * vx + sine * vy, cosine * vy - sine * vx, vz]),
            roll=self._body.roll,
            pitch=self._body.pitch,
        )
