"""What a sensor reads at one instant. Without ROS."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from maasi_filter.models.pose import Pose
from maasi_filter.models.sensor import Sensor

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class SensorReading:
    """
    Detections of one image or sweep.

    Attributes
    ----------
    values : ndarray, shape (m, d)
        Range [m], bearing and, in 3D, elevation [rad].
    covariances : ndarray, shape (m, d, d), or None
        Of the values; None: the sensor's R.
    positions : ndarray, shape (m, d)
        Of the targets by these values [m, map].
    dropped : dict
        Detections left out: reason to count.

    """

    values: FloatArray
    covariances: FloatArray | None
    positions: FloatArray
    dropped: dict[str, int]

    @classmethod
    def of_ranges(cls, values: FloatArray, sensor: Sensor, pose: Pose) -> SensorReading:
        """
        Return the detections of a ranging sensor that are in its field of view.

        Parameters
        ----------
        values : ndarray, shape (m, d)
            Range [m], bearing and, in 3D, elevation [rad], from the robot on the map's axes.
        sensor : Sensor
            Of the robot.
        pose : Pose
            Of the robot in the map.

        """
        positions = sensor.measurement.inverse(values, pose)
        return cls(values, None, positions, {}).in_field_of_view(sensor, pose)

    def in_field_of_view(self, sensor: Sensor, pose: Pose) -> SensorReading:
        """
        Return the detections with pi(x, q) > 0 and within the maximum range; the rest is counted.

        Parameters
        ----------
        sensor : Sensor
            Its detection model and maximum range.
        pose : Pose
            q, of the robot in the map.

        """
        if not len(self.values):
            return self
        inside = sensor.detection.probability(self.positions, pose) > 0.0
        inside &= self.values[:, 0] <= sensor.maximum_range
        outside = int(np.count_nonzero(~inside))
        if not outside:
            return self
        return replace(
            self,
            values=self.values[inside],
            covariances=None if self.covariances is None else self.covariances[inside],
            positions=self.positions[inside],
            dropped=self.dropped | {'outside the field of view': outside},
        )
