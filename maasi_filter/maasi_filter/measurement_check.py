"""Checks measurements before a step, and counts detections that are not used by their reason."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from maasi_filter.arrays import BoolArray, FloatArray
from maasi_filter.models.detection import BoxDetection
from maasi_filter.models.pose import Pose
from maasi_filter.models.sensor import Sensor, is_covariance
from maasi_filter.records import AgentMeasurement, FoundTarget, Label
from maasi_filter.settings import FilterSettings

# Default position error of a robot with a box-shaped field of view, which blurs its edge, as a
# share of its half size.
POSE_ERROR_OF_BOX = 0.05
# Largest number of detections of a scan, which bounds the computation time.
MOST_VALUES = 1000
# Reasons that are not faults: the detection belongs to a found target, or repeats another one.
FOUND = 'found'
REPEATED = 'repeated'


@dataclass
class CheckedMeasurement:
    """A valid measurement whose detections all have covariances and are in a fixed order.

    Attributes
    ----------
    robot : str
        Name of the robot.
    pose : Pose
        Pose of the robot [m, map].
    sensor : Sensor
        Its sensor.
    values : (m, d) array
        Range [m], bearing and, in 3D, elevation [rad] of each detection.
    covariances : (m, d, d) array
        Covariances of `values` [m, rad].
    has_covariances : bool
        Whether the measurement had them; otherwise they are those of the sensor.
    index : int
        Number of the measurement of this robot.
    """

    robot: str
    pose: Pose
    sensor: Sensor
    values: FloatArray
    covariances: FloatArray
    has_covariances: bool
    index: int
    #: Standard deviation of the robot's position error per axis, as far as the covariances do
    #: not include it [m].
    pose_error: float
    labels: tuple[Label, ...] = ()  # of each detection, or empty

    def only(self, keep: BoolArray) -> CheckedMeasurement:
        """Return a copy with the detections selected by `keep`."""
        if keep.all():
            return self
        labels = tuple(label for label, kept in zip(self.labels, keep.tolist()) if kept)
        return replace(
            self, values=self.values[keep], covariances=self.covariances[keep], labels=labels
        )


def check_measurements(
    measurements: Sequence[AgentMeasurement],
    steps: int,
    time: float,
    settings: FilterSettings,
    dimension: int,
) -> list[CheckedMeasurement]:
    """Return the valid measurements of a step in the order of the robots' names.

    Parameters
    ----------
    measurements : sequence of AgentMeasurement
        One for each robot that measured.
    steps : int
        Steps since the previous call.
    time : float
        Since the first step [s].
    settings : FilterSettings
        Of the filter.
    dimension : int
        2 or 3.

    Returns
    -------
    list of CheckedMeasurement
        With `values` (m, d): range [m], bearing and, in 3D, elevation [rad].

    Raises
    ------
    ValueError
        If a number is not finite, a shape or covariance is wrong, or a robot occurs twice.
    """
    if isinstance(steps, bool) or int(steps) != steps or steps < 0:
        raise ValueError(f'steps: got {steps!r}, allowed are whole numbers from 0')
    if not math.isfinite(time):
        raise ValueError(f'time: got {time}, allowed are finite numbers')
    ordered = sorted(measurements, key=lambda item: item.robot)
    members = [_checked(item, settings, dimension) for item in ordered]
    names = [member.robot for member in members]
    if len(set(names)) != len(names):
        raise ValueError(f'measurements: got robots {names}, allowed is each robot once')
    return members


def pose_error_of(sensor: Sensor, settings: FilterSettings, dimension: int) -> float:
    """Return the default position error of a robot that reports none [m]."""
    if settings.pose_error is not None:
        return settings.pose_error
    if isinstance(sensor.detection, BoxDetection):
        extent = sensor.detection.upper - sensor.detection.lower
        return POSE_ERROR_OF_BOX * 0.5 * float(extent[:dimension].min())
    return 0.0


def _checked(measurement: AgentMeasurement, settings: FilterSettings, d: int) -> CheckedMeasurement:
    name, sensor = measurement.robot, measurement.sensor
    if sensor.dimension != d:
        raise ValueError(f'{name}: sensor: got {sensor.dimension} dimensions, allowed is {d}')
    values = np.array(measurement.values, dtype=float)
    if values.size == 0:
        values = values.reshape(0, d)
    if values.ndim != 2 or values.shape[1] != d:
        raise ValueError(f'{name}: values: got shape {values.shape}, allowed is (m, {d})')
    if len(values) > MOST_VALUES:
        raise ValueError(f'{name}: values: got {len(values)}, allowed are {MOST_VALUES}')
    if not np.isfinite(values).all():
        raise ValueError(f'{name}: values: got {values.tolist()}, allowed are finite numbers')
    covariances = np.repeat(sensor.covariance[None], len(values), axis=0)
    given = measurement.covariances if settings.use_detection_covariances else None
    has_covariances = given is not None
    if given is not None:
        covariances = _own_covariances(name, given, len(values), d)
    pose_error = pose_error_of(sensor, settings, d)
    if measurement.position_covariance is not None:
        reported = _reported_error(name, measurement.position_covariance, d)
        if settings.pose_error is None and not has_covariances:
            pose_error = max(pose_error, reported)
    labels = tuple(measurement.labels)
    if len(labels) not in (0, len(values)):
        raise ValueError(f'{name}: labels: got {len(labels)}, allowed are {len(values)}, or none')
    # Results do not depend on the order in which a sensor lists detections.
    order = np.lexsort(values.T[::-1])
    return CheckedMeasurement(
        name,
        measurement.pose,
        sensor,
        values[order],
        covariances[order],
        has_covariances,
        measurement.index,
        pose_error,
        tuple(labels[i] for i in order.tolist()) if labels else (),
    )


def _own_covariances(name: str, given: FloatArray, count: int, d: int) -> FloatArray:
    covariances = np.array(given, dtype=float)
    if covariances.size == 0:
        covariances = covariances.reshape(0, d, d)
    if covariances.shape != (count, d, d):
        raise ValueError(
            f'{name}: covariances: got shape {covariances.shape}, allowed is ({count}, {d}, {d})'
        )
    wrong = [covariance for covariance in covariances if not is_covariance(covariance)]
    if wrong:
        raise ValueError(
            f'{name}: covariances: got {wrong[0].tolist()}, allowed is a symmetric positive '
            'definite matrix of finite numbers'
        )
    return covariances


def _reported_error(name: str, reported: FloatArray, d: int) -> float:
    matrix = np.asarray(reported, dtype=float)
    variances = np.diagonal(matrix)
    if variances.shape != (3,) or not (np.isfinite(variances).all() and min(variances) >= 0):
        raise ValueError(
            f'{name}: position_covariance: got {matrix.tolist()}, allowed is a (3, 3) matrix with '
            'finite variances from 0'
        )
    return math.sqrt(float(variances[:d].max()))


def check_shared(robot: str, targets: Sequence[FoundTarget], dimension: int) -> None:
    """Raise ValueError for targets with non-finite numbers, another dimension, or equal ids."""
    ids = [target.id for target in targets]
    if min(ids, default=1) < 1 or len(set(ids)) < len(ids):
        raise ValueError(f'{robot}: target ids: got {ids}, allowed are different ones from 1')
    for target in targets:
        shapes = target.position.shape, target.covariance.shape
        if shapes != ((dimension,), (dimension, dimension)):
            raise ValueError(
                f'{robot}: target {target.id}: got {len(target.position)} dimensions, allowed '
                f'is {dimension}'
            )
        if not (np.isfinite(target.position).all() and is_covariance(target.covariance)):
            raise ValueError(
                f'{robot}: target {target.id}: got position {target.position.tolist()} with '
                f'covariance {target.covariance.tolist()}, allowed are finite numbers and a '
                'positive definite matrix'
            )


def count_dropped(dropped: dict[str, int], reason: str, number: int) -> None:
    """Count detections that are dropped for a reason."""
    if number:
        dropped[reason] = dropped.get(reason, 0) + number


def within_range(member: CheckedMeasurement, dropped: dict[str, int]) -> CheckedMeasurement:
    """Return a measurement without detections beyond the range of its sensor."""
    reach = member.values[:, 0] <= member.sensor.maximum_range
    count_dropped(dropped, 'range', int((~reach).sum()))
    return member.only(reach)


def without_repeats(member: CheckedMeasurement, dropped: dict[str, int]) -> CheckedMeasurement:
    """Merge detections closer than the sensor's resolution, unless their identities differ."""
    values, gate = member.values, member.sensor.resolution
    # Detections are sorted by range.
    reach = values[:, 0] - gate * np.sqrt(member.covariances[:, 0, 0])
    first = np.searchsorted(values[:, 0], reach, side='right')
    keep = np.ones(len(values), np.bool_)
    for j in np.flatnonzero(first < np.arange(len(values))).tolist():
        others = first[j] + np.flatnonzero(keep[first[j] : j])
        errors = member.sensor.measurement.residual(values[others], values[j])
        solved = np.linalg.solve(member.covariances[j], errors.T).T
        same = (errors * solved).sum(axis=1) < gate**2
        if member.labels:
            same &= [member.labels[i].identity == member.labels[j].identity for i in others]
        keep[j] = not same.any()
    count_dropped(dropped, REPEATED, int((~keep).sum()))
    return member.only(keep)


def count_unexplained(centres: FloatArray, bounds: FloatArray, dropped: dict[str, int]) -> None:
    """Count detections that only clutter explains, by the positions (m, d) that they point at."""
    inside = ((centres >= bounds[:, 0]) & (centres <= bounds[:, 1])).all(axis=1)
    count_dropped(dropped, 'outside', int((~inside).sum()))
    count_dropped(dropped, 'unseen', int(inside.sum()))
