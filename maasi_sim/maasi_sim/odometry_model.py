"""Simulated odometry: starts at zero, with noise, and drift that grows with the way."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from maasi_filter.pose import Pose, compose, inverse, quaternion_product
from maasi_filter.settings import Settings
from maasi_planner.motion import RobotState
from maasi_sim.noise_streams import noise_stream

Array = NDArray[np.float64]
# A variance reported is never quite zero: consumers invert it.
_LEAST_VARIANCE = 1e-12


class OdometrySettings(Settings):
    """How good a robot's odometry is; all zero: perfect."""

    position_noise: float = Field(
        default=0.002, ge=0.0, description='Deviation of each coordinate, anew each step [m]'
    )
    heading_noise: float = Field(
        default=0.002, ge=0.0, description='Deviation of the heading, anew each step [rad]'
    )
    velocity_noise: float = Field(
        default=0.005, ge=0.0, description='Deviation of each part of the velocity [m/s]'
    )
    position_drift: float = Field(
        default=0.0,
        ge=0.0,
        description='Deviation of the drift of x and y after one metre; grows with its root [m]',
    )
    heading_drift: float = Field(
        default=0.0,
        ge=0.0,
        description='Deviation of the drift of the heading after one metre; grows with its root '
        '[rad]',
    )


@dataclass(frozen=True)
class OdometryReading:
    """
    What a robot says about its motion, as in ``nav_msgs/Odometry``.

    Attributes
    ----------
    pose : Pose
        In the odometry frame: the frame of the robot at the start.
    covariance : ndarray, shape (6, 6)
        Of the pose [m, rad].
    velocity, angular_velocity : ndarray, shape (3,)
        The robot's frame [m/s, rad/s].

    """

    pose: Pose
    covariance: Array
    velocity: Array
    angular_velocity: Array


class OdometryModel:
    """
    A robot's odometry.

    Height, roll and pitch are measured against the ground and gravity: they carry noise at most,
    while x, y and heading are counted up, and drift.

    Parameters
    ----------
    settings : OdometrySettings
        Noise and drift.
    start : Pose
        True pose when the odometry stands at zero; level.
    seed : int
        Of the run.
    robot : str
        Whose odometry it is.

    """

    def __init__(self, settings: OdometrySettings, start: Pose, seed: int, robot: str) -> None:
        self.settings = settings
        self.seed = seed
        self.robot = robot
        self._to_start = inverse(Pose.from_yaw(start.position, start.yaw))
        self._last = compose(self._to_start, start)
        self._offset = np.zeros(2)
        self._turn = 0.0
        self._noise_covariance = np.diag(
            [settings.position_noise**2 + _LEAST_VARIANCE] * 3
            + [_LEAST_VARIANCE] * 2
            + [settings.heading_noise**2 + _LEAST_VARIANCE]
        )
        # Covariance of the drift: x and y of the estimate, heading.
        self._drift = np.zeros((3, 3))

    def step(self, state: RobotState, step: int) -> OdometryReading:
        """
        Go on to the robot's next true state and return what its odometry says.

        Parameters
        ----------
        state : RobotState
            True state.
        step : int
            Discrete step, which keys the noise.

        """
        settings = self.settings
        generator = noise_stream(self.seed, self.robot, step, 'odometry')
        drift, noise = generator.standard_normal(3), generator.standard_normal(10)
        true = compose(self._to_start, state.pose)
        moved = true.position[:2] - self._last.position[:2]
        way = math.sqrt(float(moved[0] * moved[0] + moved[1] * moved[1]))
        if way > 0.0 and (settings.position_drift > 0.0 or settings.heading_drift > 0.0):
            before = self._place(true)
            self._turn += settings.heading_drift * math.sqrt(way) * float(drift[2])
            # The heading turns about where the robot is, not about the origin.
            self._offset += before - self._place(true)
            self._offset += settings.position_drift * math.sqrt(way) * drift[:2]
            self._grow(moved, way)
        self._last = true
        half = 0.5 * (self._turn + settings.heading_noise * float(noise[3]))
        position = np.append(self._place(true), true.position[2])
        position = position + settings.position_noise * noise[:3]
        orientation = quaternion_product(
            [math.cos(half), 0.0, 0.0, math.sin(half)], true.orientation
        )
        body = state.pose.rotation().T
        return OdometryReading(
            Pose(position, orientation),
            self._covariance(),
            body @ state.velocity + settings.velocity_noise * noise[4:7],
            state.angular_velocity + settings.heading_noise * noise[7:10],
        )

    def _place(self, true: Pose) -> Array:
        cosine, sine = math.cos(self._turn), math.sin(self._turn)
        x, y = float(true.position[0]), float(true.position[1])
        return self._offset + np.array([cosine * x - sine * y, sine * x + cosine * y])

    def _grow(self, moved: Array, way: float) -> None:
        cosine, sine = math.cos(self._turn), math.sin(self._turn)
        step = np.array([cosine * moved[0] - sine * moved[1], sine * moved[0] + cosine * moved[1]])
        motion = np.eye(3)
        motion[0, 2], motion[1, 2] = -step[1], step[0]
        settings = self.settings
        self._drift = motion @ self._drift @ motion.T + way * np.diag(
            [settings.position_drift**2, settings.position_drift**2, settings.heading_drift**2]
        )

    def _covariance(self) -> Array:
        covariance = self._noise_covariance.copy()
        covariance[:2, :2] += self._drift[:2, :2]
        covariance[:2, 5] += self._drift[:2, 2]
        covariance[5, :2] += self._drift[2, :2]
        covariance[5, 5] += self._drift[2, 2]
        return covariance
