"""Births: particles for targets that nothing represents yet."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from maasi_filter.detection_model import DetectionModel
from maasi_filter.exploration import Exploration, interpolate_at
from maasi_filter.phd import MeasurementSet
from maasi_filter.pose import Pose

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
# A place never counts as seen beyond doubt: the model of the sensor is not that good.
LEAST_UNEXPLORED = 1e-6


@njit(cache=True, error_model='numpy')
def _draw(  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    values, cartesian, centres, roots, volume, sensor_position, bounds, noise, particles, jacobian
):
    """Fill birth particles (m, J, d), and |dx/dz| at each, 0 where it is outside the bounds."""
    number, births, d = noise.shape
    z = np.empty(d)
    for m in range(number):
        for j in range(births):
            for a in range(d):
                total = 0.0
                for b in range(a + 1):
                    total += roots[m, a, b] * noise[m, j, b]
                z[a] = total
            if cartesian[m]:
                for a in range(d):
                    particles[m, j, a] = centres[m, a] + z[a]
                size = volume[m]
            else:
                for a in range(d):
                    z[a] += values[m, a]
                level = z[0]
                size = abs(z[0])
                if d == 3:
                    cosine = math.cos(z[2])
                    level *= cosine
                    size *= abs(level)
                    particles[m, j, 2] = sensor_position[2] + z[0] * math.sin(z[2])
                    if cosine < 0.0:
                        # Beyond straight up no measurement can point.
                        size = 0.0
                particles[m, j, 0] = sensor_position[0] + level * math.cos(z[1])
                particles[m, j, 1] = sensor_position[1] + level * math.sin(z[1])
                if z[0] <= 0.0:
                    size = 0.0
            for a in range(d):
                if not bounds[a, 0] <= particles[m, j, a] <= bounds[a, 1]:
                    size = 0.0
            jacobian[m, j] = size


@njit(cache=True, error_model='numpy')
def _weigh(  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    particles, jacobian, probability, prior, unexplored, values, lower, step, least
):
    number, births, d = particles.shape
    totals = np.zeros(number)
    for m in range(number):
        for j in range(births):
            weight = 0.0
            if jacobian[m, j] > 0.0:
                weight = prior * probability[m, j] * jacobian[m, j] / births
                if unexplored:
                    z = particles[m, j, 2] if d == 3 else 0.0
                    unseen = interpolate_at(
                        values, lower, step, particles[m, j, 0], particles[m, j, 1], z
                    )
                    weight *= max(unseen, least)
            jacobian[m, j] = weight
            totals[m] += weight
    return totals


@dataclass
class MeasurementBirths:
    """Births at each of m measurements.

    Parameters
    ----------
    particles : (m, J, d) array
        Metres.
    intensity : (m, J) array
        b: predicted intensity times psi_z over the density of the draw, divided by J. Its sum
        over j belongs to C(z), and b / C(z) is the posterior weight.
    totals : (m,) array
        The sum.
    inside : (m,) bool array
        Whether any draw is inside the environment.
    """

    particles: FloatArray
    intensity: FloatArray
    totals: FloatArray
    inside: NDArray[np.bool_]


def measurement_births(
    measurements: MeasurementSet,
    pose: Pose,
    detection: DetectionModel,
    exploration: Exploration,
    expected_targets: float,
    number: int,
    generator: np.random.Generator,
    unexplored: bool = True,
) -> MeasurementBirths:
    """Draw `number` births for each measurement from the prior of unseen targets.

    Draws are x = g^-1(z + N(0, R)) inside E; the intensity of targets not seen so far is
    (N0 / V) e(x), or N0 / V if not `unexplored`. b = (N0 / V) e(x) pi(x, q) |dx/dz| / J, with
    |dx/dz| = r in 2D and r^2 |cos eta| in 3D. A birth counts for its own measurement only.
    """
    d = measurements.values.shape[1]
    count = len(measurements)
    bounds = exploration.bounds
    noise = generator.standard_normal((count, number, d))
    particles = np.empty((count, number, d))
    jacobian = np.empty((count, number))
    _draw(
        measurements.values,
        measurements.cartesian,
        measurements.centres,
        measurements.roots,
        measurements.volume,
        pose.position,
        bounds,
        noise,
        particles,
        jacobian,
    )
    inside: NDArray[np.bool_] = np.any(jacobian > 0.0, axis=1)
    probability = detection.probability(particles.reshape(-1, d), pose).reshape(count, number)
    values, lower, step = exploration.kernel()
    prior = expected_targets / float(np.prod(bounds[:, 1] - bounds[:, 0]))
    totals = _weigh(
        particles,
        jacobian,
        probability,
        prior,
        unexplored,
        values,
        lower,
        step,
        LEAST_UNEXPLORED,
    )
    return MeasurementBirths(particles, jacobian, totals, inside)


@njit(cache=True, error_model='numpy')
def _thin(  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    particles, intensity, mass, number, offset, first_group, out, weights, group
):
    """Fill systematically chosen births of each measurement, of equal weights."""
    births, d = particles.shape[1], particles.shape[2]
    filled = 0
    for m in range(particles.shape[0]):
        wanted = number[m]
        if wanted == 0:
            continue
        total = 0.0
        for j in range(births):
            total += intensity[m, j]
        step = total / wanted
        point = offset[m] * step
        cumulative = 0.0
        placed = 0
        for j in range(births):
            cumulative += intensity[m, j]
            while placed < wanted and (point < cumulative or j == births - 1):
                for a in range(d):
                    out[filled, a] = particles[m, j, a]
                weights[filled] = mass[m] / wanted
                group[filled] = first_group + m
                filled += 1
                placed += 1
                point += step


def thin_births(
    births: MeasurementBirths,
    mass: FloatArray,
    number: IntArray,
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
    first_group : int
        Group of the first measurement's births; the next ones have the next numbers.
    """
    total = int(number.sum())
    out = np.empty((total, births.particles.shape[2]))
    weights = np.empty(total)
    group = np.empty(total, np.int64)
    offset = generator.random(len(number))
    _thin(
        births.particles,
        births.intensity,
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
