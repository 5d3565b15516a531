"""Detections of one robot ready for kernels: densities, their roots, and where they point."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from maasi_filter.models.pose import Pose

FloatArray = NDArray[np.float64]

# Closer than this many deviations of the range, a bearing says nothing and noise is Cartesian.
POLE_DEVIATIONS = 3.0
LARGEST_BEARING_VARIANCE = math.pi**2 / 3.0
LARGEST_ELEVATION_VARIANCE = math.pi**2 / 12.0


@dataclass
class MeasurementSet:
    """Detections of one robot, ready for the kernels.

    Parameters
    ----------
    values : (m, d) array
        Range and angles.
    covariances : (m, d, d) array
        In measurement space, uncertainty of the robot's position included.
    cartesian : (m,) bool array
        Whether the density is a Gaussian around `centres` instead: next to the robot, where
        angles are not defined.
    centres : (m, d) array
        Where the detections point at, metres.
    roots : (m, d, d) array
        Cholesky factors of the covariance in the space used.
    information : (m, d, d) array
        Its inverse.
    log_norm : (m,) array
        Logarithm of the density at its peak, per unit of measurement space.
    volume : (m,) array
        |dx/dz| at the detection: 1 / (unit of measurement space) times m^d.
    gates : (m, 2) array
        What squared errors of range and angles (Cartesian: of nothing and the position) are at
        least multiplied with in the squared normalised error.
    """

    values: FloatArray
    covariances: FloatArray
    cartesian: NDArray[np.bool_]
    centres: FloatArray
    roots: FloatArray
    information: FloatArray
    log_norm: FloatArray
    volume: FloatArray
    gates: FloatArray

    def __len__(self) -> int:
        return len(self.values)


@njit(cache=True, error_model='numpy')
def _invert(matrix, inverse):  # type: ignore[no-untyped-def]
    """Fill the inverse of a covariance, in place."""
    if matrix.shape[0] == 2:
        determinant = matrix[0, 0] * matrix[1, 1] - matrix[0, 1] * matrix[1, 0]
        inverse[0, 0] = matrix[1, 1] / determinant
        inverse[1, 1] = matrix[0, 0] / determinant
        inverse[0, 1] = -matrix[0, 1] / determinant
        inverse[1, 0] = inverse[0, 1]
        return
    a = matrix
    c00 = a[1, 1] * a[2, 2] - a[1, 2] * a[2, 1]
    c01 = a[0, 2] * a[2, 1] - a[0, 1] * a[2, 2]
    c02 = a[0, 1] * a[1, 2] - a[0, 2] * a[1, 1]
    determinant = a[0, 0] * c00 + a[1, 0] * c01 + a[2, 0] * c02
    inverse[0, 0] = c00 / determinant
    inverse[0, 1] = c01 / determinant
    inverse[0, 2] = c02 / determinant
    inverse[1, 0] = inverse[0, 1]
    inverse[1, 1] = (a[0, 0] * a[2, 2] - a[0, 2] * a[2, 0]) / determinant
    inverse[1, 2] = (a[0, 2] * a[1, 0] - a[0, 0] * a[1, 2]) / determinant
    inverse[2, 0] = inverse[0, 2]
    inverse[2, 1] = inverse[1, 2]
    inverse[2, 2] = (a[0, 0] * a[1, 1] - a[0, 1] * a[1, 0]) / determinant


@njit(cache=True, error_model='numpy')
def _root(matrix, root):  # type: ignore[no-untyped-def]
    """Fill the lower Cholesky factor of a covariance, in place; return log of its determinant."""
    d = matrix.shape[0]
    log_determinant = 0.0
    for i in range(d):
        for j in range(i + 1):
            total = matrix[i, j]
            for k in range(j):
                total -= root[i, k] * root[j, k]
            if i == j:
                root[i, i] = math.sqrt(max(total, 1e-300))
                log_determinant += 2.0 * math.log(root[i, i])
            else:
                root[i, j] = total / root[j, j]
        for j in range(i + 1, d):
            root[i, j] = 0.0
    return log_determinant


@njit(cache=True, error_model='numpy')
def _gates(covariance, cartesian, gate):  # type: ignore[no-untyped-def]
    """Fill lower bounds of the inverse covariance on its axes.

    The largest sum of a row bounds the eigenvalues of the correlation.
    """
    d = covariance.shape[0]
    most = 1.0
    for i in range(d):
        total = 0.0
        for j in range(d):
            total += abs(covariance[i, j]) / math.sqrt(covariance[i, i] * covariance[j, j])
        most = max(most, total)
    widest = covariance[1, 1]
    if d == 3:
        widest = max(widest, covariance[2, 2])
    if cartesian:
        widest = max(widest, covariance[0, 0])
    gate[0] = 1.0 / (most * covariance[0, 0])
    gate[1] = 1.0 / (most * widest)


@njit(cache=True, error_model='numpy')
def spherical_frame(values, frame):  # type: ignore[no-untyped-def]
    """Fill dx/dz at a measurement (d, d), in place; return the magnitude of its determinant."""
    r = values[0]
    cos_bearing = math.cos(values[1])
    sin_bearing = math.sin(values[1])
    if values.shape[0] == 2:
        frame[0, 0] = cos_bearing
        frame[1, 0] = sin_bearing
        frame[0, 1] = -r * sin_bearing
        frame[1, 1] = r * cos_bearing
        return abs(r)
    cos_elevation = math.cos(values[2])
    sin_elevation = math.sin(values[2])
    frame[0, 0] = cos_elevation * cos_bearing
    frame[1, 0] = cos_elevation * sin_bearing
    frame[2, 0] = sin_elevation
    frame[0, 1] = -r * cos_elevation * sin_bearing
    frame[1, 1] = r * cos_elevation * cos_bearing
    frame[2, 1] = 0.0
    frame[0, 2] = -r * sin_elevation * cos_bearing
    frame[1, 2] = -r * sin_elevation * sin_bearing
    frame[2, 2] = r * cos_elevation
    return abs(r * r * cos_elevation)


@njit(cache=True, error_model='numpy')
def _prepare(  # type: ignore[no-untyped-def]
    values,
    covariances,
    sensor_position,
    pose_error,
    cartesian_near,
    cap_angles,
    cartesian,
    centres,
    roots,
    information,
    log_norm,
    volume,
    gates,
):
    number, d = values.shape
    frame = np.zeros((d, d))
    matrix = np.zeros((d, d))
    for m in range(number):
        z = values[m]
        covariance = covariances[m]
        determinant = spherical_frame(z, frame)
        for axis in range(d):
            centres[m, axis] = sensor_position[axis] + z[0] * frame[axis, 0]
        own = pose_error * pose_error
        if pose_error > 0.0:
            # An error of the robot's position, seen along the axes of the measurement.
            level = abs(z[0])
            if d == 3:
                level *= abs(math.cos(z[2]))
                covariance[2, 2] += own / max(z[0] * z[0], 1e-12)
            covariance[0, 0] += own
            covariance[1, 1] += own / max(level * level, 1e-12)
        deviation = math.sqrt(covariance[0, 0])
        cartesian[m] = cartesian_near and abs(z[0]) < POLE_DEVIATIONS * deviation
        if cartesian[m]:
            if determinant < 1e-9:
                spherical_frame(z + 1e-6, frame)
            # Angles that are not known at all spread no farther than the distance allows.
            floor = own + 0.01 * covariance[0, 0]
            for i in range(d):
                for j in range(d):
                    total = floor if i == j else 0.0
                    for k in range(d):
                        for n in range(d):
                            total += frame[i, k] * covariance[k, n] * frame[j, n]
                    matrix[i, j] = total
            volume[m] = max(determinant, 1e-9)
            log_determinant = _root(matrix, roots[m])
            log_norm[m] = (
                -0.5 * d * math.log(2.0 * math.pi) - 0.5 * log_determinant + math.log(volume[m])
            )
            _invert(matrix, information[m])
            _gates(matrix, True, gates[m])
        else:
            if cap_angles:
                for axis in range(1, d):
                    largest = LARGEST_BEARING_VARIANCE
                    if axis == 2:
                        largest = LARGEST_ELEVATION_VARIANCE
                    if covariance[axis, axis] > largest:
                        scale = math.sqrt(largest / covariance[axis, axis])
                        for j in range(d):
                            covariance[axis, j] *= scale
                            covariance[j, axis] *= scale
            volume[m] = determinant
            log_determinant = _root(covariance, roots[m])
            log_norm[m] = -0.5 * d * math.log(2.0 * math.pi) - 0.5 * log_determinant
            _invert(covariance, information[m])
            _gates(covariance, False, gates[m])


def prepare_measurements(
    values: FloatArray,
    covariances: FloatArray,
    pose: Pose,
    pose_error: float = 0.0,
    cartesian_near: bool = False,
    cap_angles: bool = True,
) -> MeasurementSet:
    """Return detections (m, d) with covariances (m, d, d) ready for the kernels.

    Parameters
    ----------
    pose : Pose
        Of the sensor.
    pose_error : float
        Deviation of the error of the sensor's position, per axis, metres; it is added to the
        noise as the measurement sees it.
    cartesian_near : bool
        Whether a detection within three deviations of range of the robot is taken as a position
        with a Cartesian covariance. For covariances that come from one, as a camera's do: next
        to the robot they say that the bearing is not known, and a ring is no disc.
    cap_angles : bool
        Whether angular variances are capped at those of an angle that is not known at all.
    """
    number, d = values.shape
    covariances = np.array(covariances)
    out = MeasurementSet(
        values=values,
        covariances=covariances,
        cartesian=np.zeros(number, np.bool_),
        centres=np.empty((number, d)),
        roots=np.empty((number, d, d)),
        information=np.empty((number, d, d)),
        log_norm=np.empty(number),
        volume=np.empty(number),
        gates=np.empty((number, 2)),
    )
    _prepare(
        values,
        covariances,
        pose.position,
        pose_error,
        cartesian_near,
        cap_angles,
        out.cartesian,
        out.centres,
        out.roots,
        out.information,
        out.log_norm,
        out.volume,
        out.gates,
    )
    return out
