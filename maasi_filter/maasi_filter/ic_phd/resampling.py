"""Multinomial resampling of weighted particles, and jitter against their degeneracy."""

from __future__ import annotations

import numpy as np
from numba import njit

from maasi_filter.arrays import FloatArray, IntArray


@njit(cache=True, error_model='numpy')
def _select(cumulative, points, index):  # type: ignore[no-untyped-def]
    """Fill the first index whose cumulative weight is above each of the increasing points."""
    i = 0
    for k in range(len(points)):
        while i < len(cumulative) - 1 and cumulative[i] <= points[k]:
            i += 1
        index[k] = i


def resample(weights: FloatArray, number: int, generator: np.random.Generator) -> IntArray:
    """Return indices (number,) of particles, drawn with replacement by weight; they increase."""
    # Uniform points in order, from exponential gaps.
    gaps = np.cumsum(generator.standard_exponential(number + 1))
    cumulative = np.cumsum(weights)
    index = np.empty(number, np.int64)
    _select(cumulative, gaps[:-1] * (cumulative[-1] / gaps[-1]), index)
    return index


def jittered(
    particles: FloatArray,
    index: IntArray,
    deviation: float,
    bounds: FloatArray,
    generator: np.random.Generator,
) -> FloatArray:
    """Return resampled particles (number, d); those drawn more than once are moved apart.

    A deviation from the papers: targets stand still, so that without it ever fewer different
    particles are left.
    """
    moved = particles[index]
    copies = np.flatnonzero(index[1:] == index[:-1]) + 1
    noise = deviation * generator.standard_normal((len(copies), particles.shape[1]))
    moved[copies] = np.clip(moved[copies] + noise, bounds[:, 0], bounds[:, 1])
    return moved
