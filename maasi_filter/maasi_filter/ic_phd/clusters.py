"""Clusters of particles by K-means: potential targets (000, section 3.3)."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from maasi_filter.arrays import FloatArray, IntArray
from maasi_filter.records import Cluster

# Particles that are compared with all centres at a time.
PART = 256


@njit(cache=True, error_model='numpy')
def _assign(particles, centres, label):  # type: ignore[no-untyped-def]
    """Fill the nearest centre of each particle; return how many changed."""
    d = particles.shape[1]
    least = np.empty(PART)
    nearest = np.empty(PART)
    changed = 0
    for first in range(0, len(particles), PART):
        number = min(PART, len(particles) - first)
        part = particles[first : first + number]
        least[:] = np.inf
        for c in range(len(centres)):
            for i in range(number):
                x = part[i, 0] - centres[c, 0]
                y = part[i, 1] - centres[c, 1]
                z = part[i, 2] - centres[c, 2] if d == 3 else 0.0
                square = x * x + y * y + z * z
                nearest[i] = float(c) if square < least[i] else nearest[i]
                least[i] = min(square, least[i])
        for i in range(number):
            if label[first + i] != np.int64(nearest[i]):
                label[first + i] = np.int64(nearest[i])
                changed += 1
    return changed


@njit(cache=True, error_model='numpy')
def _sum_by_label(particles, weights, label, mass, sums):  # type: ignore[no-untyped-def]
    """Fill mass (k,) and weighted sums (k, d) of the particles of each label."""
    mass[:] = 0.0
    sums[:] = 0.0
    for i in range(len(particles)):
        mass[label[i]] += weights[i]
        for a in range(particles.shape[1]):
            sums[label[i], a] += weights[i] * particles[i, a]


@njit(cache=True, error_model='numpy')
def _add_squares(particles, weights, label, means, covariances):  # type: ignore[no-untyped-def]
    """Add the weighted outer products of the offsets from the means to (k, d, d)."""
    d = particles.shape[1]
    for i in range(len(particles)):
        g = label[i]
        for a in range(d):
            for b in range(a + 1):
                offset = (particles[i, a] - means[g, a]) * (particles[i, b] - means[g, b])
                covariances[g, a, b] += weights[i] * offset
                covariances[g, b, a] = covariances[g, a, b]


@njit(cache=True, error_model='numpy')
def _keep_least(particles, centre, least):  # type: ignore[no-untyped-def]
    """Lower `least` (n,) to the squared distance from a centre where that is smaller."""
    d = particles.shape[1]
    for i in range(len(particles)):
        x = particles[i, 0] - centre[0]
        y = particles[i, 1] - centre[1]
        z = particles[i, 2] - centre[2] if d == 3 else 0.0
        least[i] = min(x * x + y * y + z * z, least[i])


def _starting_centres(
    particles: FloatArray,
    weights: FloatArray,
    number: int,
    start: FloatArray,
    generator: np.random.Generator,
) -> FloatArray:
    """Return starting centres: the given ones first, then K-means++."""
    centres = start[:number]
    least = np.full(len(particles), np.inf)
    for centre in centres:
        _keep_least(particles, centre, least)
    while len(centres) < number:
        chance = np.cumsum(weights * least if len(centres) else weights)
        if not chance[-1] > 0.0:
            break
        draw = generator.random() * chance[-1]
        pick = particles[min(int(np.searchsorted(chance, draw, 'right')), len(particles) - 1)]
        centres = np.concatenate([centres, pick[None]])
        _keep_least(particles, pick, least)
    return np.array(centres)


def kmeans(
    particles: FloatArray,
    weights: FloatArray,
    number: int,
    generator: np.random.Generator,
    start: FloatArray,
    iterations: int = 20,
) -> tuple[IntArray, FloatArray]:
    """Return labels (n,) and centres (k, d) of weighted K-means.

    `start` (s, d) are the centres of the step before; K-means++ adds what is missing of `number`.
    """
    centres = _starting_centres(particles, weights, number, start, generator)
    label = np.full(len(particles), -1, np.int64)
    mass = np.empty(len(centres))
    sums = np.empty_like(centres)
    for _ in range(iterations):
        if _assign(particles, centres, label) == 0:
            break
        _sum_by_label(particles, weights, label, mass, sums)
        # An empty cluster stays where it was.
        full = mass > 0.0
        centres[full] = sums[full] / mass[full, None]
    return label, centres


def clusters_of(
    particles: FloatArray, weights: FloatArray, label: IntArray, number: int
) -> dict[int, Cluster]:
    """Return the clusters that have mass, by label; the radius is the weighted rms distance."""
    d = particles.shape[1]
    mass, sums = np.empty(number), np.empty((number, d))
    _sum_by_label(particles, weights, label, mass, sums)
    means = sums / np.maximum(mass, 1e-300)[:, None]
    covariances = np.zeros((number, d, d))
    _add_squares(particles, weights, label, means, covariances)
    covariances /= np.maximum(mass, 1e-300)[:, None, None]
    return {
        g: Cluster(
            means[g], covariances[g], math.sqrt(float(np.trace(covariances[g]))), float(mass[g])
        )
        for g in np.flatnonzero(mass > 0.0).tolist()
    }
