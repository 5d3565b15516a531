"""Births of particles (000, section 3.2; 001, (A1); 003) and resampling."""

import math
from collections.abc import Sequence

import numpy as np
from numba import njit

from maasi_filter.arrays import FloatArray, IntArray
from maasi_filter.geometry.area import Area
from maasi_filter.measurement_check import CheckedMeasurement


def measurement_births(
    member: CheckedMeasurement,
    before: Sequence[CheckedMeasurement],
    area: Area,
    number: int,
    generator: np.random.Generator,
) -> tuple[FloatArray, FloatArray]:
    """Return J births at each of m measurements, x = g^-1(z + N(0, R)), (m J, d), and b (m, J).

    Their intensity is N0 / V times the prior. Divided by the density of the draw and multiplied by
    the probability that robots `before` missed them, b = (N0 / V) pi(x, q) |dx/dz|
    prod(1 - pi_before) / J, where |dx/dz| = r in 2D and r^2 cos(elevation) in 3D; 0 outside E.
    b / C(z) is the posterior weight. A birth counts for its own measurement only: its b sum to
    <psi_z, Y>.
    """
    sensor, pose = member.sensor, member.pose
    count, d = member.values.shape
    noise = generator.standard_normal((count, number, d)) @ np.linalg.cholesky(sensor.covariance).T
    z = (member.values[:, None, :] + noise).reshape(-1, d)
    particles = sensor.measurement.inverse(z, pose)
    # Exclude draws with negative range, or elevation beyond +-90 degrees.
    level = z[:, 0] * (np.cos(z[:, 2]) if d == 3 else 1.0)
    jacobian = level * z[:, 0] if d == 3 else level
    inside = (z[:, 0] > 0.0) & (level > 0.0)
    for coordinate, (low, high) in zip(particles.T, area.bounds):
        inside &= (coordinate >= low) & (coordinate <= high)
    intensity = (area.expected_targets / area.volume / number) * jacobian
    intensity *= area.density(particles)
    intensity *= sensor.detection.probability(particles, pose)
    for other in before:
        intensity *= 1.0 - other.sensor.detection.probability(particles, other.pose)
    return particles, np.where(inside, intensity, 0.0).reshape(count, number)


def uniform_births(
    area: Area, expected: float, number: int, generator: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Return uniform births: particles (J, d) and weights Y V / J (001, (A1)), times the prior."""
    low, high = area.bounds.T
    particles = low + (high - low) * generator.random((number, len(low)))
    share = float(np.prod(high - low)) / area.volume
    return particles, expected / number * share * area.density(particles)


def gaussian_births(
    centres: FloatArray,
    spread: FloatArray,
    area: Area,
    expected: float,
    number: int,
    generator: np.random.Generator,
) -> tuple[FloatArray, FloatArray]:
    """Return births from one Gaussian over all measured positions (003, section 3.3).

    Weights are Y / (J p(x)) times the prior, with the Gaussian density p; draws outside the bounds
    are dropped. Unlike in the paper, the noise covariance `spread` is added to the empirical one,
    which is singular for few measurements.
    """
    d = area.dimension
    mean = centres.mean(axis=0)
    offset = centres - mean
    root = np.linalg.cholesky(offset.T @ offset / len(centres) + spread)
    noise = generator.standard_normal((number, d))
    particles = mean + noise @ root.T
    log_density = (
        -0.5 * (noise * noise).sum(axis=1)
        - 0.5 * d * math.log(2.0 * math.pi)
        - np.log(np.diagonal(root)).sum()
    )
    # Bound the weight of a draw far out in the tails by the total birth mass.
    weights = np.minimum(expected / area.volume / number * np.exp(-log_density), expected)
    low, high = area.bounds.T
    inside = ((particles >= low) & (particles <= high)).all(axis=1)
    particles = particles[inside]
    return particles, weights[inside] * area.density(particles)


def noise_in_space(member: CheckedMeasurement) -> FloatArray:
    """Return the mean covariance of the detections' noise in map coordinates [m^2]."""
    model, pose = member.sensor.measurement, member.pose
    inverse = np.linalg.pinv(model.jacobian(model.inverse(member.values, pose), pose))
    spreads = inverse @ member.sensor.covariance @ inverse.transpose(0, 2, 1)
    return np.asarray(spreads.mean(axis=0))


@njit(cache=True, error_model='numpy')
def _drawn(weights, gaps):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    cumulative, points = np.cumsum(weights), np.cumsum(gaps)
    scale = cumulative[-1] / points[-1]
    cumulative[-1] = np.inf
    index = np.empty(len(gaps) - 1, np.int64)
    i = j = 0
    # Branchless: a branch would be mispredicted half of the time.
    while i < len(index):
        index[i] = j
        below = np.int64(cumulative[j] <= points[i] * scale)
        j += below
        i += 1 - below
    return index


def resample(weights: FloatArray, number: int, generator: np.random.Generator) -> IntArray:
    """Return increasing indices (number,) of particles, drawn with replacement by weight."""
    # Uniform points in order, from exponential gaps.
    return np.asarray(_drawn(weights, generator.standard_exponential(number + 1)))


@njit(cache=True, error_model='numpy')
def _moved(particles, index, noise, bounds):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    moved = np.empty((len(index), particles.shape[1]))
    copies = 0
    for i in range(len(index)):
        copy = i > 0 and index[i] == index[i - 1]
        for a in range(particles.shape[1]):
            coordinate = particles[index[i], a] + (noise[copies, a] if copy else 0.0)
            moved[i, a] = min(max(coordinate, bounds[a, 0]), bounds[a, 1]) if copy else coordinate
        copies += copy
    return moved


def jittered(
    particles: FloatArray,
    index: IntArray,
    deviation: float,
    bounds: FloatArray,
    generator: np.random.Generator,
) -> FloatArray:
    """Return resampled particles (number, d) with copies moved apart; not in the papers."""
    copies = np.count_nonzero(index[1:] == index[:-1])
    noise = deviation * generator.standard_normal((copies, particles.shape[1]))
    return np.asarray(_moved(particles, index, noise, bounds))
