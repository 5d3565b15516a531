"""Topics of a robot: poses from odometry or a localiser, and the battery charge."""

import math
from collections.abc import Callable

import numpy as np
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from sensor_msgs.msg import BatteryState

from maasi_drivers.agent.odometry import MapOdometry, StampedPose, is_in_map
from maasi_drivers.agent.robot_node import RobotNode
from maasi_drivers.settings.driver import BatteryUnit, DriverSettings
from maasi_filter.models.pose import Pose
from maasi_filter.ros.conversions import FARTHEST, FASTEST, bounded, pose_from_ros, stamp_from_ros
from maasi_filter.ros.lifecycle_node import LockstepLifecycleNode
from maasi_filter.ros.qos import sensor_reader

_CONFIRMED = 3  # so many messages in a row fix their frame; one that is wrong must not


class OdometryTopic:
    """Passes poses on `odom` to `driver.take_pose`."""

    def __init__(self, driver: RobotNode) -> None:
        self._driver = driver
        self._in_map: bool | None = None  # of previous messages
        self._in_a_row = 0  # number of them
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
        in_map = is_in_map(frame, settings.odometry_origin, settings.frame)
        wanted = settings.odometry_frame
        wanted = wanted or (settings.frame if settings.odometry_origin == 'map' else '')
        space = frame.rpartition('/')[0]
        if (frame != wanted) if wanted else (space not in ('', driver.robot, driver.namespace)):
            raise ValueError(
                f'header.frame_id: read {frame!r}, allowed is '
                + (repr(wanted) if wanted else f"'odom' or '{driver.robot}/odom' (odometry_frame)")
            )
        before = 'in' if self._in_map else 'not in'
        changed = self._in_map not in (None, in_map)
        if changed and self._in_a_row >= _CONFIRMED:
            raise ValueError(
                f'header.frame_id: read {frame!r}, but previous messages were {before} '
                f'{settings.frame!r}; allowed is one frame'
            )
        pose = pose_from_ros(message.pose.pose)
        covariance = np.asarray(message.pose.covariance)
        linear, angular = message.twist.twist.linear, message.twist.twist.angular
        bounded('twist.linear', (linear.x, linear.y, linear.z), FASTEST)
        bounded('twist.angular', (angular.x, angular.y, angular.z), FASTEST)
        bounded('pose.covariance', covariance, FARTHEST**2)
        # The message is valid: from here on it may change what is known of the odometry.
        if changed:
            driver.warn_throttled(
                'frame of the odometry',
                f'odom: header.frame_id is {frame!r}, the first messages were {before} '
                f'{settings.frame!r}: restarting',
            )
            driver.restart('the frame of the odometry changed')
            driver.map_odometry, self._in_a_row = None, 0
        self._in_map, self._in_a_row = in_map, self._in_a_row + 1
        if driver.map_odometry is None:
            origin = pose if settings.odometry_origin == 'first' and not in_map else None
            driver.map_odometry = MapOdometry(
                Pose(np.zeros(3)) if in_map else driver.start_pose, origin
            )
            if in_map and settings.odometry_origin != 'map':
                driver.get_logger().warning(
                    f'odom: header.frame_id is {frame!r}: using its poses as map poses, without '
                    'adding start and yaw; set odometry_origin: map to confirm'
                )
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
    """Poses in the map on `pose`, from motion capture, SLAM or another localiser.

    `frame`: the name of the map in them; default: the driver's.
    """

    def __init__(
        self,
        node: LockstepLifecycleNode[DriverSettings],
        on_pose: Callable[[int, Pose], None],
        topic: str = 'pose',
        frame: str = '',
    ) -> None:
        self._node, self._on_pose = node, on_pose
        self._topic, self._frame = topic, frame or node.settings.frame
        node.create_subscription(PoseStamped, topic, self._receive, sensor_reader(False))

    def _receive(self, message: PoseStamped) -> None:
        frame, wanted = message.header.frame_id.strip('/'), self._frame
        try:
            if frame != wanted:
                raise ValueError(f'header.frame_id: read {frame!r}, allowed is {wanted!r}')
            pose = pose_from_ros(message.pose)
        except ValueError as error:
            self._node.drop('pose', f'{self._topic}: {error}')
            return
        self._on_pose(stamp_from_ros(message.header.stamp), pose)


# A full battery may read more than 1: a TurtleBot3 with 12.6 V reports 116.7 %, as OpenCR maps 10.5
# V to 12.3 V on 0 to 100 (`update_battery_status` in turtlebot3.cpp).
_MOST = 1.5


def charge_of(percentage: float, unit: BatteryUnit) -> float:
    """Return the charge, 0 to 1, or -1 for an invalid value."""
    charge = percentage if unit == 'fraction' else 0.01 * percentage
    return min(charge, 1.0) if 0.0 <= charge <= _MOST else -1.0


class BatteryTopic:
    """Passes charges on `battery_state` to `driver.take_charge`."""

    def __init__(self, driver: RobotNode, topic: str = 'battery_state') -> None:
        self._driver = driver
        # In lockstep: stamp [ns] and reading.
        self._waiting: list[tuple[int, float]] = []
        self._subscription = driver.create_subscription(
            BatteryState, topic, self._on_battery, sensor_reader(driver.settings.lockstep)
        )

    def _on_battery(self, message: BatteryState) -> None:
        if self._driver.settings.lockstep:
            self._waiting.append((stamp_from_ros(message.header.stamp), message.percentage))
        else:
            self._receive(message.percentage)

    def _receive(self, percentage: float) -> None:
        unit = self._driver.settings.battery_unit
        charge = charge_of(percentage, unit)
        if charge < 0.0 and not math.isnan(percentage):
            self._driver.drop(
                'battery',
                f'battery_state.percentage: read {percentage:g}, allowed is '
                f'{"0 to 1" if unit == "fraction" else "0 to 100"}, or nan: battery_unit is {unit}',
            )
        self._driver.take_charge(charge)

    def receive_before(self, stamp: int) -> None:
        """In lockstep, handle the readings before a stamp [ns]."""
        handle = self._subscription.handle
        while (taken := handle.take_message(BatteryState, False)) is not None:
            self._on_battery(taken[0])
        ready = sorted(item for item in self._waiting if item[0] < stamp)
        self._waiting = [item for item in self._waiting if item[0] >= stamp]
        for _, reading in ready:
            self._receive(reading)
