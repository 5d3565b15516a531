"""Sequences of images that are hard to segment, and how well markers are seen in them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from maasi_drivers.settings.camera import CameraSettings
from maasi_drivers.vision.camera_model import Camera
from maasi_drivers.vision.marker_detector import MarkerDetector
from maasi_filter.models.measurement import RangeBearing
from maasi_filter.models.pose import Pose, quaternion_product
from maasi_filter.settings import EnvironmentSettings
from maasi_sim.world.camera import CameraRenderer
from maasi_sim.world.floor import RenderSettings, scene_of
from maasi_sim.world.world import TargetSettings, World

BOX = 0.2
MODEL = RangeBearing()


@dataclass(frozen=True)
class Frame:
    """One image, where it was taken, and the markers in it."""

    image: np.ndarray
    pose: Pose
    in_box: np.ndarray
    targets: np.ndarray


@dataclass(frozen=True)
class Score:
    """Recall inside the box, false blobs per frame, RMSE [m], mean NEES."""

    recall: float
    false_per_frame: float
    rmse: float
    nees: float


def drone_camera(**changes: object) -> CameraSettings:
    """Return the drone's camera."""
    values = {'focal_length': [220.0, 220.0], 'distortion': [-0.12, 0.03, 0.001, -0.001]}
    return CameraSettings.model_validate(values | changes)


def hard_floor(seed: int) -> RenderSettings:
    """Return light and distractors of one sequence, drawn for each seed."""
    generator = np.random.default_rng([seed, 77])
    return RenderSettings.model_validate(
        {
            'marker_diameter': 0.03,
            'floor_colour': (generator.uniform(0.3, 0.6) * generator.uniform(0.93, 1.07, 3)),
            'floor_texture': generator.uniform(0.02, 0.08),
            'light_variation': generator.uniform(0.2, 0.5),
            'light_wavelength': generator.uniform(0.6, 3.0),
            'vignetting': generator.uniform(0.0, 0.3),
            'exposure_drift': 0.3,
            'white_balance_drift': 0.15,
            'shot_noise': generator.uniform(0.05, 0.2),
            'read_noise': generator.uniform(1.0, 4.0),
            'exposure_time': generator.uniform(0.0, 0.02),
            'blur': generator.uniform(0.3, 1.0),
            'jpeg_quality': int(generator.integers(80, 96)) if generator.random() < 0.5 else None,
            'distractors': {'sheets': 6, 'lines': 8, 'purple': 8, 'cyan': 8, 'large': 3},
        }
    )


def one_image(settings: CameraSettings, targets, pose: Pose, floor=None) -> np.ndarray:
    """Return what a camera sees of markers on the floor, without disturbances by default."""
    floor = floor or RenderSettings.ideal()
    world = World.from_settings(
        EnvironmentSettings(bounds=[[-1, 3], [-1, 3]]), TargetSettings(positions=targets), 1
    )
    shapes = scene_of(world, floor, 1)
    return CameraRenderer(Camera.from_settings(settings), floor, shapes, 1, 'drone').render(
        pose, 0, 0
    )


def sequence(
    settings: CameraSettings, floor: RenderSettings, seed: int, frames: int, tilt: float = 0.02
) -> Iterator[Frame]:
    """Render images of a drone that darts over a floor of 2.7 m with 30 markers."""
    world = World.from_settings(
        EnvironmentSettings(bounds=[[-0.3, 2.4], [-0.3, 2.4]]),
        TargetSettings(count=30, separation=0.15, margin=0.1),
        seed,
    )
    camera = Camera.from_settings(settings)
    renderer = CameraRenderer(camera, floor, scene_of(world, floor, seed), seed, 'drone')
    generator = np.random.default_rng([seed, 78])
    for step in range(frames):
        half = 0.5 * generator.normal(0.0, tilt, size=2)
        heading = generator.uniform(-np.pi, np.pi)
        level = Pose.from_yaw([*generator.uniform(-0.1, 2.2, size=2), 1.0], heading)
        turn = Pose(np.zeros(3), np.array([1.0, half[0], half[1], 0.0]))
        pose = Pose(level.position, quaternion_product(level.orientation, turn.orientation))
        image = renderer.render(
            pose,
            step,
            0.7 * step,
            generator.normal(0.0, 0.25, size=3) * [1.0, 1.0, 0.3],
            generator.normal(0.0, 0.3, size=3),
        )
        offset = (world.targets - pose.position[:2]) @ level.rotation()[:2, :2]
        in_box = np.all(np.abs(offset) <= BOX, axis=1)
        in_box &= sees_whole(camera, world.targets, pose, 0.5 * floor.marker_diameter)
        yield Frame(image, pose, world.targets[in_box], world.targets)


def score(
    settings: CameraSettings, floor: RenderSettings, seed: int, frames: int, gate: float = 0.03
) -> Score:
    """Match what a camera's detector sees of a sequence to its markers, and count."""
    detector = MarkerDetector(settings)
    expected = found = false = count = 0
    squares: list[float] = []
    nees: list[float] = []
    for frame in sequence(settings, floor, seed, frames):
        count += 1
        seen = detector.detect(frame.image, frame.pose)
        expected += len(frame.in_box)
        distances = np.linalg.norm(frame.targets[:, None] - seen.positions[None], axis=2)
        nearest = distances.min(axis=0) if len(seen.values) else np.empty(0)
        false += int(np.count_nonzero(nearest > gate))
        for target in frame.in_box:
            if not len(seen.values):
                continue
            errors = seen.positions - target
            best = int(np.argmin(np.linalg.norm(errors, axis=1)))
            if np.linalg.norm(errors[best]) <= gate:
                found += 1
                squares.append(float(errors[best] @ errors[best]))
                expected_value = MODEL.measure(target[None], frame.pose)[0]
                error = MODEL.residual(seen.values[best], expected_value)
                nees.append(float(error @ np.linalg.solve(seen.covariances[best], error)))
    return Score(
        found / max(expected, 1),
        false / max(count, 1),
        float(np.sqrt(np.mean(squares))) if squares else np.inf,
        float(np.mean(nees)) if nees else np.inf,
    )


def sees_whole(camera, places, pose, radius):
    """Return for markers at places (n, 2) [m, map] whether their rims are inside the image."""
    angles = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    circle = radius * np.stack([np.cos(angles), np.sin(angles), np.zeros(24)], axis=1)
    points = np.pad(places, ((0, 0), (0, 1)))
    rims = (points[:, None, :] + circle).reshape(-1, 3)
    return (camera.margin(rims, pose) >= 0).reshape(len(points), -1).all(axis=1)
