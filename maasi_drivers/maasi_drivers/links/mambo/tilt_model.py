"""Model of a Mambo under piloting commands. Without ROS.

Roll and pitch of a command are shares of the largest tilt. A tilt accelerates by g tan(tilt), and
drag opposes the speed, in proportion to it (R. Mahony, V. Kumar, P. Corke, "Multirotor
aerial vehicles", IEEE Robotics & Automation Magazine 19(3), 2012). So one measured number is
enough: the steady speed at the largest tilt. A command acts after a delay.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

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
