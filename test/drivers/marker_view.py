"""Sequences of images that are hard to segment, and how well markers are seen in them."""

from collections.abc import Iterator
from typing import NamedTuple

import cv2
import numpy as np
from ideal_floor import ideal

from maasi_drivers.settings.camera import CameraSettings
from maasi_drivers.vision.camera_model import Camera
from maasi_drivers.vision.marker_detector import MarkerDetector
from maasi_filter.geometry.environment import EnvironmentSettings
from maasi_filter.models.measurement import RangeAndAngles
from maasi_filter.models.pose import Pose, quaternion_product
from maasi_sim.simulation.camera import CameraRenderer
from maasi_sim.simulation.floor import RenderSettings, scene_of
from maasi_sim.simulation.world import TargetSettings, World

DISTORTION = [-0.21, 0.06, 0.002, -0.003, 0.01]
BOX, GATE = 0.2, 0.03
MODEL = RangeAndAngles(2)


class Score(NamedTuple):
    """Recall inside the box, false blobs per image, RMSE [m], mean NEES."""

    recall: float
    false_per_image: float
    rmse: float
    nees: float


def drone_camera(**changes: object) -> CameraSettings:
    values = {'focal_length': [220.0, 220.0], 'distortion': [-0.12, 0.03, 0.001, -0.001]}
    return CameraSettings.model_validate(values | changes)


def hard_floor(seed: int) -> RenderSettings:
    """Return light and distractors of one sequence."""
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
    floor, space = floor or ideal(), EnvironmentSettings(bounds=[[-1, 3], [-1, 3]])
    shapes = scene_of(World.from_settings(space, TargetSettings(positions=targets), 1), floor, 1)
    renderer = CameraRenderer(Camera.from_settings(settings), floor, shapes, 1, 'drone')
    return renderer.render(pose, 0, 0)


def sequence(
    settings: CameraSettings, floor: RenderSettings, seed: int, images: int
) -> Iterator[tuple[np.ndarray, Pose, np.ndarray, np.ndarray]]:
    """Yield images of 30 markers, with the pose, the markers as a whole in it, and all markers."""
    world = World.from_settings(
        EnvironmentSettings(bounds=[[-0.3, 2.4], [-0.3, 2.4]]),
        TargetSettings(count=30, separation=0.15, margin=0.1),
        seed,
    )
    camera = Camera.from_settings(settings)
    renderer = CameraRenderer(camera, floor, scene_of(world, floor, seed), seed, 'drone')
    generator = np.random.default_rng([seed, 78])
    angles = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    rim = np.stack([np.cos(angles), np.sin(angles), np.zeros(24)], axis=1)
    rims = world.targets_3d_at(0)[:, None, :] + 0.5 * floor.marker_diameter * rim
    for step in range(images):
        half = 0.5 * generator.normal(0.0, 0.02, size=2)
        heading = generator.uniform(-np.pi, np.pi)
        level = Pose.from_yaw([*generator.uniform(-0.1, 2.2, size=2), 1.0], heading)
        turn = Pose(np.zeros(3), np.array([1.0, half[0], half[1], 0.0]))
        pose = Pose(level.position, quaternion_product(level.orientation, turn.orientation))
        velocity = generator.normal(0.0, 0.25, size=3) * [1.0, 1.0, 0.3]
        turning = generator.normal(0.0, 0.3, size=3)
        image = renderer.render(pose, step, 0.7 * step, velocity, turning)
        offset = (world.targets - pose.position[:2]) @ level.rotation()[:2, :2]
        in_box = np.all(np.abs(offset) <= BOX, axis=1)
        whole = camera.margin(rims.reshape(-1, 3), pose) >= 0
        in_box &= whole.reshape(len(rims), -1).all(axis=1)
        yield image, pose, world.targets[in_box], world.targets


def score(settings: CameraSettings, floor: RenderSettings, seed: int, images: int) -> Score:
    """Match what a camera's detector sees of a sequence to its markers, and count."""
    detector = MarkerDetector(settings)
    expected, false = 0, 0
    squares: list[float] = []
    nees: list[float] = []
    for image, pose, in_box, targets in sequence(settings, floor, seed, images):
        seen = detector.detect(image, pose)
        expected += len(in_box)
        distances = np.linalg.norm(targets[:, None] - seen.positions[None], axis=2)
        false += int(np.count_nonzero(distances.min(axis=0, initial=np.inf) > GATE))
        for target in in_box if len(seen.values) else ():
            errors = seen.positions - target
            best = int(np.argmin(np.linalg.norm(errors, axis=1)))
            if np.linalg.norm(errors[best]) <= GATE:
                squares.append(float(errors[best] @ errors[best]))
                error = MODEL.residual(seen.values[best], MODEL.measure(target[None], pose)[0])
                nees.append(float(error @ np.linalg.solve(seen.covariances[best], error)))
    rmse = float(np.sqrt(np.mean(squares)))
    return Score(len(squares) / expected, false / images, rmse, float(np.mean(nees)))


def turned(pose: Pose, change: np.ndarray) -> Pose:
    """Return a pose moved by three coordinates, and turned by three small angles of the map."""
    matrix = cv2.Rodrigues(np.array(change[3:]))[0] @ pose.rotation()
    w = 0.5 * np.sqrt(1.0 + np.trace(matrix))
    skew = (matrix - matrix.T)[[2, 0, 1], [1, 2, 0]]
    return Pose(pose.position + change[:3], np.array([w, *skew / (4 * w)]))
