"""The command that gives a sensor's noise R from a recording of one target."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from pydantic import ValidationError

from maasi_drivers.agent.odometry import MapOdometry, PoseHistory, StampedPose
from maasi_drivers.calibration.bag_reader import BagError, BagReader
from maasi_drivers.calibration.sensor_calibration import Observation, SensorNoise, sensor_noise
from maasi_drivers.settings.camera import load_calibration
from maasi_drivers.settings.driver import DriverSettings
from maasi_drivers.vision.images import decode_image, image_to_array
from maasi_drivers.vision.marker_detector import MarkerDetector
from maasi_filter.models.pose import Pose
from maasi_filter.ros.parameters import parameter_fields, unflatten

# Topics of a robot that show its target.
_USED = {
    'images': ('/camera/image_raw', '/camera/image_raw/compressed'),
    'detections': ('/detections',),
}
# The driver's own poses come first: its detections are relative to them.
_POSES = ('/state', '/odom')
_POSE_TYPES = ('AgentState', 'Odometry', 'PoseStamped')
# Mean errors above this multiple of their standard deviation are significant.
_CLEAR = 4.0


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(
        prog='calibrate_sensor',
        description='From a recording (rosbag2) of one target, seen from many places: the noise R '
        'of the sensor, for sensor.noise, and the probability of detection inside its field of '
        'view. The images go through the same steps as in the driver.',
    )
    parser.add_argument('bag', type=Path, help='folder of the recording')
    parser.add_argument(
        '--parameters',
        type=Path,
        required=True,
        metavar='FILE',
        help="the driver's parameter file, for its camera, sensor and start",
    )
    parser.add_argument(
        '--robot', metavar='NAMESPACE', help='of the robot (default: the only one recorded)'
    )
    parser.add_argument(
        '--target',
        type=float,
        nargs='+',
        metavar='X',
        help='where the target is in the map [m] (default: the mean of where it was seen)',
    )
    parser.add_argument(
        '--use',
        choices=('images', 'detections'),
        help='segment the recorded images, or take the detections that a driver published '
        '(default: images, if there are any)',
    )
    parser.add_argument(
        '--poses',
        metavar='TOPIC',
        help='where the robot was: AgentState or PoseStamped in the map, or Odometry (default: '
        'state, else odom)',
    )
    parser.add_argument(
        '--least-range',
        type=float,
        default=0.05,
        metavar='M',
        help='nearer observations are left out: the bearing means nothing there (default: 0.05)',
    )
    parser.add_argument('--json', type=Path, metavar='FILE', help='write the result to a file too')
    return parser


def read_parameters(path: Path) -> DriverSettings:
    """Return the settings in a driver's parameter file."""
    try:
        content = yaml.safe_load(path.read_text(encoding='utf-8'))
        (node,) = content.values()
        flat = dict(_dotted(node['ros__parameters'], ''))
    except OSError as error:
        raise ValueError(f'{path}: {error.strerror}') from error
    except (yaml.YAMLError, AttributeError, KeyError, TypeError, ValueError) as error:
        raise ValueError(
            f"{path}: not a parameter file of one node ('/**: {{ros__parameters: ...}}')"
        ) from error
    known = {field.name for field in parameter_fields(DriverSettings, flat)}
    for name in flat:
        if name.startswith(('camera.', 'sensor.', 'environment.')) and name not in known:
            raise ValueError(f'{path}: {name}: there is no such parameter')
    try:
        settings = DriverSettings.model_validate(unflatten(DriverSettings, flat))
    except ValidationError as error:
        first = error.errors()[0]
        key = '.'.join(map(str, first['loc']))
        raise ValueError(f'{path}: {key}: read {first["input"]!r}; {first["msg"]}') from error
    except ValueError as error:
        raise ValueError(f'{path}: {error}') from error
    if settings.camera is not None and settings.calibration_file:
        try:
            camera = load_calibration(settings.calibration_file, settings.camera)
        except (OSError, ValueError) as error:
            raise ValueError(f'{path}: calibration_file: {error}') from error
        settings = settings.model_copy(update={'camera': camera})
    return settings


def _dotted(node: Mapping[str, Any], prefix: str) -> Iterator[tuple[str, Any]]:
    for key, value in node.items():
        if isinstance(value, dict):
            yield from _dotted(value, f'{prefix}{key}.')
        else:
            yield f'{prefix}{key}', value


class RecordedRobot:
    """A robot in a recording."""

    def __init__(
        self,
        bag: Path,
        settings: DriverSettings,
        robot: str | None = None,
        use: str | None = None,
        poses: str | None = None,
    ) -> None:
        self.settings = settings
        self.left_out = 0
        self._bag = bag
        with BagReader(bag) as reader:
            self._types, self.recovered = reader.types, reader.recovered
        kinds = (use,) if use else (*_USED,)
        for kind in kinds:
            robots = {
                topic[: -len(end)].strip('/')
                for topic in self._types
                for end in _USED[kind]
                if topic.endswith(end)
            }
            if robot is not None:
                robots &= {robot.strip('/')}
            if robots:
                break
        if len(robots) != 1:
            there = ', '.join(sorted(self._types)) or 'no topics'
            raise ValueError(
                f'{bag}: robot: found {", ".join(sorted(robots)) or "none"} with '
                f'{" or ".join(kinds)}, allowed is one (--robot, --use); recorded are {there}'
            )
        self.robot, self.use = robots.pop(), kind
        state, odometry = map(self._topic, _POSES)
        self.poses = poses or (state if state in self._types else odometry)
        known = self._types.get(self.poses, 'not recorded')
        self._pose_type = known.rpartition('/')[2]
        if self._pose_type not in _POSE_TYPES:
            raise ValueError(
                f'{bag}: poses: {self.poses} is {known}, allowed are {", ".join(_POSE_TYPES)}'
            )

    def _topic(self, name: str) -> str:
        return f'/{self.robot}{name}' if self.robot else name

    def _messages(self, *topics: str) -> Iterator[tuple[str, Any]]:
        with BagReader(self._bag) as reader:
            try:
                for item in reader.messages(topics):
                    yield item.topic, item.message
            except BagError as error:
                # Messages before the damage are used.
                self.recovered = f'{error}; what is before it is read'

    def observations(self) -> list[Observation]:
        """Return what it saw, each with where it was then."""
        if self.use == 'detections':
            return list(self._published())
        if self.settings.camera is None:
            raise ValueError(
                'parameter camera: got nothing, allowed with images are the settings of a camera'
            )
        return list(self._segmented())

    def _published(self) -> Iterator[Observation]:
        dimension = self.settings.environment.dimension
        for _, message in self._messages(*map(self._topic, _USED['detections'])):
            values = [[item.range, item.bearing, item.elevation] for item in message.detections]
            array = np.reshape(np.array(values, dtype=float), (-1, 3))[:, :dimension]
            pose = _pose(message.pose.pose)
            if pose is None or not np.isfinite(array).all():
                self.left_out += 1
            else:
                yield Observation(pose, array)

    def _segmented(self) -> Iterator[Observation]:
        assert self.settings.camera is not None
        camera = self.settings.camera
        for _, message in self._messages(self._topic('/camera/camera_info')):
            if message.k[0] != 0.0:
                camera = camera.with_calibration(
                    message.width,
                    message.height,
                    message.k.tolist(),
                    message.d.tolist(),
                    message.distortion_model,
                )
                break
        detector = MarkerDetector(camera, self.settings.environment.dimension)
        history = self._history()
        offset = round(camera.stamp_offset * 1e9)
        for topic, message in self._messages(*map(self._topic, _USED['images'])):
            placed = history.at(_stamp(message) + offset)
            try:
                if placed is None:
                    raise ValueError
                decode = decode_image if topic.endswith('/compressed') else image_to_array
                seen = detector.detect(decode(message), placed.pose)
            except ValueError:
                self.left_out += 1
                continue
            yield Observation(placed.pose, seen.values)

    def _history(self) -> PoseHistory:
        settings, kind = self.settings, self._pose_type
        history = PoseHistory(sys.maxsize)
        odometry: MapOdometry | None = None
        start = Pose.from_yaw(settings.start, settings.yaw)
        for _, message in self._messages(self.poses):
            pose = _pose(message.pose if kind == 'PoseStamped' else message.pose.pose)
            if pose is None:
                continue
            if kind == 'Odometry':
                if odometry is None:
                    first = settings.odometry_origin == 'first'
                    odometry = MapOdometry(start, pose if first else None)
                history.add(odometry.apply(_stamp(message), pose))
            else:
                history.add(StampedPose(_stamp(message), pose))
        return history


def _stamp(message: Any) -> int:
    stamp = message.header.stamp
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def _pose(message: Any) -> Pose | None:
    """Return a recorded pose; None where it is none."""
    point, turn = message.position, message.orientation
    try:
        return Pose(
            np.array([point.x, point.y, point.z]), np.array([turn.w, turn.x, turn.y, turn.z])
        )
    except ValueError:
        return None


def report(recorded: RecordedRobot, noise: SensorNoise, given: bool) -> str:
    """Return the result in words, and as what goes into a robot's type or parameters."""
    names = ('range', 'bearing', 'elevation')[: len(noise.bias)]
    units = ('m', 'rad', 'rad')
    place = ' '.join(f'{value:.4f}' for value in noise.target)
    poses = f'; poses of {recorded.poses}' if recorded.use == 'images' else ''
    lines = [
        f'{recorded.robot or "/"}: {noise.used} {recorded.use} used, at {noise.ranges[0]:.2f} to '
        f'{noise.ranges[1]:.2f} m{poses}',
        f'target at {place} m, ' + ('as given' if given else 'the mean of where it was seen'),
        f'left out: {noise.near} from too near, {noise.others} detections of something else, '
        f'{recorded.left_out} without a pose or not to be used',
        f'in the field of view {noise.inside} times, not seen {noise.missed} times of those',
    ]
    for name, unit, deviation, bias in zip(names, units, noise.deviations, noise.bias):
        clear = given and abs(bias) > _CLEAR * deviation / np.sqrt(noise.used)
        lines.append(
            f'{name}: deviation {deviation:.4f} {unit}, mean error {bias:+.4f} {unit}'
            + (': check mount, stamp_offset, start and target' if clear else '')
        )
    correlation = noise.covariance / np.outer(noise.deviations, noise.deviations)
    lines.append(f'correlation of range and bearing: {correlation[0, 1]:+.2f}')
    entries = ', '.join(f'{name}: {value:.4g}' for name, value in zip(names, noise.deviations))
    lines += ['', 'sensor:']
    if noise.inside:
        # With 1 a single miss would rule a target out for good.
        lines.append(f'  detection: {{probability: {min(noise.probability, 0.99):.2f}}}')
    lines.append(f'  noise: {{{entries}, as: deviation, angles: radians}}')
    return '\n'.join(lines)


def main(arguments: list[str] | None = None) -> int:
    """Run the command and return its exit code: 0, or 2 for wrong input."""
    options = build_parser().parse_args(arguments)
    recorded: RecordedRobot | None = None
    try:
        settings = read_parameters(options.parameters)
        recorded = RecordedRobot(options.bag, settings, options.robot, options.use, options.poses)
        sensor = settings.sensor.build(recorded.robot, settings.environment.dimension)
        noise = sensor_noise(recorded.observations(), sensor, options.target, options.least_range)
    except (ValueError, BagError) as error:
        if recorded is not None and recorded.recovered:
            print(f'warning: {recorded.recovered}', file=sys.stderr)
        print(f'error: {error}', file=sys.stderr)
        return 2
    if recorded.recovered:
        print(f'warning: {recorded.recovered}', file=sys.stderr)
    print(report(recorded, noise, options.target is not None))
    if options.json is not None:
        content = asdict(noise) | {'deviations': noise.deviations, 'left_out': recorded.left_out}
        text = json.dumps(content, indent=2, default=np.ndarray.tolist)
        try:
            options.json.write_text(f'{text}\n', encoding='utf-8')
        except OSError as error:
            print(f'error: --json: {options.json}: {error.strerror}', file=sys.stderr)
            return 2
    return 0


if __name__ == '__main__':
    sys.exit(main())
