"""Poses of a robot from its odometry or from a localiser, by topics."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry

from maasi_drivers.agent.odometry import MapOdometry, StampedPose
from maasi_drivers.agent.robot_node import RobotNode
from maasi_drivers.settings.driver import DriverSettings
from maasi_filter.models.pose import Pose
from maasi_filter.ros.conversions import FARTHEST, FASTEST, bounded, pose_from_ros, stamp_from_ros
from maasi_filter.ros.lifecycle_node import LockstepLifecycleNode
from maasi_filter.ros.qos import sensor_reader


class OdometryTopic:
    """Hands poses to `driver.take_pose`.

    Subscribes
    ----------
    `odom` (nav_msgs/Odometry)
    """

    def __init__(self, driver: RobotNode) -> None:
        self._driver = driver
        quality = sensor_reader(driver.settings.lockstep)
        driver.create_subscription(Odometry, 'odom', self._on_odometry, quality)

    def _on_odometry(self, message: Odometry) -> None:
        driver = self._driver
        if not driver.active:
            return
        stamp = stamp_from_ros(message.header.stamp)
        if not driver.is_new_pose('odom.header.stamp', stamp):
            return
        try:
            placed = self._place(stamp, message)
        except ValueError as error:
            driver.drop('odometry', f'odom: {error}')
            driver.refuse_pose(stamp)
            return
        driver.take_pose(placed)

    def _place(self, stamp: int, message: Odometry) -> StampedPose:
        driver, settings = self._driver, self._driver.settings
        frame = message.header.frame_id.lstrip('/')
        in_map = settings.odometry_origin == 'map'
        wanted = settings.odometry_frame or (settings.frame if in_map else '')
        space = frame.rpartition('/')[0]
        if (frame != wanted) if wanted else (space not in ('', driver.robot, driver.namespace)):
            raise ValueError(
                f'header.frame_id: read {frame!r}, allowed is '
                + (repr(wanted) if wanted else f"'odom' or '{driver.robot}/odom' (odometry_frame)")
            )
        pose = pose_from_ros(message.pose.pose)
        covariance = np.asarray(message.pose.covariance)
        if driver.map_odometry is None:
            origin = pose if settings.odometry_origin == 'first' else None
            driver.map_odometry = MapOdometry(
                Pose(np.zeros(3)) if in_map else driver.start_pose, origin
            )
        linear, angular = message.twist.twist.linear, message.twist.twist.angular
        bounded('twist.linear', (linear.x, linear.y, linear.z), FASTEST)
        bounded('twist.angular', (angular.x, angular.y, angular.z), FASTEST)
        bounded('pose.covariance', covariance, FARTHEST**2)
        # A negative first variance stands for an unknown covariance.
        known = covariance.any() and covariance[0] >= 0.0
        return driver.map_odometry.apply(
            stamp,
            pose,
            covariance.reshape(6, 6) if known else None,
            (linear.x, linear.y, linear.z),
            (angular.x, angular.y, angular.z),
        )


class PoseTopic:
    """Where a robot is by motion capture, SLAM or another localiser.

    Subscribes
    ----------
    `pose` (geometry_msgs/PoseStamped), in the map
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
