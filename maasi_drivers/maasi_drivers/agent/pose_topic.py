"""Poses of a localiser, from a topic."""

from __future__ import annotations

from collections.abc import Callable

from geometry_msgs.msg import PoseStamped

from maasi_drivers.agent.driver_settings import DriverSettings
from maasi_filter.models.pose import Pose
from maasi_filter.ros.conversions import pose_from_ros, stamp_from_ros
from maasi_filter.ros.lifecycle_node import LockstepLifecycleNode
from maasi_filter.ros.qos import sensor_reader


class PoseTopic:
    """Where a robot is by motion capture, SLAM or another localiser.

    Subscribes
    ----------
    `pose` (geometry_msgs/PoseStamped), in the map

    Parameters
    ----------
    node : LockstepLifecycleNode
        The robot's driver.
    on_pose : callable
        Takes stamp [ns] and pose in the map.
    """

    def __init__(
        self, node: LockstepLifecycleNode[DriverSettings], on_pose: Callable[[int, Pose], None]
    ) -> None:
        self._node = node
        self._on_pose = on_pose
        node.create_subscription(PoseStamped, 'pose', self._take, sensor_reader(False))

    def _take(self, message: PoseStamped) -> None:
        frame, wanted = message.header.frame_id.strip('/'), self._node.settings.frame
        try:
            if frame != wanted:
                raise ValueError(f'header.frame_id: read {frame!r}, allowed is {wanted!r}')
            pose = pose_from_ros(message.pose)
        except ValueError as error:
            self._node.drop('pose', f'pose: {error}')
            return
        self._on_pose(stamp_from_ros(message.header.stamp), pose)
