"""The simulated laser scanner."""

import numpy as np
import shapely
from numpy.testing import assert_allclose, assert_array_equal

from maasi_filter.geometry.area import Area
from maasi_filter.geometry.environment import EnvironmentSettings
from maasi_filter.models.pose import Pose
from maasi_sim.simulation.sensors import LaserScanner, LaserSettings

BOUNDS = np.array([[0.0, 3.0], [0.0, 2.0]])
EXACT = LaserSettings(noise=0.0, wall_margin=0.0, minimum_range=0.0)


def scanner(settings=EXACT, centres=(), radii=(), polygons=(), seed=1, robot='ground'):
    rounds = [{'centre': [*map(float, c)], 'radius': float(r)} for c, r in zip(centres, radii)]
    values = {'bounds': BOUNDS.tolist(), 'obstacles': [*rounds, *polygons]}
    area = Area(EnvironmentSettings.model_validate(values))
    return LaserScanner(settings, area, seed, robot)


def test_walls_and_circles_agree_with_a_fine_march_along_each_beam():
    centres, radii = np.array([[1.5, 1.0], [2.2, 0.4], [0.5, 1.6]]), np.array([0.2, 0.1, 0.3])
    pose = Pose.from_yaw([0.9, 0.8, 0.0], 0.4)
    wedge = [[2.4, 1.2], [2.8, 1.9], [2.0, 1.8]]
    ranges = scanner(centres=centres, radii=radii, polygons=[wedge]).scan(pose, 0)
    along = np.arange(0.0, 3.5, 0.0005)
    for beam in range(0, 360, 3):
        angle = 0.4 + np.deg2rad(beam)
        points = pose.position[:2] + along[:, None] * [np.cos(angle), np.sin(angle)]
        hit = (np.linalg.norm(points[:, None] - centres, axis=2) < radii).any(axis=1)
        hit |= shapely.contains_xy(shapely.Polygon(wedge), points)
        hit |= ((points < BOUNDS[:, 0]) | (points > BOUNDS[:, 1])).any(axis=1)
        assert abs(ranges[beam] - along[np.argmax(hit)]) < 0.02


def test_far_is_infinite_and_near_is_minus_infinite():
    settings = LaserSettings(noise=0.0, wall_margin=0.1, minimum_range=0.65, maximum_range=1.9)
    ranges = scanner(settings).scan(Pose.from_yaw([1.0, 0.5, 0.0], 0.0), 0)
    assert_array_equal(ranges[[0, 270]], [np.inf, -np.inf])
    assert_allclose(ranges[90], 1.6)
    # Outside its walls it sees nothing behind, inside a circle zero.
    ranges = scanner().scan(Pose.from_yaw([4.0, 3.0, 0.0], 0.0), 0)
    assert np.isinf(ranges[[0, 90]]).all()
    here = Pose.from_yaw([1.0, 0.5, 0.0], 0.0)
    inside = scanner(centres=[[1.0, 0.5]], radii=[0.3]).scan(here, 0)
    assert_array_equal(inside, np.zeros(360))
    # Other robots are seen.
    ranges = scanner().scan(here, 0, centres=[[1.6, 0.5]], radii=[0.1])
    assert_allclose(ranges[[0, 90]], [0.5, 1.5], rtol=1e-6)


def test_noise_is_keyed_and_as_large_as_set():
    noisy = scanner(LaserSettings(noise=0.05, wall_margin=0.0, beams=4000, maximum_range=9.0))
    pose = Pose.from_yaw([1.0, 1.0, 0.0], 0.0)
    exact = scanner(LaserSettings(noise=0.0, wall_margin=0.0, beams=4000, maximum_range=9.0))
    difference = noisy.scan(pose, 3) - exact.scan(pose, 3)
    assert_allclose([difference.mean(), difference.std()], [0.0, 0.05], atol=0.003)
    assert (noisy.scan(pose, 4) != noisy.scan(pose, 3)).all()
