"""A sensor of range, bearing and elevation."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from maasi_drivers.agent.odometry import StampedPose
from maasi_drivers.agent.ranging_mount import RangingMount
from maasi_drivers.agent.sensor_input import SensorInput
from maasi_drivers.agent.sensor_reading import SensorReading, Sweep
from maasi_filter.ros.conversions import label_problem, labels_of, stamp_from_ros
from maasi_filter.ros.qos import sensor_reader
from maasi_msgs.msg import RangeArray

FloatArray = NDArray[np.float64]


class RangingInput(SensorInput[Sweep]):
    """A sensor that measures range and direction of what is near.

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
        if not good.all():
            first = values[np.flatnonzero(~good)[0]].tolist()
            self.driver.drop(
                'range',
                f'ranges: read {first}, allowed are a finite range from 0 [m], a bearing within pi '
                'and an elevation within pi/2 [rad]',
                int(np.count_nonzero(~good)),
            )
        labelled = np.array([label_problem(item) is None for item in message.ranges], dtype=bool)
        if not labelled[good].all():
            first = next(text for item in message.ranges if (text := label_problem(item)))
            self.driver.drop('range', f'ranges: {first}', int(np.count_nonzero(~labelled[good])))
            good &= labelled
        labels = labels_of([item for item, kept in zip(message.ranges, good.tolist()) if kept])
        sweep = Sweep(values[good], labels)
        self.driver.take_frame('ranges', stamp_from_ros(message.header.stamp), sweep)

    def detect(self, data: Sweep, pose: StampedPose) -> SensorReading:
        """Return the measurements of one sweep, relative to the robot's position in the map."""
        sensor = self.driver.sensor
        if self._mount is None:
            return SensorReading.of_sweep(data, sensor, pose.pose)
        reading = SensorReading(*self._mount.measurements(data.values, pose), {}, data.labels)
        return reading.in_field_of_view(sensor, pose.pose)
