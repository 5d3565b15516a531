"""Estimates a sensor's noise R from a recording of one target."""

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

from maasi_drivers.calibration.bag_reader import BagError
from maasi_drivers.calibration.recorded_robot import RecordedRobot
from maasi_drivers.calibration.sensor_calibration import SensorNoise, sensor_noise
from maasi_drivers.settings.camera import load_calibration
from maasi_drivers.settings.driver import DriverSettings
from maasi_filter.ros.parameters import parameter_fields, unflatten
from maasi_filter.wording import problems

_CLEAR = 4.0  # mean errors above this multiple of their standard deviation are significant


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(
        prog='calibrate_sensor',
        description='Estimate the noise R of a sensor (sensor.noise) and its detection '
        'probability from a recording (rosbag2) of one target seen from many positions. Images '
        'are processed as in the driver.',
    )
    add = parser.add_argument
    add('bag', type=Path, metavar='BAG', help='folder of the recording')
    add(
        '--parameters',
        type=Path,
        required=True,
        metavar='FILE',
        help="the driver's parameter file, for its camera, sensor and start",
    )
    add(
        '--robot',
        metavar='NAMESPACE',
        help='namespace of the robot (default: the only recorded robot)',
    )
    add(
        '--target',
        type=float,
        nargs='+',
        metavar='X',
        help='position of the target in the map [m] (default: the mean of its detections)',
    )
    add(
        '--use',
        choices=('images', 'detections'),
        help='use the recorded images or the detections of a driver (default: images, if recorded)',
    )
    add(
        '--poses',
        metavar='TOPIC',
        help='topic of poses: AgentState or PoseStamped in the map, or Odometry (default: '
        'state, else pose, else odom)',
    )
    add(
        '--least-range',
        type=float,
        default=0.05,
        metavar='M',
        help='skip closer observations, whose bearing is unreliable [m] (default: 0.05)',
    )
    add('--json', type=Path, metavar='FILE', help='write the result to FILE, too')
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
            raise ValueError(f'{path}: {name}: unknown parameter')
    try:
        settings = DriverSettings.model_validate(unflatten(DriverSettings, flat))
    except ValidationError as error:
        raise ValueError(f'{path}: {problems(error)}') from None
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


def report(recorded: RecordedRobot, noise: SensorNoise, given: bool) -> str:
    """Return the result as text, including lines for the robot's type or parameters."""
    names = ('range', 'bearing', 'elevation')[: len(noise.bias)]
    units = ('m', 'rad', 'rad')
    position = ' '.join(f'{value:.4f}' for value in noise.target)
    poses = f'; poses of {recorded.pose_source()}' if recorded.use == 'images' else ''
    lines = [
        f'{recorded.robot or "/"}: {noise.used} {recorded.use} used, at {noise.ranges[0]:.2f} to '
        f'{noise.ranges[1]:.2f} m{poses}',
        f'target at {position} m, ' + ('as given' if given else 'the mean of its detections'),
        f'skipped: {noise.near} from too close, {noise.others} of other objects, '
        f'{recorded.left_out} without a pose or unusable',
        f'images with the target in the field of view: {noise.inside}, without a detection: '
        f'{noise.missed}',
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
        # With 1 a single miss would rule out a target.
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
