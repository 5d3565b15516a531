"""Prediction of densities and of e for targets in a random walk."""

from __future__ import annotations

import math

import numpy as np

from maasi_filter.pmb.density import Density
from maasi_filter.unexplored_map import UnexploredMap


def diffuse(density: Density, variance: float, generator: np.random.Generator) -> None:
    """Convolve a density with a normal one of `variance` [m^2] on each axis.

    Particles are moved, so they remain a sample of the true density. Its product of factors is
    replaced by a normal density with their moments, which only Metropolis moves use afterwards.
    """
    d = density.particles.shape[1]
    noise = generator.standard_normal(density.particles.shape)
    density.replace_particles(
        np.clip(
            density.particles + math.sqrt(variance) * noise,
            density.frame[0, :d],
            density.frame[1, :d],
        )
    )
    density.condense()


def diffuse_unexplored(exploration: UnexploredMap, variance: float) -> None:
    """Diffuse e as for targets in a random walk, with reflecting bounds."""
    values = exploration.values
    for axis in range(exploration.dimension):
        rate = 0.5 * variance / float(exploration.step[axis]) ** 2
        # The explicit scheme is stable and positive up to a ratio of 1/2.
        parts = max(1, math.ceil(rate / 0.25))
        for _ in range(parts):
            flow = rate / parts * np.diff(values, axis=axis)
            width = [(0, 0)] * exploration.dimension
            width[axis] = (1, 1)
            values += np.diff(np.pad(flow, width), axis=axis)
