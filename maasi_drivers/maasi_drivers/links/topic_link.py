"""A robot with ROS topics for odometry, battery and velocity commands."""

import time
from collections import Counter
from collections.abc import Sequence
from typing import Any

from geometry_msgs.msg import Twist, TwistStamped
from rclpy.duration import Duration
from rclpy.node import Node

from maasi_drivers.agent.flight_rules import flight_volume
from maasi_drivers.agent.odometry import StampedPose
from maasi_drivers.agent.robot_node import RobotNode
from maasi_drivers.agent.robot_topics import BatteryTopic, OdometryTopic
from maasi_drivers.links.robot_link import RobotLink
from maasi_drivers.settings.driver import CommandType
from maasi_drivers.settings.vehicles import FlightSettings
from maasi_filter.ros.conversions import stamp_to_ros
from maasi_filter.ros.qos import COMMANDS, RELIABLE

_TYPES: dict[str, type] = {
    'geometry_msgs/msg/TwistStamped': TwistStamped,
    'geometry_msgs/msg/Twist': Twist,
}
_PATIENCE = 10.0  # a robot may start, or restart, this much later than its driver [s]


class CommandPublisher:
    """Publishes TwistStamped (TurtleBot3 on Jazzy), Twist (on Humble) or the subscribed type."""

    def __init__(self, node: Node, topic: str, kind: CommandType, lockstep: bool = False) -> None:
        self._node = node
        self._quality = RELIABLE if lockstep else COMMANDS
        self.topic = node.resolve_topic_name(topic)
        #: None until the type is known.
        self.publisher: Any = None
        self._kind: type = TwistStamped
        self._subscribed_at = time.monotonic()
        self._auto = kind == 'auto' and not lockstep
        if self._auto:
            self.refresh()
        else:
            self._use(Twist if kind == 'twist' else TwistStamped)

    def _use(self, kind: type) -> None:
        # A process can have only one type per topic.
        self.destroy()
        self._kind = kind
        self.publisher = self._node.create_publisher(kind, self.topic, self._quality)

    def refresh(self) -> str:
        """Follow the subscribed type; return why no command is received, or nothing."""
        if self.publisher is not None and self.publisher.get_subscription_count():
            self._subscribed_at = time.monotonic()
            return ''
        known = self._node.get_subscriptions_info_by_topic(self.topic)
        wanted = [name for name, _ in Counter(item.topic_type for item in known).most_common()]
        kind = next((_TYPES[name] for name in wanted if name in _TYPES), None)
        if self._auto and kind is not None and (self.publisher is None or kind is not self._kind):
            self._use(kind)
        if not wanted:
            silence = time.monotonic() - self._subscribed_at
            if silence < _PATIENCE:
                return ''
            return f'{self.topic}: no subscription for {silence:.0f} s; is the robot running?'
        if any(_TYPES.get(name) is self._kind for name in wanted):
            return ''  # discovered, but not connected yet
        return (
            f'{self.topic}: the robot subscribes to {", ".join(wanted)}; set the parameter '
            'command_type'
        )

    def publish(self, command: TwistStamped) -> None:
        """Publish a command, in the subscribed type."""
        if self.publisher is not None:
            self.publisher.publish(command if self._kind is TwistStamped else command.twist)

    def destroy(self) -> None:
        """Destroy the publisher."""
        if self.publisher is not None:
            self._node.destroy_publisher(self.publisher)
            self.publisher = None


_ZERO = (0.0, 0.0, 0.0, 0.0)
# At the end: commands, and longest wait for the acknowledgement of the last one [s].
_STOP_COMMANDS, _STOP_TIME = 3, Duration(seconds=0.3)
_GUARD_POLLS = 5  # polls between two checks for the guard


class TopicLink(RobotLink):
    """A link by ROS topics.

    Subscribes
    ----------
    `odom` (nav_msgs/Odometry), unless poses come from tf or `pose`;
    `battery_state` (sensor_msgs/BatteryState)

    Publishes
    ---------
    `cmd_vel` (geometry_msgs/TwistStamped or Twist, as subscribed) with each pose, and zeros on a
    fault and at the end
    """

    def __init__(self, driver: RobotNode) -> None:
        super().__init__(driver)
        settings = driver.settings
        if settings.motion.model != 'unicycle':
            # In 2D the bounds of the environment have no heights.
            driver.volume = flight_volume(driver.volume.area, settings, FlightSettings())
        self._commands = CommandPublisher(
            driver, 'cmd_vel', settings.command_type, settings.lockstep
        )
        self._polls = 0
        # Whether it has a guard, and whether it had one.
        self._guarded = self._was_guarded = False
        self._command = TwistStamped()
        self._command.header.frame_id = f'{driver.robot}/base_link'

    def connect(self) -> None:
        """Subscribe to the robot."""
        driver = self.driver
        if driver.settings.poses == 'odometry':
            OdometryTopic(driver)
        self._battery = BatteryTopic(driver)
        driver.expect_subscribers(lambda: self._commands.publisher)

    def close(self) -> None:
        """Destroy the publisher."""
        self._commands.destroy()

    def send(self, placed: StampedPose, command: Sequence[float]) -> None:
        """Publish a command, with the stamp of the pose."""
        self._command.header.stamp = stamp_to_ros(placed.stamp)
        self._publish(command)

    def hold(self) -> None:
        """Publish zeros."""
        self._publish(_ZERO)

    def stop(self) -> None:
        """Publish zero commands and wait for the acknowledgement."""
        for _ in range(_STOP_COMMANDS):
            self._publish(_ZERO)
        if self._commands.publisher is not None:
            self._commands.publisher.wait_for_all_acked(_STOP_TIME)

    def poll(self) -> None:
        """Follow the subscribed type; warn if nothing subscribes."""
        if (problem := self._commands.refresh()) and not self.driver.ending:
            self.driver.warn_throttled('cmd_vel', problem)
        if self._polls % _GUARD_POLLS == 0:
            readers = self.driver.get_subscriptions_info_by_topic('state')
            self._guarded = any(item.node_name == 'guard' for item in readers)
            self._was_guarded |= self._guarded
        self._polls += 1
        if self._was_guarded and not self._guarded and not self.driver.ending:
            self.driver.warn_throttled(
                'guard', 'guard lost: if this driver dies, nothing stops the robot'
            )

    def status(self) -> dict[str, Any]:
        """Return whether there is a guard."""
        return {'guard': 'available' if self._guarded else 'not available'}

    def begin_step(self, stamp: int) -> None:
        """Handle the battery readings before this step."""
        self._battery.receive_before(stamp)

    def hold_step(self, stamp: int) -> None:
        """Publish zeros with the stamp of the step."""
        self._command.header.stamp = stamp_to_ros(stamp)
        self._publish(_ZERO)

    def repeat(self) -> None:
        """Publish the last command again."""
        self._commands.publish(self._command)

    def _publish(self, command: Sequence[float]) -> None:
        twist = self._command.twist
        twist.linear.x, twist.linear.y, twist.linear.z, twist.angular.z = command
        self._commands.publish(self._command)
