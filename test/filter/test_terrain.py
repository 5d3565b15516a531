"""The terrain: heights, rays and lines of sight against analytic and sampled answers."""

from itertools import product

import numpy as np
import pytest

from maasi_filter.geometry.terrain import Terrain

ROUNDING = 1e-9  # [m], of coordinates below 1 km and slopes below 100


def sampled(function, bounds=(-100.0, 100.0), nodes=201):
    """Return the terrain of a function of x and y, on a square grid."""
    axis = np.linspace(*bounds, nodes)
    heights = function(*np.meshgrid(axis, axis, indexing='ij'))
    return Terrain(heights, [bounds[0]] * 2, [axis[1] - axis[0]] * 2)


def rough(generator, shape=(40, 33), steepness=3.0):
    heights = steepness * generator.standard_normal(shape).cumsum(axis=0)
    step = generator.uniform(0.5, 3.0, 2)
    return Terrain(heights, generator.uniform(-50.0, 50.0, 2), step)


def inside(terrain, generator, number):
    return generator.uniform(*terrain.bounds.T, (number, 2))


def bilinear(terrain, points):
    """Interpolate by the weights of the four corners."""
    surface, out = terrain.surface, np.zeros(len(points))
    cell = (points[:, :2] - surface.corner) / surface.step
    corner = np.minimum(cell.astype(int), np.array(surface.heights.shape) - 2)
    share = cell - corner
    for a, b in product((0, 1), (0, 1)):
        weight = np.abs(1 - a - share[:, 0]) * np.abs(1 - b - share[:, 1])
        out += weight * surface.heights[corner[:, 0] + a, corner[:, 1] + b]
    return out


def test_heights_are_bilinear():
    generator = np.random.default_rng(1)
    for _ in range(20):
        terrain = rough(generator)
        points = inside(terrain, generator, 200)
        assert terrain.heights(points) == pytest.approx(bilinear(terrain, points), abs=ROUNDING)
        # Differences of a bilinear function along an axis, within a cell, are exact.
        aside = terrain.surface.step * 1e-3
        cells = np.floor((points - terrain.surface.corner) / terrain.surface.step)
        moved = np.floor((points + aside - terrain.surface.corner) / terrain.surface.step)
        same = (cells == moved).all(axis=1)
        for axis in (0, 1):
            step = np.eye(2)[axis] * aside[axis]
            rise = (terrain.heights(points + step) - terrain.heights(points)) / aside[axis]
            slope = terrain.slopes(points)[:, axis]
            assert slope[same] == pytest.approx(rise[same], abs=1e-6)


def test_rays_meet_a_plane_where_geometry_says():
    generator = np.random.default_rng(2)
    for _ in range(50):
        a, b, c = generator.uniform(-0.5, 0.5, 3)
        nodes = int(generator.integers(2, 60))
        terrain = sampled(lambda x, y, a=a, b=b, c=c: a * x + b * y + c, nodes=nodes)
        start = np.array([*generator.uniform(-40.0, 40.0, 2), 0.0])
        start[2] = a * start[0] + b * start[1] + c + generator.uniform(1.0, 30.0)
        ways = generator.uniform(-1.0, 1.0, (100, 3)) - [0.0, 0.0, 1.0]
        fall = a * ways[:, 0] + b * ways[:, 1] - ways[:, 2]
        gap = start[2] - (a * start[0] + b * start[1] + c)
        expected = start + (gap / fall)[:, None] * ways
        within = (fall > 0.0) & (np.abs(expected[:, :2]) < 100.0 - ROUNDING).all(axis=1)
        met = terrain.meets(start, ways)
        assert met[within] == pytest.approx(expected[within], abs=1e-7)
        assert np.isnan(met[~within]).all()
        assert within.sum() > 20


def test_flat_ground_is_the_plane():
    terrain = Terrain(np.zeros((17, 40)), [-80.0, -200.0], [10.0, 10.0])
    generator = np.random.default_rng(3)
    ways = generator.uniform(-1.0, 1.0, (500, 3)) - [0.0, 0.0, 1.2]
    start = np.array([3.0, -7.0, 12.5])
    plane = start + (-start[2] / ways[:, 2])[:, None] * ways
    met = terrain.meets(start, ways)
    known = np.isfinite(met).all(axis=1)
    assert known.sum() > 300
    assert met[known] == pytest.approx(plane[known], abs=ROUNDING)
    assert terrain.visible(start, plane[known] * [1.0, 1.0, 0.0]).all()


def test_what_a_cone_hides():
    """A point behind a cone is hidden exactly if the line to it passes below the top.

    In the vertical plane through the axis, along a grid line, the cone is exact on the grid.
    """
    height, radius = 20.0, 50.0
    terrain = sampled(lambda x, y: np.maximum(height * (1.0 - np.hypot(x, y) / radius), 0.0))
    for level in (25.0, 40.0, 70.0):
        start = np.array([-60.0, 0.0, level])
        # The line over the top reaches the ground here.
        edge = level * 60.0 / (level - height) - 60.0
        points = np.array([[x, 0.0, 0.0] for x in np.linspace(51.0, 99.0, 97)])
        expected = points[:, 0] >= edge - 1e-9
        assert (terrain.visible(start, points) == expected).all(), level
        if 50.0 < edge < 100.0:
            near = np.array([[edge + 1e-3, 0.0, 0.0], [edge - 1e-3, 0.0, 0.0]])
            assert terrain.visible(start, near).tolist() == [True, False]


def test_rays_on_a_gaussian_hill():
    """The grid differs from the hill by at most h^2 / 8 times its largest curvature, each axis."""
    height, spread, step = 30.0, 25.0, 3.0

    def hill(x, y):
        return height * np.exp(-0.5 * (x * x + y * y) / spread**2)

    # So wide that each ray reaches the ground on it.
    terrain = sampled(hill, (-600.0, 600.0), 401)
    error = 2.0 * step * step / 8.0 * height / spread**2
    points = np.random.default_rng(4).uniform(-90.0, 90.0, (2000, 2))
    assert np.abs(terrain.heights(points) - hill(*points.T)).max() <= error
    start = np.array([-70.0, 15.0, 45.0])
    met = terrain.meets(start, np.column_stack([points, hill(*points.T)]) - start)
    assert np.isfinite(met).all()
    assert np.abs(met[:, 2] - hill(*met[:, :2].T)).max() <= error + ROUNDING


@pytest.mark.parametrize('seed', range(8))
def test_rays_and_sight_agree_on_random_ground(seed):
    generator = np.random.default_rng(seed)
    for _ in range(6):
        shape = tuple(generator.integers(2, 70, 2).tolist())
        terrain = rough(generator, shape, generator.uniform(0.0, 3.0))
        for x, y in inside(terrain, generator, 8):
            start = np.array([x, y, terrain.height([x, y]) + generator.uniform(0.5, 40.0)])
            ways = generator.standard_normal((150, 3)) * [1.0, 1.0, 0.5] - [0.0, 0.0, 0.3]
            met = terrain.meets(start, ways)
            known = np.isfinite(met).all(axis=1)
            # What a ray meets is on the ground and in sight.
            assert met[known, 2] == pytest.approx(terrain.heights(met[known]), abs=1e-6)
            assert terrain.visible(start, met[known]).all()
            # What is below it is hidden.
            below = met[known] + 0.05 * ways[known] / np.linalg.norm(ways[known], axis=1)[:, None]
            deep = below[:, 2] < terrain.heights(below) - 1e-5
            assert not terrain.visible(start, below[deep]).any()
            # No sample of the ray before it is below the ground.
            shares = np.linspace(0.0, 1.0, 60)[1:-1]
            samples = start + shares[:, None, None] * (met[known] - start)
            flat = samples.reshape(-1, 3)
            assert (flat[:, 2] - terrain.heights(flat)).min(initial=0.0) > -1e-6


@pytest.mark.parametrize('seed', range(4))
def test_clearance_is_the_least_of_samples(seed):
    generator = np.random.default_rng(seed)
    shares = np.linspace(0.0, 1.0, 4001)[:, None]
    for _ in range(40):
        terrain = rough(generator, tuple(generator.integers(2, 60, 2).tolist()))
        one, two = np.column_stack([inside(terrain, generator, 2), generator.uniform(0, 60, 2)])
        path = one + shares * (two - one)
        gaps = path[:, 2] - terrain.heights(path)
        least = terrain.clearance(one, two)
        # Between samples the height above ground changes by at most the slopes times the distance.
        distance = np.linalg.norm(two - one) / 8000.0
        steepest = np.abs(np.diff(terrain.surface.heights, axis=0)).max(initial=0.0)
        steepest += np.abs(np.diff(terrain.surface.heights, axis=1)).max(initial=0.0)
        slope = 1.0 + steepest / terrain.surface.step.min()
        assert gaps.min() - slope * distance <= least <= gaps.min() + ROUNDING


def test_sight_is_the_same_both_ways_and_straight_down():
    generator = np.random.default_rng(9)
    terrain = rough(generator, (80, 80))
    points = inside(terrain, generator, 300)
    ends = np.column_stack([points, terrain.heights(points) + generator.uniform(0.0, 20.0, 300)])
    for one, two in zip(ends[::2], ends[1::2]):
        assert terrain.visible(one, two[None]) == terrain.visible(two, one[None])
    down = np.array([[0.0, 0.0, -1.0]])
    for position in ends:
        met = terrain.meets(position, down)[0]
        assert met == pytest.approx([*position[:2], terrain.height(position)], abs=ROUNDING)


@pytest.mark.parametrize(
    ('heights', 'corner', 'step', 'text'),
    [
        (np.zeros((1, 5)), [0, 0], [1, 1], 'heights: got shape'),
        (np.full((2, 2), np.nan), [0, 0], [1, 1], 'heights: got a number that is not finite'),
        (np.zeros((2, 2)), [0, np.inf], [1, 1], 'corner: got'),
        (np.zeros((2, 2)), [0, 0], [1, -1], 'step: got'),
    ],
)
def test_invalid_grids_are_refused(heights, corner, step, text):
    with pytest.raises(ValueError, match=text):
        Terrain(heights, corner, step)
