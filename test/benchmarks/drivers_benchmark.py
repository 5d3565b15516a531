"""Time of seeing: segmentation and projection of one image by the robust rule."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from time import perf_counter
from typing import Any

import numpy as np

from maasi_drivers.settings.camera import CameraSettings
from maasi_drivers.vision.camera_model import Camera
from maasi_drivers.vision.marker_detector import MarkerDetector
from maasi_filter.models.pose import Pose
from maasi_filter.settings import EnvironmentSettings
from maasi_sim.world.camera import CameraRenderer
from maasi_sim.world.floor_scene import scene_of
from maasi_sim.world.render_settings import RenderSettings
from maasi_sim.world.world import TargetSettings, World


def _time(function: Callable[[], object], repeats: int) -> float:
    """Return the median time of a call [ms]."""
    times = np.empty(repeats)
    for index in range(repeats):
        start = perf_counter()
        function()
        times[index] = perf_counter() - start
    return 1e3 * float(np.median(times))


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
    """
    Time the robust rule, beside the paper's rule on the same image, and the rendering.

    Parameters
    ----------
    share : float
        Of all calls.

    Returns
    -------
    list of dict
        name, value, unit, baseline (what was compared with) and ratio (its time over ours).

    """
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

        ours = _time(partial(robust.detect, image, pose), repeats)
        other = _time(partial(paper.detect, image, pose), repeats)
        render = partial(renderer.render, pose, 1, 0.1, (0.3, 0.1, 0.0))
        results.append(
            {
                'name': f'segment_{width}x{height}',
                'value': ours,
                'unit': 'ms',
                'baseline': "the paper's rule on the same image",
                'ratio': other / ours,
            }
        )
        results.append(
            {
                'name': f'render_{width}x{height}',
                'value': _time(render, repeats),
                'unit': 'ms',
                'baseline': None,
                'ratio': None,
            }
        )
    return results
