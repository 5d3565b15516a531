"""From pixels to the floor and back."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from marker_view import DISTORTION, turned
from numpy.testing import assert_allclose

from maasi_drivers.agent.sensor_reading import measured
from maasi_drivers.settings.camera import CameraSettings
from maasi_drivers.vision.camera_model import Camera, box_view_margin
from maasi_drivers.vision.detector import blobs_at
from maasi_drivers.vision.marker_detector import MarkerDetector
from maasi_filter.models.measurement import RangeAndAngles
from maasi_filter.models.pose import Pose

DOWN = Pose.from_yaw([0.0, 0.0, 1.0], 0.0)
# A camera on a mast behind a ground robot's middle, tilted to look at its front.
TILTED = {
    'focal_length': [140.0, 140.0],
    'mount': {'position': [-0.1, 0.05, 0.4], 'rpy': [0.0, 1.25, 0.0]},
}


def camera(**changes):
    return Camera.from_settings(CameraSettings.model_validate(changes))


def tilted_pose(seed):
    generator = np.random.default_rng(seed)
    quaternion = np.array([1.0, *generator.normal(0.0, 0.1, 2), generator.normal()])
    return Pose(np.array([*generator.uniform(-3, 3, 2), generator.uniform(0.5, 2)]), quaternion)


def test_a_camera_looking_down_has_the_front_up_and_the_left_on_the_left():
    pixels = camera().project([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]], DOWN)
    assert_allclose(pixels, [[79.5, 59.5], [79.5, 33.5], [53.5, 59.5]], atol=1e-9)


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 10_000), x=st.floats(-0.5, 159.5), y=st.floats(-0.5, 119.5))
def test_back_projection_inverts_projection(seed, x, y):
    view = camera(distortion=DISTORTION)
    pose = tilted_pose(seed)
    position = view.back_project([[x, y]], pose, height=0.02)[0]
    assert_allclose(view.project([[*position[0], 0.02]], pose), [[x, y]], atol=1e-7)


def random_lens(generator):
    """Return a random lens of each model, some of them strong."""
    spread = generator.choice([0.01, 0.1, 0.3])
    model = str(generator.choice(['plumb_bob', 'rational_polynomial', 'equidistant']))
    k = generator.normal(0.0, spread, 14)
    if model == 'equidistant':
        k[1:4] *= 0.1
    else:
        k[2:4] *= 0.02  # a lens that is not quite in the middle
        k[8:] *= 0.01
    number = generator.choice({'plumb_bob': [4, 5], 'equidistant': [4]}.get(model, [8, 12, 14]))
    focal = generator.uniform(80.0, 500.0, 2).tolist()
    return {'distortion': k[:number].tolist(), 'distortion_model': model, 'focal_length': focal}


@pytest.mark.parametrize('seed', range(60))
def test_every_lens_model_is_inverted_where_it_holds(seed):
    generator = np.random.default_rng([46, seed])
    view = camera(**random_lens(generator))
    edge = min(0.97 * view.largest_radius, 6.0 if view.model == 'equidistant' else 1.0)
    radii, turns = generator.uniform(0.0, edge, 300), generator.uniform(0.0, 2 * np.pi, 300)
    points = radii[:, None] * np.stack([np.cos(turns), np.sin(turns)], axis=1)
    pixels, slopes = view._distorted(points)
    assert np.isfinite(pixels).all()
    # Off-centre terms may fold the image near the end of the radial model.
    single = np.linalg.det(slopes) > 1e-3 * np.abs(slopes).max(axis=(1, 2)) ** 2
    rays, jacobians = view.undistort(pixels)
    assert_allclose(rays[single], points[single], atol=1e-6)
    assert_allclose(
        jacobians[single] @ slopes[single], np.tile(np.eye(2), (single.sum(), 1, 1)), atol=1e-5
    )
    # Any pixel has a ray that leads back to it, or none at all.
    anywhere = generator.uniform(-100.0, 260.0, (300, 2))
    rays, _ = view.undistort(anywhere)
    known = np.isfinite(rays).all(axis=1)
    assert_allclose(view._distorted(rays[known])[0], anywhere[known], atol=1e-6)
    assert (np.hypot(*rays[known].T) < view.largest_radius).all()


def test_the_lens_models_are_those_of_the_field():
    """By the formulas of OpenCV's documents, for a ray that is well off the axis."""
    k, (x, y) = [0.3, -0.2, 0.01, -0.02, 0.05, 0.25, -0.1, 0.02], (0.4, -0.3)
    r2 = x * x + y * y
    ratio = np.polyval([k[4], k[1], k[0], 1.0], r2) / np.polyval([k[7], k[6], k[5], 1.0], r2)
    rational = [
        x * ratio + 2 * k[2] * x * y + k[3] * (r2 + 2 * x * x),
        y * ratio + k[2] * (r2 + 2 * y * y) + 2 * k[3] * x * y,
    ]
    angle = np.arctan(np.sqrt(r2))
    wide = angle * np.polyval([*k[3::-1], 1.0], angle**2) / np.sqrt(r2)
    for model, number, expected in (
        ('rational_polynomial', 8, rational),
        ('equidistant', 4, [x * wide, y * wide]),
    ):
        view = camera(distortion=k[:number], distortion_model=model)
        pixels = np.array([79.5, 59.5]) + 260.0 * np.array(expected)
        assert_allclose(view._distorted(np.array([[x, y]]))[0][0], pixels, atol=1e-9)


def test_the_image_reaches_half_a_pixel_beyond_the_outermost_centres():
    view = camera()
    corners = [[0.0, 0.0], [159.0, 119.0], [159.5, 60.0], [80.0, -1.5]]
    positions = np.pad(view.back_project(corners, DOWN)[0], ((0, 0), (0, 1)))
    assert_allclose(view.margin(positions, DOWN), [0.5, 0.5, 0.0, -1.0], atol=1e-9)


def test_what_cannot_be_seen_is_nan():
    view = camera()
    assert np.isnan(view.project([[0, 0, 1.5]], DOWN)).all()
    level = camera(mount={'position': [0, 0, 0.2], 'rpy': [0, 0, 0]})
    ground = Pose.from_yaw([0.0, 0.0, 0.0], 0.0)
    positions = level.back_project([[80, 10], [80, 110]], ground)[0]
    assert np.isnan(positions[0]).all()
    assert np.isfinite(positions[1]).all()
    assert view.project(np.empty((0, 3)), DOWN).shape == (0, 2)
    assert view.back_project(np.empty((0, 2)), DOWN)[0].shape == (0, 2)
    # The lens model does not fold far points into the image.
    strong = camera(distortion=[-0.8, 0.0, 0.0, 0.0])
    far = np.stack([np.linspace(0.0, 5.0, 400), np.zeros(400), np.zeros(400)], axis=1)
    pixels = strong.project(far, DOWN)
    known = ~np.isnan(pixels[:, 1])
    assert (np.diff(pixels[known, 1]) < 0).all()
    assert known[:50].all() and not known[-1]
    assert (strong.margin(far[~known], DOWN) < 0).all()


@pytest.mark.parametrize('seed', range(4))
def test_derivatives_of_back_projection(seed):
    view = camera(distortion=DISTORTION, mount={'position': [0.1, -0.05, 0.03], 'rpy': [0, 1.4, 1]})
    pose, pixel, step = tilted_pose(seed), np.array([[30.0, 100.0]]), 1e-5
    _, by_pixel, by_pose = view.back_project(pixel, pose, 0.05)

    def moved(change):
        return view.back_project(pixel + change[:2], turned(pose, change[2:]), 0.05)[0][0]

    slopes = [(moved(step * axis) - moved(-step * axis)) / (2 * step) for axis in np.eye(8)]
    found = np.concatenate([by_pixel[0], by_pose[0]], axis=1)
    assert_allclose(found, np.transpose(slopes), rtol=1e-5, atol=1e-7)


def test_covariance_covers_the_noise_of_pixels_and_pose():
    settings = {'distortion': DISTORTION, 'pixel_noise': 0.8, 'segmentation': {'rule': 'paper'}}
    detector = MarkerDetector(CameraSettings.model_validate(settings))
    generator = np.random.default_rng(11)
    pose_covariance = np.diag([0.01, 0.02, 0.015, 0.01, 0.02, 0.03]) ** 2
    root = np.sqrt(pose_covariance)
    true = Pose.from_yaw([1.0, -0.5, 1.1], 0.7)
    point = np.array([[1.3, -0.4, 0.0]])
    nees = []
    for _ in range(600):
        pixel = detector.camera.project(point, true) + generator.normal(0.0, 0.8, (1, 2))
        believed = turned(true, root @ generator.standard_normal(6))
        seen = detector.detect(blobs_at(pixel, 0.0), believed, pose_covariance)
        expected = RangeAndAngles(2).measure(point[:, :2], believed)[0]
        offset = RangeAndAngles(2).residual(seen.values[0], expected)
        nees.append(offset @ np.linalg.solve(seen.covariances[0], offset))
    assert 1.75 < np.mean(nees) < 2.25


@pytest.mark.parametrize('model', [RangeAndAngles(2), RangeAndAngles(3)])
@pytest.mark.parametrize('offset', [0.0, 1e-9, 1e-4, 1e-3, 1e-2])
def test_right_over_a_target_the_bearing_says_nothing(model, offset):
    places = np.array([[offset, 0.0, 0.0]])[:, : model.dimension]
    values, covariance = measured(model, places, 9e-6 * np.eye(model.dimension)[None], DOWN)
    assert np.isfinite(values).all() and (np.linalg.eigvalsh(covariance[0]) > 0).all()
    expected = min((0.003 / max(offset, 1e-12)) ** 2, np.pi**2 / 3)
    assert_allclose(covariance[0, 1, 1], expected, rtol=1e-6)


@pytest.mark.parametrize(
    ('changes', 'low', 'high', 'height', 'fits'),
    [
        ({}, [-0.215, -0.215], [0.215, 0.215], 1.0, True),
        ({'focal_length': [300, 300]}, [-0.215, -0.215], [0.215, 0.215], 1.0, False),
        # Lower down it sees less.
        ({}, [-0.215, -0.215], [0.215, 0.215], 0.9, False),
        (TILTED, [-0.115, -0.115], [0.215, 0.215], 0.0, True),
        (TILTED, [-0.3, -0.1], [0.2, 0.2], 0.0, False),
        ({'mount': {'position': [0, 0, 0.1], 'rpy': [0] * 3}}, [-0.1] * 2, [0.2] * 2, 0, False),
        ({'distortion': DISTORTION}, [-0.115, -0.115], [0.215, 0.215], 1.0, True),
    ],
)
def test_the_margin_of_a_box_is_that_of_its_worst_place(changes, low, high, height, fits):
    view = camera(**changes)
    pose = Pose.from_yaw([0.3, -0.2, height], 1.1)
    inside = np.random.default_rng(0).uniform(low, high, (2000, 2))
    world = np.pad(pose.position[:2] + inside @ pose.rotation()[:2, :2].T, ((0, 0), (0, 1)))
    worst = view.margin(world, pose).min()
    margin = box_view_margin(view, low, high, height)
    assert (margin >= 0) == fits
    assert margin == worst == -np.inf or worst - 3.0 < margin <= worst
