"""Measurement model of range and angles: g(x, q), its inverse and Jacobian (000, eq. (6) to (9)).

Bearings are relative to the map's axes, not to the robot's heading. In 2D the range is horizontal.
"""

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from maasi_filter.arrays import FloatArray
from maasi_filter.models.pose import Pose

TWO_PI = 2.0 * math.pi


@njit(cache=True, error_model='numpy')
def wrap(angle: float) -> float:
    """Return `angle` in [-pi, pi)."""
    if -math.pi <= angle < math.pi:
        return angle
    wrapped = angle - TWO_PI * math.floor((angle + math.pi) / TWO_PI)
    return wrapped if wrapped < math.pi else wrapped - TWO_PI  # rounding may land on pi itself


def wrap_angle(angle: ArrayLike) -> FloatArray:
    """Return angles [rad] wrapped to [-pi, pi), same shape."""
    array = np.asarray(angle, dtype=float)
    wrapped = array - TWO_PI * np.floor((array + math.pi) / TWO_PI)
    wrapped = np.where(wrapped >= math.pi, wrapped - TWO_PI, wrapped)
    return np.where((array >= -math.pi) & (array < math.pi), array, wrapped)


@dataclass(frozen=True)
class RangeAndAngles:
    """Horizontal range and bearing in 2D; range, bearing and elevation in 3D."""

    dimension: int

    def measure(self, positions: ArrayLike, pose: Pose) -> FloatArray:
        """Return g(x, q), (n, d) [m, rad, rad], of targets at positions (n, d) [m, map].

        All angles are 0 at the robot itself; the bearing is 0 straight above it.
        """
        x, y, z = self._offsets(positions, pose)
        level = np.hypot(x, y)
        values = np.empty((len(x), self.dimension))
        values[:, 0] = np.hypot(level, z)
        values[:, 1] = np.arctan2(y, x)
        if self.dimension == 3:
            # Equal to the arcsin of (9), but precise near the vertical.
            values[:, 2] = np.arctan2(z, level)
        return values

    def inverse(self, z: ArrayLike, pose: Pose) -> FloatArray:
        """Return the positions (n, d) [m, map] of measurements (n, d) [m, rad, rad].

        A negative range, which noise can produce, points in the opposite direction.
        """
        values, origin = self._array('z', z), pose.position
        distance, bearing = values[:, 0], values[:, 1]
        positions = np.empty(values.shape)
        direction: FloatArray | float = 1.0
        if self.dimension == 3:
            direction = np.cos(values[:, 2])
            positions[:, 2] = distance * np.sin(values[:, 2]) + origin[2]
        positions[:, 0] = distance * (direction * np.cos(bearing)) + origin[0]
        positions[:, 1] = distance * (direction * np.sin(bearing)) + origin[1]
        return positions

    def jacobian(self, positions: ArrayLike, pose: Pose) -> FloatArray:
        """Return dg/dx, (n, d, d).

        Where it does not exist (zero range, or straight above for the bearing), its rows are zero.
        """
        x, y, z = self._offsets(positions, pose)
        level = np.hypot(x, y)
        distance = np.hypot(level, z)
        safe = np.where(distance > 0.0, distance, np.inf)
        safe_level = np.where(level > 0.0, level, np.inf)
        matrix = np.zeros((len(x), self.dimension, self.dimension))
        matrix[:, 0, 0], matrix[:, 0, 1] = x / safe, y / safe
        matrix[:, 1, 0], matrix[:, 1, 1] = -y / safe_level**2, x / safe_level**2
        if self.dimension == 3:
            matrix[:, 0, 2] = z / safe
            matrix[:, 2, 0] = -x * z / (safe**2 * safe_level)
            matrix[:, 2, 1] = -y * z / (safe**2 * safe_level)
            matrix[:, 2, 2] = level / safe**2
        return matrix

    def residual(self, z: ArrayLike, predicted: ArrayLike) -> FloatArray:
        """Return z - predicted with the bearing wrapped; shapes broadcast, last axis d."""
        difference = np.array(np.asarray(z, dtype=float) - np.asarray(predicted, dtype=float))
        difference[..., 1] = wrap_angle(difference[..., 1])
        return difference

    def _offsets(self, positions: ArrayLike, pose: Pose) -> FloatArray:
        array = self._array('positions', positions)
        offsets = np.zeros((3, len(array)))
        offsets[: self.dimension] = (array - pose.position[: self.dimension]).T
        return offsets

    def _array(self, name: str, value: ArrayLike) -> FloatArray:
        array = np.atleast_2d(np.asarray(value, dtype=float))
        if array.ndim != 2 or array.shape[1] != self.dimension:
            raise ValueError(f'{name}: got shape {array.shape}, allowed is (n, {self.dimension})')
        return array
