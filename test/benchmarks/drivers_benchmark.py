"""Time of seeing: segmentation and projection of one image by the robust rule."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from timing import entry, median_time

from maasi_drivers.settings.camera import CameraSettings
from maasi_drivers.vision.camera_model import Camera
from maasi_drivers.vision.marker_detector import MarkerDetector
from maasi_filter.models.pose import Pose
from maasi_filter.settings import EnvironmentSettings
from maasi_sim.simulation.camera import CameraRenderer
from maasi_sim.simulation.floor import RenderSettings, scene_of
from maasi_sim.simulation.world import TargetSettings, World


def _image(settings: CameraSettings, seed: int = 1) -> tuple[np.ndarray, Pose, CameraRenderer]:
    """Return a moderately hard image with a few markers, its pose and its renderer."""
    world = World.from_settings(
        EnvironmentSettings(bounds=[[-0.3, 0.9], [-0.3, 0.9]]),
        TargetSettings(count=12, separation=0.12, margin=0.05),
        seed,
    )
    floor = RenderSettings.model_validate(
        {'distractors': {'sheets': 2, 'lines': 3, 'purple': 3, 'cyan': 3}}
    )
    camera = Camera.from_settings(settings)
    renderer = CameraRenderer(camera, floor, scene_of(world, floor, seed), seed, 'drone')
    pose = Pose.from_yaw([0.3, 0.3, 1.0], 0.4)
    return renderer.render(pose, 0, 0.0), pose, renderer


def run(share: float = 1.0) -> list[dict[str, Any]]:
    """Time the robust rule, beside the paper's on the same image, and the rendering."""
    repeats = max(1, round(share * 300))
    results: list[dict[str, Any]] = []
    for width, height, focal in ((160, 120, 220.0), (640, 480, 880.0)):
        values: dict[str, Any] = {
            'width': width,
            'height': height,
            'focal_length': [focal, focal],
            'distortion': [-0.1, 0.02, 0.001, -0.001],
        }
        robust = MarkerDetector(CameraSettings.model_validate(values))
        paper = MarkerDetector(
            CameraSettings.model_validate(values | {'segmentation': {'rule': 'paper'}})
        )
        image, pose, renderer = _image(robust.settings)
        for detector in (robust, paper):
            detector.detect(image, pose)
        ours, other = (
            1e3 * median_time(partial(detector.detect, image, pose), repeats)
            for detector in (robust, paper)
        )
        render = partial(renderer.render, pose, 1, 0.1, (0.3, 0.1, 0.0))
        what = "the paper's rule on the same image"
        results.append(entry(f'segment_{width}x{height}', ours, 'ms', what, other / ours))
        drawn = 1e3 * median_time(render, repeats)
        results.append(entry(f'render_{width}x{height}', drawn))
    return results
