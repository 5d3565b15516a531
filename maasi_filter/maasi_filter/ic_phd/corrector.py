"""The PHD corrector Psi (000, (13), (16)), with the same sums for any number of threads."""

import math
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import NamedTuple

import numpy as np
from numba import njit

from maasi_filter.arrays import FloatArray
from maasi_filter.geometry.vector_math import arctan2, exponential, use_wide_vectors
from maasi_filter.models.detection import fill_probabilities
from maasi_filter.models.measurement import TWO_PI, wrap
from maasi_filter.models.pose import Pose
from maasi_filter.models.sensor import Sensor

CHUNK = 2048
SUMS = {'reassoc', 'nsz', 'nnan'}  # sums may be added in vector lanes; all numbers are finite
X, Y, Z, RANGE, BEARING, ELEVATION, ROWS = range(7)  # rows of a chunk's working array


class PhdScan(NamedTuple):
    """Detections of one robot and its sensor, as the kernels need them.

    values (m, d) in m and rad; information (d, d) is the inverse of R; log_norm is the logarithm of
    the Gaussian's peak; kind and parameters describe pi(x, q); position (3,) in m.
    """

    values: FloatArray
    information: FloatArray
    log_norm: float
    kind: int
    parameters: FloatArray
    position: FloatArray
    cosine: float
    sine: float


def phd_scan(values: FloatArray, sensor: Sensor, pose: Pose) -> PhdScan:
    """Return detections (m, d) in the form of the corrector."""
    kind, parameters = sensor.detection.kernel()
    _, log_determinant = np.linalg.slogdet(2.0 * math.pi * sensor.covariance)
    return PhdScan(
        np.ascontiguousarray(values),
        np.asarray(np.linalg.inv(sensor.covariance), float),
        -0.5 * float(log_determinant),
        kind,
        parameters,
        pose.position,
        math.cos(pose.yaw),
        math.sin(pose.yaw),
    )


@njit(cache=True, error_model='numpy')
def _fill_offsets(particles, scan, rows):  # type: ignore[no-untyped-def]
    use_wide_vectors()
    number, d = particles.shape
    for i in range(number):
        x = particles[i, 0] - scan.position[0]
        y = particles[i, 1] - scan.position[1]
        z = particles[i, 2] - scan.position[2] if d == 3 else 0.0
        rows[X, i] = x
        rows[Y, i] = y
        rows[Z, i] = z
        rows[RANGE, i] = math.sqrt(x * x + y * y + z * z)
    for i in range(number):
        x = rows[X, i]
        y = rows[Y, i]
        rows[BEARING, i] = arctan2(y, x)
        rows[ELEVATION, i] = arctan2(rows[Z, i], math.sqrt(x * x + y * y))


@njit(cache=True, error_model='numpy', fastmath=SUMS)
def _fill_psi(z, scan, rows, weights, psi):  # type: ignore[no-untyped-def]
    """Replace pi in `psi` (n,) by psi_z = pi N(z; g(x), R); return its weighted sum (13)."""
    use_wide_vectors()
    solid = len(z) == 3
    i00, i11, i01 = scan.information[0, 0], scan.information[1, 1], 2.0 * scan.information[0, 1]
    i22 = scan.information[2, 2] if solid else 0.0
    i02 = 2.0 * scan.information[0, 2] if solid else 0.0
    i12 = 2.0 * scan.information[1, 2] if solid else 0.0
    z0 = z[0]
    z1 = wrap(z[1])
    z2 = z[2] if solid else 0.0
    total = 0.0
    for i in range(len(weights)):
        e0 = z0 - rows[RANGE, i]
        e1 = z1 - rows[BEARING, i]
        e1 = e1 - TWO_PI if e1 >= math.pi else e1
        e1 = e1 + TWO_PI if e1 < -math.pi else e1
        e2 = z2 - rows[ELEVATION, i]
        square = e0 * (e0 * i00 + e1 * i01) + e1 * e1 * i11
        square += e2 * (e0 * i02 + e1 * i12 + e2 * i22)
        value = psi[i] * exponential(scan.log_norm - 0.5 * square)
        psi[i] = value
        total += value * weights[i]
    return total


@njit(cache=True, nogil=True, error_model='numpy')
def _explain_chunks(particles, weights, scan, probability, psi, sums, first, last):  # type: ignore[no-untyped-def]
    """Fill pi (n,), psi (m, n) and the weighted sums (chunks, m) of psi."""
    rows = np.empty((ROWS, CHUNK))
    for chunk in range(first, last):
        begin = chunk * CHUNK
        end = min(len(weights), begin + CHUNK)
        part = probability[begin:end]
        _fill_offsets(particles[begin:end], scan, rows)
        x, y, z = rows[X], rows[Y], rows[Z]
        fill_probabilities(scan.kind, scan.parameters, x, y, z, scan.cosine, scan.sine, part)
        for m in range(len(scan.values)):
            psi[m, begin:end] = part
            sums[chunk, m] = _fill_psi(
                scan.values[m], scan, rows, weights[begin:end], psi[m, begin:end]
            )


def phd_correct(
    particles: FloatArray,
    weights: FloatArray,
    scan: PhdScan,
    background: FloatArray,
    pool: ThreadPoolExecutor | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Return the factor of each particle's weight, and C(z) (000, (13), (16)).

    The factor is 1 - pi + sum over z of psi_z / C(z), with C(z) = background + <psi_z, D>, where
    `background` (m,) is the intensity of clutter and births at each detection, above 0.
    """
    number, count, chunks = len(weights), len(scan.values), max(1, -(-len(weights) // CHUNK))
    psi, sums = np.empty((count, number)), np.empty((chunks, count))
    probability = np.empty(number)
    explain = partial(_explain_chunks, particles, weights, scan, probability, psi, sums)
    part = chunks if pool is None else max(4, -(-chunks // 8))
    firsts = range(0, chunks, part)
    lasts = [min(first + part, chunks) for first in firsts]
    run = map if pool is None else pool.map
    list(run(explain, firsts, lasts))
    factor = 1.0 - probability
    normaliser = background + sums.cumsum(axis=0)[-1]
    for share, row in zip(1.0 / normaliser, psi):
        factor += share * row
    return factor, normaliser
