"""From pixels to measurements with covariances (001, (17), (18))."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from maasi_filter.models.pose import Pose

Array = NDArray[np.float64]


# A bearing that says nothing is uniform over the circle: variance pi^2 / 3.
_BEARING_VARIANCE_LIMIT = np.pi**2 / 3.0


def propagate(
    by_pixel: Array,
    pixel_covariances: ArrayLike,
    by_pose: Array,
    pose_covariance: ArrayLike | None = None,
) -> Array:
    """Return the covariances (n, 2, 2) of floor positions, from those of pixels and pose [m^2].

    Parameters
    ----------
    by_pixel, by_pose : ndarray, shapes (n, 2, 2) and (n, 2, 6)
        Derivatives, from `Camera.back_project`.
    pixel_covariances : array_like, shape (n, 2, 2) or (2, 2)
        [px^2].
    pose_covariance : array_like, shape (6, 6), optional
        Of x, y, z [m] and of rotations about the map's axes [rad].

    Raises
    ------
    ValueError
        If the pose's covariance has another shape or is not finite.
    """
    pixel = np.asarray(pixel_covariances, dtype=np.float64)
    covariances = by_pixel @ pixel @ by_pixel.transpose(0, 2, 1)
    if pose_covariance is not None:
        matrix = np.asarray(pose_covariance, dtype=np.float64)
        if matrix.shape != (6, 6):
            raise ValueError(f'pose_covariance: got shape {matrix.shape}, allowed is (6, 6)')
        if not np.isfinite(matrix).all():
            raise ValueError('pose_covariance: got a number that is not finite')
        covariances = covariances + by_pose @ matrix @ by_pose.transpose(0, 2, 1)
    return np.asarray(covariances)


def range_bearing(
    positions: Array,
    covariances: Array,
    pose: Pose,
    dimension: int = 2,
    floor_height: float = 0.0,
    floor_deviation: float = 0.005,
) -> tuple[Array, Array]:
    """
    Turn floor positions into range, bearing (and elevation) from the robot (000, eq. (6) to (9)).

    Parameters
    ----------
    positions : ndarray, shape (n, 2)
        On the floor, map frame [m].
    covariances : ndarray, shape (n, 2, 2)
        Of the positions [m^2].
    pose : Pose
        Of the robot; the bearing counts from the map's x axis, whatever the yaw.
    dimension : {2, 3}
        2: horizontal range and bearing; 3: range in space, bearing, elevation.
    floor_height : float
        Of the positions [m].
    floor_deviation : float
        How well that height is known [m]; keeps the covariance regular in 3D.

    Returns
    -------
    values : ndarray, shape (n, dimension)
        [m, rad(, rad)].
    covariances : ndarray, shape (n, dimension, dimension)
        To first order. Right over a target the bearing says nothing: its variance is bounded by
        that of a uniform angle.
    """
    if dimension not in (2, 3):
        raise ValueError(f'dimension: got {dimension}, allowed 2 or 3')
    values = np.empty((len(positions), dimension))
    result = np.empty((len(positions), dimension, dimension))
    _range_bearing(
        positions, covariances, pose.position, floor_height, floor_deviation, values, result
    )
    return values, result


@njit(cache=True)
def _range_bearing(positions, covariances, origin, height, deviation, values, result):
    dimension = values.shape[1]
    for i in range(positions.shape[0]):
        dx, dy = positions[i, 0] - origin[0], positions[i, 1] - origin[1]
        horizontal = np.sqrt(dx * dx + dy * dy)
        bearing = np.arctan2(dy, dx)
        cosine, sine = np.cos(bearing), np.sin(bearing)
        xx, yy = covariances[i, 0, 0], covariances[i, 1, 1]
        xy = 0.5 * (covariances[i, 0, 1] + covariances[i, 1, 0])
        # Variances along the line of sight and across it.
        along = cosine * cosine * xx + 2.0 * cosine * sine * xy + sine * sine * yy
        across = sine * sine * xx - 2.0 * cosine * sine * xy + cosine * cosine * yy
        both = cosine * sine * (yy - xx) + (cosine * cosine - sine * sine) * xy
        limit = np.sqrt(_BEARING_VARIANCE_LIMIT / across) if across > 0.0 else np.inf
        per_metre = min(1.0 / horizontal, limit) if horizontal > 0.0 else min(limit, 1e9)
        values[i, 1] = bearing
        result[i, 1, 1] = across * per_metre * per_metre
        if dimension == 2:
            values[i, 0] = horizontal
            result[i, 0, 0] = along
            result[i, 0, 1] = result[i, 1, 0] = both * per_metre
            continue
        rise = height - origin[2]
        distance = max(np.sqrt(horizontal * horizontal + rise * rise), 1e-12)
        # Derivatives of range and elevation along the horizontal line of sight, and upwards.
        by_along, by_up = horizontal / distance, rise / distance
        up = deviation * deviation
        values[i, 0] = distance
        values[i, 2] = np.arcsin(min(max(rise / distance, -1.0), 1.0))
        result[i, 0, 0] = by_along * by_along * along + by_up * by_up * up
        result[i, 2, 2] = (by_up * by_up * along + by_along * by_along * up) / distance**2
        result[i, 0, 2] = result[i, 2, 0] = by_along * by_up * (up - along) / distance
        result[i, 0, 1] = result[i, 1, 0] = by_along * both * per_metre
        result[i, 1, 2] = result[i, 2, 1] = -by_up / distance * both * per_metre
