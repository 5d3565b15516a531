"""Speed of rays and lines of sight over terrain of 1,000 x 1,000 cells, next to plain NumPy."""

import numpy as np
from timing import entry, few, median_time

from maasi_filter.geometry.terrain import Terrain

CELLS, STEP = 1001, 5.0  # nodes per axis, and their distance [m]
NUMBER, SAMPLED = 20_000, 20  # of lines, and of those that NumPy samples
PER_CELL = 4.0  # samples of NumPy in each cell


def hills():
    """Return rough hills over 5 km x 5 km, a position above them, and points on the ground."""
    generator = np.random.default_rng(0)
    x, y = np.meshgrid(*[np.linspace(0.0, 1.0, CELLS)] * 2, indexing='ij')
    heights = 80.0 * np.sin(9.0 * x) * np.cos(7.0 * y) + generator.standard_normal(x.shape)
    terrain = Terrain(heights, [0.0, 0.0], [STEP, STEP])
    points = generator.uniform(0.0, (CELLS - 1) * STEP, (NUMBER, 2))
    return terrain, np.array([2500.0, 2500.0, 150.0]), terrain.on_ground(points)


def sampled_heights(terrain, points):
    """Interpolate heights bilinearly by array operations."""
    surface = terrain.surface
    cell = (points[:, :2] - surface.corner) / surface.step
    corner = np.clip(cell.astype(int), 0, np.array(surface.heights.shape) - 2)
    (u, v), (i, j) = (cell - corner).T, corner.T
    low = (1.0 - v) * surface.heights[i, j] + v * surface.heights[i, j + 1]
    high = (1.0 - v) * surface.heights[i + 1, j] + v * surface.heights[i + 1, j + 1]
    return (1.0 - u) * low + u * high


def sampled_sight(terrain, start, points):
    """Return which points no sample of the line to them, before its last cell, hides."""
    seen = []
    for point in points:
        cells = np.abs(point[:2] - start[:2]).max() / STEP
        shares = np.linspace(0.0, 1.0 - 1.0 / max(cells, 2.0), int(PER_CELL * cells) + 2)
        line = start + shares[:, None] * (point - start)
        seen.append(bool((line[:, 2] >= sampled_heights(terrain, line)).all()))
    return np.array(seen)


def run(share=1.0):
    """Yield an entry per kernel; the peer's time is that of as many lines."""
    terrain, start, points = hills()
    repeats = few(share, 5)
    plain = median_time(lambda: sampled_sight(terrain, start, points[:SAMPLED]), repeats)
    plain *= NUMBER / SAMPLED
    agree = sampled_sight(terrain, start, points[:SAMPLED]) == terrain.visible(
        start, points[:SAMPLED]
    )
    assert agree.mean() >= 0.9, agree
    near = terrain.on_ground(start[:2] + 0.01 * (points[:, :2] - 2500.0))
    for name, function, peer in (
        ('lines of sight, 2 km', lambda: terrain.visible(start, points), plain),
        ('lines of sight, 20 m', lambda: terrain.visible(start, near), None),
        ('rays to the ground, 2 km', lambda: terrain.meets(start, points - start), plain),
    ):
        seconds = median_time(function, repeats)
        text = None if peer is None else f'NumPy, sampled, {NUMBER / peer:.3g}/s'
        ratio = None if peer is None else peer / seconds
        yield entry(name, NUMBER / seconds, '1/s', text, ratio)
