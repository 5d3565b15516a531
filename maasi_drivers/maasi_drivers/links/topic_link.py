"""A robot with ROS topics for odometry, battery and velocity commands."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from geometry_msgs.msg import TwistStamped

from maasi_drivers.agent import geofence
from maasi_drivers.agent.battery_topic import BatteryTopic
from maasi_drivers.agent.odometry import StampedPose
from maasi_drivers.agent.odometry_topic import OdometryTopic
from maasi_drivers.agent.robot_node import RobotNode
from maasi_drivers.links.command_publisher import CommandPublisher
from maasi_drivers.links.robot_link import RobotLink
from maasi_filter.ros.conversions import stamp_to_ros

_ZERO = (0.0, 0.0, 0.0, 0.0)
# At the end: commands, and longest wait until the last one has arrived [s].
_STOP_COMMANDS, _STOP_TIME = 3, 0.3
# Polls from one look for the guard to the next.
_GUARD_POLLS = 5


class TopicLink(RobotLink):
    """A link by ROS topics.

    Subscribes
    ----------
    `odom` (nav_msgs/Odometry), unless poses come from tf or `pose`;
    `battery_state` (sensor_msgs/BatteryState)

    Publishes
    ---------
    `cmd_vel` (geometry_msgs/TwistStamped or Twist, as the robot listens), with each pose, and
    zeros on a fault and at the end
    """

    def __init__(self, driver: RobotNode) -> None:
        super().__init__(driver)
        settings = driver.settings
        # In the plane the bounds of the environment have no heights.
        self._fence = geofence.make_vehicle_fence(
            None, driver.bounds, settings.radius, 0.0, settings.start[2]
        )
        self._publisher: CommandPublisher | None = None
        self._polls = 0
        # Whether it has a guard, and whether it had one.
        self._guarded = self._was_guarded = False
        self._command = TwistStamped()
        self._command.header.frame_id = f'{driver.robot}/base_link'

    def connect(self) -> None:
        """Subscribe, and publish commands."""
        driver, settings = self.driver, self.driver.settings
        commands = CommandPublisher(driver, 'cmd_vel', settings.command_type, settings.lockstep)
        self._publisher = commands
        if settings.poses == 'odometry':
            OdometryTopic(driver)
        self._battery = BatteryTopic(driver)
        driver.expect_subscribers(lambda: commands.publisher)

    def close(self) -> None:
        """Destroy the publisher."""
        if self._publisher is not None:
            self._publisher.destroy()
            self._publisher = None

    def send(self, placed: StampedPose, command: Sequence[float]) -> None:
        """Publish a command, with the stamp of the pose."""
        self._command.header.stamp = stamp_to_ros(placed.stamp)
        self._publish(command)

    def hold(self) -> None:
        """Publish zeros."""
        self._publish(_ZERO)

    def stop(self) -> None:
        """Publish zeros, and wait until they have arrived."""
        if self._publisher is None:
            return
        for _ in range(_STOP_COMMANDS):
            self._publish(_ZERO)
        self._publisher.wait(_STOP_TIME)

    def poll(self) -> None:
        """Follow the type that the robot subscribes to; warn where nothing does."""
        if self._publisher is None:
            return
        self._publisher.refresh()
        if problem := self._publisher.problem():
            self.driver.warn_throttled('cmd_vel', problem)
        if self._polls % _GUARD_POLLS == 0:
            readers = self.driver.get_subscriptions_info_by_topic('state')
            self._guarded = any(item.node_name == 'guard' for item in readers)
            self._was_guarded |= self._guarded
        self._polls += 1
        if self._was_guarded and not self._guarded:
            self.driver.warn_throttled(
                'guard', 'the guard has gone: nobody stops the robot if this driver dies'
            )

    def status(self) -> dict[str, Any]:
        """Return whether there is a guard."""
        return {'guard': 'is there' if self._guarded else 'is not there'}

    def goal_problem(self, position: Sequence[float]) -> str | None:
        """Refuse heights far from that of the start; a ground robot has none."""
        if self.driver.follower.on_ground:
            return None
        return geofence.goal_problem(self._fence, position)

    def begin_step(self, stamp: int) -> None:
        """Take the readings of the battery before this step."""
        self._battery.take_before(stamp)

    def hold_step(self, stamp: int) -> None:
        """Publish zeros with the stamp of the step."""
        self._command.header.stamp = stamp_to_ros(stamp)
        self._publish(_ZERO)

    def repeat(self) -> None:
        """Publish the last command again."""
        if self._publisher is not None:
            self._publisher.publish(self._command)

    def _publish(self, command: Sequence[float]) -> None:
        twist = self._command.twist
        twist.linear.x, twist.linear.y, twist.linear.z, twist.angular.z = command
        if self._publisher is not None:
            self._publisher.publish(self._command)
