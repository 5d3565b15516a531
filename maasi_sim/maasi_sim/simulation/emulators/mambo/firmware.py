"""What a Mambo's own computer does with commands, and how its body moves.

Stands in for Parrot's firmware, which is not public. A piloting command "executes once and goes
back to hovering without new commands coming in" (pyparrot, `Minidrone.fly_direct`). When the
connection is lost it hovers on, says pyparrot's author
(https://github.com/amymcgovern/pyparrot/issues/165), and Parrot's manual that it lands: a setting
here, as the times are.

Roll and pitch of a piloting command are shares of the largest tilt, not of a speed (pyparrot,
docs/minidronecommands.rst, `fly_direct`; Parrot's minidrone.xml, PCMD and MaxTilt). At level
flight the thrust carries the weight, so that a tilt accelerates by g tan(tilt), and the rotors'
drag grows with the speed (Mahony, Kumar, Corke, "Multirotor aerial vehicles", IEEE Robotics &
Automation Magazine 19(3), 2012; Martin, Salaun, "The true role of accelerometer feedback in
quadrotor control", ICRA 2010):

    dv/dt = g tan(tilt) - drag v

gym-pybullet-drones has k = 9.18e-7 kg for a Crazyflie (after Forster, "System identification of
the Crazyflie 2.0", ETH Zurich 2015): 0.2 1/s at its 27 g. Nobody has published that of a Mambo.
Without roll and pitch it stabilises itself by its downward camera: "0 m/s horizontal speed
reference" (minidrone.xml, PilotingModeChanged, mode easy).

Frames: the position is relative to the take-off point and heading, x forward, y left, z up.
"""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Literal, NamedTuple

import numpy as np

from maasi_filter.models.pose import Pose
from maasi_planner.motion import RobotState
from maasi_sim.scenario.schema import BatterySettings
from maasi_sim.simulation.odometry import OdometryModel, OdometrySettings
from maasi_sim.simulation.robots import Battery

_GRAVITY = 9.81
_HOVER_GAIN = 2.0  # deceleration for each m/s while it hovers [1/s]
# Time constants of tilt, vertical speed and rotation rate [s].
_TILT_TIME, _CLIMB_TIME, _TURN_TIME = 0.1, 0.2, 0.1


@dataclass(frozen=True)
class FirmwareSettings:
    """How the fake's firmware behaves, and how its body answers."""

    take_off_height: float = 0.8  # at which it hovers after take-off [m]
    command_timeout: float = 0.5  # until the last piloting command is void: hover [s]
    delay: float = 0.1  # from a piloting command to its tilt set-point [s]
    lost_link: Literal['hover', 'land'] = 'hover'  # when its controller is silent
    landing_timeout: float = 3.0  # without its controller until it lands, with `land` [s]
    critical_charge: float = 0.03  # at which it lands by itself [1]
    drag: float = 0.5  # deceleration for each m/s of speed [1/s]


class TiltBody:
    """A quadrotor under commanded tilts and drag [1/s], without a floor [m, m/s, rad, map]."""

    def __init__(self, drag: float, pose: Pose) -> None:
        self.drag = drag
        self.rest_at(pose)

    def rest_at(self, pose: Pose) -> None:
        """Be at rest at a pose."""
        self.position = pose.position.copy()
        self.velocity = np.zeros(3)
        self.roll = self.pitch = 0.0
        self.yaw = pose.yaw
        self._rates = np.zeros(3)

    def level_speed(self) -> tuple[float, float]:
        """Return its speed forward and to the left [m/s]."""
        cosine, sine = math.cos(self.yaw), math.sin(self.yaw)
        vx, vy, _ = self.velocity.tolist()
        return cosine * vx + sine * vy, cosine * vy - sine * vx

    def step(self, command: Sequence[float], most_tilt: float, h: float) -> None:
        """Advance by `h` s: tilt forward and right [rad], climb, turn; without tilt it hovers.

        It brakes by `most_tilt` [rad] at most then; `h` is at most 0.05 s.
        """
        ahead, left = self.level_speed()
        pitch, roll, climb, turn_rate = command
        if pitch == roll == 0.0:
            pitch, roll = (
                min(max(_HOVER_GAIN * speed / _GRAVITY, -most_tilt), most_tilt)
                for speed in (-ahead, left)
            )
        follow = 1.0 - math.exp(-h / _TILT_TIME)
        pitch_step, roll_step = follow * (pitch - self.pitch), follow * (roll - self.roll)
        self.pitch += pitch_step
        self.roll += roll_step
        forward = _GRAVITY * math.tan(self.pitch) - self.drag * ahead
        leftward = -_GRAVITY * math.tan(self.roll) - self.drag * left
        rising = (climb - self.velocity[2]) * (1.0 - math.exp(-h / _CLIMB_TIME)) / h
        cosine, sine = math.cos(self.yaw), math.sin(self.yaw)
        acceleration = np.array(
            [cosine * forward - sine * leftward, sine * forward + cosine * leftward, rising]
        )
        before = self.velocity
        self.velocity = before + h * acceleration
        self.position = self.position + 0.5 * h * (before + self.velocity)
        turn = self._rates[2]
        turn += (1.0 - math.exp(-h / _TURN_TIME)) * (turn_rate - turn)
        self.yaw += h * turn
        self._rates = np.array([roll_step / h, pitch_step / h, turn])

    def robot_state(self) -> RobotState:
        """Return pose, velocity in the map, and angular velocity about the body's axes."""
        return RobotState(
            Pose.from_rpy(self.position, (self.roll, self.pitch, self.yaw)),
            self.velocity.copy(),
            self._rates.copy(),
        )


# Commands act from one piece of time to the next [s].
_PIECE = 0.02
_TAKE_OFF_SPEED, _LANDING_SPEED = 0.5, 0.4
_DEGREE = math.pi / 180.0
# What a controller may set: range, and unit: tilt [degrees], climb [m/s], turn [degrees/s].
LIMITS = {
    'tilt': ((5.0, 25.0), _DEGREE),
    'climb': ((0.5, 2.0), 1.0),
    'turn': ((50.0, 360.0), _DEGREE),
}


class FlyingState(IntEnum):
    """Values of the event FlyingStateChanged."""

    LANDED = 0
    TAKING_OFF = 1
    HOVERING = 2
    FLYING = 3
    LANDING = 4
    EMERGENCY = 5


AIRBORNE = frozenset(FlyingState) - {FlyingState.LANDED, FlyingState.EMERGENCY}


class Piloting(NamedTuple):
    """A piloting command (PCMD), whole per cent: to the right, forward, clockwise, up."""

    roll: int = 0
    pitch: int = 0
    yaw: int = 0
    climb: int = 0


@dataclass
class MamboFirmware:
    """A Mambo's flight, without its network."""

    start: Pose
    settings: FirmwareSettings = field(default_factory=FirmwareSettings)
    battery: BatterySettings = field(default_factory=BatterySettings)
    odometry: OdometrySettings = field(default_factory=OdometrySettings)
    seed: int = 1
    name: str = 'mambo'

    def __post_init__(self) -> None:
        self.floor = float(self.start.position[2])
        self.time = 0.0
        self.flying_state = FlyingState.LANDED
        #: What 100 per cent of a piloting command are [rad, m/s, rad/s].
        self.limits = {'tilt': 15.0 * _DEGREE, 'climb': 1.0, 'turn': 150.0 * _DEGREE}
        self.charge = Battery(self.battery)
        self.take_offs = 0
        self.body = TiltBody(self.settings.drag, self.start)
        self._odometry = OdometryModel(self.odometry, self.start, self.seed, self.name)
        self._readings = 0
        # Piloting commands, and the time at which they take effect.
        self._piloted: deque[tuple[float, Piloting]] = deque([(-math.inf, Piloting())])
        self._received_at = -math.inf

    @property
    def percent(self) -> int:
        """Reported battery charge, 0 to 100."""
        return round(100.0 * self.charge.charge)

    @property
    def state(self) -> RobotState:
        """True state, in the map."""
        return self.body.robot_state()

    @property
    def height(self) -> float:
        """Above the floor [m]."""
        return float(self.body.position[2]) - self.floor

    def estimate(self) -> Pose:
        """Return where it believes to be, from its take-off point; each call draws new noise."""
        self._readings += 1
        return self._odometry.step(self.state, self._readings).pose

    def note_message(self) -> None:
        """Note the time of a message from the controller."""
        self._received_at = self.time

    def take_off(self) -> None:
        """Take off, if it stands on the floor with a battery that is not empty."""
        if self.flying_state == FlyingState.LANDED and not self._critical:
            self.take_offs += 1
            self.flying_state = FlyingState.TAKING_OFF

    def land(self) -> None:
        """Land where it is."""
        if self.flying_state in AIRBORNE:
            self.flying_state = FlyingState.LANDING

    def emergency(self) -> None:
        """Cut the motors."""
        self._rest()
        self.flying_state = FlyingState.EMERGENCY

    def pilot(self, piloting: Piloting) -> None:
        """Take a piloting command, which holds until the next one or its time is up."""
        self._piloted.append((self.time + self.settings.delay, piloting))

    def limit(self, name: str, value: float) -> None:
        """Set what 100 per cent are, of a name in `LIMITS` and in its unit, cut to its range."""
        (low, high), unit = LIMITS[name]
        self.limits[name] = min(max(value, low), high) * unit

    def advance(self, dt: float) -> None:
        """Advance by `dt` seconds."""
        pieces = max(1, math.ceil(dt / _PIECE - 1e-9))
        h = dt / pieces
        for _ in range(pieces):
            self.time += h
            self._look_after()
            if self.flying_state not in AIRBORNE:
                continue
            self.body.step(self._command(), self.limits['tilt'], h)
            self.charge.drain(float(np.linalg.norm(self.body.velocity)), h)
            if self.height <= 0.0 and self.body.velocity[2] <= 0.0:
                # It stands on the floor instead of sinking into it.
                self._rest()
                if self.flying_state == FlyingState.LANDING:
                    self.flying_state = FlyingState.LANDED

    @property
    def _critical(self) -> bool:
        return self.charge.charge <= self.settings.critical_charge

    def _look_after(self) -> None:
        state, settings = self.flying_state, self.settings
        if state in (FlyingState.LANDED, FlyingState.LANDING, FlyingState.EMERGENCY):
            return
        silent = self.time - self._received_at > settings.landing_timeout
        if (silent and settings.lost_link == 'land') or self._critical:
            self.flying_state = FlyingState.LANDING
        elif state != FlyingState.TAKING_OFF:
            moves = any(self._current())
            self.flying_state = FlyingState.FLYING if moves else FlyingState.HOVERING
        elif self.height >= settings.take_off_height:
            self.flying_state = FlyingState.HOVERING

    def _current(self) -> Piloting:
        piloted = self._piloted
        while len(piloted) > 1 and piloted[1][0] <= self.time:
            piloted.popleft()
        began, piloting = piloted[0]
        acts = 0.0 <= self.time - began <= self.settings.command_timeout
        return piloting if acts else Piloting()

    def _command(self) -> tuple[float, float, float, float]:
        if self.flying_state == FlyingState.TAKING_OFF:
            return 0.0, 0.0, _TAKE_OFF_SPEED, 0.0
        if self.flying_state == FlyingState.LANDING:
            return 0.0, 0.0, -_LANDING_SPEED, 0.0
        roll, pitch, yaw, climb = (0.01 * share for share in self._current())
        tilt, limits = self.limits['tilt'], self.limits
        return tilt * pitch, tilt * roll, limits['climb'] * climb, -limits['turn'] * yaw

    def _rest(self) -> None:
        self.body.rest_at(Pose.from_yaw([*self.body.position[:2], self.floor], self.body.yaw))
