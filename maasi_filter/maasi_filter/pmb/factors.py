"""Factors of a component's density: what each scan tells about where its target is.

The density is a product of factors, one for each scan since birth (Williams 2015, eq. (31) to (33),
with marginal association probabilities):

    f(x) = c_0 (1 - pi(x)) + pi(x) sum_j c_j g(z_j | x)

Factors are rows of numbers, so that one kernel evaluates the product of all of them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from maasi_filter.exploration import interpolate_at
from maasi_filter.models.detection import PARAMETERS, DetectionModel, detection_probability_at
from maasi_filter.models.measurement import wrap
from maasi_filter.models.measurement_set import MeasurementSet
from maasi_filter.models.pose import Pose
from maasi_filter.vector_math import arctan2

FloatArray = NDArray[np.float64]

# Kind of pi of a factor that is no scan's: 1 everywhere.
ALWAYS = -1
# With 1, a single miss would end a component that certainly exists.
MOST_PROBABLE = 0.98
# An environment is never seen beyond doubt: the model of the sensor is not that good.
LEAST_UNEXPLORED = 1e-3
LOG_NOTHING = -690.0

# A head: sensor position, cos and sin of its yaw, kind of pi, c_0, first term, terms, parameters.
SENSOR, COS, SIN, KIND, MISS, FIRST, TERMS, MODEL = 0, 3, 4, 5, 6, 7, 8, 9
HEAD = MODEL + PARAMETERS
# A term: log c_j and the peak of g, whether g is Cartesian, its centre, its information.
SCALE, CARTESIAN, CENTRE, INFORMATION = 0, 1, 2, 5
TERM = INFORMATION + 9


@dataclass(frozen=True)
class Scan:
    """What one robot measured, as rows of numbers.

    Parameters
    ----------
    head : (HEAD,) array
        Sensor and its pi; c_0 is 1.
    terms : (m, TERM) array
        Detections; c_j is 1.
    measurements : MeasurementSet
        The same with what draws need.
    pose : Pose
        Of the sensor.
    detection : DetectionModel
        pi.
    """

    head: FloatArray
    terms: FloatArray
    measurements: MeasurementSet
    pose: Pose
    detection: DetectionModel


def make_scan(measurements: MeasurementSet, pose: Pose, detection: DetectionModel) -> Scan:
    """Return a scan as rows of numbers."""
    kind, parameters = detection.kernel()
    head = np.zeros(HEAD)
    head[SENSOR : SENSOR + 3] = pose.position
    head[COS], head[SIN] = math.cos(pose.yaw), math.sin(pose.yaw)
    head[KIND] = kind
    head[MISS] = 1.0
    head[TERMS] = len(measurements)
    head[MODEL:] = parameters
    terms = np.zeros((len(measurements), TERM))
    d = measurements.values.shape[1]
    cartesian = measurements.cartesian
    terms[:, SCALE] = measurements.log_norm
    terms[:, CARTESIAN] = cartesian
    terms[:, CENTRE : CENTRE + d] = np.where(
        cartesian[:, None], measurements.centres, measurements.values
    )
    for a in range(d):
        for b in range(d):
            terms[:, INFORMATION + 3 * a + b] = measurements.information[:, a, b]
    return Scan(head, terms, measurements, pose, detection)


def gaussian_factor(mean: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return head and term of a normal density."""
    d = len(mean)
    head = np.zeros(HEAD)
    head[COS] = 1.0
    head[KIND] = ALWAYS
    head[TERMS] = 1
    terms = np.zeros((1, TERM))
    _, log_determinant = np.linalg.slogdet(covariance)
    terms[0, SCALE] = -0.5 * (d * math.log(2.0 * math.pi) + log_determinant)
    terms[0, CARTESIAN] = 1.0
    terms[0, CENTRE : CENTRE + d] = mean
    information = np.linalg.inv(covariance)
    for a in range(d):
        for b in range(d):
            terms[0, INFORMATION + 3 * a + b] = information[a, b]
    return head, terms


@njit(cache=True, error_model='numpy')
def probability_at(head, x, y, z):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Return pi at a position, capped."""
    if head[KIND] == ALWAYS:
        return 1.0
    value = detection_probability_at(
        int(head[KIND]),
        head[MODEL:],
        x - head[SENSOR],
        y - head[SENSOR + 1],
        z - head[SENSOR + 2],
        head[COS],
        head[SIN],
    )
    return min(value, MOST_PROBABLE)


@njit(cache=True, error_model='numpy')
def log_likelihood_at(head, term, d, x, y, z):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return log of c_j g(z_j | x)."""
    if term[CARTESIAN] > 0.5:
        a = x - term[CENTRE]
        b = y - term[CENTRE + 1]
        c = z - term[CENTRE + 2] if d == 3 else 0.0
    else:
        dx = x - head[SENSOR]
        dy = y - head[SENSOR + 1]
        dz = z - head[SENSOR + 2] if d == 3 else 0.0
        level = math.sqrt(dx * dx + dy * dy)
        a = math.sqrt(level * level + dz * dz) - term[CENTRE]
        b = wrap(arctan2(dy, dx) - term[CENTRE + 1])
        c = arctan2(dz, level) - term[CENTRE + 2] if d == 3 else 0.0
    i = INFORMATION
    square = a * (a * term[i] + 2.0 * (b * term[i + 1] + c * term[i + 2]))
    square += b * (b * term[i + 4] + 2.0 * c * term[i + 5]) + c * c * term[i + 8]
    return term[SCALE] - 0.5 * square


@njit(cache=True, error_model='numpy')
def log_factor_at(head, terms, d, x, y, z):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return log f(x); `terms` are those of all factors."""
    probability = probability_at(head, x, y, z)
    total = head[MISS] * (1.0 - probability)
    first = int(head[FIRST])
    for k in range(first, first + int(head[TERMS])):
        total += probability * math.exp(log_likelihood_at(head, terms[k], d, x, y, z))
    return math.log(total) if total > 1e-300 else LOG_NOTHING


@njit(cache=True, error_model='numpy')
def log_product_at(heads, terms, grid, frame, d, x, y, z):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return the log of the prior and of all factors but the last, and that of the last.

    `grid` is e at birth, or empty; `frame` has lower and upper bounds and the grid's step.
    """
    inside = frame[0, 0] <= x <= frame[1, 0] and frame[0, 1] <= y <= frame[1, 1]
    if d == 3:
        inside = inside and frame[0, 2] <= z <= frame[1, 2]
    if not inside:
        return -np.inf, 0.0
    total = 0.0
    if grid.shape[0]:
        unseen = interpolate_at(grid, frame[0], frame[2], x, y, z)
        total = math.log(max(unseen, LEAST_UNEXPLORED))
    last = heads.shape[0] - 1
    for k in range(last):
        total += log_factor_at(heads[k], terms, d, x, y, z)
    return total, log_factor_at(heads[last], terms, d, x, y, z)


@njit(cache=True, error_model='numpy')
def log_products(heads, terms, grid, frame, positions, products, last):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Fill both parts of the log density at positions (n, d)."""
    d = positions.shape[1]
    for i in range(positions.shape[0]):
        z = positions[i, 2] if d == 3 else 0.0
        products[i], last[i] = log_product_at(
            heads, terms, grid, frame, d, positions[i, 0], positions[i, 1], z
        )


@njit(cache=True, error_model='numpy')
def likelihoods(head, terms, positions, weights, probability, seen):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Fill pi (n,) and pi g_j (m, n) at particles; return p_D = sum w pi."""
    d = positions.shape[1]
    total = 0.0
    for i in range(positions.shape[0]):
        z = positions[i, 2] if d == 3 else 0.0
        probability[i] = probability_at(head, positions[i, 0], positions[i, 1], z)
        total += weights[i] * probability[i]
        for j in range(terms.shape[0]):
            seen[j, i] = probability[i] * math.exp(
                log_likelihood_at(head, terms[j], d, positions[i, 0], positions[i, 1], z)
            )
    return total
