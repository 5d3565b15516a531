"""What the tests of the drivers share: sequences that are hard to segment, and drivers at work."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from marker_view import sees_whole
from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
from robot_team import KINDS, TURTLEBOT, Team, parameters_of

from maasi_drivers.settings.camera import CameraSettings
from maasi_drivers.settings.driver import DriverSettings
from maasi_drivers.vision.camera_model import Camera
from maasi_drivers.vision.marker_detector import MarkerDetector
from maasi_filter.models.measurement import RangeBearing
from maasi_filter.models.pose import Pose, quaternion_product
from maasi_filter.ros.parameters import flatten
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
    """Return light and distractors of one sequence, drawn anew for each seed."""
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


def score(detector: MarkerDetector, frames: Iterator[Frame], gate: float = 0.03) -> Score:
    """Match detections to markers, one to one by distance, and count."""
    expected = found = false = count = 0
    squares: list[float] = []
    nees: list[float] = []
    for frame in frames:
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


@pytest.fixture
def drone() -> Callable[..., CameraSettings]:
    """Return `drone_camera`."""
    return drone_camera


@pytest.fixture
def rendered_score() -> Callable[..., Score]:
    """Return a function: score of a camera's detector on frames of a floor."""

    def run(settings: CameraSettings, floor: RenderSettings, seed: int, frames: int) -> Score:
        return score(MarkerDetector(settings), sequence(settings, floor, seed, frames))

    return run


@pytest.fixture
def hard_score() -> Callable[[str, int, int], Score]:
    """Return a function: score of a rule on the hard sequence of a seed."""

    def run(rule: str, seed: int, frames: int) -> Score:
        settings = drone_camera(segmentation={'rule': rule})
        return score(MarkerDetector(settings), sequence(settings, hard_floor(seed), seed, frames))

    return run


@pytest.fixture
def set_back(monkeypatch):
    """Return a function that sets the clock of a node back by a time [s]."""

    def change(node, seconds):
        clock, behind = node.get_clock(), Duration(seconds=seconds)
        late = SimpleNamespace(now=lambda: clock.now() - behind)
        monkeypatch.setattr(node, 'get_clock', lambda: late)

    return change


@pytest.fixture
def play(context):
    """
    Return a function that starts a driver in this process, and the team around it.

    Its kind: a name in KINDS, or class and settings.
    """
    started = []
    executor = SingleThreadedExecutor(context=context)

    def start(kind='turtlebot', wants=None, **changes):
        made, settings = KINDS[kind] if isinstance(kind, str) else kind
        settings = settings | changes
        driver = made(
            context=context, namespace='/rover', parameter_overrides=parameters_of(settings)
        )
        executor.add_node(driver)
        team = Team(context, settings, executor, wants)
        started.extend([driver, team])
        assert driver.trigger_configure().name == 'SUCCESS'
        assert driver.trigger_activate().name == 'SUCCESS'
        team.connect()
        return driver, team

    yield start
    for node in started:
        if hasattr(node, 'halt'):
            node.halt()
        node.destroy_node()
    executor.shutdown()


@pytest.fixture
def process(context, tmp_path):
    """Return a function that starts a driver as a process of its own."""
    running = []

    def start(environment=None, program=('turtlebot_driver',), **changes):
        file = tmp_path / 'parameters.yaml'
        flat = flatten(DriverSettings.model_validate(TURTLEBOT | changes))
        file.write_text(yaml.safe_dump({'/**': {'ros__parameters': flat}}))
        command = [*program, '--ros-args', '--remap', '__ns:=/rover', '--params-file', str(file)]
        running.append(subprocess.Popen(command, env=os.environ | (environment or {})))
        return running[-1]

    yield start
    for item in running:
        if item.poll() is None:
            item.kill()
        item.wait()


@pytest.fixture
def team(context):
    executor = SingleThreadedExecutor(context=context)
    team = Team(context, TURTLEBOT, executor)
    yield team
    executor.shutdown()
    team.destroy_node()
