"""One robot's scan: its detections as factors, and draws of where targets may be that they show."""

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from maasi_filter.arrays import BoolArray, FloatArray
from maasi_filter.geometry.terrain import Terrain
from maasi_filter.measurement_check import CheckedMeasurement
from maasi_filter.models.detection import BoxDetection, DetectionModel
from maasi_filter.models.line_of_sight import HIDDEN, probability_in_sight
from maasi_filter.models.pose import Pose
from maasi_filter.pmb.density import Density, fill_moments
from maasi_filter.pmb.factors import (
    COS,
    FIRST,
    HEAD,
    KIND,
    LEAST_UNEXPLORED,
    MISS,
    MODEL,
    MOST_PROBABLE,
    SCALE,
    SENSOR,
    SIN,
    TERMS,
    gaussian_terms,
)
from maasi_filter.settings import FilterSettings
from maasi_filter.unexplored_map import UnexploredMap

LEAST_SUPPORT = 10.0  # fewest effective draws that stand for a density
# Closer than this many deviations of the range, bearings say nothing and noise is Cartesian.
POLE_DEVIATIONS = 3.0
# Variances of range and angles are at most these: an unknown angle is uniform.
MOST_VARIANCES = np.array([math.inf, math.pi**2 / 3.0, math.pi**2 / 12.0])
LEAST_VOLUME = 1e-9


@dataclass(frozen=True)
class Scan:
    """What one robot measured in m detections, with n draws of the place that each points at."""

    head: FloatArray  # (HEAD,): Factor of the scan: sensor and its pi; c_0 is 1
    terms: FloatArray  # (m, TERM): Factors of the detections; c_j is 1
    pose: Pose  # Of the sensor
    terrain: Terrain | None  # Ground that may hide targets
    detection: DetectionModel  # pi
    ranges: FloatArray  # (m,): Metres
    deviations: FloatArray  # (m,): Of the ranges, metres
    centres: FloatArray  # (m, d): Measured positions, metres
    draws: FloatArray  # (m, n, d): x = g^-1(z + noise), metres
    #: (m, n): pi(x) |dx/dz|, 0 outside the bounds: with it a mean over the draws is an
    #: integral of pi(x) g(z | x).
    volume: FloatArray
    weights: FloatArray  # (m, n): The same times e(x) and the prior
    means: FloatArray  # (m, d): Of the draws
    covariances: FloatArray  # (m, d, d): Of the draws
    #: (m,): lambda_j = (N0 / V) int prior e pi g(z_j | x) dx, of targets not seen before.
    intensity: FloatArray

    def born(
        self, wanted: BoolArray, prior: tuple[FloatArray, FloatArray], frame: FloatArray
    ) -> list[tuple[int, Density]]:
        """Return the density prior e pi g_j of each wanted detection with enough draws inside."""
        total, squares = self.weights.sum(axis=1), np.square(self.weights).sum(axis=1)
        wanted = wanted & (np.square(total) > LEAST_SUPPORT * squares)
        head = self.head.copy()
        head[MISS], head[FIRST], head[TERMS] = 0.0, 0.0, 1.0
        densities = []
        for j in np.flatnonzero(wanted).tolist():
            terms = self.terms[j : j + 1].copy()
            terms[0, SCALE] -= math.log(self.weights[j].mean())
            draws, weights = self.draws[j].copy(), self.weights[j] / total[j]
            density = Density(draws, weights, head[None].copy(), terms, prior, frame)
            densities.append((j, density))
        return densities


def make_scan(
    member: CheckedMeasurement,
    factor: float,
    exploration: UnexploredMap,
    settings: FilterSettings,
    generator: np.random.Generator,
) -> Scan:
    """Return a scan with draws of each detection, before e is updated with it.

    `factor` is that of the variances. The position error of the robot is added to the noise.
    Covariances that a camera reports come from Cartesian ones: next to the robot, where the bearing
    is unknown, they are used as Cartesian ones.
    """
    values, pose, detection = member.values, member.pose, member.sensor.detection
    (count, d), number = values.shape, settings.pmb.particles
    if isinstance(detection, BoxDetection):
        # The position error of the robot blurs the edge of a box-shaped field of view.
        detection = detection.softened(2.0 * member.pose_error)
    distance = np.abs(values[:, 0])
    level = distance * np.abs(np.cos(values[:, 2])) if d == 3 else distance
    covariances = member.covariances * factor
    pose_variance = member.pose_error**2
    covariances[:, 0, 0] += pose_variance
    covariances[:, 1, 1] += pose_variance / np.maximum(level * level, 1e-12)
    if d == 3:
        covariances[:, 2, 2] += pose_variance / np.maximum(distance * distance, 1e-12)
    deviations = np.sqrt(covariances[:, 0, 0])
    near = member.has_covariances & (distance < POLE_DEVIATIONS * deviations)
    centres = member.sensor.measurement.inverse(values, pose)
    cap = np.sqrt(np.minimum(MOST_VARIANCES[:d] / np.diagonal(covariances, axis1=1, axis2=2), 1.0))
    used = covariances * cap[:, :, None] * cap[:, None, :]
    scale = np.ones(count)
    if near.any():
        jacobian = distance * level if d == 3 else distance
        scale[near] = np.maximum(jacobian[near], LEAST_VOLUME)
        safe = np.where(jacobian < LEAST_VOLUME, 1e-6, 0.0)
        frames = _derivatives(values + safe[:, None])
        # Unknown angles spread no farther than the distance allows.
        floor = (pose_variance + 0.01 * covariances[:, 0, 0])[:, None, None] * np.eye(d)
        space = floor + frames @ covariances @ frames.swapaxes(1, 2)
        used[near] = space[near]
    origins = np.where(near[:, None], centres, values)
    terms, roots = gaussian_terms(origins, used, near)
    terms[:, SCALE] += np.log(scale)
    head = np.zeros(HEAD)
    head[SENSOR : SENSOR + 3] = pose.position
    head[COS], head[SIN] = math.cos(pose.yaw), math.sin(pose.yaw)
    head[KIND], head[MODEL:] = detection.kernel()
    head[MISS], head[TERMS] = 1.0, count
    draws, volume = generator.standard_normal((count, number, d)), np.empty((count, number))
    _place(origins, near, roots, scale, pose.position, exploration.bounds, draws, volume)
    flat = draws.reshape(-1, d)
    terrain = exploration.area.terrain
    probability = probability_in_sight(detection, flat, pose, terrain, HIDDEN)
    probability = np.minimum(probability, MOST_PROBABLE)
    volume *= probability.reshape(count, number)
    weights = np.maximum(exploration.at(flat), LEAST_UNEXPLORED).reshape(count, number) * volume
    weights *= exploration.area.density(flat).reshape(count, number)
    means, spreads = np.empty((count, d)), np.empty((count, d, d))
    even = np.full(number, 1.0 / number)
    for j in range(count):
        fill_moments(draws[j], even, means[j], spreads[j])
    return Scan(
        head,
        terms,
        pose,
        terrain,
        detection,
        values[:, 0],
        deviations,
        centres,
        draws,
        volume,
        weights,
        means,
        spreads,
        exploration.area.expected_targets / exploration.volume * (weights.sum(axis=1) / number),
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


@njit(cache=True, error_model='numpy')
def _place(  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    origins, cartesian, roots, scale, sensor_position, bounds, particles, jacobian
):
    """Turn normal numbers (m, n, d) into positions; |dx/dz| is 0 where no target can be."""
    d = origins.shape[1]
    z = np.zeros(3)
    for m in range(particles.shape[0]):
        for i in range(particles.shape[1]):
            for a in range(d):
                z[a] = origins[m, a]
                for b in range(a + 1):
                    z[a] += roots[m, a, b] * particles[m, i, b]
            if cartesian[m]:
                for a in range(d):
                    particles[m, i, a] = z[a]
                jacobian[m, i] = scale[m]
            else:
                level = z[0] * math.cos(z[2]) if d == 3 else z[0]
                particles[m, i, 0] = sensor_position[0] + level * math.cos(z[1])
                particles[m, i, 1] = sensor_position[1] + level * math.sin(z[1])
                jacobian[m, i] = z[0]
                if d == 3:
                    particles[m, i, 2] = sensor_position[2] + z[0] * math.sin(z[2])
                    jacobian[m, i] = z[0] * level
                if not (z[0] > 0.0 and level > 0.0):
                    jacobian[m, i] = 0.0
            for a in range(d):
                if not bounds[a, 0] <= particles[m, i, a] <= bounds[a, 1]:
                    jacobian[m, i] = 0.0
