"""Births: particles for targets that nothing represents yet."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from maasi_filter.exploration import Exploration, interpolate_at
from maasi_filter.ic_phd.phd import MeasurementSet
from maasi_filter.models.detection import DetectionModel, probabilities
from maasi_filter.models.pose import Pose
from maasi_filter.vector_math import sines

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
# A place never counts as seen beyond doubt: the model of the sensor is not that good.
LEAST_UNEXPLORED = 1e-6


@njit(cache=True, error_model='numpy')
def _draw(  # type: ignore[no-untyped-def]
    values,
    cartesian,
    centres,
    roots,
    volume,
    sensor_position,
    bounds,
    noise,
    starts,
    particles,
    jacobian,
    inside,
):
    """Fill birth particles (n, d), and |dx/dz| at each, 0 where it is outside the bounds."""
    d = noise.shape[1]
    most = 1
    for m in range(values.shape[0]):
        most = max(most, starts[m + 1] - starts[m])
    z = np.empty((3, most))
    sine = np.empty((2, most))
    cosine = np.ones((2, most))
    sine[1] = 0.0
    for m in range(values.shape[0]):
        first = starts[m]
        number = starts[m + 1] - first
        root = roots[m]
        origin = centres[m] if cartesian[m] else values[m]
        drawn = noise[first : first + number]
        for a in range(d):
            value = z[a]
            for j in range(number):
                value[j] = origin[a]
            for b in range(a + 1):
                factor = root[a, b]
                for j in range(number):
                    value[j] += factor * drawn[j, b]
        out = particles[first : first + number]
        size = jacobian[first : first + number]
        if cartesian[m]:
            for j in range(number):
                for a in range(d):
                    out[j, a] = z[a, j]
                size[j] = volume[m]
        else:
            sines(z[1], number, sine[0], cosine[0])
            if d == 3:
                sines(z[2], number, sine[1], cosine[1])
            for j in range(number):
                level = z[0, j] * cosine[1, j]
                out[j, 0] = sensor_position[0] + level * cosine[0, j]
                out[j, 1] = sensor_position[1] + level * sine[0, j]
                size[j] = z[0, j]
                if d == 3:
                    out[j, 2] = sensor_position[2] + z[0, j] * sine[1, j]
                    size[j] *= level
                # Beyond straight up no measurement can point, nor behind.
                if not (z[0, j] > 0.0 and level > 0.0):
                    size[j] = 0.0
        for a in range(d):
            lower = bounds[a, 0]
            upper = bounds[a, 1]
            for j in range(number):
                size[j] = size[j] if lower <= out[j, a] <= upper else 0.0
        inside[m] = (size > 0.0).any()


@njit(cache=True, error_model='numpy')
def _weigh(  # type: ignore[no-untyped-def]
    particles, starts, jacobian, probability, prior, unexplored, values, lower, step, least, totals
):
    """Replace |dx/dz| by the intensity b of each birth, and fill its sums."""
    d = particles.shape[1]
    for m in range(totals.shape[0]):
        totals[m] = 0.0
        births = starts[m + 1] - starts[m]
        for j in range(starts[m], starts[m + 1]):
            weight = 0.0
            if jacobian[j] > 0.0:
                weight = prior * probability[j] * jacobian[j] / births
                if unexplored:
                    z = particles[j, 2] if d == 3 else 0.0
                    unseen = interpolate_at(
                        values, lower, step, particles[j, 0], particles[j, 1], z
                    )
                    weight *= max(unseen, least)
            jacobian[j] = weight
            totals[m] += weight


@njit(cache=True, error_model='numpy')
def _starts(number, starts):  # type: ignore[no-untyped-def]
    """Fill where each measurement's births start, and the end; return the end."""
    starts[0] = 0
    for m in range(number.shape[0]):
        starts[m + 1] = starts[m] + number[m]
    return starts[-1]


@njit(cache=True, error_model='numpy')
def _bear(  # type: ignore[no-untyped-def]
    values,
    cartesian,
    centres,
    roots,
    volume,
    sensor_position,
    bounds,
    noise,
    starts,
    particles,
    jacobian,
    inside,
    kind,
    parameters,
    yaw,
    prior,
    unexplored,
    grid,
    lower,
    step,
    least,
    totals,
):
    """Do all of it in one call, with a detection model's kernel."""
    _draw(
        values,
        cartesian,
        centres,
        roots,
        volume,
        sensor_position,
        bounds,
        noise,
        starts,
        particles,
        jacobian,
        inside,
    )
    probability = probabilities(kind, parameters, particles, sensor_position, yaw)
    _weigh(
        particles,
        starts,
        jacobian,
        probability,
        prior,
        unexplored,
        grid,
        lower,
        step,
        least,
        totals,
    )


@dataclass
class MeasurementBirths:
    """Births at each of m measurements.

    Parameters
    ----------
    particles : (n, d) array
        Metres; those of a measurement lie together.
    intensity : (n,) array
        b: predicted intensity times psi_z over the density of the draw, divided by J. Its sum
        belongs to C(z), and b / C(z) is the posterior weight.
    starts : (m + 1,) int array
        Where each measurement's births start, and the end.
    totals : (m,) array
        The sums.
    inside : (m,) bool array
        Whether any draw is inside the environment.
    """

    particles: FloatArray
    intensity: FloatArray
    starts: IntArray
    totals: FloatArray
    inside: NDArray[np.bool_]


def measurement_births(
    measurements: MeasurementSet,
    pose: Pose,
    detection: DetectionModel,
    exploration: Exploration,
    expected_targets: float,
    number: int | IntArray,
    generator: np.random.Generator,
    unexplored: bool = True,
) -> MeasurementBirths:
    """Draw births for each measurement from the prior of unseen targets.

    Draws are x = g^-1(z + N(0, R)) inside E; the intensity of targets not seen so far is
    (N0 / V) e(x), or N0 / V if not `unexplored`. b = (N0 / V) e(x) pi(x, q) |dx/dz| / J, with
    |dx/dz| = r in 2D and r^2 |cos eta| in 3D. A birth counts for its own measurement only.

    Parameters
    ----------
    number : int or (m,) int array
        J, for each measurement.
    """
    d = measurements.values.shape[1]
    count = len(measurements)
    bounds = exploration.bounds
    starts = np.empty(count + 1, np.int64)
    total = _starts(np.full(count, number) if isinstance(number, int) else number, starts)
    noise = generator.standard_normal((total, d))
    particles = np.empty((total, d))
    jacobian = np.empty(total)
    inside = np.empty(count, np.bool_)
    totals = np.empty(count)
    drawn = (
        measurements.values,
        measurements.cartesian,
        measurements.centres,
        measurements.roots,
        measurements.volume,
        pose.position,
        bounds,
        noise,
        starts,
        particles,
        jacobian,
        inside,
    )
    prior = expected_targets / exploration.volume
    weighed = (prior, unexplored, *exploration.kernel(), LEAST_UNEXPLORED, totals)
    kernel = detection.kernel()
    if kernel is None:
        _draw(*drawn)
        _weigh(particles, starts, jacobian, detection.probability(particles, pose), *weighed)
    else:
        _bear(*drawn, *kernel, pose.yaw, *weighed)
    return MeasurementBirths(particles, jacobian, starts, totals, inside)


@njit(cache=True, error_model='numpy')
def _worth(  # type: ignore[no-untyped-def]
    values, cartesian, volume, covariances, log_own, prior, per_target, least, most, number
):
    d = values.shape[1]
    for m in range(values.shape[0]):
        square = values[m, 0] * values[m, 0] + covariances[m, 0, 0]
        size = square if d == 3 else math.sqrt(square)
        if cartesian[m]:
            size = volume[m]
        ratio = math.exp(min(log_own[m] - math.log(prior * size), 700.0))
        number[m] = min(max(math.ceil(per_target / (1.0 + ratio)), least), most)


def births_worth_drawing(
    measurements: MeasurementSet,
    log_own: FloatArray,
    expected_targets: float,
    volume: float,
    per_target: int,
    least: int,
    most: int,
) -> IntArray:
    """Return how many births to draw for each measurement (m,).

    As many as there would be particles for the share of the detection that births explain if
    nothing around it were explored and nothing missed. Where particles explain a detection well
    the sum of b is next to nothing in C(z), and a few draws are enough for it.

    Parameters
    ----------
    log_own : (m,) array
        Logarithm of what particles add to C(z).
    expected_targets, volume : float
        N0, and V of the environment.
    per_target : int
        Particles for each expected target.
    least, most : int
        Bounds of the result.
    """
    number = np.empty(len(measurements), np.int64)
    _worth(
        measurements.values,
        measurements.cartesian,
        measurements.volume,
        measurements.covariances,
        log_own,
        expected_targets / volume,
        float(per_target),
        min(least, most),
        most,
        number,
    )
    return number


@njit(cache=True, error_model='numpy')
def _worth_keeping(totals, scale, starts, per_target, least_mass, mass, number):  # type: ignore[no-untyped-def]
    total = 0
    for m in range(totals.shape[0]):
        mass[m] = totals[m] * scale[m]
        number[m] = 0
        if mass[m] > least_mass:
            wanted = min(math.ceil(per_target * mass[m]), starts[m + 1] - starts[m])
            number[m] = wanted
        total += number[m]
    return total


def births_worth_keeping(
    births: MeasurementBirths, scale: FloatArray, per_target: int, least_mass: float
) -> tuple[FloatArray, IntArray, int]:
    """Return the posterior mass of each measurement's births, how many to keep, and their sum.

    Parameters
    ----------
    scale : (m,) array
        1 / C(z) of each measurement.
    per_target : int
        Particles for each expected target; never more than were drawn.
    least_mass : float
        Births of a smaller posterior mass are left out.
    """
    mass = np.empty(len(scale))
    number = np.empty(len(scale), np.int64)
    total = _worth_keeping(
        births.totals, scale, births.starts, float(per_target), least_mass, mass, number
    )
    return mass, number, total


@njit(cache=True, error_model='numpy')
def _thin(  # type: ignore[no-untyped-def]
    particles, intensity, starts, mass, number, offset, first_group, out, weights, group
):
    """Fill systematically chosen births of each measurement, of equal weights."""
    d = particles.shape[1]
    filled = 0
    for m in range(number.shape[0]):
        wanted = number[m]
        if wanted == 0:
            continue
        total = 0.0
        for j in range(starts[m], starts[m + 1]):
            total += intensity[j]
        step = total / wanted
        point = offset[m] * step
        cumulative = 0.0
        placed = 0
        for j in range(starts[m], starts[m + 1]):
            cumulative += intensity[j]
            while placed < wanted and (point < cumulative or j == starts[m + 1] - 1):
                for a in range(d):
                    out[filled, a] = particles[j, a]
                weights[filled] = mass[m] / wanted
                group[filled] = first_group + m
                filled += 1
                placed += 1
                point += step


def thin_births(
    births: MeasurementBirths,
    mass: FloatArray,
    number: IntArray,
    total: int,
    first_group: int,
    generator: np.random.Generator,
) -> tuple[FloatArray, FloatArray, IntArray]:
    """Return the births worth keeping: particles (n, d), weights (n,) and groups (n,).

    What a detection leaves to its births decides how many particles they get; they are chosen by
    systematic resampling.

    Parameters
    ----------
    mass : (m,) array
        Posterior mass of each measurement's births.
    number : (m,) int array
        Particles for each.
    total : int
        Their sum.
    first_group : int
        Group of the first measurement's births; the next ones have the next numbers.
    """
    out = np.empty((total, births.particles.shape[1]))
    weights = np.empty(total)
    group = np.empty(total, np.int64)
    offset = generator.random(len(number))
    _thin(
        births.particles,
        births.intensity,
        births.starts,
        mass,
        number,
        offset,
        first_group,
        out,
        weights,
        group,
    )
    return out, weights, group


def uniform_births(
    bounds: FloatArray, expected: float, number: int, generator: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Return births anywhere: particles (n, d) and weights Y V / J (001, eq. (A1)).

    Parameters
    ----------
    expected : float
        Y V, targets expected to appear in the whole environment.
    """
    size = bounds[:, 1] - bounds[:, 0]
    particles = bounds[:, 0] + size * generator.random((number, len(bounds)))
    return particles, np.full(number, expected / number)


def gaussian_births(
    centres: FloatArray,
    spread: FloatArray,
    bounds: FloatArray,
    expected: float,
    number: int,
    generator: np.random.Generator,
) -> tuple[FloatArray, FloatArray]:
    """Return births from one Gaussian over all measured positions (003, section 3.3).

    Weights are Y / (J p(x)) with p the Gaussian density; draws outside the bounds are left out.

    Parameters
    ----------
    centres : (m, d) array
        g^-1(z), metres.
    spread : (d, d) array
        Covariance of the noise at the measurements, added to the empirical one, which is singular
        for few measurements: a deviation from the paper.
    expected : float
        Y V, targets expected to appear in the whole environment.
    """
    d = len(bounds)
    mean = centres.mean(axis=0)
    offset = centres - mean
    covariance = offset.T @ offset / len(centres) + spread
    root = np.linalg.cholesky(covariance)
    noise = generator.standard_normal((number, d))
    particles = mean + noise @ root.T
    log_density = (
        -0.5 * (noise * noise).sum(axis=1)
        - 0.5 * d * math.log(2.0 * math.pi)
        - np.log(np.diagonal(root)).sum()
    )
    volume = float(np.prod(bounds[:, 1] - bounds[:, 0]))
    # Far out in the tails one draw may not stand for more than everything that is born.
    weights = np.minimum(expected / volume / number * np.exp(-log_density), expected)
    inside = ((particles >= bounds[:, 0]) & (particles <= bounds[:, 1])).all(axis=1)
    return particles[inside], weights[inside]
