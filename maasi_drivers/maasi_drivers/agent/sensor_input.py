"""A robot's sensor as used by its driver, and a sensor of range, bearing and elevation."""

import math
from abc import ABC, abstractmethod
from typing import Generic, TypeVar

import numpy as np

from maasi_drivers.agent.odometry import StampedPose
from maasi_drivers.agent.robot_node import RobotNode
from maasi_drivers.agent.sensor_reading import SensorReading, Sweep, measured
from maasi_drivers.settings.driver import RangingSettings
from maasi_filter.arrays import FloatArray
from maasi_filter.models.pose import Pose
from maasi_filter.models.sensor import Sensor
from maasi_filter.ros.conversions import label_problem, labels_of, stamp_from_ros
from maasi_filter.ros.qos import sensor_reader
from maasi_msgs.msg import RangeArray

DataT = TypeVar('DataT')


class SensorInput(ABC, Generic[DataT]):
    """A source of images or sweeps, and the detection of targets in them.

    Each image or sweep is passed to `driver.receive_frame`.

    Parameters
    ----------
    driver : RobotNode
        The robot's node.

    Attributes
    ----------
    name : str
        What it delivers, for messages.
    offset : int
        Added to the stamp of an image for the time of its pose [ns].
    """

    name = 'sweep'

    def __init__(self, driver: RobotNode) -> None:
        self.driver = driver
        self.offset = 0

    def prepare(self) -> None:
        """Check the settings; raise `SettingsError` for one that is not allowed."""

    @abstractmethod
    def set_up(self) -> None:
        """Compile kernels and subscribe, in *configure*."""

    @abstractmethod
    def detect(self, data: DataT, pose: StampedPose) -> SensorReading:
        """Return the detections in an image or sweep.

        Parameters
        ----------
        data : image or sweep
            What was passed to `driver.receive_frame`.
        pose : StampedPose
            Pose of the robot at the stamp of `data`, with its covariance.

        Returns
        -------
        SensorReading
            With ranges [m] and angles [rad] from the robot, and their covariances.

        Raises
        ------
        ValueError
            If it cannot be used: the next one answers instead.
        """

    def close(self) -> None:
        """Release what is no ROS entity; may be called repeatedly."""


class RangingMount:
    """Converts sweeps of a mounted sensor into measurements from the robot's position."""

    def __init__(self, settings: RangingSettings, sensor: Sensor) -> None:
        self._model = sensor.measurement
        self._position = np.array(settings.position)
        self._rotation = Pose.from_rpy([0.0, 0.0, 0.0], settings.rpy).rotation()
        self._noise = np.zeros((3, 3))
        d = sensor.dimension
        self._noise[:d, :d] = sensor.covariance
        if d == 2:
            self._noise[2, 2] = sensor.covariance[1, 1]

    def measurements(
        self, sweep: FloatArray, pose: StampedPose
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return values (m, d), covariances and map positions of a sweep (m, 3) [m, rad]."""
        d = self._model.dimension
        if not len(sweep):
            return np.zeros((0, d)), np.zeros((0, d, d)), np.zeros((0, d))
        body = pose.pose.rotation()
        ranges, bearings, elevations = sweep.T
        cb, sb = np.cos(bearings), np.sin(bearings)
        ce, se = np.cos(elevations), np.sin(elevations)
        unit = np.stack([ce * cb, ce * sb, se], axis=1)
        # Columns: by range, by bearing, by elevation.
        slopes = np.stack(
            [
                unit,
                ranges[:, None] * np.stack([-ce * sb, ce * cb, np.zeros_like(sb)], axis=1),
                ranges[:, None] * np.stack([-se * cb, -se * sb, ce], axis=1),
            ],
            axis=2,
        )
        turn = body @ self._rotation
        arms = self._position @ body.T + (ranges[:, None] * unit) @ turn.T
        by_sweep = turn @ slopes
        spread = by_sweep @ self._noise @ by_sweep.transpose(0, 2, 1)
        # A small rotation about the map's axes moves a target by the cross product with its arm.
        by_turn = np.cross(np.eye(3), arms[:, None]).transpose(0, 2, 1)
        spread = spread + by_turn @ pose.covariance[3:, 3:] @ by_turn.transpose(0, 2, 1)
        positions = (pose.pose.position + arms)[:, :d]
        values, covariances = measured(self._model, positions, spread[:, :d, :d], pose.pose)
        return values, covariances, positions


class RangingInput(SensorInput[Sweep]):
    """A sensor of range and direction; `ranging.frame` defines its angles.

    Subscribes
    ----------
    `ranges` (maasi_msgs/RangeArray); what its angles are relative to: `ranging.frame`
    """

    def set_up(self) -> None:
        """Subscribe."""
        driver, ranging = self.driver, self.driver.settings.ranging
        self._mount = RangingMount(ranging, driver.sensor) if ranging.frame == 'body' else None
        quality = sensor_reader(driver.settings.lockstep)
        driver.create_subscription(RangeArray, 'ranges', self._on_ranges, quality)

    def _on_ranges(self, message: RangeArray) -> None:
        values = np.array(
            [(item.range, item.bearing, item.elevation) for item in message.ranges], dtype=float
        ).reshape(-1, 3)
        if self._mount is None:
            values = values[:, : self.driver.dimension]
        limits = np.array([math.inf, math.pi, 0.5 * math.pi][: values.shape[1]]) + 1e-6
        good = np.isfinite(values).all(axis=1) & (values[:, 0] >= 0.0)
        good &= (np.abs(values) <= limits).all(axis=1)
        problems = [
            label_problem(item)
            if fine
            else f'read {row}, allowed are a finite range from 0 [m], a bearing within pi and an '
            'elevation within pi/2 [rad]'
            for item, row, fine in zip(message.ranges, values.tolist(), good.tolist())
        ]
        if wrong := [text for text in problems if text is not None]:
            self.driver.drop('range', f'ranges: {wrong[0]}', len(wrong))
        kept = [text is None for text in problems]
        labels = labels_of([item for item, good in zip(message.ranges, kept) if good])
        sweep = Sweep(values[np.array(kept, dtype=bool)], labels)
        self.driver.receive_frame('ranges', stamp_from_ros(message.header.stamp), sweep)

    def detect(self, data: Sweep, pose: StampedPose) -> SensorReading:
        """Return the measurements of one sweep, relative to the robot's position in the map."""
        sensor = self.driver.sensor
        if self._mount is None:
            return SensorReading.of_sweep(data, sensor, pose.pose)
        reading = SensorReading(*self._mount.measurements(data.values, pose), {}, data.labels)
        return reading.in_field_of_view(sensor, pose.pose)
