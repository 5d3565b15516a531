"""Random terrain with the statistics of real terrain, as the paper's is not available."""

from __future__ import annotations

from copy import deepcopy
from typing import Any

import numpy as np
from scipy import ndimage

from maasi_filter.arrays import FloatArray
from maasi_sim.experiments.experiment import Outcome
from maasi_sim.experiments.searches import run_search
from maasi_sim.world.noise_streams import noise_stream

# Self-affine with Hurst's exponent of real terrain, about 0.8 (a fractal dimension of 2.2); the
# deviation of heights over the whole map is that of hills.
HURST = 0.8
MAP_SIZE = 12_000.0
MAP_NODES = 1024
DEVIATION = 150.0


def self_affine_map(
    generator: np.random.Generator, nodes: int = MAP_NODES, hurst: float = HURST
) -> FloatArray:
    """Return heights of a periodic map, (nodes, nodes), with mean 0 and deviation 1.

    The power of a wave number k falls with k^-(2 H + 2), so that the mean square difference of
    two heights grows with their distance to the power 2 H.
    """
    spectrum = np.fft.rfft2(generator.standard_normal((nodes, nodes)))
    waves = np.hypot(np.fft.fftfreq(nodes)[:, None], np.fft.rfftfreq(nodes)[None, :])
    waves[0, 0] = np.inf
    heights = np.fft.irfft2(spectrum * waves ** -(hurst + 1.0), s=(nodes, nodes))
    return np.asarray((heights - heights.mean()) / heights.std())


def chunk(generator: np.random.Generator, size: float, nodes: int) -> FloatArray:
    """Return the heights of an area of `size` metres in a map of 12 km, (nodes, nodes) [m]."""
    heights = DEVIATION * self_affine_map(generator)
    corner = generator.uniform(0.0, MAP_NODES, size=2)
    along = np.linspace(0.0, size * MAP_NODES / MAP_SIZE, nodes)
    places = np.meshgrid(corner[0] + along, corner[1] + along, indexing='ij')
    return np.asarray(ndimage.map_coordinates(heights, places, order=3, mode='grid-wrap'))


def littered(
    heights: FloatArray,
    bounds: FloatArray,
    number: int,
    spread: float,
    margin: float,
    generator: np.random.Generator,
) -> FloatArray:
    """Return targets in two clusters: around the lowest and around the highest place.

    Of ten places drawn around each, with deviation `spread`, the lowest (highest) one is taken, one
    target after the other, at least `margin` from the bounds.
    """
    nodes = heights.shape[0]
    low, high = bounds[:, 0] + margin, bounds[:, 1] - margin
    sides = [np.linspace(bounds[axis, 0], bounds[axis, 1], nodes) for axis in (0, 1)]
    inside = ((sides[0] >= low[0]) & (sides[0] <= high[0]))[:, None] & (
        (sides[1] >= low[1]) & (sides[1] <= high[1])
    )[None, :]
    targets = []
    for sign in (1.0, -1.0):
        signed = np.where(inside, sign * heights, np.inf)
        row, column = np.unravel_index(int(np.argmin(signed)), signed.shape)
        centre = np.array([sides[0][row], sides[1][column]])
        for _ in range(number // 2):
            places = centre + generator.normal(0.0, spread, (10, 2))
            # Reflected at the bounds, so that targets do not accumulate along them.
            places = np.where(places < low, 2.0 * low - places, places)
            places = np.where(places > high, 2.0 * high - places, places)
            places = np.clip(places, low, high)
            index = (places - bounds[:, 0]) / (bounds[:, 1] - bounds[:, 0]) * (nodes - 1)
            found = ndimage.map_coordinates(heights, index.T, order=1)
            targets.append(places[int(np.argmin(sign * found))])
    return np.array(targets)


def run_on_terrain(settings: dict[str, Any], seed: int) -> Outcome:
    """Run a search for 14 targets at a low and a high place of terrain made from the seed."""
    generator = noise_stream(seed, purpose='terrain')
    bounds = np.array(settings['scenario']['environment']['bounds'], float)
    heights = chunk(generator, float(bounds[0, 1] - bounds[0, 0]), 57)
    targets = littered(heights, bounds, 14, 15.0, 10.0, generator)
    content = deepcopy(settings)
    content['scenario']['targets'] = {'positions': targets.tolist()}
    outcome = run_search(content, seed)
    outcome.details['heights'] = heights[::2, ::2].round(2).tolist()
    return outcome
