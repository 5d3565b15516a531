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

from maasi_filter.measurement_model import TWO_PI, wrap
from maasi_filter.pose import Pose

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

CHUNK = 8192
BLOCK = 16
# Likelihoods exp(-q/2) with q this far above the smallest are below 1e-17 of it.
RELATIVE_GATE = 80.0
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
    """

    values: FloatArray
    covariances: FloatArray
    cartesian: NDArray[np.bool_]
    centres: FloatArray
    roots: FloatArray
    information: FloatArray
    log_norm: FloatArray
    volume: FloatArray

    def __len__(self) -> int:
        return len(self.values)


@njit(cache=True, error_model='numpy')
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


@njit(cache=True, error_model='numpy')
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


@njit(cache=True, error_model='numpy')
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


@njit(cache=True, error_model='numpy')
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
    )
    for m in range(number):
        log_determinant = _root(out.covariances[m], out.roots[m])
        _invert(out.covariances[m], out.information[m])
        out.log_norm[m] = -0.5 * (d * math.log(2.0 * math.pi) + log_determinant)
    return out


@njit(cache=True, error_model='numpy')
def arctan2(y: float, x: float) -> float:  # pragma: no cover - compiled
    """Return the angle of (x, y), to about one unit in the last place; 0 at the origin.

    Cephes' rational approximation: several times faster than the C library's, and the same to
    the bit on every machine.
    """
    ax = abs(x)
    ay = abs(y)
    small = min(ax, ay)
    large = max(ax, ay)
    # Choices instead of branches, so that loops over arrays become vector instructions.
    upper = small > 0.66 * large
    top = small - large if upper else small
    bottom = small + large if upper else large
    t = top / (bottom if bottom > 0.0 else 1.0)
    z = t * t
    top = -8.750608600031904122785e-1 * z - 1.615753718733365076637e1
    top = (top * z - 7.500855792314704667340e1) * z - 1.228866684490136173410e2
    top = top * z - 6.485021904942025371773e1
    bottom = (z + 2.485846490142306297962e1) * z + 1.650270098316988542046e2
    bottom = (bottom * z + 4.328810604912902668951e2) * z + 4.853903996359136964868e2
    bottom = bottom * z + 1.945506571482613964425e2
    angle = (0.25 * math.pi if upper else 0.0) + (t + t * (z * top / bottom))
    angle = 0.5 * math.pi - angle if ay > ax else angle
    angle = math.pi - angle if x < 0.0 else angle
    return angle if y >= 0.0 else -angle


@njit(cache=True, nogil=True, error_model='numpy')
def _associate_chunks(  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    first_chunk,
    last_chunk,
    particles,
    denominator_weights,
    probability,
    sensor_position,
    values,
    cartesian,
    centres,
    information,
    likelihood,
    all_smallest,
    all_sums,
):
    """Fill likelihoods (m, n), pi exp(-(q - smallest) / 2), of chunks, and weighted sums."""
    d = particles.shape[1]
    number = values.shape[0]
    polar = not cartesian.all()
    # Coordinates apart, and loops without branches: they become vector instructions.
    x = np.empty(CHUNK)
    y = np.empty(CHUNK)
    height = np.zeros(CHUNK)
    distance = np.empty(CHUNK)
    bearing = np.empty(CHUNK)
    elevation = np.zeros(CHUNK)
    for chunk in range(first_chunk, last_chunk):
        start = chunk * CHUNK
        size = min(particles.shape[0], start + CHUNK) - start
        for i in range(size):
            x[i] = particles[start + i, 0] - sensor_position[0]
            y[i] = particles[start + i, 1] - sensor_position[1]
        if d == 3:
            for i in range(size):
                height[i] = particles[start + i, 2] - sensor_position[2]
        if polar:
            for i in range(size):
                bearing[i] = arctan2(y[i], x[i])
                distance[i] = math.sqrt(x[i] * x[i] + y[i] * y[i])
            if d == 3:
                for i in range(size):
                    elevation[i] = arctan2(height[i], distance[i])
                    distance[i] = math.sqrt(distance[i] * distance[i] + height[i] * height[i])
        for m in range(number):
            row = likelihood[m, start : start + size]
            i00 = information[m, 0, 0]
            i11 = information[m, 1, 1]
            i01 = 2.0 * information[m, 0, 1]
            i22 = 0.0
            i02 = 0.0
            i12 = 0.0
            z2 = 0.0
            if d == 3:
                i22 = information[m, 2, 2]
                i02 = 2.0 * information[m, 0, 2]
                i12 = 2.0 * information[m, 1, 2]
            if cartesian[m]:
                z0 = centres[m, 0] - sensor_position[0]
                z1 = centres[m, 1] - sensor_position[1]
                if d == 3:
                    z2 = centres[m, 2] - sensor_position[2]
                for i in range(size):
                    e0 = z0 - x[i]
                    e1 = z1 - y[i]
                    e2 = z2 - height[i]
                    row[i] = (
                        e0 * (e0 * i00 + e1 * i01 + e2 * i02)
                        + e1 * (e1 * i11 + e2 * i12)
                        + e2 * e2 * i22
                    )
            else:
                z0 = values[m, 0]
                z1 = wrap(values[m, 1])
                if d == 3:
                    z2 = values[m, 2]
                for i in range(size):
                    e0 = z0 - distance[i]
                    e1 = z1 - bearing[i]
                    e1 = e1 - TWO_PI if e1 >= math.pi else e1
                    e1 = e1 + TWO_PI if e1 < -math.pi else e1
                    e2 = z2 - elevation[i]
                    row[i] = (
                        e0 * (e0 * i00 + e1 * i01 + e2 * i02)
                        + e1 * (e1 * i11 + e2 * i12)
                        + e2 * e2 * i22
                    )
            least = np.inf
            for i in range(size):
                if row[i] < least and probability[start + i] * denominator_weights[start + i] > 0.0:
                    least = row[i]
            total = 0.0
            largest = least + RELATIVE_GATE
            for i in range(size):
                if row[i] < largest and probability[start + i] * denominator_weights[start + i] > 0:
                    value = probability[start + i] * math.exp(-0.5 * (row[i] - least))
                    row[i] = value
                    total += value * denominator_weights[start + i]
                else:
                    row[i] = 0.0
            all_smallest[chunk, m] = least
            all_sums[chunk, m] = total


@njit(cache=True, error_model='numpy')
def _normalise(  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    smallest, sums, log_norm, other, log_normaliser, own_mass, other_scale, scale
):
    """Fill log C(z), the particles' share of it, 1 / C(z), and the factor of each chunk."""
    chunks, number = smallest.shape
    for m in range(number):
        least = np.inf
        for chunk in range(chunks):
            least = min(least, smallest[chunk, m])
        total = 0.0
        if least < np.inf:
            for chunk in range(chunks):
                if smallest[chunk, m] < np.inf:
                    total += sums[chunk, m] * math.exp(-0.5 * (smallest[chunk, m] - least))
        log_other = math.log(other[m]) if other[m] > 0.0 else -np.inf
        # Everything in units of the largest likelihood: exact however small that is.
        log_peak = log_norm[m] - 0.5 * least if total > 0.0 else -np.inf
        own_mass[m] = 0.0
        other_scale[m] = 0.0
        for chunk in range(chunks):
            scale[chunk, m] = 0.0
        log_sum = log_other
        # Where something else explains it e^600 times better, the particles' share is nothing.
        if total > 0.0 and log_other - log_peak < 600.0:
            relative = math.exp(log_other - log_peak)
            own_mass[m] = total / (total + relative)
            log_sum = log_peak + math.log(total + relative)
            for chunk in range(chunks):
                if smallest[chunk, m] < np.inf:
                    part = math.exp(-0.5 * (smallest[chunk, m] - least))
                    scale[chunk, m] = part / (total + relative)
        if log_sum > -np.inf:
            # Next to nothing may still be divided by; what is multiplied with it is as small.
            other_scale[m] = math.exp(min(-log_sum, 700.0))
        log_normaliser[m] = log_sum


@njit(cache=True, nogil=True, error_model='numpy')
def _apply_chunks(  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    first_chunk,
    last_chunk,
    particles,
    weights,
    first,
    likelihood,
    scale,
    centres,
    factor,
    share,
    component,
    all_moments,
    group,
    group_share,
):
    """Add psi_z / C(z) to `factor`, and sum moments of W_i(z) = psi_z(x_i) w_i / C(z).

    `share` and `component` keep the largest W_i(z) of each particle, and its z. `moments`
    (m, 1 + d + d (d + 1) / 2) are taken about `centres`.
    """
    d = particles.shape[1]
    number = likelihood.shape[0]
    for chunk in range(first_chunk, last_chunk):
        start = chunk * CHUNK
        stop = min(particles.shape[0], start + CHUNK)
        for m in range(number):
            row = likelihood[m]
            multiple = scale[chunk, m]
            c0 = centres[m, 0]
            c1 = centres[m, 1]
            c2 = centres[m, 2] if d == 3 else 0.0
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
            # Particles of a group lie together, so its sum is kept apart until another comes.
            current = np.int64(0)
            held = 0.0
            for i in range(start, stop):
                value = row[i]
                if value == 0.0:
                    continue
                ratio = value * multiple
                factor[i] += ratio
                value = ratio * weights[i]
                if value <= 0.0:
                    continue
                if value > share[i]:
                    share[i] = value
                    component[i] = first + m
                if group[i] != current:
                    group_share[chunk, current, m] += held
                    held = 0.0
                    current = group[i]
                held += value
                x = particles[i, 0] - c0
                y = particles[i, 1] - c1
                t0 += value
                tx += value * x
                ty += value * y
                txx += value * x * x
                txy += value * x * y
                tyy += value * y * y
                if d == 3:
                    z = particles[i, 2] - c2
                    tz += value * z
                    txz += value * x * z
                    tyz += value * y * z
                    tzz += value * z * z
            if held > 0.0:
                group_share[chunk, current, m] += held
            moments = all_moments[chunk, m]
            moments[0] = t0
            moments[1] = tx
            moments[2] = ty
            if d == 2:
                moments[3] = txx
                moments[4] = txy
                moments[5] = tyy
            else:
                moments[3] = tz
                moments[4] = txx
                moments[5] = txy
                moments[6] = tyy
                moments[7] = txz
                moments[8] = tyz
                moments[9] = tzz


@njit(cache=True, error_model='numpy')
def regroup(  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    weights, factor, share, component, group, group_share, updated, regrouped
):
    """Fill the updated weights, and the groups of particles after one robot's detections.

    A particle belongs to the detection that explains most of its weight, if one does. What a
    detection leaves of a group that it mostly took belongs to it too. Groups of detections are
    numbered behind the ones there are.
    """
    groups, number = group_share.shape
    mass = np.zeros(groups)
    for i in range(weights.shape[0]):
        updated[i] = weights[i] * factor[i]
        mass[group[i]] += updated[i]
    taken = np.empty(groups, np.int64)
    for g in range(groups):
        taken[g] = g
        best = 0.5 * mass[g]
        for m in range(number):
            if group_share[g, m] > best:
                best = group_share[g, m]
                taken[g] = groups + m
    for i in range(weights.shape[0]):
        if share[i] > 0.5 * updated[i]:
            regrouped[i] = groups + component[i]
        else:
            regrouped[i] = taken[group[i]]


@njit(cache=True, error_model='numpy')
def finish_moments(  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
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
    if pool is None or count < 4:
        function(0, count)
        return
    futures = [pool.submit(function, chunk, chunk + 1) for chunk in range(count)]
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
    log_normaliser = np.empty(number)
    own_mass = np.empty(number)
    other_scale = np.empty(number)
    mass = np.empty(number)
    means = np.empty((number, d))
    covariances = np.empty((number, d, d))
    group_share = np.zeros((groups, number))
    chunks = max(1, -(-n // CHUNK))
    for first in range(0, number, BLOCK):
        block = slice(first, min(number, first + BLOCK))
        width = block.stop - first
        likelihood = np.empty((width, n))
        smallest = np.empty((chunks, width))
        sums = np.empty((chunks, width))
        before = (
            particles,
            denominator,
            probability,
            pose.position,
            measurements.values[block],
            measurements.cartesian[block],
            measurements.centres[block],
            measurements.information[block],
            likelihood,
            smallest,
            sums,
        )
        run_chunks(lambda c, e, work=before: _associate_chunks(c, e, *work), n, pool)  # type: ignore[misc]
        scale = np.empty((chunks, width))
        _normalise(
            smallest,
            sums,
            measurements.log_norm[block],
            other[block],
            log_normaliser[block],
            own_mass[block],
            other_scale[block],
            scale,
        )
        moments = np.empty((chunks, width, 1 + d + d * (d + 1) // 2))
        shares = np.zeros((chunks, groups, width))
        after = (
            particles,
            weights,
            first,
            likelihood,
            scale,
            measurements.centres[block],
            factor,
            share,
            component,
            moments,
            group,
            shares,
        )
        run_chunks(lambda c, e, work=after: _apply_chunks(c, e, *work), n, pool)  # type: ignore[misc]
        finish_moments(
            moments, measurements.centres[block], mass[block], means[block], covariances[block]
        )
        for chunk in range(chunks):
            group_share[:, block] += shares[chunk]
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
