"""Clusters of particles by K-means, the potential targets (000, section 3.3)."""

import numpy as np
from numba import njit

from maasi_filter.arrays import FloatArray, IntArray
from maasi_filter.records import Cluster

PART = 128  # particles per block; after resampling most blocks are small boxes
# Columns of a covariance's entries in sums of products.
SQUARES = np.array([[1, 2, 4], [2, 3, 5], [4, 5, 6]])


@njit(cache=True, error_model='numpy')
def _assign(particles, low, high, centres, label, owner, changed):  # type: ignore[no-untyped-def]
    """Fill nearest centres, pruned by boxes (Kanungo et al. 2002); return which centres changed."""
    d = particles.shape[1]
    least, nearest, gaps = np.empty(PART), np.empty(PART), np.empty(len(centres))
    changed[:] = False
    for part in range(len(owner)):
        reach = np.inf
        for c in range(len(centres)):
            gaps[c] = farthest = 0.0
            for a in range(d):
                below = low[part, a] - centres[c, a]
                above = centres[c, a] - high[part, a]
                gaps[c] += max(below, above, 0.0) ** 2
                farthest += min(below, above) ** 2
            reach = min(reach, farthest)
        one, count = -1, 0
        for c in range(len(centres)):
            if gaps[c] <= reach:
                one, count = c, count + 1
        if count == 1 and one == owner[part]:
            continue
        owner[part] = one if count == 1 else -1
        first = part * PART
        number = min(PART, len(particles) - first)
        some = particles[first : first + number]
        least[:] = np.inf
        for c in range(len(centres)):
            for i in range(number if gaps[c] <= reach else 0):
                x = some[i, 0] - centres[c, 0]
                y = some[i, 1] - centres[c, 1]
                z = some[i, 2] - centres[c, 2] if d == 3 else 0.0
                square = x * x + y * y + z * z
                nearest[i] = float(c) if square < least[i] else nearest[i]
                least[i] = min(square, least[i])
        for i in range(number):
            before, now = label[first + i], np.int64(nearest[i])
            if before != now:
                changed[before] = changed[now] = True
                label[first + i] = now


@njit(cache=True, error_model='numpy')
def _move_centres(particles, weights, label, owner, changed, centres):  # type: ignore[no-untyped-def]
    mass, sums = np.zeros(len(centres)), np.zeros(centres.shape)
    for part in range(len(owner)):
        if owner[part] < 0 or changed[owner[part]]:
            for i in range(part * PART, min((part + 1) * PART, len(label))):
                g = label[i]
                if changed[g]:
                    mass[g] += weights[i]
                    for a in range(particles.shape[1]):
                        sums[g, a] += weights[i] * particles[i, a]
    for c in range(len(centres)):
        for a in range(particles.shape[1] if mass[c] > 0.0 else 0):
            centres[c, a] = sums[c, a] / mass[c]


@njit(cache=True, error_model='numpy')
def _iterate(particles, weights, low, high, centres, iterations):  # type: ignore[no-untyped-def]
    """Move the centres until no particle changes its cluster; return the label of each particle."""
    label, owner = np.full(len(particles), -1), np.full(len(low), -1)
    # The last entry belongs to label -1.
    changed = np.empty(len(centres) + 1, np.bool_)
    for _ in range(iterations):
        _assign(particles, low, high, centres, label, owner, changed)
        if not changed.any():
            break
        _move_centres(particles, weights, label, owner, changed, centres)
    return label


@njit(cache=True, error_model='numpy')
def _add_moments(particles, weights, label, means, sums):  # type: ignore[no-untyped-def]
    """Add mass and weighted products of offsets from the means, by label, to (k, 7)."""
    for i in range(len(particles)):
        g = label[i]
        x = particles[i, 0] - means[g, 0]
        y = particles[i, 1] - means[g, 1]
        z = particles[i, 2] - means[g, 2] if particles.shape[1] == 3 else 0.0
        for column, value in enumerate((1.0, x * x, y * x, y * y, z * x, z * y, z * z)):
            sums[g, column] += weights[i] * value


@njit(cache=True, error_model='numpy')
def _keep_least(particles, centre, least):  # type: ignore[no-untyped-def]
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
    """Return starting centres: the given ones first, others by K-means++."""
    centres = start[:number]
    least = np.full(len(particles), np.inf)
    for centre in centres if len(centres) < number else ():
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
    """Return labels (n,) and centres (k, d) of weighted K-means from `start`, or from K-means++."""
    centres = _starting_centres(particles, weights, number, start, generator)
    starts = np.arange(0, len(particles), PART)
    low, high = np.minimum.reduceat(particles, starts), np.maximum.reduceat(particles, starts)
    return _iterate(particles, weights, low, high, centres, iterations), centres


def clusters_of(
    particles: FloatArray, weights: FloatArray, label: IntArray, means: FloatArray
) -> dict[int, Cluster]:
    """Return the clusters with mass, by label; their radius is the weighted rms distance."""
    sums, d = np.zeros((len(means), 7)), means.shape[1]
    _add_moments(particles, weights, label, means, sums)
    mass = sums[:, 0]
    covariances = sums.take(SQUARES[:d, :d], axis=1) / np.maximum(mass, 1e-300)[:, None, None]
    radii = np.sqrt(covariances.trace(axis1=1, axis2=2))
    return {
        g: Cluster(means[g], covariances[g], float(radii[g]), float(mass[g]))
        for g in np.flatnonzero(mass > 0.0).tolist()
    }
