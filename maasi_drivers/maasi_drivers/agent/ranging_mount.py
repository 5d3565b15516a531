"""Ranges in the frame of a sensor that is mounted on a robot: to the suite's measurements."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from maasi_drivers.agent.odometry import StampedPose
from maasi_drivers.vision.camera_model import rotation_from_rpy
from maasi_filter.models.sensor import Sensor
from maasi_filter.settings import Finite, Settings

FloatArray = NDArray[np.float64]

# Variance of an angle of which nothing is known, as of the bearing of what is straight below.
_ANY_ANGLE = np.pi**2 / 3.0


class RangingSettings(Settings):
    """What the angles of `ranges` are relative to, and where the sensor sits."""

    frame: Literal['map', 'body'] = Field(
        default='map',
        description="'map': bearings from the map's x axis, elevations from the horizontal plane; "
        "'body': both in the frame of the sensor on the robot, as real ones give them, with slant "
        'ranges',
    )
    position: list[Finite] = Field(
        default_factory=lambda: [0.0, 0.0, 0.0],
        min_length=3,
        max_length=3,
        description="Of the sensor in the robot's frame, with frame body [m]",
    )
    rpy: list[Finite] = Field(
        default_factory=lambda: [0.0, 0.0, 0.0],
        min_length=3,
        max_length=3,
        description='Roll, pitch, yaw of the sensor about fixed axes of the robot, with frame body '
        '[rad]',
    )


class RangingMount:
    """Turns sweeps of a mounted sensor into measurements from the robot's position.

    Parameters
    ----------
    settings : RangingSettings
        Where it sits.
    sensor : Sensor
        Its measurement model and noise R; R is that of range, bearing and elevation in the
        sensor's frame. In a planar search the elevation has the noise of the bearing.
    """

    def __init__(self, settings: RangingSettings, sensor: Sensor) -> None:
        self._model = sensor.measurement
        self._position = np.array(settings.position)
        self._rotation = rotation_from_rpy(*settings.rpy)
        self._noise = np.zeros((3, 3))
        d = sensor.dimension
        self._noise[:d, :d] = sensor.covariance
        if d == 2:
            self._noise[2, 2] = sensor.covariance[1, 1]

    def measurements(
        self, sweep: FloatArray, pose: StampedPose
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return what the robot measured.

        Parameters
        ----------
        sweep : ndarray, shape (m, 3)
            Slant range [m], bearing and elevation [rad] in the sensor's frame: x forward, y left.
        pose : StampedPose
            Of the robot at the sweep; the covariance of its orientation counts.

        Returns
        -------
        values : ndarray, shape (m, d)
            Range, bearing and, in 3D, elevation, axes of the map [m, rad].
        covariances : ndarray, shape (m, d, d)
            Of the values; the error of the robot's position is left to the filter.
        positions : ndarray, shape (m, d)
            Where that is [m, map].
        """
        d = self._model.dimension
        if not len(sweep):
            return np.zeros((0, d)), np.zeros((0, d, d)), np.zeros((0, d))
        body = pose.pose.rotation()
        ranges, bearings, elevations = sweep.T
        cb, sb = np.cos(bearings), np.sin(bearings)
        ce, se = np.cos(elevations), np.sin(elevations)
        unit = np.stack([ce * cb, ce * sb, se], axis=1)
        # Columns: by range, by bearing, by elevation.
        slopes = np.stack(
            [
                unit,
                ranges[:, None] * np.stack([-ce * sb, ce * cb, np.zeros_like(sb)], axis=1),
                ranges[:, None] * np.stack([-se * cb, -se * sb, ce], axis=1),
            ],
            axis=2,
        )
        turn = body @ self._rotation
        arms = self._position @ body.T + (ranges[:, None] * unit) @ turn.T
        by_sweep = turn @ slopes
        spread = by_sweep @ self._noise @ by_sweep.transpose(0, 2, 1)
        # A small rotation about the map's axes moves a target by its cross product with the arm.
        by_turn = _cross(-arms)
        spread = spread + by_turn @ pose.covariance[3:, 3:] @ by_turn.transpose(0, 2, 1)
        positions = (pose.pose.position + arms)[:, :d]
        values = self._model.measure(positions, pose.pose)
        slope = self._model.jacobian(positions, pose.pose)
        covariances = slope @ spread[:, :d, :d] @ slope.transpose(0, 2, 1)
        unknown = np.logical_not(np.any(slope, axis=2))
        unknown[:, 0] = False
        index = np.nonzero(unknown)
        covariances[index[0], index[1], index[1]] = _ANY_ANGLE
        return values, covariances, positions


def _cross(vectors: FloatArray) -> FloatArray:
    """Return the matrices (n, 3, 3) with which vectors (n, 3) take cross products."""
    out = np.zeros((len(vectors), 3, 3))
    x, y, z = vectors.T
    out[:, 0, 1], out[:, 0, 2] = -z, y
    out[:, 1, 0], out[:, 1, 2] = z, -x
    out[:, 2, 0], out[:, 2, 1] = -y, x
    return out
