"""One robot's detections as rows of numbers for the kernels."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from maasi_filter.arrays import BoolArray, FloatArray
from maasi_filter.measurement_check import CheckedMeasurement
from maasi_filter.models.detection import DetectionModel
from maasi_filter.models.pose import Pose
from maasi_filter.pmb.factors import (
    COS,
    HEAD,
    KIND,
    MISS,
    MODEL,
    SCALE,
    SENSOR,
    SIN,
    TERMS,
    gaussian_terms,
)

# Closer than this many deviations of the range, bearings say nothing and noise is Cartesian.
POLE_DEVIATIONS = 3.0
# Variances of range and angles are at most these: an unknown angle is uniform.
MOST_VARIANCES = np.array([math.inf, math.pi**2 / 3.0, math.pi**2 / 12.0])
LEAST_VOLUME = 1e-9


@dataclass(frozen=True)
class Scan:
    """What one robot measured in m detections.

    Parameters
    ----------
    ranges, deviations : (m,) arrays
        Measured ranges and their standard deviations, metres.
    """

    head: FloatArray  # (HEAD,): Factor of the scan: sensor and its pi; c_0 is 1
    terms: FloatArray  # (m, TERM): Factors of the detections; c_j is 1
    pose: Pose  # Of the sensor
    detection: DetectionModel  # pi
    ranges: FloatArray
    deviations: FloatArray
    cartesian: BoolArray  # (m,): Whether the noise is Gaussian in space, not in range and angles
    #: (m, d): Mean of the noise in that space: measured position, or range and angles.
    origins: FloatArray
    centres: FloatArray  # (m, d): Measured positions, metres
    roots: FloatArray  # (m, d, d): Cholesky factors of the covariance in that space
    volume: FloatArray  # (m,): |dx/dz| of Cartesian detections, else 1


def make_scan(member: CheckedMeasurement, factor: float, detection: DetectionModel) -> Scan:
    """Return a scan for the kernels.

    The position error of the robot is added to the noise. Covariances that a camera reports come
    from Cartesian ones: next to the robot, where the bearing is unknown, they are used as such.
    """
    values, pose = member.values, member.pose
    number, d = values.shape
    distance = np.abs(values[:, 0])
    level = distance * np.abs(np.cos(values[:, 2])) if d == 3 else distance
    covariances = member.covariances * factor
    own = member.pose_error**2
    if own > 0.0:
        covariances[:, 0, 0] += own
        covariances[:, 1, 1] += own / np.maximum(level * level, 1e-12)
        if d == 3:
            covariances[:, 2, 2] += own / np.maximum(distance * distance, 1e-12)
    deviations = np.sqrt(covariances[:, 0, 0])
    near = member.own & (distance < POLE_DEVIATIONS * deviations)
    centres = member.sensor.measurement.inverse(values, pose)
    cap = np.sqrt(np.minimum(MOST_VARIANCES[:d] / np.diagonal(covariances, axis1=1, axis2=2), 1.0))
    used = covariances * cap[:, :, None] * cap[:, None, :]
    volume = np.ones(number)
    if near.any():
        jacobian = distance * level if d == 3 else distance
        volume[near] = np.maximum(jacobian[near], LEAST_VOLUME)
        safe = np.where(jacobian < LEAST_VOLUME, 1e-6, 0.0)
        frames = _derivatives(values + safe[:, None])
        # Unknown angles spread no farther than the distance allows.
        floor = (own + 0.01 * covariances[:, 0, 0])[:, None, None] * np.eye(d)
        space = floor + frames @ covariances @ frames.swapaxes(1, 2)
        used[near] = space[near]
    origins = np.where(near[:, None], centres, values)
    terms, roots = gaussian_terms(origins, used, near)
    terms[:, SCALE] += np.log(volume)
    head = np.zeros(HEAD)
    head[SENSOR : SENSOR + 3] = pose.position
    head[COS], head[SIN] = math.cos(pose.yaw), math.sin(pose.yaw)
    head[KIND], head[MODEL:] = detection.kernel()
    head[MISS], head[TERMS] = 1.0, number
    return Scan(
        head,
        terms,
        pose,
        detection,
        values[:, 0],
        deviations,
        near,
        origins,
        centres,
        roots,
        volume,
    )


def _derivatives(values: FloatArray) -> FloatArray:
    """Return dx/dz (m, d, d) at range and angles (m, d)."""
    d = values.shape[1]
    r, bearing = values[:, 0], values[:, 1]
    elevation = values[:, 2] if d == 3 else np.zeros(len(values))
    cos_b, sin_b = np.cos(bearing), np.sin(bearing)
    cos_e, sin_e = np.cos(elevation), np.sin(elevation)
    columns = [
        np.stack([cos_e * cos_b, cos_e * sin_b, sin_e], axis=1),
        np.stack([-r * cos_e * sin_b, r * cos_e * cos_b, np.zeros(len(r))], axis=1),
        np.stack([-r * sin_e * cos_b, -r * sin_e * sin_b, r * cos_e], axis=1),
    ]
    return np.stack(columns, axis=2)[:, :d, :d]
