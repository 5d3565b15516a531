"""Births: where new targets may be that detections point at."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from maasi_filter.arrays import BoolArray, FloatArray
from maasi_filter.pmb.density import Density, fill_moments
from maasi_filter.pmb.factors import (
    FIRST,
    LEAST_UNEXPLORED,
    MISS,
    MOST_PROBABLE,
    SCALE,
    TERMS,
    Scan,
)
from maasi_filter.unexplored_map import UnexploredMap

# Fewest effective draws that stand for a density.
LEAST_SUPPORT = 10.0


@njit(cache=True, error_model='numpy')
def _draw(  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    origins, cartesian, roots, volume, sensor_position, bounds, particles, jacobian
):
    """Turn standard normal numbers (m, n, d) into positions, and fill |dx/dz| at each (m, n).

    It is 0 outside the bounds, behind the sensor and beyond straight up: nothing points there.
    """
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
                jacobian[m, i] = volume[m]
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


@dataclass(frozen=True)
class Births:
    """Draws of the places that each of m detections points at.

    Parameters
    ----------
    means, covariances : (m, d) and (m, d, d) arrays
        Of the draws.
    """

    particles: FloatArray  # (m, n, d): x = g^-1(z + noise), metres
    #: (m, n): pi(x) |dx/dz|, 0 outside the bounds: with it a mean over the draws is an
    #: integral of pi(x) g(z | x).
    volume: FloatArray
    weights: FloatArray  # (m, n): The same times e(x)
    means: FloatArray
    covariances: FloatArray
    #: (m,): lambda_j = (N0 / V) int e pi g(z_j | x) dx, of detections of targets not seen
    #: before.
    intensity: FloatArray


def draw_births(
    scan: Scan,
    exploration: UnexploredMap,
    expected_targets: float,
    number: int,
    generator: np.random.Generator,
) -> Births:
    """Return births of a scan, before e is updated with it (Williams 2015)."""
    count, d = scan.origins.shape
    particles = generator.standard_normal((count, number, d))
    volume = np.empty((count, number))
    _draw(
        scan.origins,
        scan.cartesian,
        scan.roots,
        scan.volume,
        scan.pose.position,
        exploration.bounds,
        particles,
        volume,
    )
    flat = particles.reshape(-1, d)
    probability = np.minimum(scan.detection.probability(flat, scan.pose), MOST_PROBABLE)
    volume *= probability.reshape(count, number)
    unseen = np.maximum(exploration.at(flat), LEAST_UNEXPLORED).reshape(count, number)
    weights = unseen * volume
    intensity = expected_targets / exploration.volume * weights.mean(axis=1)
    means, covariances = np.empty((count, d)), np.empty((count, d, d))
    even = np.full(number, 1.0 / number)
    for draws, mean, covariance in zip(particles, means, covariances):
        fill_moments(draws, even, mean, covariance)
    return Births(particles, volume, weights, means, covariances, intensity)


def born(
    scan: Scan, births: Births, wanted: BoolArray, grid: FloatArray, frame: FloatArray
) -> list[tuple[int, Density]]:
    """Return the density e pi g_j of each detection that is wanted, by its number.

    A detection near or beyond the bounds has few draws inside the environment, and none is made.
    """
    total, squares = births.weights.sum(axis=1), np.square(births.weights).sum(axis=1)
    wanted = wanted & (np.square(total) > LEAST_SUPPORT * squares)
    if not wanted.any():
        return []
    grid = grid.copy()
    head = scan.head.copy()
    head[MISS], head[FIRST], head[TERMS] = 0.0, 0.0, 1.0
    densities = []
    for j in np.flatnonzero(wanted).tolist():
        terms = scan.terms[j : j + 1].copy()
        terms[0, SCALE] -= math.log(births.weights[j].mean())
        weights = births.weights[j] / total[j]
        density = Density(
            births.particles[j].copy(), weights, head[None].copy(), terms, grid, frame
        )
        densities.append((j, density))
    return densities
