"""Targets that are found: they leave the intensity, and take their measurements with them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from maasi_filter.ic_phd.phd import MeasurementSet, _invert, _root
from maasi_filter.models.measurement import wrap
from maasi_filter.models.pose import Pose

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

# A detection exists, so the probability of detection of what caused it was not nothing.
LEAST_PROBABILITY = 0.01
LEAST_MISS = 0.02
# Uncertainty over distance beyond which a measurement is not linear, radians.
LARGEST_ANGLE = 0.25
# Squared normalised innovation beyond which a detection is of something else.
LARGEST_INNOVATION = 25.0
# Squared deviations that a target may be from where its detections have told that it is.
LARGEST_SHIFT = 16.0
# Of a place that is taken for certain, 1 / m^2.
UNLIMITED_INFORMATION = 1e12
# Gauss and Hermite's rule for the standard normal distribution.
NODES, NODE_WEIGHTS = np.polynomial.hermite_e.hermegauss(4)
NODE_WEIGHTS = NODE_WEIGHTS / NODE_WEIGHTS.sum()
# Smallest share of a likelihood that is taken in at a time; with less, nodes are too far apart.
LEAST_SHARE = 1.0 / 64.0
# A share of the bound that a covariance may lack without being widened.
LEAST_LACK = 0.05


@dataclass
class FoundTarget:
    """A target marked as found.

    Parameters
    ----------
    id : int
        From 1, in the order of being found.
    position : (d,) array
        Metres, frame `map`.
    covariance : (d, d) array
        Of the error of `position`, square metres.
    robot : str
        Whose measurement completed it.
    measurement : int
        That robot's measurement index then.
    time : float
        Seconds.
    origin : int
        Its number in the filter of another robot that it was taken over from; 0 for the filter's
        own.
    """

    id: int
    position: FloatArray
    covariance: FloatArray
    robot: str
    measurement: int
    time: float
    origin: int = 0


@njit(cache=True, error_model='numpy')
def _predict(  # type: ignore[no-untyped-def]
    position, sensor_position, z, cartesian, centre, error, jacobian
):
    """Fill z - g(x) and dg/dx at a target, in place (Cartesian: centre - x and identity)."""
    d = position.shape[0]
    if cartesian:
        for a in range(d):
            error[a] = centre[a] - position[a]
            for b in range(d):
                jacobian[a, b] = 1.0 if a == b else 0.0
        return
    dx = position[0] - sensor_position[0]
    dy = position[1] - sensor_position[1]
    dz = position[2] - sensor_position[2] if d == 3 else 0.0
    level = max(math.sqrt(dx * dx + dy * dy), 1e-9)
    distance = max(math.sqrt(level * level + dz * dz), 1e-9)
    error[0] = z[0] - distance
    error[1] = wrap(z[1] - math.atan2(dy, dx))
    jacobian[0, 0] = dx / distance
    jacobian[0, 1] = dy / distance
    jacobian[1, 0] = -dy / (level * level)
    jacobian[1, 1] = dx / (level * level)
    if d == 3:
        error[2] = z[2] - math.atan2(dz, level)
        jacobian[0, 2] = dz / distance
        jacobian[1, 2] = 0.0
        square = distance * distance
        jacobian[2, 0] = -dx * dz / (square * level)
        jacobian[2, 1] = -dy * dz / (square * level)
        jacobian[2, 2] = level / square


@njit(cache=True, error_model='numpy')
def _innovation(jacobian, covariance, noise, out):  # type: ignore[no-untyped-def]
    d = jacobian.shape[0]
    for a in range(d):
        for b in range(d):
            total = noise[a, b]
            for i in range(d):
                for j in range(d):
                    total += jacobian[a, i] * covariance[i, j] * jacobian[b, j]
            out[a, b] = total


@njit(cache=True, error_model='numpy')
def _noise(roots, out):  # type: ignore[no-untyped-def]
    d = roots.shape[0]
    for a in range(d):
        for b in range(d):
            total = 0.0
            for k in range(min(a, b) + 1):
                total += roots[a, k] * roots[b, k]
            out[a, b] = total


@njit(cache=True, error_model='numpy')
def _inherit(group_share, own_mass, information, places):  # type: ignore[no-untyped-def]
    """Add, in place, to each new group's information that of the group it mostly comes from.

    Not where it lies so far from that one's place that the information is of another target.
    """
    groups, number = group_share.shape
    d = places.shape[1]
    for m in range(number):
        if groups == 0 or not own_mass[m] > 0.5:
            continue
        source = 0
        for g in range(1, groups):
            if group_share[g, m] > group_share[source, m]:
                source = g
        square = 0.0
        for a in range(d):
            for b in range(d):
                square += (
                    (places[groups + m, a] - places[source, a])
                    * information[source, a, b]
                    * (places[groups + m, b] - places[source, b])
                )
        if square <= LARGEST_SHIFT or information[source, 0, 0] >= UNLIMITED_INFORMATION:
            information[groups + m] += information[source]


@njit(cache=True, error_model='numpy')
def _extend(  # type: ignore[no-untyped-def]
    known,
    known_places,
    positions,
    sensor_position,
    values,
    cartesian,
    centres,
    information,
    group_share,
    own_mass,
    out,
    places,
):
    """Fill information and places of groups and of detections."""
    number, d = positions.shape
    groups = known.shape[0]
    for g in range(groups):
        for a in range(d):
            places[g, a] = known_places[g, a]
            for b in range(d):
                out[g, a, b] = known[g, a, b]
    error = np.empty(d)
    jacobian = np.empty((d, d))
    for m in range(number):
        # Particles that explain little are no place of what else does.
        place = positions[m] if own_mass[m] > 0.5 else centres[m]
        _predict(place, sensor_position, values[m], cartesian[m], centres[m], error, jacobian)
        for a in range(d):
            places[groups + m, a] = place[a]
            for b in range(d):
                total = 0.0
                for i in range(d):
                    for j in range(d):
                        total += jacobian[i, a] * information[m, i, j] * jacobian[j, b]
                out[groups + m, a, b] = total
    _inherit(group_share, own_mass, out, places)


def extended_information(
    information: FloatArray,
    places: FloatArray,
    positions: FloatArray,
    group_share: FloatArray,
    own_mass: FloatArray,
    measurements: MeasurementSet,
    pose: Pose,
) -> tuple[FloatArray, FloatArray]:
    """Return information (g + m, d, d) and places (g + m, d) of groups and m detections' groups.

    A detection tells H^T R^-1 H, with H at `positions`. Where particles mostly explain it, what
    was known of the group that they mostly are of is added, unless that speaks against the place:
    a few stray particles of a group may stand for another target, of which its detections tell
    nothing.

    Parameters
    ----------
    information : (g, d, d) array
        Of the groups there were, 1 / m^2.
    places : (g, d) array
        Where they were when their last detections were taken in, metres.
    positions : (m, d) array
        Means of what the detections explain, metres.
    group_share : (g, m) array
        How much each group explains of each detection.
    own_mass : (m,) array
        How much all particles explain of it.
    """
    groups, d = information.shape[:2]
    out = np.empty((groups + len(measurements), d, d))
    new_places = np.empty((groups + len(measurements), d))
    _extend(
        information,
        places,
        positions,
        pose.position,
        measurements.values,
        measurements.cartesian,
        measurements.centres,
        measurements.information,
        group_share,
        own_mass,
        out,
        new_places,
    )
    return out, new_places


@njit(cache=True, error_model='numpy')
def _eigen(matrix, values, vectors):  # type: ignore[no-untyped-def]
    """Fill eigenvalues and vectors (columns) of a symmetric matrix, by Jacobi's rotations."""
    d = matrix.shape[0]
    a = matrix.copy()
    for i in range(d):
        for j in range(d):
            vectors[i, j] = 1.0 if i == j else 0.0
    for _ in range(30):
        off = 0.0
        diagonal = 0.0
        for i in range(d):
            diagonal += a[i, i] * a[i, i]
            for j in range(i):
                off += a[i, j] * a[i, j]
        if off <= 1e-30 * diagonal:
            break
        for p in range(d - 1):
            for q in range(p + 1, d):
                if a[p, q] == 0.0:
                    continue
                theta = (a[q, q] - a[p, p]) / (2.0 * a[p, q])
                t = 1.0 / (abs(theta) + math.sqrt(theta * theta + 1.0))
                if theta < 0.0:
                    t = -t
                c = 1.0 / math.sqrt(t * t + 1.0)
                s = t * c
                for k in range(d):
                    x = a[k, p]
                    y = a[k, q]
                    a[k, p] = c * x - s * y
                    a[k, q] = s * x + c * y
                for k in range(d):
                    x = a[p, k]
                    y = a[q, k]
                    a[p, k] = c * x - s * y
                    a[q, k] = s * x + c * y
                for k in range(d):
                    x = vectors[k, p]
                    y = vectors[k, q]
                    vectors[k, p] = c * x - s * y
                    vectors[k, q] = s * x + c * y
    for i in range(d):
        values[i] = a[i, i]


@njit(cache=True, error_model='numpy')
def _bound(covariance, information, bounded, lack):  # type: ignore[no-untyped-def]
    """Fill the covariance widened to the inverse of the information, and a root of what is added.

    Return whether anything much was added.
    """
    d = covariance.shape[0]
    root = np.empty((d, d))
    back = np.zeros((d, d))
    white = np.empty((d, d))
    values = np.empty(d)
    vectors = np.empty((d, d))
    _root(information, root)
    # back = root^-T, upper triangular.
    for j in range(d):
        for i in range(j, -1, -1):
            total = 1.0 if i == j else 0.0
            for k in range(i + 1, j + 1):
                total -= root[k, i] * back[k, j]
            back[i, j] = total / root[i, i]
    for i in range(d):
        for j in range(d):
            total = 0.0
            for k in range(d):
                for m in range(d):
                    total += root[k, i] * covariance[k, m] * root[m, j]
            white[i, j] = total
    for i in range(d):
        for j in range(i):
            mean = 0.5 * (white[i, j] + white[j, i])
            white[i, j] = mean
            white[j, i] = mean
    _eigen(white, values, vectors)
    much = False
    for j in range(d):
        missing = max(1.0 - values[j], 0.0)
        much |= missing > LEAST_LACK
        for i in range(d):
            total = 0.0
            for k in range(i, d):
                total += back[i, k] * vectors[k, j]
            lack[i, j] = total * math.sqrt(missing)
    for i in range(d):
        for j in range(d):
            total = covariance[i, j]
            for k in range(d):
                total += lack[i, k] * lack[j, k]
            bounded[i, j] = total
    return much


@njit(cache=True, error_model='numpy')
def _exceeds(covariance, information, share, matrix, root):  # type: ignore[no-untyped-def]
    """Return whether a covariance is above `share` of the inverse of the information.

    Its inverse is below the information over `share` then. False too where that cannot be told.
    """
    d = covariance.shape[0]
    _invert(covariance, matrix)
    for i in range(d):
        if not covariance[i, i] > 0.0:
            return False
        for j in range(d):
            matrix[i, j] = information[i, j] / share - matrix[i, j]
    for i in range(d):
        for j in range(i + 1):
            total = matrix[i, j]
            for k in range(j):
                total -= root[i, k] * root[j, k]
            if i != j:
                root[i, j] = total / root[j, j]
            elif total > 1e-12 * information[i, i]:
                root[i, i] = math.sqrt(total)
            else:
                return False
    return True


@njit(cache=True, error_model='numpy')
def _fill_groups(covariances, information, prior, fill):  # type: ignore[no-untyped-def]
    groups, d = covariances.shape[0], covariances.shape[1]
    bounded = np.empty((d, d))
    total = np.empty((d, d))
    any_lack = False
    for g in range(groups):
        for i in range(d):
            for j in range(d):
                total[i, j] = information[g, i, j] + prior[i, j]
        lacks = False
        # Most lack nothing, which a root of three numbers tells.
        if not _exceeds(covariances[g], total, 1.0 - LEAST_LACK, bounded, fill[g]):
            lacks = _bound(covariances[g], total, bounded, fill[g])
        if lacks:
            any_lack = True
        else:
            fill[g] = 0.0
    return any_lack


@njit(cache=True, error_model='numpy')
def _narrow(  # type: ignore[no-untyped-def]
    mass, covariances, information, prior, least_mass, radius, bounded, narrow
):
    d = covariances.shape[1]
    lack = np.empty((d, d))
    total = np.empty((d, d))
    some = False
    for m in range(mass.shape[0]):
        narrow[m] = False
        if mass[m] <= least_mass:
            continue
        trace = 0.0
        for a in range(d):
            trace += covariances[m, a, a]
        if trace > radius * radius:
            continue
        for i in range(d):
            for j in range(d):
                total[i, j] = information[m, i, j] + prior[i, j]
        _bound(covariances[m], total, bounded[m], lack)
        trace = 0.0
        for a in range(d):
            trace += bounded[m, a, a]
        narrow[m] = trace <= radius * radius
        some |= narrow[m]
    return some


def narrow_clouds(
    mass: FloatArray,
    covariances: FloatArray,
    information: FloatArray,
    prior: FloatArray,
    least_mass: float,
    radius: float,
) -> tuple[IntArray, FloatArray]:
    """Return which of m clouds are heavy and narrow, and covariances (m, d, d) of those.

    Covariances are widened to the inverse of the information of their data, with which the root
    mean square radius may not be above `radius` either.

    Parameters
    ----------
    mass, covariances, information : (m,), (m, d, d), (m, d, d) arrays
        Of the clouds, and of their detections.
    prior : (d, d) array
        Information before any detection, positive definite.
    least_mass : float
        T_m.
    radius : float
        T_r, metres.
    """
    bounded = np.empty_like(covariances)
    narrow = np.empty(len(mass), np.bool_)
    if not _narrow(mass, covariances, information, prior, least_mass, radius, bounded, narrow):
        return np.empty(0, np.int64), bounded
    return np.nonzero(narrow)[0], bounded


def bounded_below(covariance: FloatArray, information: FloatArray) -> FloatArray:
    """Return the covariance widened, where it is narrower, to what the data can tell.

    No unbiased estimate is better than the inverse of the information of its data (Cramer-Rao).

    Parameters
    ----------
    covariance, information : (d, d) arrays
        The information has to be positive definite.
    """
    bounded = np.empty_like(covariance)
    _bound(covariance, information, bounded, np.empty_like(covariance))
    return bounded


def missing_spread(
    covariances: FloatArray, information: FloatArray, prior: FloatArray
) -> FloatArray | None:
    """Return roots (g, d, d) of what covariances lack to the bound; None if none lacks much.

    Parameters
    ----------
    covariances, information : (g, d, d) arrays
        Of groups of particles, and of their detections.
    prior : (d, d) array
        Information before any detection, positive definite.
    """
    fill = np.zeros_like(covariances)
    return fill if _fill_groups(covariances, information, prior, fill) else None


@njit(cache=True, error_model='numpy')
def _intensity(  # type: ignore[no-untyped-def]
    positions,
    covariances,
    probability,
    centre_probability,
    sensor_position,
    values,
    cartesian,
    centres,
    roots,
    volume,
    odds,
    kappa,
):
    number, d = positions.shape
    error = np.empty(d)
    jacobian = np.empty((d, d))
    noise = np.empty((d, d))
    innovation = np.empty((d, d))
    inverse = np.empty((d, d))
    root = np.empty((d, d))
    for m in range(values.shape[0]):
        _noise(roots[m], noise)
        for f in range(number):
            _predict(
                positions[f], sensor_position, values[m], cartesian[m], centres[m], error, jacobian
            )
            _innovation(jacobian, covariances[f], noise, innovation)
            log_determinant = _root(innovation, root)
            _invert(innovation, inverse)
            q = 0.0
            for a in range(d):
                for b in range(d):
                    q += error[a] * inverse[a, b] * error[b]
            density = math.exp(-0.5 * (q + log_determinant + d * math.log(2.0 * math.pi)))
            if cartesian[m]:
                density *= volume[m]
            detected = probability[f]
            if odds:
                detected = max(detected, max(centre_probability[m], LEAST_PROBABILITY))
                # The alternative is that the found target was missed.
                detected /= max(1.0 - detected, LEAST_MISS)
            kappa[f, m] = detected * density


@njit(cache=True, error_model='numpy')
def _match_moments(  # type: ignore[no-untyped-def]
    position, covariance, sensor_position, z, cartesian, centre, information, out, out_covariance
):
    """Update one target with one detection by quadrature of its Gaussian times the likelihood.

    The likelihood comes in by shares, powers of it, none of which takes more than half of the
    nodes out. Return whether it was done: not for what is no measurement of it, nor where the
    noise is so much narrower than the Gaussian that its nodes miss the likelihood.
    """
    d = position.shape[0]
    number = len(NODES) ** d
    nodes = np.empty((number, d))
    prior = np.empty(number)
    fit = np.empty(number)
    weight = np.empty(number)
    error = np.empty(d)
    jacobian = np.empty((d, d))
    root = np.empty((d, d))
    for a in range(d):
        out[a] = position[a]
        for b in range(d):
            out_covariance[a, b] = covariance[a, b]
    left = 1.0
    while left > 0.0:
        _root(out_covariance, root)
        best = -math.inf
        for i in range(number):
            prior[i] = 1.0
            for a in range(d):
                nodes[i, a] = out[a]
            rest = i
            for b in range(d):
                prior[i] *= NODE_WEIGHTS[rest % len(NODES)]
                for a in range(b, d):
                    nodes[i, a] += root[a, b] * NODES[rest % len(NODES)]
                rest //= len(NODES)
            _predict(nodes[i], sensor_position, z, cartesian, centre, error, jacobian)
            square = 0.0
            for a in range(d):
                for b in range(d):
                    square += error[a] * information[a, b] * error[b]
            fit[i] = -0.5 * square
            best = max(best, fit[i])
        share = left
        total = 0.0
        while True:
            total = 0.0
            squares = 0.0
            for i in range(number):
                likelihood = math.exp(share * (fit[i] - best))
                weight[i] = prior[i] * likelihood
                total += weight[i]
                squares += weight[i] * likelihood
            if total * total >= 0.5 * squares:
                break
            share *= 0.5
            if share < LEAST_SHARE:
                return False
        left = left - share
        for a in range(d):
            out[a] = 0.0
            for i in range(number):
                out[a] += weight[i] * nodes[i, a] / total
        for a in range(d):
            for b in range(d):
                out_covariance[a, b] = 0.0
                for i in range(number):
                    offset = (nodes[i, a] - out[a]) * (nodes[i, b] - out[b])
                    out_covariance[a, b] += weight[i] * offset / total
    # In a linear model this is the squared innovation.
    _predict(out, sensor_position, z, cartesian, centre, error, jacobian)
    _invert(covariance, root)
    square = 0.0
    for a in range(d):
        for b in range(d):
            square += error[a] * information[a, b] * error[b]
            square += (out[a] - position[a]) * root[a, b] * (out[b] - position[b])
    return square <= LARGEST_INNOVATION


@njit(cache=True, error_model='numpy')
def _update(  # type: ignore[no-untyped-def]
    position,
    covariance,
    sensor_position,
    z,
    cartesian,
    centre,
    root,
    information,
    out,
    out_covariance,
):
    """Update one target with one detection; an iterated extended Kalman filter.

    Where the measurement is far from linear over the target's uncertainty, next to the robot or
    straight above or below it, moments are matched instead, if the noise is wide enough for it.
    Return whether it was done: not for what is no measurement of it.
    """
    d = position.shape[0]
    if not cartesian:
        level = 0.0
        trace = 0.0
        for a in range(2):
            level += (position[a] - sensor_position[a]) ** 2
        for a in range(d):
            trace += covariance[a, a]
        if trace > LARGEST_ANGLE * LARGEST_ANGLE * level:
            return _match_moments(
                position,
                covariance,
                sensor_position,
                z,
                cartesian,
                centre,
                information,
                out,
                out_covariance,
            )
    error = np.empty(d)
    jacobian = np.empty((d, d))
    noise = np.empty((d, d))
    innovation = np.empty((d, d))
    inverse = np.empty((d, d))
    gain = np.empty((d, d))
    _noise(root, noise)
    for a in range(d):
        out[a] = position[a]
    for step in range(3):
        _predict(out, sensor_position, z, cartesian, centre, error, jacobian)
        _innovation(jacobian, covariance, noise, innovation)
        _invert(innovation, inverse)
        if step == 0:
            q = 0.0
            for a in range(d):
                for b in range(d):
                    q += error[a] * inverse[a, b] * error[b]
            if q > LARGEST_INNOVATION:
                return False
        for a in range(d):
            for b in range(d):
                total = 0.0
                for i in range(d):
                    for j in range(d):
                        total += covariance[a, i] * jacobian[j, i] * inverse[j, b]
                gain[a, b] = total
        for j in range(d):
            for i in range(d):
                error[j] -= jacobian[j, i] * (position[i] - out[i])
        for a in range(d):
            total = position[a]
            for j in range(d):
                total += gain[a, j] * error[j]
            out_covariance[a, 0] = total
        for a in range(d):
            out[a] = out_covariance[a, 0]
    # Joseph's form keeps it symmetric and positive definite.
    keep = np.empty((d, d))
    for a in range(d):
        for b in range(d):
            total = 1.0 if a == b else 0.0
            for j in range(d):
                total -= gain[a, j] * jacobian[j, b]
            keep[a, b] = total
    for a in range(d):
        for b in range(d):
            total = 0.0
            for i in range(d):
                for j in range(d):
                    total += keep[a, i] * covariance[i, j] * keep[b, j]
                    total += gain[a, i] * noise[i, j] * gain[b, j]
            out_covariance[a, b] = total
    return True


def found_intensity(
    positions: FloatArray,
    covariances: FloatArray,
    probability: FloatArray,
    centre_probability: FloatArray,
    measurements: MeasurementSet,
    pose: Pose,
    odds: bool = True,
) -> FloatArray:
    """Return kappa (f, m), the intensity of detections that found targets cause.

    kappa = pi N(z; g(x), R + H P H^T), a soft gate: it is added to C(z), so that a detection of a
    found target gives little mass to anything else.

    Parameters
    ----------
    positions, covariances : (f, d), (f, d, d) arrays
        Of the found targets, metres.
    probability : (f,) array
        pi at the found targets.
    centre_probability : (m,) array
        pi where the detections point at.
    odds : bool
        Whether pi is replaced by pi / (1 - pi): a found target exists, so the alternative to its
        having caused the detection is that it was missed.
    """
    kappa = np.zeros((len(positions), len(measurements)))
    if kappa.size:
        _intensity(
            positions,
            covariances,
            probability,
            centre_probability,
            pose.position,
            measurements.values,
            measurements.cartesian,
            measurements.centres,
            measurements.roots,
            measurements.volume,
            odds,
            kappa,
        )
    return kappa


@njit(cache=True, error_model='numpy')
def _exclude(kappa, other, out):  # type: ignore[no-untyped-def]
    targets, number = kappa.shape
    total = other.copy()
    for f in range(targets):
        for m in range(number):
            total[m] += kappa[f, m]
    for f in range(targets):
        best = 0
        most = -1.0
        for m in range(number):
            share = kappa[f, m] / total[m] if total[m] > 0.0 else 0.0
            if share > most:
                most = share
                best = m
        for m in range(number):
            out[f, m] = kappa[f, m] if m == best else kappa[f, m] * (1.0 - most)


def exclusive(kappa: FloatArray, other: FloatArray) -> FloatArray:
    """Return kappa (f, m) with each found target having caused one detection at most.

    Where a found target surely caused one detection of a scan it cannot explain another one.

    Parameters
    ----------
    other : (m,) array
        Intensity of what else could have caused each detection.
    """
    if kappa.shape[1] < 2:
        return kappa
    out = np.empty_like(kappa)
    _exclude(kappa, other, out)
    return out


def refine(
    position: FloatArray,
    covariance: FloatArray,
    measurements: MeasurementSet,
    index: int,
    pose: Pose,
) -> tuple[FloatArray, FloatArray]:
    """Return position and covariance of a found target after one of its detections.

    They are unchanged where the detection cannot be used.
    """
    new_position = np.empty_like(position)
    new_covariance = np.empty_like(covariance)
    done = _update(
        position,
        covariance,
        pose.position,
        measurements.values[index],
        measurements.cartesian[index],
        measurements.centres[index],
        measurements.roots[index],
        measurements.information[index],
        new_position,
        new_covariance,
    )
    return (new_position, new_covariance) if done else (position, covariance)


def remove_measurements(
    centres: FloatArray, positions: FloatArray, distance: float, every: bool
) -> NDArray[np.bool_]:
    """Return which of m detections stay once found targets took theirs.

    Parameters
    ----------
    centres : (m, d) array
        g^-1(z), metres.
    positions : (f, d) array
        Found targets, metres.
    distance : float
        T_z, metres.
    every : bool
        Whether all detections within T_z of a found target go (003, algorithm 1), or only the
        closest one to each found target (000, section 3.3; 001, algorithm 1).
    """
    keep = np.ones(len(centres), np.bool_)
    for position in positions:
        apart = np.sqrt(((centres - position) ** 2).sum(axis=1))
        near = keep & (apart <= distance)
        if not near.any():
            continue
        if every:
            keep &= ~near
        else:
            keep[int(np.argmin(np.where(near, apart, np.inf)))] = False
    return keep
