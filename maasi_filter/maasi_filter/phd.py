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

import numpy as np
from numba import njit
from numpy.typing import NDArray

from maasi_filter.measurement_model import wrap
from maasi_filter.pose import Pose

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

CHUNK = 8192
BLOCK = 16
# Likelihoods exp(-q/2) with q this far above the smallest are below 1e-21 of it.
RELATIVE_GATE = 100.0
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
    gate : (m,) array
        Variance that bounds q from below: of the range, or of the distance to the centre.
    """

    values: FloatArray
    covariances: FloatArray
    cartesian: NDArray[np.bool_]
    centres: FloatArray
    roots: FloatArray
    information: FloatArray
    log_norm: FloatArray
    volume: FloatArray
    gate: FloatArray

    def __len__(self) -> int:
        return len(self.values)


@njit(cache=True)
def _invert(matrix, inverse):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
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


@njit(cache=True)
def _root(matrix, root):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
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


@njit(cache=True)
def spherical_frame(values, frame):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
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


@njit(cache=True)
def _prepare(  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
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
    gate,
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
            trace = 0.0
            for i in range(d):
                trace += matrix[i, i]
            gate[m] = trace
            volume[m] = max(determinant, 1e-9)
            log_determinant = _root(matrix, roots[m])
            log_norm[m] = (
                -0.5 * d * math.log(2.0 * math.pi) - 0.5 * log_determinant + math.log(volume[m])
            )
            _invert(matrix, information[m])
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
            gate[m] = covariance[0, 0]
            volume[m] = determinant
            log_determinant = _root(covariance, roots[m])
            log_norm[m] = -0.5 * d * math.log(2.0 * math.pi) - 0.5 * log_determinant
            _invert(covariance, information[m])


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
        gate=np.empty(number),
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
        out.gate,
    )
    return out


@njit(cache=True, nogil=True)
def _associate_chunk(  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    start,
    stop,
    particles,
    denominator_weights,
    probability,
    sensor_position,
    values,
    cartesian,
    centres,
    information,
    gate,
    likelihood,
    smallest,
    sums,
):
    """Fill likelihoods pi exp(-(q - smallest) / 2) of a chunk, and their weighted sums."""
    d = particles.shape[1]
    number = values.shape[0]
    for m in range(number):
        smallest[m] = np.inf
        sums[m] = 0.0
    for i in range(start, stop):
        for m in range(number):
            likelihood[i, m] = np.inf
        if probability[i] <= 0.0 or denominator_weights[i] <= 0.0:
            continue
        dx = particles[i, 0] - sensor_position[0]
        dy = particles[i, 1] - sensor_position[1]
        dz = 0.0
        level_square = dx * dx + dy * dy
        square = level_square
        if d == 3:
            dz = particles[i, 2] - sensor_position[2]
            square += dz * dz
        distance = math.sqrt(square)
        bearing = 0.0
        elevation = 0.0
        angles_known = False
        for m in range(number):
            if cartesian[m]:
                e0 = particles[i, 0] - centres[m, 0]
                e1 = particles[i, 1] - centres[m, 1]
                e2 = 0.0
                least = e0 * e0 + e1 * e1
                if d == 3:
                    e2 = particles[i, 2] - centres[m, 2]
                    least += e2 * e2
                if least > gate[m] * (smallest[m] + RELATIVE_GATE):
                    continue
            else:
                e0 = values[m, 0] - distance
                if e0 * e0 > gate[m] * (smallest[m] + RELATIVE_GATE):
                    continue
                if not angles_known:
                    angles_known = True
                    bearing = math.atan2(dy, dx)
                    if d == 3:
                        elevation = math.atan2(dz, math.sqrt(level_square))
                e1 = wrap(values[m, 1] - bearing)
                e2 = 0.0
                if d == 3:
                    e2 = values[m, 2] - elevation
            info = information[m]
            q = e0 * e0 * info[0, 0] + e1 * e1 * info[1, 1] + 2.0 * e0 * e1 * info[0, 1]
            if d == 3:
                q += e2 * e2 * info[2, 2] + 2.0 * e2 * (e0 * info[0, 2] + e1 * info[1, 2])
            likelihood[i, m] = q
            if q < smallest[m]:
                smallest[m] = q
    for i in range(start, stop):
        for m in range(number):
            if likelihood[i, m] < smallest[m] + RELATIVE_GATE:
                value = probability[i] * math.exp(-0.5 * (likelihood[i, m] - smallest[m]))
                likelihood[i, m] = value
                sums[m] += value * denominator_weights[i]
            else:
                likelihood[i, m] = 0.0


@njit(cache=True, nogil=True)
def _apply_chunk(  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    start,
    stop,
    particles,
    weights,
    first,
    likelihood,
    scale,
    centres,
    factor,
    share,
    component,
    moments,
    group,
    group_share,
):
    """Turn likelihoods into W_i(z), add them to `factor`, and sum their moments.

    `likelihood` becomes W_i(z) = psi_z(x_i) w_i / C(z); `share` and `component` keep the largest
    one of each particle. `moments` (m, 1 + d + d (d + 1) / 2) are taken about `centres`.
    """
    d = particles.shape[1]
    number = likelihood.shape[1]
    offset = np.empty(d)
    for m in range(number):
        for j in range(moments.shape[1]):
            moments[m, j] = 0.0
    for i in range(start, stop):
        for m in range(number):
            value = likelihood[i, m]
            if value == 0.0:
                continue
            ratio = value * scale[m]
            value = ratio * weights[i]
            likelihood[i, m] = value
            factor[i] += ratio
            if value > share[i]:
                share[i] = value
                component[i] = first + m
            if value > 0.0:
                group_share[group[i], m] += value
                moments[m, 0] += value
                j = 1 + d
                for a in range(d):
                    offset[a] = particles[i, a] - centres[m, a]
                    moments[m, 1 + a] += value * offset[a]
                    for b in range(a + 1):
                        moments[m, j] += value * offset[a] * offset[b]
                        j += 1


def run_chunks(
    function: Callable[[int, int, int], None], number: int, pool: ThreadPoolExecutor | None
) -> None:
    """Call `function(chunk, start, stop)` for chunks of fixed size, in threads if there is a pool.

    Every chunk writes to places of its own, so that the result does not depend on the threads.
    """
    count = max(1, -(-number // CHUNK))
    if pool is None or count < 4:
        for chunk in range(count):
            function(chunk, chunk * CHUNK, min(number, (chunk + 1) * CHUNK))
        return
    futures = [
        pool.submit(function, chunk, chunk * CHUNK, min(number, (chunk + 1) * CHUNK))
        for chunk in range(count)
    ]
    for future in futures:
        future.result()


@dataclass
class Association:
    """Outcome of the update for one robot.

    Parameters
    ----------
    factor : (n,) array
        What each weight is multiplied with: 1 - pi + sum over z of psi_z / C(z).
    log_normaliser : (m,) array
        Logarithm of C(z), -inf where nothing explains a detection.
    own_mass : (m,) array
        Share of a detection that the given particles explain, in [0, 1].
    other_scale : (m,) array
        1 / C(z): what an intensity outside the particles is multiplied with for its share.
    share : (n,) array
        Largest W_i(z) of each particle over z.
    component : (n,) array
        That z, or -1.
    means, covariances : (m, d), (m, d, d) arrays
        Of the particles weighted with W_i(z), metres; covariance 0 where there is no mass.
    group_share : (g, m) array
        W_i(z) summed over the particles of each group.
    """

    factor: FloatArray
    log_normaliser: FloatArray
    own_mass: FloatArray
    other_scale: FloatArray
    share: FloatArray
    component: IntArray
    means: FloatArray
    covariances: FloatArray
    group_share: FloatArray


def associate(
    particles: FloatArray,
    weights: FloatArray,
    probability: FloatArray,
    measurements: MeasurementSet,
    pose: Pose,
    other: FloatArray,
    denominator_weights: FloatArray | None = None,
    group: IntArray | None = None,
    groups: int = 1,
    pool: ThreadPoolExecutor | None = None,
) -> Association:
    """Return the update of particle weights by one robot's detections (000, eq. (13), (16)).

    Parameters
    ----------
    particles : (n, d) array
        Metres, frame `map`.
    weights : (n,) array
        Of the running intensity.
    probability : (n,) array
        pi at the particles.
    measurements : MeasurementSet
        m detections; with none the factor is 1 - pi.
    pose : Pose
        Of the sensor.
    other : (m,) array
        What else explains each detection: intensity of clutter, found targets and births, per
        unit of measurement space. Added to C(z).
    denominator_weights : (n,) array, optional
        Weights in C(z) where they are not the running ones: 002, eq. (9) has the predicted ones.
    group : (n,) int array, optional
        Group of each particle, from 0.
    groups : int
        Number of groups.
    pool : ThreadPoolExecutor, optional
        For large sets; the result is the same.
    """
    n, d = particles.shape
    number = len(measurements)
    denominator = weights if denominator_weights is None else denominator_weights
    group = np.zeros(n, np.int64) if group is None else group
    factor = 1.0 - probability
    share = np.zeros(n)
    component = np.full(n, -1, np.int64)
    log_normaliser = np.full(number, -np.inf)
    own_mass = np.zeros(number)
    other_scale = np.zeros(number)
    means = np.array(measurements.centres)
    covariances = np.zeros((number, d, d))
    group_share = np.zeros((groups, number))
    chunks = max(1, -(-n // CHUNK))
    upper = [(a, b) for a in range(d) for b in range(a + 1)]
    for first in range(0, number, BLOCK):
        block = slice(first, min(number, first + BLOCK))
        width = block.stop - first
        likelihood = np.empty((n, width))
        smallest = np.empty((chunks, width))
        sums = np.empty((chunks, width))
        values = measurements.values[block]
        cartesian = measurements.cartesian[block]
        centres = measurements.centres[block]
        information = measurements.information[block]
        gate = measurements.gate[block]

        def first_pass(
            chunk: int,
            start: int,
            stop: int,
            values: FloatArray = values,
            cartesian: NDArray[np.bool_] = cartesian,
            centres: FloatArray = centres,
            information: FloatArray = information,
            gate: FloatArray = gate,
            likelihood: FloatArray = likelihood,
            smallest: FloatArray = smallest,
            sums: FloatArray = sums,
        ) -> None:
            _associate_chunk(
                start,
                stop,
                particles,
                denominator,
                probability,
                pose.position,
                values,
                cartesian,
                centres,
                information,
                gate,
                likelihood,
                smallest[chunk],
                sums[chunk],
            )

        run_chunks(first_pass, n, pool)
        least = smallest.min(axis=0)
        safe = np.where(np.isfinite(least), least, 0.0)
        relative = np.exp(-0.5 * np.maximum(smallest - safe, 0.0))
        relative[~np.isfinite(smallest)] = 0.0
        total = np.zeros(width)
        for chunk in range(chunks):
            total += relative[chunk] * np.where(relative[chunk] > 0.0, sums[chunk], 0.0)
        log_own = np.full(width, -np.inf)
        some = total > 0.0
        log_own[some] = np.log(total[some]) + measurements.log_norm[block][some] - 0.5 * least[some]
        log_other = np.full(width, -np.inf)
        there = other[block] > 0.0
        log_other[there] = np.log(other[block][there])
        log_sum = np.logaddexp(log_own, log_other)
        finite = np.isfinite(log_sum)
        log_normaliser[block] = log_sum
        own_mass[block][finite] = np.exp(log_own[finite] - log_sum[finite])
        other_scale[block][finite] = np.exp(-log_sum[finite])
        scale = np.zeros((chunks, width))
        exponent = measurements.log_norm[block] - log_sum - 0.5 * smallest
        usable = np.isfinite(exponent)
        scale[usable] = np.exp(exponent[usable])
        moments = np.empty((chunks, width, 1 + d + len(upper)))
        shares = np.zeros((chunks, groups, width))

        def second_pass(
            chunk: int,
            start: int,
            stop: int,
            likelihood: FloatArray = likelihood,
            scale: FloatArray = scale,
            centres: FloatArray = centres,
            moments: FloatArray = moments,
            shares: FloatArray = shares,
            first: int = first,
        ) -> None:
            _apply_chunk(
                start,
                stop,
                particles,
                weights,
                first,
                likelihood,
                scale[chunk],
                centres,
                factor,
                share,
                component,
                moments[chunk],
                group,
                shares[chunk],
            )

        run_chunks(second_pass, n, pool)
        summed = np.zeros(moments.shape[1:])
        for chunk in range(chunks):
            summed += moments[chunk]
            group_share[:, block] += shares[chunk]
        mass = summed[:, 0]
        for m in np.nonzero(mass > 0.0)[0]:
            offset = summed[m, 1 : 1 + d] / mass[m]
            means[first + m] = centres[m] + offset
            for j, (a, b) in enumerate(upper):
                value = summed[m, 1 + d + j] / mass[m] - offset[a] * offset[b]
                covariances[first + m, a, b] = value
                covariances[first + m, b, a] = value
    return Association(
        factor,
        log_normaliser,
        own_mass,
        other_scale,
        share,
        component,
        means,
        covariances,
        group_share,
    )
