"""Hill shading of terrain: light from the north-west, as on maps."""

import math

import numpy as np

from maasi_filter.arrays import FloatArray
from maasi_filter.geometry.terrain import Terrain

_PIXELS = 550  # on the longer side
# Light from this height; slope to which gentler ones are exaggerated, at most by a factor.
_ALTITUDE, _STEEP, _EXAGGERATED = math.radians(45.0), 0.7, 5.0
_CORNERS = np.array([[-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0], [1.0, 1.0]])
_STRONGEST = 150.0  # opacity of the darkest shade, up to 255


def hill_shading(terrain: Terrain, low: FloatArray, high: FloatArray) -> np.ndarray:
    """Return the shading of an area from low to high (2,) [m, map], (rows, columns, 4) as RGBA.

    The first row is in the north. Level ground is transparent, lit slopes are white and shaded
    ones black, so that it suits a bright and a dark floor.
    """
    size = np.maximum(np.rint(_PIXELS * (high - low) / (high - low).max()), 2).astype(int)
    x, y = (
        begin + (np.arange(number) + 0.5) / number * (end - begin)
        for begin, end, number in zip(low, high, size.tolist())
    )
    points = np.stack(np.meshgrid(x, y[::-1]), axis=-1).reshape(-1, 2)
    # Averaged over a cell: slopes of bilinear ground change abruptly between cells.
    half = 0.5 * terrain.surface.step
    slopes = np.mean([terrain.slopes(points + half * side) for side in _CORNERS], axis=0)
    steep = float(np.percentile(np.hypot(*slopes.T), 98.0))
    slopes *= min(max(_STEEP / max(steep, 1e-9), 1.0), _EXAGGERATED)
    # Normal (-slope, 1) times the direction of the light, relative to that of level ground.
    level = math.cos(_ALTITUDE) * math.sqrt(0.5)
    lit = math.sin(_ALTITUDE) + level * (slopes[:, 0] - slopes[:, 1])
    lit = np.maximum(lit / np.sqrt(1.0 + (slopes * slopes).sum(axis=1)), 0.0)
    shade = lit / math.sin(_ALTITUDE) - 1.0
    pixels = np.zeros((len(points), 4), np.uint8)
    pixels[shade > 0.0, :3] = 255
    pixels[:, 3] = np.rint(_STRONGEST * np.minimum(np.abs(shade), 1.0))
    return pixels.reshape(size[1], size[0], 4)
