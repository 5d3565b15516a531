"""Velocities from poses that come without any. Without ROS."""

from __future__ import annotations

import math

import numpy as np

from maasi_drivers.agent.odometry import StampedPose
from maasi_filter.models.pose import Pose, compose, inverse

# Longest time over which a difference is a velocity [ns].
_LONGEST = 1_000_000_000
# Faster than this is a jump of the pose, not a movement [m/s, rad/s].
_FASTEST = 50.0


class PoseSpeed:
    """Differences of poses over time."""

    def __init__(self) -> None:
        self._before: tuple[int, Pose] | None = None

    def place(self, stamp: int, pose: Pose) -> StampedPose:
        """Return a pose with velocities by the difference from the one before; zero at first.

        Parameters
        ----------
        stamp : int
            [ns].
        pose : Pose
            In the map.
        """
        velocity, turning = np.zeros(3), np.zeros(3)
        before, self._before = self._before, (stamp, pose)
        if before is not None and 0 < stamp - before[0] < _LONGEST:
            period = 1e-9 * (stamp - before[0])
            velocity = (pose.position - before[1].position) / period
            change = compose(inverse(before[1]), pose).orientation
            change = change if change[0] >= 0.0 else -change
            half = float(np.linalg.norm(change[1:]))
            angle = 2.0 * math.atan2(half, float(change[0]))
            turning = change[1:] * (angle / half if half > 0.0 else 2.0) / period
            if max(np.linalg.norm(velocity), np.linalg.norm(turning)) > _FASTEST:
                velocity, turning = np.zeros(3), np.zeros(3)
        return StampedPose(stamp, pose, np.zeros((6, 6)), velocity, turning)
