"""The PHD update Psi on weighted particles, and what it needs of a set of measurements.

The corrector is 000, eq. (13) and (16). Likelihoods are kept relative to the largest one of each
measurement and normalisers as logarithms, so that nothing underflows, however narrow the noise.
Work is done in chunks of fixed size whose sums are added in order: results are the same to the
bit for any number of threads.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from maasi_filter.models.detection import (
    EXPONENTIAL,
    GAUSSIAN,
    PARAMETERS,
    detection_probability_at,
)
from maasi_filter.models.measurement import TWO_PI, wrap
from maasi_filter.models.pose import Pose
from maasi_filter.vector_math import arctan2, exponential, lesser, use_wide_vectors

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

CHUNK = 2048
TILE = 128
TILES = CHUNK // TILE
# Rows of what is worked out of a tile. They lie in one array: of one array and fixed distances it
# is known that a loop writes nothing that it has still to read.
SEEN, UNSEEN, DISTANCE, BEARING, ELEVATION = (TILE * k for k in range(5))
WEIGHT, FACTOR, SHARE, COMPONENT = (TILE * k for k in range(4))
OWN = 5 * TILE
BLOCK = 16
# The probability of detection is given, not a model's.
GIVEN = -1
# Sums may be added in vector lanes; there are no numbers that are not a number.
SUMS = {'reassoc', 'nsz', 'nnan'}
# Likelihoods exp(-q/2) with q this far above the smallest are below 1e-17 of it.
RELATIVE_GATE = 80.0
# Work for threads is cut into at most so many ranges of chunks.
RANGES = 8
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


def position_measurements(values: FloatArray, covariances: FloatArray) -> MeasurementSet:
    """Return measured positions (m, d) [m] with covariances (m, d, d) ready for the kernels.

    A linear measurement, z = x + noise.
    """
    number, d = values.shape
    values = np.ascontiguousarray(values, dtype=float)
    out = MeasurementSet(
        values=values,
        covariances=np.array(covariances),
        cartesian=np.ones(number, np.bool_),
        centres=values.copy(),
        roots=np.empty((number, d, d)),
        information=np.empty((number, d, d)),
        log_norm=np.empty(number),
        volume=np.ones(number),
        gates=np.empty((number, 2)),
    )
    for m in range(number):
        log_determinant = _root(out.covariances[m], out.roots[m])
        _invert(out.covariances[m], out.information[m])
        _gates(out.covariances[m], True, out.gates[m])
        out.log_norm[m] = -0.5 * (d * math.log(2.0 * math.pi) + log_determinant)
    return out


@njit(cache=True, error_model='numpy', fastmath=SUMS)
def _range_of(values, number):  # type: ignore[no-untyped-def]
    """Return the smallest and the largest of the first `number` values."""
    low = np.inf
    high = np.inf
    for i in range(number):
        low = lesser(low, values[i])
        high = lesser(high, -values[i])
    return low, -high


@njit(cache=True, nogil=True, error_model='numpy')
def _arrange_chunks(  # type: ignore[no-untyped-def]
    first_chunk, last_chunk, first_tile, particles, axes, boxes
):
    """Fill the axes (tiles, 3 * TILE) of the particles of each tile, and their bounds.

    Boxes (tiles, 2, d) are lower and upper bounds. In two dimensions z is 0.
    """
    n, d = particles.shape
    flat = particles.reshape(n * d)
    for tile in range(max(first_chunk * TILES, first_tile), last_chunk * TILES):
        start = tile * TILE
        size = min(TILE, n - start)
        if size <= 0:
            break
        part = flat[start * d : (start + size) * d]
        out = axes[tile]
        # All axes in one loop: whole rows are read, and sorted in registers.
        if d == 3:
            for i in range(size):
                out[i] = part[3 * i]
                out[TILE + i] = part[3 * i + 1]
                out[2 * TILE + i] = part[3 * i + 2]
        else:
            for i in range(size):
                out[i] = part[2 * i]
                out[TILE + i] = part[2 * i + 1]
            out[2 * TILE :] = 0.0
        for axis in range(d):
            low, high = _range_of(out[axis * TILE :], size)
            boxes[tile, 0, axis] = low
            boxes[tile, 1, axis] = high


@njit(cache=True, error_model='numpy')
def _distances(boxes, tile, sensor_position):  # type: ignore[no-untyped-def]
    """Return bounds of the distance between the sensor and what lies in a tile's box."""
    near = 0.0
    far = 0.0
    for axis in range(boxes.shape[2]):
        low = boxes[tile, 0, axis] - sensor_position[axis]
        high = boxes[tile, 1, axis] - sensor_position[axis]
        near += max(max(low, -high), 0.0) ** 2
        far += max(-low, high) ** 2
    return math.sqrt(near), math.sqrt(far)


@njit(cache=True, error_model='numpy')
def _least_square(  # type: ignore[no-untyped-def]
    boxes, tile, near, far, centres, m, z0, cartesian, gates
):
    """Return a number that q of detection m is nowhere below in a tile, but for rounding.

    With u the smallest eigenvalue of the inverse correlation,
    q is at least u times the sum of squared errors over variances; and for angles a and b, and
    distance r from the sensor, the distance s between particle and detection has
    s^2 - (r - z)^2 <= r z (a^2 + b^2).
    """
    apart = 0.0
    for axis in range(boxes.shape[2]):
        low = boxes[tile, 0, axis] - centres[m, axis]
        high = centres[m, axis] - boxes[tile, 1, axis]
        apart += max(max(low, high), 0.0) ** 2
    if cartesian:
        return gates[m, 1] * apart
    square = gates[m, 0] * max(max(near - z0, z0 - far), 0.0) ** 2
    if z0 > 0.0 and far > 0.0:
        widest = max(abs(near - z0), abs(far - z0))
        square += gates[m, 1] * max(apart - widest * widest, 0.0) / (z0 * far)
    return square


@njit(cache=True, error_model='numpy', fastmath=SUMS)
def add_moments(weights, x, y, z, number, centre, solid, moments):  # type: ignore[no-untyped-def]
    """Add weight, and first and second moments about `centre`, to `moments`; return the weight."""
    c0 = centre[0]
    c1 = centre[1]
    t0 = 0.0
    tx = 0.0
    ty = 0.0
    txx = 0.0
    txy = 0.0
    tyy = 0.0
    for i in range(number):
        w = weights[i]
        a = x[i] - c0
        b = y[i] - c1
        t0 += w
        tx += w * a
        ty += w * b
        txx += w * a * a
        txy += w * a * b
        tyy += w * b * b
    moments[0] += t0
    moments[1] += tx
    moments[2] += ty
    if solid:
        c2 = centre[2]
        tz = 0.0
        txz = 0.0
        tyz = 0.0
        tzz = 0.0
        for i in range(number):
            c = z[i] - c2
            w = weights[i] * c
            tz += w
            txz += w * (x[i] - c0)
            tyz += w * (y[i] - c1)
            tzz += w * c
        moments[3] += tz
        moments[4] += txx
        moments[5] += txy
        moments[6] += tyy
        moments[7] += txz
        moments[8] += tyz
        moments[9] += tzz
    else:
        moments[3] += txx
        moments[4] += txy
        moments[5] += tyy
    return t0


@njit(cache=True, error_model='numpy', fastmath=SUMS)
def _look(  # type: ignore[no-untyped-def]
    kind,
    parameters,
    cos_yaw,
    sin_yaw,
    sensor_position,
    solid,
    axes,
    weights,
    number,
    probability,
    own,
):
    """Fill pi of a tile, unless it is given, and what the first rows of `own` are.

    The loops here have many inputs but few outputs: that these are apart is checked, once for
    each pair, before vector instructions are used.
    """
    use_wide_vectors()
    x0 = sensor_position[0]
    y0 = sensor_position[1]
    z0 = sensor_position[2] if solid else 0.0
    gain = parameters[0]
    p = parameters[1]
    q = parameters[2]
    r = parameters[3]
    if kind == EXPONENTIAL:
        for i in range(number):
            u = (axes[i] - x0) * p
            v = (axes[TILE + i] - y0) * q
            w = (axes[2 * TILE + i] - z0) * r
            probability[i] = gain * exponential(-0.5 * math.sqrt(u * u + v * v + w * w))
    elif kind == GAUSSIAN:
        for i in range(number):
            u = (axes[i] - x0) * p
            v = (axes[TILE + i] - y0) * q
            w = (axes[2 * TILE + i] - z0) * r
            probability[i] = gain * exponential(-0.5 * (u * u + v * v + w * w))
    elif kind != GIVEN:
        for i in range(number):
            probability[i] = detection_probability_at(
                kind,
                parameters,
                axes[i] - x0,
                axes[TILE + i] - y0,
                axes[2 * TILE + i] - z0,
                cos_yaw,
                sin_yaw,
            )
    for i in range(number):
        seen = probability[i] * weights[i]
        own[SEEN + i] = seen
        own[UNSEEN + i] = 0.0 if seen > 0.0 else np.inf


@njit(cache=True, error_model='numpy')
def _turn(axes, sensor_position, solid, number, own):  # type: ignore[no-untyped-def]
    """Fill range and angles of a tile in `own`."""
    use_wide_vectors()
    x0 = sensor_position[0]
    y0 = sensor_position[1]
    z0 = sensor_position[2] if solid else 0.0
    for i in range(number):
        x = axes[i] - x0
        y = axes[TILE + i] - y0
        z = axes[2 * TILE + i] - z0
        own[DISTANCE + i] = math.sqrt(x * x + y * y + z * z)
        own[BEARING + i] = arctan2(y, x)
    if solid:
        for i in range(number):
            x = axes[i] - x0
            y = axes[TILE + i] - y0
            own[ELEVATION + i] = arctan2(axes[2 * TILE + i] - z0, math.sqrt(x * x + y * y))


@njit(cache=True, error_model='numpy', fastmath=SUMS)
def _polar_squares(z, information, own, number, row):  # type: ignore[no-untyped-def]
    """Fill the squared normalised errors of a detection in range and angles; return the smallest.

    They are infinite where a particle cannot have caused it.
    """
    use_wide_vectors()
    i00 = information[0, 0]
    i11 = information[1, 1]
    i01 = 2.0 * information[0, 1]
    z0 = z[0]
    z1 = wrap(z[1])
    z2 = 0.0
    i22 = 0.0
    i02 = 0.0
    i12 = 0.0
    if len(z) == 3:
        z2 = z[2]
        i22 = information[2, 2]
        i02 = 2.0 * information[0, 2]
        i12 = 2.0 * information[1, 2]
    low = np.inf
    for i in range(number):
        e0 = z0 - own[DISTANCE + i]
        e1 = z1 - own[BEARING + i]
        e1 = e1 - TWO_PI if e1 >= math.pi else e1
        e1 = e1 + TWO_PI if e1 < -math.pi else e1
        e2 = z2 - own[ELEVATION + i]
        square = e0 * (e0 * i00 + e1 * i01) + e1 * e1 * i11
        square += e2 * (e0 * i02 + e1 * i12 + e2 * i22) + own[UNSEEN + i]
        row[i] = square
        low = lesser(low, square)
    return low


@njit(cache=True, error_model='numpy', fastmath=SUMS)
def _cartesian_squares(centre, information, axes, own, number, row):  # type: ignore[no-untyped-def]
    """Fill the squared normalised distances from where a detection points at, as above."""
    use_wide_vectors()
    i00 = information[0, 0]
    i11 = information[1, 1]
    i01 = 2.0 * information[0, 1]
    c0 = centre[0]
    c1 = centre[1]
    c2 = 0.0
    i22 = 0.0
    i02 = 0.0
    i12 = 0.0
    if len(centre) == 3:
        c2 = centre[2]
        i22 = information[2, 2]
        i02 = 2.0 * information[0, 2]
        i12 = 2.0 * information[1, 2]
    low = np.inf
    for i in range(number):
        e0 = c0 - axes[i]
        e1 = c1 - axes[TILE + i]
        e2 = c2 - axes[2 * TILE + i]
        square = e0 * (e0 * i00 + e1 * i01) + e1 * e1 * i11
        square += e2 * (e0 * i02 + e1 * i12 + e2 * i22) + own[UNSEEN + i]
        row[i] = square
        low = lesser(low, square)
    return low


@njit(cache=True, error_model='numpy', fastmath=SUMS)
def _likelihoods(row, least, own, probability, number):  # type: ignore[no-untyped-def]
    """Replace squares by pi exp(-(q - least) / 2), 0 beyond the gate; return the weighted sum."""
    use_wide_vectors()
    total = 0.0
    for i in range(number):
        gap = row[i] - least
        value = exponential(-0.5 * gap if gap < RELATIVE_GATE else -1e4)
        total += value * own[SEEN + i]
        row[i] = value * probability[i]
    return total


@njit(cache=True, error_model='numpy')
def _fill_bounds(  # type: ignore[no-untyped-def]
    axes,
    weights,
    boxes,
    kind,
    parameters,
    cos_yaw,
    sin_yaw,
    probability,
    sensor_position,
    values,
    cartesian,
    centres,
    information,
    gates,
    bounds,
    references,
):
    """Fill lower bounds of squares in each tile, and the smallest square in the lowest one's.

    The smallest of all is not above that, so that it rules out most tiles before they are looked
    at.
    """
    number, d = values.shape
    n = weights.shape[0]
    own = np.zeros(OWN)
    chance = np.empty(TILE)
    row = np.empty(TILE)
    tiles = (n + TILE - 1) // TILE
    lowest = np.full(number, np.inf)
    best = np.full(number, -1)
    for tile in range(tiles):
        near, far = _distances(boxes, tile, sensor_position)
        for m in range(number):
            lower = _least_square(
                boxes, tile, near, far, centres, m, values[m, 0], cartesian[m], gates
            )
            bounds[m, tile] = lower
            if lower < lowest[m]:
                lowest[m] = lower
                best[m] = tile
    for m in range(number):
        references[m] = np.inf
        tile = best[m]
        if tile < 0:
            continue
        start = tile * TILE
        size = min(TILE, n - start)
        if kind == GIVEN:
            chance[:size] = probability[start : start + size]
        _look(
            kind,
            parameters,
            cos_yaw,
            sin_yaw,
            sensor_position,
            d == 3,
            axes[tile],
            weights[start : start + size],
            size,
            chance,
            own,
        )
        if cartesian[m]:
            references[m] = _cartesian_squares(
                centres[m], information[m], axes[tile], own, size, row
            )
        else:
            _turn(axes[tile], sensor_position, d == 3, size, own)
            references[m] = _polar_squares(values[m], information[m], own, size, row)


@njit(cache=True, nogil=True, error_model='numpy')
def _explain_chunks(  # type: ignore[no-untyped-def]
    first_chunk,
    last_chunk,
    axes,
    weights,
    kind,
    parameters,
    cos_yaw,
    sin_yaw,
    probability,
    sensor_position,
    values,
    cartesian,
    centres,
    information,
    bounds,
    references,
    likelihood,
    active,
    all_smallest,
    all_sums,
):
    """Fill likelihoods (m, n), pi exp(-(q - smallest) / 2), of chunks, and weighted sums.

    Neighbours among the particles are mostly neighbours in space. A tile of them that a bound
    shows to be beyond the gate is not worked out: `active` (m, tiles) tells which were.
    """
    number, d = values.shape
    # Coordinates apart, and short loops without branches: they become vector instructions.
    all_own = np.zeros((TILES, OWN))
    least_here = np.empty(TILES)
    turned = np.empty(TILES, np.bool_)
    for chunk in range(first_chunk, last_chunk):
        first = chunk * CHUNK
        stop = min(weights.shape[0], first + CHUNK)
        tiles = (stop - first + TILE - 1) // TILE
        for tile in range(tiles):
            start = first + tile * TILE
            size = min(TILE, stop - start)
            turned[tile] = False
            _look(
                kind,
                parameters,
                cos_yaw,
                sin_yaw,
                sensor_position,
                d == 3,
                axes[chunk * TILES + tile],
                weights[start : start + size],
                size,
                probability[start : start + size],
                all_own[tile],
            )
        for m in range(number):
            bound = references[m]
            least = np.inf
            for tile in range(tiles):
                least_here[tile] = np.inf
                lower = bounds[m, chunk * TILES + tile]
                if lower * (1.0 - 1e-9) > bound + 1.01 * RELATIVE_GATE:
                    continue
                start = first + tile * TILE
                size = min(TILE, stop - start)
                row = likelihood[m, start : start + size]
                here = axes[chunk * TILES + tile]
                own = all_own[tile]
                if cartesian[m]:
                    least_here[tile] = _cartesian_squares(
                        centres[m], information[m], here, own, size, row
                    )
                else:
                    if not turned[tile]:
                        _turn(here, sensor_position, d == 3, size, own)
                        turned[tile] = True
                    least_here[tile] = _polar_squares(values[m], information[m], own, size, row)
                least = min(least, least_here[tile])
                bound = min(bound, least)
            total = 0.0
            for tile in range(tiles):
                within = least_here[tile] < bound + RELATIVE_GATE
                active[m, chunk * TILES + tile] = within
                if within:
                    start = first + tile * TILE
                    size = min(TILE, stop - start)
                    total += _likelihoods(
                        likelihood[m, start : start + size],
                        least,
                        all_own[tile],
                        probability[start : start + size],
                        size,
                    )
            all_smallest[chunk, m] = least if total > 0.0 else np.inf
            all_sums[chunk, m] = total


@njit(cache=True, error_model='numpy')
def _log_sums(smallest, sums, log_norm, log_own):  # type: ignore[no-untyped-def]
    """Fill the logarithm of the particles' part of C(z)."""
    for m in range(smallest.shape[1]):
        least = np.inf
        for chunk in range(smallest.shape[0]):
            least = min(least, smallest[chunk, m])
        total = 0.0
        for chunk in range(smallest.shape[0]):
            if smallest[chunk, m] < np.inf:
                total += sums[chunk, m] * math.exp(-0.5 * (smallest[chunk, m] - least))
        log_own[m] = log_norm[m] - 0.5 * least + math.log(total) if total > 0.0 else -np.inf


@njit(cache=True, error_model='numpy')
def _normalise(  # type: ignore[no-untyped-def]
    smallest, sums, log_own, other, log_normaliser, own_mass, other_scale, scale
):
    """Fill log C(z), the particles' share of it, 1 / C(z), and the factor of each chunk."""
    chunks, number = smallest.shape
    for m in range(number):
        least = np.inf
        for chunk in range(chunks):
            least = min(least, smallest[chunk, m])
        total = 0.0
        for chunk in range(chunks):
            scale[chunk, m] = 0.0
            if smallest[chunk, m] < np.inf:
                scale[chunk, m] = math.exp(-0.5 * (smallest[chunk, m] - least))
                total += sums[chunk, m] * scale[chunk, m]
        log_sum = math.log(other[m]) if other[m] > 0.0 else -np.inf
        own_mass[m] = 0.0
        other_scale[m] = 0.0
        share = 0.0
        # Where something else explains it e^600 times better, the particles' share is nothing.
        if log_own[m] > -np.inf and log_sum - log_own[m] < 600.0:
            # In units of what the particles explain: exact however small that is.
            relative = math.exp(log_sum - log_own[m])
            own_mass[m] = 1.0 / (1.0 + relative)
            share = own_mass[m] / total
            log_sum = log_own[m] + math.log(1.0 + relative)
        for chunk in range(chunks):
            scale[chunk, m] *= share
        if log_sum > -np.inf:
            # Next to nothing may still be divided by; what is multiplied with it is as small.
            other_scale[m] = math.exp(min(-log_sum, 700.0))
        log_normaliser[m] = log_sum


@njit(cache=True, error_model='numpy')
def _begin(probability, weights, number, own):  # type: ignore[no-untyped-def]
    for i in range(number):
        own[WEIGHT + i] = weights[i]
        own[FACTOR + i] = 1.0 - probability[i]
        own[SHARE + i] = 0.0
        own[COMPONENT + i] = -1.0


@njit(cache=True, error_model='numpy')
def _go_on(factor, share, component, weights, number, own):  # type: ignore[no-untyped-def]
    for i in range(number):
        own[WEIGHT + i] = weights[i]
        own[FACTOR + i] = factor[i]
        own[SHARE + i] = share[i]
        own[COMPONENT + i] = component[i]


@njit(cache=True, error_model='numpy', fastmath=SUMS)
def _take(row, multiple, detection, centre, axes, number, own, held, moments):  # type: ignore[no-untyped-def]
    """Fill W_i(z) of a detection in `held`, and what it changes in `own`.

    Add it, and its first and second moments about `centre`, to `moments`; return its sum.
    """
    use_wide_vectors()
    c0 = centre[0]
    c1 = centre[1]
    c2 = centre[2] if len(centre) == 3 else 0.0
    t0 = 0.0
    tx = 0.0
    ty = 0.0
    tz = 0.0
    txx = 0.0
    txy = 0.0
    tyy = 0.0
    txz = 0.0
    tyz = 0.0
    tzz = 0.0
    for i in range(number):
        part = row[i] * multiple
        own[FACTOR + i] += part
        part *= own[WEIGHT + i]
        held[i] = part
        most = own[SHARE + i]
        own[COMPONENT + i] = detection if part > most else own[COMPONENT + i]
        own[SHARE + i] = part if part > most else most
        a = axes[i] - c0
        b = axes[TILE + i] - c1
        c = axes[2 * TILE + i] - c2
        u = part * a
        v = part * b
        w = part * c
        t0 += part
        tx += u
        ty += v
        tz += w
        txx += u * a
        txy += u * b
        tyy += v * b
        txz += u * c
        tyz += v * c
        tzz += w * c
    moments[0] += t0
    moments[1] += tx
    moments[2] += ty
    if len(centre) == 3:
        moments[3] += tz
        moments[4] += txx
        moments[5] += txy
        moments[6] += tyy
        moments[7] += txz
        moments[8] += tyz
        moments[9] += tzz
    else:
        moments[3] += txx
        moments[4] += txy
        moments[5] += tyy
    return t0


@njit(cache=True, error_model='numpy')
def _one_group(group, number):  # type: ignore[no-untyped-def]
    different = np.int64(0)
    first = group[0]
    for i in range(number):
        different |= group[i] ^ first
    return different == 0


@njit(cache=True, error_model='numpy', fastmath=SUMS)
def _finish(own, number, factor, updated):  # type: ignore[no-untyped-def]
    """Fill factors and updated weights; return the sum."""
    total = 0.0
    for i in range(number):
        changed = own[WEIGHT + i] * own[FACTOR + i]
        factor[i] = own[FACTOR + i]
        updated[i] = changed
        total += changed
    return total


@njit(cache=True, error_model='numpy')
def _join(own, updated, groups, group, number, owner):  # type: ignore[no-untyped-def]
    """Fill the group that each particle would join by itself."""
    for i in range(number):
        joins = own[SHARE + i] > 0.5 * updated[i]
        owner[i] = groups + np.int64(own[COMPONENT + i]) if joins else group[i]


@njit(cache=True, error_model='numpy')
def _join_from_one(own, updated, groups, group, number, owner):  # type: ignore[no-untyped-def]
    """Fill the same where all are of one group."""
    for i in range(number):
        joins = own[SHARE + i] > 0.5 * updated[i]
        owner[i] = groups + np.int64(own[COMPONENT + i]) if joins else group


@njit(cache=True, error_model='numpy')
def _keep(own, number, factor, share, component):  # type: ignore[no-untyped-def]
    for i in range(number):
        factor[i] = own[FACTOR + i]
        share[i] = own[SHARE + i]
        component[i] = own[COMPONENT + i]


@njit(cache=True, nogil=True, error_model='numpy')
def _apply_chunks(  # type: ignore[no-untyped-def]
    first_chunk,
    last_chunk,
    axes,
    all_weights,
    all_probability,
    likelihood,
    active,
    scale,
    centres,
    all_factor,
    all_share,
    all_component,
    all_moments,
    all_group,
    group_share,
    group_mass,
    first_detection,
    finish,
    all_updated,
    all_owner,
):
    """Add psi_z / C(z) to `factor`, and sum moments of W_i(z) = psi_z(x_i) w_i / C(z).

    `share` and `component` keep, between blocks of detections, the largest W_i(z) of each
    particle, and its z. `moments`
    (m, 1 + d + d (d + 1) / 2) are taken about `centres`. With the last detections the updated
    weights are filled, and the group that each particle would join by itself.
    """
    n = all_weights.shape[0]
    number = likelihood.shape[0]
    groups = group_mass.shape[1]
    own = np.empty(OWN)
    held = np.empty((number, TILE))
    before = np.empty(TILE, np.int64)
    taking = np.empty(number, np.int64)
    for chunk in range(first_chunk, last_chunk):
        all_moments[chunk] = 0.0
        for tile in range(chunk * TILES, (chunk + 1) * TILES):
            start = tile * TILE
            stop = min(n, start + TILE)
            size = stop - start
            if size <= 0:
                break
            weights = all_weights[start:stop]
            factor = all_factor[start:stop]
            share = all_share[start:stop]
            component = all_component[start:stop]
            updated = all_updated[start:stop]
            single = _one_group(all_group[start:stop], size)
            here = all_group[start]
            if not single:
                before[:size] = all_group[start:stop]
            if first_detection == 0:
                _begin(all_probability[start:stop], weights, size, own)
            else:
                _go_on(factor, share, component, weights, size, own)
            takers = 0
            for m in range(number):
                if not active[m, tile] or scale[chunk, m] == 0.0:
                    continue
                total = _take(
                    likelihood[m, start:stop],
                    scale[chunk, m],
                    np.float64(first_detection + m),
                    centres[m],
                    axes[tile],
                    size,
                    own,
                    held[takers],
                    all_moments[chunk, m],
                )
                taking[takers] = m
                takers += 1
                if single:
                    group_share[chunk, here, m] += total
            if not finish:
                _keep(own, size, factor, share, component)
            else:
                total = _finish(own, size, factor, updated)
                owner = all_owner[start:stop]
                if single:
                    group_mass[chunk, here] += total
                    if takers == 0:
                        owner[:] = here
                    else:
                        _join_from_one(own, updated, groups, here, size, owner)
                else:
                    _join(own, updated, groups, before, size, owner)
                    for i in range(size):
                        group_mass[chunk, before[i]] += updated[i]
            if not single:
                for i in range(size):
                    for k in range(takers):
                        group_share[chunk, before[i], taking[k]] += held[k, i]


@njit(cache=True, error_model='numpy')
def _add_chunks(shares, group_share, first):  # type: ignore[no-untyped-def]
    """Add what chunks have of the shares (g, m) of detections from `first` on, in order."""
    for chunk in range(shares.shape[0]):
        for g in range(shares.shape[1]):
            for m in range(shares.shape[2]):
                group_share[g, first + m] += shares[chunk, g, m]


@njit(cache=True, error_model='numpy', fastmath=SUMS)
def _taken(group_mass, group_share, taken):  # type: ignore[no-untyped-def]
    """Fill for each group (g + m,) the detection's group that what is left of it belongs to.

    A detection that mostly took a group takes the rest of it too. Return whether any did.
    """
    groups, number = group_share.shape
    some = False
    for m in range(number):
        taken[groups + m] = groups + m
    for g in range(groups):
        mass = 0.0
        for chunk in range(group_mass.shape[0]):
            mass += group_mass[chunk, g]
        taken[g] = g
        best = 0.5 * mass
        for m in range(number):
            if group_share[g, m] > best:
                best = group_share[g, m]
                taken[g] = groups + m
                some = True
    return some


@njit(cache=True, nogil=True, error_model='numpy')
def _regroup_chunks(first_chunk, last_chunk, taken, owner):  # type: ignore[no-untyped-def]
    part = owner[first_chunk * CHUNK : last_chunk * CHUNK]
    for i in range(len(part)):
        part[i] = taken[part[i]]


@njit(cache=True, error_model='numpy')
def finish_moments(  # type: ignore[no-untyped-def]
    partial, references, mass, means, covariances
):
    """Add moments of chunks in order, and fill mass, mean and covariance of each set.

    Where there is no mass the mean is the reference and the covariance 0.
    """
    chunks, sets, size = partial.shape
    d = references.shape[1]
    sums = np.empty(size)
    for g in range(sets):
        for j in range(size):
            sums[j] = 0.0
            for chunk in range(chunks):
                sums[j] += partial[chunk, g, j]
        mass[g] = sums[0]
        j = 1 + d
        for a in range(d):
            means[g, a] = references[g, a]
            if sums[0] > 0.0:
                sums[1 + a] /= sums[0]
                means[g, a] += sums[1 + a]
            for b in range(a + 1):
                value = 0.0
                if sums[0] > 0.0:
                    value = sums[j] / sums[0] - sums[1 + a] * sums[1 + b]
                covariances[g, a, b] = value
                covariances[g, b, a] = value
                j += 1


def run_chunks(
    function: Callable[[int, int], None], number: int, pool: ThreadPoolExecutor | None
) -> None:
    """Call `function(first, last)` for ranges of chunks of fixed size, in threads with a pool.

    Every chunk writes to places of its own, so that the result does not depend on the threads.
    """
    count = max(1, -(-number // CHUNK))
    if pool is None or count < 8:
        function(0, count)
        return
    part = max(4, -(-count // RANGES))
    futures = [
        pool.submit(function, first, min(first + part, count)) for first in range(0, count, part)
    ]
    for future in futures:
        future.result()


class Workspace:
    """Arrays that are used again and again: fresh memory costs more than what is done in it."""

    def __init__(self) -> None:
        self._arrays: dict[str, NDArray[Any]] = {}
        self._taken: dict[str, NDArray[Any]] = {}

    def take(self, name: str, shape: tuple[int, ...], dtype: Any = np.float64) -> NDArray[Any]:
        """Return an array whose content is arbitrary; the one taken before by that name is void."""
        taken = self._taken.get(name)
        if taken is not None and taken.shape == shape:
            return taken
        size = math.prod(shape)
        array = self._arrays.get(name)
        if array is None or array.size < size:
            array = np.empty(size + size // 4, dtype)
            self._arrays[name] = array
        taken = self._taken[name] = array[:size].reshape(shape)
        return taken

    def keep(self, name: str, shape: tuple[int, ...]) -> tuple[FloatArray, bool]:
        """Return an array, and whether it begins with what the one taken before did."""
        before = self._arrays.get(name)
        array = self.take(name, shape)
        return array, before is self._arrays[name]

    def released(self, array: NDArray[Any]) -> NDArray[Any]:
        """Return an array that later takes leave alone: a copy if it is one that was taken."""
        taken = any(array.base is own for own in self._arrays.values())
        return array.copy() if taken else array

    def extended(self, name: str, array: NDArray[Any], more: NDArray[Any]) -> NDArray[Any]:
        """Return an array with rows appended; in place where it is the one taken by that name."""
        before = self._arrays.get(name)
        shape = (len(array) + len(more), *array.shape[1:])
        out = self.take(name, shape, array.dtype)
        if array.base is None or array.base is not before or out.base is not before:
            out[: len(array)] = array
        out[len(array) :] = more
        return out


@dataclass
class Association:
    """Outcome of the update for one robot.

    Parameters
    ----------
    factor : (n,) array
        What each weight is multiplied with: 1 - pi + sum over z of psi_z / C(z).
    weights : (n,) array
        The updated ones.
    log_normaliser : (m,) array
        Logarithm of C(z), -inf where nothing explains a detection.
    own_mass : (m,) array
        Share of a detection that the given particles explain, in [0, 1].
    other_scale : (m,) array
        1 / C(z): what an intensity outside the particles is multiplied with for its share.
    means, covariances : (m, d), (m, d, d) arrays
        Of the particles weighted with W_i(z), metres; covariance 0 where there is no mass.
    group_share : (g, m) array
        W_i(z) summed over the particles of each group.
    group : (n,) array
        Groups after the update. A particle belongs to the detection that explains most of its
        weight, if one does; what a detection leaves of a group that it mostly took belongs to it
        too. The group of a detection is its number behind the groups there were.
    """

    factor: FloatArray
    weights: FloatArray
    log_normaliser: FloatArray
    own_mass: FloatArray
    other_scale: FloatArray
    means: FloatArray
    covariances: FloatArray
    group_share: FloatArray
    group: IntArray


def _explain(
    axes: FloatArray,
    denominator: FloatArray,
    boxes: FloatArray,
    kernel: tuple[int, FloatArray],
    probability: FloatArray,
    measurements: MeasurementSet,
    block: slice,
    pose: Pose,
    workspace: Workspace,
    pool: ThreadPoolExecutor | None,
) -> tuple[FloatArray, NDArray[np.bool_], FloatArray, FloatArray, FloatArray]:
    """Return likelihoods, active tiles, smallest squares, sums, and log of the particles' C(z)."""
    n = len(denominator)
    chunks = max(1, -(-n // CHUNK))
    width = block.stop - block.start
    likelihood = workspace.take('likelihood', (width, n))
    active = workspace.take('active', (width, chunks * TILES), np.bool_)
    bounds = workspace.take('bounds', (width, chunks * TILES))
    smallest = np.empty((chunks, width))
    sums = np.empty((chunks, width))
    references = np.empty(width)
    log_own = np.empty(width)
    yaw = pose.yaw
    look = (*kernel, math.cos(yaw), math.sin(yaw), probability, pose.position)
    detections = (
        measurements.values[block],
        measurements.cartesian[block],
        measurements.centres[block],
        measurements.information[block],
    )
    _fill_bounds(
        axes,
        denominator,
        boxes,
        *look,
        *detections,
        measurements.gates[block],
        bounds,
        references,
    )
    work = (axes, denominator, *look, *detections, bounds, references)
    out = (likelihood, active, smallest, sums)
    run_chunks(lambda c, e: _explain_chunks(c, e, *work, *out), n, pool)
    _log_sums(smallest, sums, measurements.log_norm[block], log_own)
    return likelihood, active, smallest, sums, log_own


def associate(
    particles: FloatArray,
    weights: FloatArray,
    probability: FloatArray | tuple[int, FloatArray],
    measurements: MeasurementSet,
    pose: Pose,
    other: FloatArray | Callable[[FloatArray], FloatArray],
    denominator_weights: FloatArray | None = None,
    group: IntArray | None = None,
    groups: int = 1,
    pool: ThreadPoolExecutor | None = None,
    workspace: Workspace | None = None,
    known: int = 0,
) -> Association:
    """Return the update of particle weights by one robot's detections (000, eq. (13), (16)).

    Parameters
    ----------
    particles : (n, d) array
        Metres, frame `map`.
    weights : (n,) array
        Of the running intensity.
    probability : (n,) array, or a detection model's kernel
        pi at the particles.
    measurements : MeasurementSet
        m detections; with none the factor is 1 - pi.
    pose : Pose
        Of the sensor.
    other : (m,) array or callable
        What else explains each detection: intensity of clutter, found targets and births, per
        unit of measurement space. Added to C(z). A callable gets the logarithm of what the
        particles add to C(z), (m,).
    denominator_weights : (n,) array, optional
        Weights in C(z) where they are not the running ones: 002, eq. (9) has the predicted ones.
    group : (n,) int array, optional
        Group of each particle, from 0.
    groups : int
        Number of groups.
    pool : ThreadPoolExecutor, optional
        For large sets; the result is the same.
    workspace : Workspace, optional
        The arrays of n in the result are its own: the next update with it overwrites them.
    known : int
        How many of the particles, the first ones, are the same as at the last update with the
        workspace.
    """
    n, d = particles.shape
    number = len(measurements)
    workspace = Workspace() if workspace is None else workspace
    denominator = weights if denominator_weights is None else denominator_weights
    group = np.zeros(n, np.int64) if group is None else group
    kernel = (GIVEN, np.empty(PARAMETERS))
    if isinstance(probability, tuple):
        kernel = probability
        probability = workspace.take('probability', (n,))
    blocks = [slice(first, min(number, first + BLOCK)) for first in range(0, number, BLOCK)]
    blocks = blocks or [slice(0, 0)]
    chunks = max(1, -(-n // CHUNK))
    axes, kept = workspace.keep('axes', (chunks * TILES, 3 * TILE))
    boxes, kept_too = workspace.keep('boxes', (chunks * TILES, 2, d))
    first_tile = known // TILE if kept and kept_too else 0
    run_chunks(lambda c, e: _arrange_chunks(c, e, first_tile, particles, axes, boxes), n, pool)
    parts = (axes, denominator, boxes, kernel, probability, measurements)
    explained = _explain(*parts, blocks[0], pose, workspace, pool)
    if callable(other):
        own = [explained[4]]
        for block in blocks[1:]:
            own.append(_explain(*parts, block, pose, workspace, pool)[4])
        other = other(np.concatenate(own))
    factor = workspace.take('factor', (n,))
    share = workspace.take('share', (n,))
    component = workspace.take('component', (n,))
    updated = workspace.take('weights', (n,))
    owner = workspace.take('group', (n,), np.int64)
    log_normaliser = np.empty(number)
    own_mass = np.empty(number)
    other_scale = np.empty(number)
    mass = np.empty(number)
    means = np.empty((number, d))
    covariances = np.empty((number, d, d))
    group_share = np.zeros((groups, number))
    group_mass = np.zeros((chunks, groups))
    for block in blocks:
        width = block.stop - block.start
        # One block is the usual; of several the last one explained is not the first.
        if len(blocks) > 1:
            explained = _explain(*parts, block, pose, workspace, pool)
        likelihood, active, smallest, sums, log_own = explained
        scale = np.empty((chunks, width))
        _normalise(
            smallest,
            sums,
            log_own,
            other[block],
            log_normaliser[block],
            own_mass[block],
            other_scale[block],
            scale,
        )
        moments = np.empty((chunks, width, 1 + d + d * (d + 1) // 2))
        shares = np.zeros((chunks, groups, width))
        work = (
            axes,
            weights,
            probability,
            likelihood,
            active,
            scale,
            measurements.centres[block],
            factor,
            share,
            component,
            moments,
            group,
            shares,
            group_mass,
            block.start,
            block is blocks[-1],
            updated,
            owner,
        )
        run_chunks(lambda c, e, work=work: _apply_chunks(c, e, *work), n, pool)  # type: ignore[misc]
        finish_moments(
            moments, measurements.centres[block], mass[block], means[block], covariances[block]
        )
        _add_chunks(shares, group_share, block.start)
    taken = np.empty(groups + number, np.int64)
    if _taken(group_mass, group_share, taken):
        run_chunks(lambda c, e: _regroup_chunks(c, e, taken, owner), n, pool)
    return Association(
        factor,
        updated,
        log_normaliser,
        own_mass,
        other_scale,
        means,
        covariances,
        group_share,
        owner,
    )
