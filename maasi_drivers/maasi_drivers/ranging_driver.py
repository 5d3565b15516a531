"""The driver of a robot with a sensor of range, bearing and elevation."""

from __future__ import annotations

import math

import numpy as np

from maasi_drivers.agent.agent_driver import AgentDriver, FloatArray, Sighting
from maasi_drivers.agent.odometry import StampedPose
from maasi_drivers.agent.ranging_mount import RangingMount
from maasi_filter.ros.conversions import stamp_from_ros
from maasi_filter.ros.lifecycle_node import run
from maasi_filter.ros.qos import sensor_reader
from maasi_msgs.msg import RangeArray


class RangingDriver(AgentDriver[FloatArray]):
    """
    A robot that measures range and direction of what is near.

    Subscribes
    ----------
    `ranges` (maasi_msgs/RangeArray); what its angles are relative to: `ranging.frame`
    """

    def set_up_sensor(self) -> None:
        """Connect."""
        ranging = self.settings.ranging
        self._mount = RangingMount(ranging, self.sensor) if ranging.frame == 'body' else None
        quality = sensor_reader(self.settings.lockstep)
        self.create_subscription(RangeArray, 'ranges', self._on_ranges, quality)

    def _on_ranges(self, message: RangeArray) -> None:
        values = np.array(
            [(item.range, item.bearing, item.elevation) for item in message.ranges], dtype=float
        ).reshape(-1, 3)
        if self._mount is None:
            values = values[:, : self.dimension]
        limits = np.array([math.inf, math.pi, 0.5 * math.pi][: values.shape[1]]) + 1e-6
        good = np.isfinite(values).all(axis=1) & (values[:, 0] >= 0.0)
        good &= (np.abs(values) <= limits).all(axis=1)
        if not good.all():
            first = values[np.flatnonzero(~good)[0]].tolist()
            self.drop(
                'range',
                f'ranges: read {first}, allowed are a finite range from 0 [m], a bearing within pi '
                'and an elevation within pi/2 [rad]',
                int(np.count_nonzero(~good)),
            )
        self.take_frame('ranges', stamp_from_ros(message.header.stamp), values[good])

    def look(self, data: FloatArray, pose: StampedPose) -> Sighting:
        """Return the measurements of one sweep: as they came, or from the mounted sensor."""
        if self._mount is not None:
            values, covariances, positions = self._mount.measurements(data, pose)
            return Sighting(values, covariances, positions, {})
        positions = self.sensor.measurement.inverse(data, pose.pose)
        return Sighting(data, None, positions, {})


def main(arguments: list[str] | None = None) -> int:
    """Run the driver."""
    return run(RangingDriver, arguments)


if __name__ == '__main__':
    raise SystemExit(main())
