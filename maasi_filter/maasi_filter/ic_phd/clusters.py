"""Clusters of particles: potential targets."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from maasi_filter.ic_phd.particles import group_moments

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass
class Cluster:
    """A potential target.

    Parameters
    ----------
    position : (d,) array
        Weighted mean, metres, frame `map`.
    covariance : (d, d) array
        Weighted covariance, square metres.
    radius : float
        Weighted root mean square distance from the mean (or the largest), metres.
    mass : float
        Expected number of targets in it.
    """

    position: FloatArray
    covariance: FloatArray
    radius: float
    mass: float


@njit(cache=True, error_model='numpy')
def _merge(mass, means, covariances, least_mass, least_distance):  # type: ignore[no-untyped-def]
    """Merge groups that are at one place, in place; return the order and number of what is left."""
    groups, d = means.shape
    order = np.arange(groups)
    # Heaviest first; there are few.
    for position in range(1, groups):
        g = order[position]
        other = position - 1
        while other >= 0 and mass[order[other]] < mass[g]:
            order[other + 1] = order[other]
            other -= 1
        order[other + 1] = g
    kept = 0
    for position in range(groups):
        g = order[position]
        if mass[g] <= 0.0:
            break
        merged = False
        for other in range(kept):
            h = order[other]
            square = 0.0
            for a in range(d):
                square += (means[g, a] - means[h, a]) ** 2
            trace = 0.0
            for a in range(d):
                trace += covariances[h, a, a]
            if square < max(trace, least_distance * least_distance):
                total = mass[g] + mass[h]
                ours = mass[g] / total
                theirs = mass[h] / total
                for a in range(d):
                    for b in range(d):
                        covariances[h, a, b] = (
                            theirs * covariances[h, a, b]
                            + ours * covariances[g, a, b]
                            + ours
                            * theirs
                            * (means[g, a] - means[h, a])
                            * (means[g, b] - means[h, b])
                        )
                for a in range(d):
                    means[h, a] = theirs * means[h, a] + ours * means[g, a]
                mass[h] = total
                merged = True
                break
        if not merged:
            order[kept] = g
            kept += 1
    count = 0
    for position in range(kept):
        if mass[order[position]] >= least_mass:
            order[count] = order[position]
            count += 1
    return order[:count]


def group_clusters(
    mass: FloatArray,
    means: FloatArray,
    covariances: FloatArray,
    least_mass: float,
    least_distance: float,
) -> list[Cluster]:
    """Return clusters from the moments of groups of particles, heaviest groups first.

    A group whose mean is within the radius of a heavier one, or within `least_distance` metres,
    is part of it: what is left of an earlier detection of the same target.

    Parameters
    ----------
    mass, means, covariances : (g,), (g, d), (g, d, d) arrays
        Of the groups.
    least_mass : float
        Lighter clusters are left out.
    """
    mass = mass.copy()
    means = means.copy()
    covariances = covariances.copy()
    order = _merge(mass, means, covariances, least_mass, least_distance)
    masses = mass.tolist()
    traces = covariances.trace(axis1=1, axis2=2).tolist()
    return [
        Cluster(means[g], covariances[g], math.sqrt(max(traces[g], 0.0)), masses[g])
        for g in order.tolist()
    ]


@njit(cache=True, error_model='numpy')
def _assign(particles, centres, label):  # type: ignore[no-untyped-def]
    """Fill the nearest centre of each particle; return how many changed."""
    changed = 0
    d = particles.shape[1]
    for i in range(particles.shape[0]):
        best = np.inf
        nearest = 0
        for c in range(centres.shape[0]):
            square = 0.0
            for a in range(d):
                square += (particles[i, a] - centres[c, a]) ** 2
            if square < best:
                best = square
                nearest = c
        if label[i] != nearest:
            label[i] = nearest
            changed += 1
    return changed


@njit(cache=True, error_model='numpy')
def _centre(particles, weights, label, centres):  # type: ignore[no-untyped-def]
    d = particles.shape[1]
    mass = np.zeros(centres.shape[0])
    sums = np.zeros_like(centres)
    for i in range(particles.shape[0]):
        mass[label[i]] += weights[i]
        for a in range(d):
            sums[label[i], a] += weights[i] * particles[i, a]
    for c in range(centres.shape[0]):
        # An empty cluster stays where it was.
        if mass[c] > 0.0:
            for a in range(d):
                centres[c, a] = sums[c, a] / mass[c]
    return mass


@njit(cache=True, error_model='numpy')
def _squares(particles, centre, least):  # type: ignore[no-untyped-def]
    for i in range(particles.shape[0]):
        square = 0.0
        for a in range(particles.shape[1]):
            square += (particles[i, a] - centre[a]) ** 2
        if square < least[i]:
            least[i] = square


@njit(cache=True, error_model='numpy')
def _farthest(particles, weights, label, means, squares):  # type: ignore[no-untyped-def]
    for i in range(particles.shape[0]):
        if weights[i] > 0.0:
            square = 0.0
            for a in range(particles.shape[1]):
                square += (particles[i, a] - means[label[i], a]) ** 2
            if square > squares[label[i]]:
                squares[label[i]] = square


def _seed_centres(
    particles: FloatArray,
    weights: FloatArray,
    number: int,
    start: FloatArray | None,
    generator: np.random.Generator,
) -> FloatArray:
    """Return starting centres: the given ones first, then K-means++."""
    centres = np.empty((number, particles.shape[1]))
    filled = 0
    least = np.full(len(particles), np.inf)
    if start is not None:
        for centre in start[:number]:
            centres[filled] = centre
            filled += 1
            _squares(particles, centre, least)
    while filled < number:
        chance = weights if filled == 0 else weights * least
        cumulative = np.cumsum(chance)
        if cumulative[-1] <= 0.0:
            # Every particle is on a centre already.
            centres[filled:] = centres[0]
            break
        draw = generator.random() * cumulative[-1]
        pick = min(int(np.searchsorted(cumulative, draw, side='right')), len(particles) - 1)
        centres[filled] = particles[pick]
        _squares(particles, centres[filled], least)
        filled += 1
    return centres


def kmeans(
    particles: FloatArray,
    weights: FloatArray,
    number: int,
    generator: np.random.Generator,
    start: FloatArray | None = None,
    iterations: int = 20,
) -> tuple[IntArray, FloatArray]:
    """Return labels (n,) and centres (k, d) of weighted K-means.

    Parameters
    ----------
    number : int
        k, at least 1; the papers have the rounded expected number of targets.
    start : (s, d) array, optional
        Centres of the step before; K-means++ adds what is missing.
    iterations : int
        At most.
    """
    number = min(max(1, number), len(particles))
    centres = _seed_centres(particles, weights, number, start, generator)
    label = np.full(len(particles), -1, np.int64)
    for _ in range(iterations):
        if _assign(particles, centres, label) == 0:
            break
        _centre(particles, weights, label, centres)
    return label, centres


def kmeans_clusters(
    particles: FloatArray,
    weights: FloatArray,
    label: IntArray,
    number: int,
    largest: bool = False,
) -> tuple[list[Cluster], IntArray]:
    """Return the clusters of labelled particles that have mass, and their labels.

    Parameters
    ----------
    largest : bool
        Whether the radius is the distance of the farthest particle instead of the weighted root
        mean square.
    """
    mass, means, covariances = group_moments(particles, weights, label, number)
    farthest = np.zeros(number)
    if largest:
        _farthest(particles, weights, label, means, farthest)
    clusters = []
    labels = []
    for c in np.nonzero(mass > 0.0)[0]:
        radius = math.sqrt(max(float(np.trace(covariances[c])), 0.0))
        if largest:
            radius = math.sqrt(float(farthest[c]))
        clusters.append(Cluster(means[c].copy(), covariances[c].copy(), radius, float(mass[c])))
        labels.append(int(c))
    return clusters, np.array(labels, np.int64)
