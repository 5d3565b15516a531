"""From pixels to ground that is not flat, and what a hill hides from a camera."""

import numpy as np
import pytest
from ideal_floor import ideal
from marker_view import DISTORTION
from numpy.testing import assert_allclose

from maasi_drivers.settings.camera import CameraSettings
from maasi_drivers.vision.camera_model import Camera
from maasi_drivers.vision.detector import blobs_at
from maasi_drivers.vision.marker_detector import MarkerDetector
from maasi_drivers.vision.terrain_projection import project_to_terrain
from maasi_filter.geometry.terrain import Terrain
from maasi_filter.models.pose import Pose
from maasi_sim.simulation.camera import CameraRenderer
from maasi_sim.simulation.floor import disc

FLAT = Terrain(np.zeros((9, 12)), [-80.0, -100.0], [20.0, 20.0])
SLOPES = 0.3, -0.2


def plane(slopes=SLOPES, height=4.0):
    axis = np.linspace(-60.0, 60.0, 13)
    x, y = np.meshgrid(axis, axis, indexing='ij')
    return Terrain(height + slopes[0] * x + slopes[1] * y, [-60.0, -60.0], [10.0, 10.0])


def random_pose(generator, height):
    tilt = generator.normal(0.0, 0.15, 2)
    return Pose(
        np.array([*generator.uniform(-5.0, 5.0, 2), height]),
        np.array([1.0, *tilt, generator.normal()]),
    )


@pytest.mark.parametrize('seed', range(5))
def test_flat_terrain_is_the_floor(seed):
    generator = np.random.default_rng(seed)
    camera = Camera.from_settings(CameraSettings(distortion=DISTORTION))
    pixels = generator.uniform([0.0, 0.0], [159.0, 119.0], (40, 2))
    pose = random_pose(generator, 12.0)
    expected = camera.back_project(pixels, pose)
    found = project_to_terrain(camera, pixels, pose, FLAT)
    assert np.isfinite(found[0]).all()
    for one, two in zip(found, expected):
        assert_allclose(one, two, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize('seed', range(5))
def test_derivatives_on_a_slope_are_those_of_small_changes(seed):
    generator = np.random.default_rng(seed)
    camera, terrain = Camera.from_settings(CameraSettings()), plane()
    pixel, pose = (
        generator.uniform([20.0, 20.0], [140.0, 100.0], (1, 2)),
        random_pose(generator, 30),
    )
    (position,), (by_pixel,), (by_pose,) = project_to_terrain(camera, pixel, pose, terrain)
    on_ground = terrain.on_ground(position[None])
    assert_allclose(camera.project(on_ground, pose), pixel, atol=1e-6)
    small = 1e-4
    for axis in range(2):
        change = small * np.eye(2)[axis]
        moved = [project_to_terrain(camera, pixel + s * change, pose, terrain)[0] for s in (1, -1)]
        assert_allclose(
            by_pixel[:, axis], (moved[0] - moved[1])[0] / (2 * small), rtol=1e-4, atol=1e-6
        )
    for axis in range(6):
        ends = []
        for sign in (small, -small):
            shift, turn = np.zeros(3), np.zeros(3)
            (shift if axis < 3 else turn)[axis % 3] = sign
            turned = Pose.from_rpy([0, 0, 0], turn.tolist())
            rotation = turned.rotation() @ pose.rotation()
            # The quaternion of the product, for small turns.
            w, x, y, z = pose.orientation
            a, b, c = 0.5 * turn
            orientation = [
                w - a * x - b * y - c * z,
                x + a * w + b * z - c * y,
                y + b * w + c * x - a * z,
                z + c * w + a * y - b * x,
            ]
            moved = Pose(pose.position + shift, np.array(orientation))
            assert_allclose(moved.rotation(), rotation, atol=1e-7)
            ends.append(project_to_terrain(camera, pixel, moved, terrain)[0][0])
        assert_allclose(by_pose[:, axis], (ends[0] - ends[1]) / (2 * small), rtol=1e-4, atol=1e-5)


def test_detections_are_on_the_slope():
    terrain, pose = plane(), Pose.from_yaw([3.0, 2.0, 25.0], 0.7)
    # Of any size, as these blobs have none.
    settings = CameraSettings.model_validate({'segmentation': {'rule': 'paper'}})
    detector = MarkerDetector(settings, 2, terrain)
    target = terrain.on_ground([[4.0, 3.5]])
    pixels = detector.camera.project(target, pose)
    reading = detector.detect(blobs_at(pixels), pose)
    assert_allclose(reading.positions, target[:, :2], atol=1e-6)
    flat = MarkerDetector(settings, 2).detect(blobs_at(pixels), pose)
    # The plane z = 0 is 4.5 m lower there: the ray is longer by a sixth to a fifth of its length.
    assert np.linalg.norm(flat.positions - target[:, :2]) > 0.3


def test_a_rendered_marker_is_where_the_ground_is_and_hidden_behind_a_hill():
    axis = np.linspace(-20.0, 20.0, 81)
    x, _ = np.meshgrid(axis, axis, indexing='ij')
    ridge = Terrain(np.maximum(3.0 - np.abs(x - 4.0), 0.0), [-20.0, -20.0], [0.5, 0.5])
    mount = {'position': [0.0, 0.0, 0.0], 'rpy': [0.0, 0.5, 0.0]}
    settings = CameraSettings.model_validate(
        {'mount': mount, 'marker_diameter': 0.6, 'segmentation': {'rule': 'paper'}}
    )
    camera, detector = Camera.from_settings(settings), MarkerDetector(settings, 2, ridge)
    pose = Pose.from_yaw([-1.0, 0.0, 4.0], 0.0)
    found = {}
    for place in ([3.0, 0.2], [7.0, 0.2]):
        shapes = [disc(place, 0.3, [0.08, 0.17, 0.62])]
        image = CameraRenderer(camera, ideal(), shapes, 1, 'one', ridge).render(pose, 0, 0.0)
        found[place[0]] = detector.detect(image, pose).positions
    assert len(found[7.0]) == 0
    # A tilted disc's centroid is not its centre: within a tenth of its radius.
    assert_allclose(found[3.0], [[3.0, 0.2]], atol=0.03)
    # It would be seen without the ridge.
    free = CameraRenderer(camera, ideal(), shapes, 1, 'one').render(pose, 0, 0.0)
    assert len(MarkerDetector(settings, 2).detect(free, pose).positions) == 1
