"""A ground robot's laser scan: placed in the map for its controller, and watched."""

from __future__ import annotations

import numpy as np
from sensor_msgs.msg import LaserScan

from maasi_drivers.agent.driver_settings import ScanSettings
from maasi_drivers.agent.odometry import StampedPose
from maasi_drivers.agent.robot_node import RobotNode
from maasi_drivers.agent.scan_avoidance import ScanUnicycle, scan_points
from maasi_drivers.agent.waypoint_follower import Goal, GoalStatus
from maasi_filter.ros.conversions import stamp_from_ros
from maasi_filter.ros.qos import sensor_reader
from maasi_planner.motion import RobotState

# Kind of fault.
_SCAN = 'scan'
# A distance to the waypoint that is smaller by this is progress [m].
_PROGRESS = 0.02


class ScanInput:
    """Hands scans to the controller, and finds out whether they are silent or the robot is blocked.

    Subscribes
    ----------
    `scan` (sensor_msgs/LaserScan)

    Parameters
    ----------
    driver : RobotNode
        The robot's node.
    settings : ScanSettings
        Place of the scanner, and timeouts.
    motion : ScanUnicycle
        The controller.
    """

    def __init__(self, driver: RobotNode, settings: ScanSettings, motion: ScanUnicycle) -> None:
        self._driver = driver
        self._settings = settings
        self._motion = motion
        self.reset()

    def reset(self) -> None:
        """Discard what belongs to another time."""
        self._scan: LaserScan | None = None
        self._scanned_at: int | None = None
        # The present goal, the least distance that was left to it [m], and its stamp [ns].
        self._nearest: tuple[Goal, float, int] | None = None

    def set_up(self) -> None:
        """Compile and subscribe."""
        driver, motion = self._driver, self._motion
        position = driver.settings.start
        motion.see([[position[0] + 0.4, position[1]], [position[0] + 9.0, position[1]]])
        state = RobotState.at_rest(position)
        motion.command(state, [position[0] + 1.0, position[1], position[2]])
        motion.see(np.zeros((0, 2)))
        quality = sensor_reader(driver.settings.lockstep)
        driver.create_subscription(LaserScan, 'scan', self._on_scan, quality)

    def update(self, placed: StampedPose) -> None:
        """Place the last scan, and stop a robot without scans; before each command."""
        self._place()
        if self._scanned_at is None:
            self._scanned_at = placed.stamp
        age = 1e-9 * (placed.stamp - self._scanned_at)
        if age > self._settings.timeout:
            text = f'no scan for {age:.1f} s'
            if self._driver.health.begin(_SCAN, text):
                self._driver.get_logger().warning(f'{text}: stopping the robot')

    def is_blocked(self, placed: StampedPose) -> bool:
        """Return whether the robot has made no progress to its waypoint for `blocked_timeout`."""
        follower = self._driver.follower
        goal = follower.goal
        if goal is None or goal.status != GoalStatus.MOVING:
            self._nearest = None
            return False
        left = follower.distance(placed.pose.position)
        if (
            self._nearest is None
            or self._nearest[0] is not goal
            or left < self._nearest[1] - _PROGRESS
        ):
            self._nearest = (goal, left, placed.stamp)
        return 1e-9 * (placed.stamp - self._nearest[2]) > self._settings.blocked_timeout

    def _on_scan(self, message: LaserScan) -> None:
        if self._driver.active:
            self._scan = message
            self._place()

    def _place(self) -> None:
        """Place the scan in the map once the odometry covers its stamp."""
        driver, message, settings = self._driver, self._scan, self._settings
        latest = driver.history.latest
        if message is None or latest is None:
            return
        stamp = stamp_from_ros(message.header.stamp)
        if stamp > latest.stamp:
            return
        self._scan = None
        placed = driver.history.at(stamp)
        if placed is None:
            driver.drop(
                'scan',
                f'scan.header.stamp: read {stamp} ns, allowed is what the odometry covers, up to '
                f'{latest.stamp} ns',
            )
            return
        try:
            points = scan_points(
                message.ranges,
                (message.angle_min, message.angle_increment),
                (message.range_min, message.range_max),
                message.time_increment,
                placed,
                [*settings.position, settings.yaw],
            )
        except ValueError as error:
            driver.drop('scan', f'scan.{error}')
            return
        self._motion.see(points)
        self._scanned_at = latest.stamp
        if driver.health.end(_SCAN):
            driver.get_logger().info('scan: received again')
