"""The reading of a sensor at one instant. Without ROS."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from maasi_filter.arrays import BoolArray, FloatArray
from maasi_filter.models.measurement import RangeAndAngles
from maasi_filter.models.pose import Pose
from maasi_filter.models.sensor import Sensor
from maasi_filter.records import Label


@dataclass(frozen=True)
class Sweep:
    """The returns of a ranging sensor at one instant: values and labels as in `SensorReading`."""

    values: FloatArray
    labels: tuple[Label, ...] = ()


# Variance of a completely unknown angle: uniform over the circle [rad^2].
_ANY_ANGLE = np.pi**2 / 3.0


def measured(
    model: RangeAndAngles, positions: FloatArray, covariances: FloatArray, pose: Pose
) -> tuple[FloatArray, FloatArray]:
    """Return range and angles of targets (n, d) [m, map] with first-order covariances.

    Right above a target the bearing is unknown: its variance is at most that of a uniform
    angle.
    """
    # Straight above the derivative does not exist; use that at a distance of 1 nm.
    shifted = np.array(positions)
    shifted[(shifted[:, :2] == pose.position[:2]).all(axis=1), 0] += 1e-9
    slopes = model.jacobian(shifted, pose)
    result = slopes @ covariances @ slopes.transpose(0, 2, 1)
    known = np.sqrt(_ANY_ANGLE / np.maximum(result[:, 1, 1], _ANY_ANGLE))[:, None]
    result[:, 1] *= known
    result[:, :, 1] *= known
    return model.measure(positions, pose), result


@dataclass(frozen=True)
class SensorReading:
    """Detections of one image or sweep.

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
    labels : tuple of Label
        Class and identity of each detection; empty: none is known.
    """

    values: FloatArray
    covariances: FloatArray | None
    positions: FloatArray
    dropped: dict[str, int]
    labels: tuple[Label, ...] = ()

    @classmethod
    def of_sweep(cls, sweep: Sweep, sensor: Sensor, pose: Pose) -> SensorReading:
        """Return the detections of a sweep in the field of view, on the map's axes."""
        positions = sensor.measurement.inverse(sweep.values, pose)
        reading = cls(sweep.values, None, positions, {}, sweep.labels)
        return reading.in_field_of_view(sensor, pose)

    def in_field_of_view(self, sensor: Sensor, pose: Pose) -> SensorReading:
        """Return the detections in the field of view (pi(x, q) > 0, in range); count the rest."""
        if not len(self.values):
            return self
        inside = sensor.detection.probability(self.positions, pose) > 0.0
        inside &= self.values[:, 0] <= sensor.maximum_range
        return self.only(inside, 'outside the field of view')

    def only(self, keep: BoolArray, reason: str) -> SensorReading:
        """Return the detections where `keep` (m,) is true; count the rest under a reason."""
        left_out = int(np.count_nonzero(~keep))
        if not left_out:
            return self
        return replace(
            self,
            values=self.values[keep],
            covariances=None if self.covariances is None else self.covariances[keep],
            positions=self.positions[keep],
            dropped=self.dropped | {reason: left_out},
            labels=tuple(label for label, kept in zip(self.labels, keep.tolist()) if kept),
        )
