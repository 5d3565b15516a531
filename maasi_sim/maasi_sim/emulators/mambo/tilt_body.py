"""Motion of a quadrotor under commanded tilt angles, as a Mambo under piloting commands.

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
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from maasi_filter.models.pose import Pose
from maasi_filter.settings import Settings
from maasi_planner.motion import RobotState

FloatArray = NDArray[np.float64]

_GRAVITY = 9.81


class TiltBodySettings(Settings):
    """How the body of a fake Mambo answers its commands."""

    drag: float = Field(
        default=0.5, gt=0.0, le=20.0, description='Deceleration for each m/s of speed [1/s]'
    )
    tilt_time: float = Field(
        default=0.1, gt=0.0, le=2.0, description='Time constant of the tilt [s]'
    )
    climb_time: float = Field(
        default=0.2, gt=0.0, le=2.0, description='Time constant of the vertical speed [s]'
    )
    turn_time: float = Field(
        default=0.1, gt=0.0, le=2.0, description='Time constant of the rotation rate [s]'
    )
    hover_gain: float = Field(
        default=2.0,
        ge=0.0,
        le=20.0,
        description='Deceleration for each m/s while it hovers; 0: it only levels itself, as in '
        'the modes medium and difficult [1/s]',
    )


@dataclass(frozen=True)
class TiltCommand:
    """
    Command of the body.

    Attributes
    ----------
    pitch, roll : float
        Tilt that accelerates it forward, and to the right [rad].
    climb : float
        Vertical speed [m/s].
    turn : float
        Rotation rate, anticlockwise [rad/s].

    """

    pitch: float = 0.0
    roll: float = 0.0
    climb: float = 0.0
    turn: float = 0.0

    @property
    def hovers(self) -> bool:
        """Whether it stabilises its horizontal speed by itself."""
        return self.pitch == 0.0 and self.roll == 0.0


class TiltBody:
    """
    A quadrotor under commanded tilts, without a floor.

    Parameters
    ----------
    settings : TiltBodySettings
        Drag and time constants.
    pose : Pose
        Where it is at rest, in the map.

    Attributes
    ----------
    position, velocity : ndarray, shape (3,)
        In the map [m], [m/s].
    roll, pitch, yaw : float
        Right-handed about forward, left and up [rad].

    """

    def __init__(self, settings: TiltBodySettings, pose: Pose) -> None:
        self.settings = settings
        self.rest_at(pose)

    def rest_at(self, pose: Pose) -> None:
        """Be at rest at a pose."""
        self.position = pose.position.copy()
        self.velocity = np.zeros(3)
        self.roll = self.pitch = 0.0
        self.yaw = pose.yaw
        self._rates = np.zeros(3)

    def step(self, command: TiltCommand, most_tilt: float, h: float) -> None:
        """Go on for `h` seconds, at most 0.05; hovering it tilts by `most_tilt` [rad] at most."""
        settings = self.settings
        cosine, sine = math.cos(self.yaw), math.sin(self.yaw)
        vx, vy, vz = self.velocity.tolist()
        ahead, left = cosine * vx + sine * vy, cosine * vy - sine * vx
        pitch, roll = command.pitch, command.roll
        if command.hovers:
            pitch, roll = (
                min(max(settings.hover_gain * speed / _GRAVITY, -most_tilt), most_tilt)
                for speed in (-ahead, left)
            )
        follow = 1.0 - math.exp(-h / settings.tilt_time)
        pitch_step, roll_step = follow * (pitch - self.pitch), follow * (roll - self.roll)
        self.pitch += pitch_step
        self.roll += roll_step
        forward = _GRAVITY * math.tan(self.pitch) - settings.drag * ahead
        leftward = -_GRAVITY * math.tan(self.roll) - settings.drag * left
        rising = (command.climb - vz) * (1.0 - math.exp(-h / settings.climb_time)) / h
        acceleration = np.array(
            [cosine * forward - sine * leftward, sine * forward + cosine * leftward, rising]
        )
        before = self.velocity
        self.velocity = before + h * acceleration
        self.position = self.position + 0.5 * h * (before + self.velocity)
        turn = self._rates[2]
        turn += (1.0 - math.exp(-h / settings.turn_time)) * (command.turn - turn)
        self.yaw += h * turn
        self._rates = np.array([roll_step / h, pitch_step / h, turn])

    def robot_state(self) -> RobotState:
        """Return pose, velocity in the map, and angular velocity about the body's axes."""
        half = 0.5 * np.array([self.roll, self.pitch, self.yaw])
        (cr, cp, cy), (sr, sp, sy) = np.cos(half), np.sin(half)
        orientation = np.array(
            [
                cr * cp * cy + sr * sp * sy,
                sr * cp * cy - cr * sp * sy,
                cr * sp * cy + sr * cp * sy,
                cr * cp * sy - sr * sp * cy,
            ]
        )
        return RobotState(
            Pose(self.position.copy(), orientation), self.velocity.copy(), self._rates.copy()
        )
