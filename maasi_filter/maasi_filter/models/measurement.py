"""Measurements of a target from a robot: g(x, q), its inverse, Jacobian and density.

Range, bearing and, in 3D, elevation (000, eq. (6) to (9)). Bearings are in the map's axes, not
relative to the robot's heading. In 2D the range is horizontal.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod

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
    # Rounding may land on pi itself.
    return wrapped if wrapped < math.pi else wrapped - TWO_PI


def wrap_angle(angle: ArrayLike) -> FloatArray:
    """Return angles [rad] wrapped to [-pi, pi), same shape."""
    array = np.asarray(angle, dtype=float)
    wrapped = array - TWO_PI * np.floor((array + math.pi) / TWO_PI)
    wrapped = np.where(wrapped >= math.pi, wrapped - TWO_PI, wrapped)
    return np.where((array >= -math.pi) & (array < math.pi), array, wrapped)


class MeasurementModel(ABC):
    """Range and angles of a target seen from a robot."""

    dimension: int
    names: tuple[str, ...]

    @abstractmethod
    def measure(self, positions: ArrayLike, pose: Pose) -> FloatArray:
        """Return g(x, q), shape (n, d) [m, rad, rad], of targets at positions (n, d) [m, map].

        A target at the robot itself has all angles 0; one straight above has bearing 0.
        """

    @abstractmethod
    def inverse(self, z: ArrayLike, pose: Pose) -> FloatArray:
        """Return the positions (n, d) [m, map] that measurements (n, d) point at.

        A negative range, which noise can produce, points the opposite way.
        """

    @abstractmethod
    def jacobian(self, positions: ArrayLike, pose: Pose) -> FloatArray:
        """Return dg/dx, shape (n, d, d).

        At a pole (zero range, or straight above for the bearing) the derivative does not exist;
        the rows of the angles concerned, and of a zero range, are zero there.
        """

    def residual(self, z: ArrayLike, predicted: ArrayLike) -> FloatArray:
        """Return z - predicted with the bearing wrapped; shapes broadcast, last axis d."""
        difference = np.array(np.asarray(z, dtype=float) - np.asarray(predicted, dtype=float))
        difference[..., 1] = wrap_angle(difference[..., 1])
        return difference

    def log_density(
        self, z: ArrayLike, positions: ArrayLike, pose: Pose, covariance: ArrayLike
    ) -> FloatArray:
        """Return log p(z | x), a Gaussian in measurement space (000, eq. (10)).

        Parameters
        ----------
        z : (d,) or (m, d) array
            One measurement or several.
        positions : (n, d) array
            Targets, metres, frame `map`.
        covariance : (d, d) array
            Positive definite.

        Returns
        -------
        (n,) or (m, n) array

        Raises
        ------
        ValueError
            If the covariance is not positive definite.
        """
        values = np.asarray(z, dtype=float)
        matrix = np.asarray(covariance, dtype=float)
        try:
            root = np.linalg.cholesky(matrix)
        except np.linalg.LinAlgError:
            raise ValueError(
                f'covariance: got {matrix.tolist()}, allowed is a positive definite matrix'
            ) from None
        predicted = self.measure(positions, pose)
        difference = self.residual(values[..., None, :], predicted)
        scaled = np.linalg.solve(root, difference[..., None])[..., 0]
        log_norm = -0.5 * self.dimension * math.log(TWO_PI) - np.log(np.diagonal(root)).sum()
        return np.asarray(log_norm - 0.5 * (scaled * scaled).sum(axis=-1))

    def _array(self, name: str, value: ArrayLike) -> FloatArray:
        array = np.atleast_2d(np.asarray(value, dtype=float))
        if array.ndim != 2 or array.shape[1] != self.dimension:
            raise ValueError(f'{name}: got shape {array.shape}, allowed is (n, {self.dimension})')
        return array


class RangeBearing(MeasurementModel):
    """Horizontal range and bearing, 2D."""

    dimension = 2
    names = ('range', 'bearing')

    def measure(self, positions: ArrayLike, pose: Pose) -> FloatArray:
        """Return range and bearing of positions, (n, 2)."""
        offset = self._array('positions', positions) - pose.position[:2]
        return np.stack(
            [np.hypot(offset[:, 0], offset[:, 1]), np.arctan2(offset[:, 1], offset[:, 0])], axis=1
        )

    def inverse(self, z: ArrayLike, pose: Pose) -> FloatArray:
        """Return where measurements point, (n, 2)."""
        values = self._array('z', z)
        direction = np.stack([np.cos(values[:, 1]), np.sin(values[:, 1])], axis=1)
        return np.asarray(pose.position[:2] + values[:, :1] * direction)

    def jacobian(self, positions: ArrayLike, pose: Pose) -> FloatArray:
        """Return dg/dx at positions, (n, 2, 2)."""
        offset = self._array('positions', positions) - pose.position[:2]
        distance = np.hypot(offset[:, 0], offset[:, 1])
        safe = np.where(distance > 0.0, distance, np.inf)
        matrix = np.zeros((len(offset), 2, 2))
        matrix[:, 0, :] = offset / safe[:, None]
        matrix[:, 1, 0] = -offset[:, 1] / safe**2
        matrix[:, 1, 1] = offset[:, 0] / safe**2
        return matrix


class RangeBearingElevation(MeasurementModel):
    """Range, bearing and elevation, 3D."""

    dimension = 3
    names = ('range', 'bearing', 'elevation')

    def measure(self, positions: ArrayLike, pose: Pose) -> FloatArray:
        """Return range, bearing and elevation of positions, (n, 3)."""
        offset = self._array('positions', positions) - pose.position
        level = np.hypot(offset[:, 0], offset[:, 1])
        # atan2 is the arcsin of (9), and keeps its digits next to the vertical.
        return np.stack(
            [
                np.hypot(level, offset[:, 2]),
                np.arctan2(offset[:, 1], offset[:, 0]),
                np.arctan2(offset[:, 2], level),
            ],
            axis=1,
        )

    def inverse(self, z: ArrayLike, pose: Pose) -> FloatArray:
        """Return where measurements point, (n, 3)."""
        values = self._array('z', z)
        level = np.cos(values[:, 2])
        direction = np.stack(
            [level * np.cos(values[:, 1]), level * np.sin(values[:, 1]), np.sin(values[:, 2])],
            axis=1,
        )
        return np.asarray(pose.position + values[:, :1] * direction)

    def jacobian(self, positions: ArrayLike, pose: Pose) -> FloatArray:
        """Return dg/dx at positions, (n, 3, 3)."""
        offset = self._array('positions', positions) - pose.position
        level = np.hypot(offset[:, 0], offset[:, 1])
        distance = np.hypot(level, offset[:, 2])
        safe = np.where(distance > 0.0, distance, np.inf)
        safe_level = np.where(level > 0.0, level, np.inf)
        matrix = np.zeros((len(offset), 3, 3))
        matrix[:, 0, :] = offset / safe[:, None]
        matrix[:, 1, 0] = -offset[:, 1] / safe_level**2
        matrix[:, 1, 1] = offset[:, 0] / safe_level**2
        matrix[:, 2, 0] = -offset[:, 0] * offset[:, 2] / (safe**2 * safe_level)
        matrix[:, 2, 1] = -offset[:, 1] * offset[:, 2] / (safe**2 * safe_level)
        matrix[:, 2, 2] = level / safe**2
        return matrix
