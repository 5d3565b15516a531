"""The guard of a robot: a small process that stops the robot when its driver dies or hangs."""

from functools import partial
from typing import Any

from action_msgs.srv import CancelGoal
from geometry_msgs.msg import TwistStamped
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.serialization import deserialize_message

from maasi_drivers.links.topic_link import CommandPublisher
from maasi_drivers.settings.driver import GuardSettings
from maasi_filter.ros.lifecycle_node import LockstepLifecycleNode
from maasi_filter.ros.qos import liveliness_reader
from maasi_msgs.msg import AgentState

_STOP_PERIOD = 0.1
# Time between checks of the subscriptions, as a stop must not wait for discovery, and between
# requests to cancel the goals of Nav2 [s].
_REFRESH_PERIOD = 0.5


class GuardNode(LockstepLifecycleNode[GuardSettings]):
    """Publish zero velocities while the driver of this robot does not respond.

    Robots commanded by a topic need it, because they keep executing the last command. Where Nav2
    drives, the guard also cancels its goals.

    Subscribes
    ----------
    `state` (maasi_msgs/AgentState), for the driver's liveliness: asserted by its executor thread,
    so that it is lost when the process dies, is stopped, or hangs in a callback

    Publishes
    ---------
    `cmd_vel` (geometry_msgs/TwistStamped or Twist), 10 times a second from the loss of liveliness
    until it returns; nothing before the first driver

    Calls
    -----
    the cancel service of `navigate_to_pose` (action_msgs/CancelGoal), if available
    """

    def __init__(self, **options: Any) -> None:
        super().__init__('guard', GuardSettings, in_robot=True, **options)
        self._last = b''
        # Whether it has ever detected a driver, and whether that is lost.
        self._received = self._lost = False
        self._stop_timer: Any = None

    def set_up(self) -> None:
        """Connect."""
        self._publisher = CommandPublisher(self, 'cmd_vel', self.settings.command_type)
        self._nav2 = self.create_client(CancelGoal, 'navigate_to_pose/_action/cancel_goal')
        self.create_wall_timer(_REFRESH_PERIOD, self._refresh)
        self._lease = lease = self.settings.lease
        quality = liveliness_reader(lease)
        # Before that it would not notice the loss of the driver.
        self.expect(lambda: self._received)
        # Only the last message is used, after no other has arrived.
        self.permanent(
            lease,
            lambda: self.create_subscription(
                AgentState,
                'state',
                self._on_state,
                quality,
                raw=True,
                event_callbacks=SubscriptionEventCallbacks(
                    liveliness=partial(self._on_liveliness, lease)
                ),
            ),
        )

    def start(self) -> None:
        """Stop the robot if its driver was lost before."""
        if self._lost:
            self._begin_stop()

    def halt(self) -> None:
        """Stop publishing."""
        if self._stop_timer is not None:
            self._stop_timer.cancel()
            self.destroy_timer(self._stop_timer)
            self._stop_timer = None

    def status(self) -> dict[str, Any]:
        """Return whether the driver is lost and whether the robot is being stopped."""
        return {'driver lost': self._lost, 'stopping': self._stop_timer is not None}

    def _on_state(self, message: bytes) -> None:
        self._last = message

    def _on_liveliness(self, lease: float, event: Any) -> None:
        if lease != self._lease:
            return  # from an earlier configuration
        self._lost = event.alive_count == 0
        if not self._lost:
            self._received = True
            if self._stop_timer is not None:
                self.get_logger().info('driver available again')
            self.halt()
        elif self.active and self._stop_timer is None:
            self._begin_stop()

    def _begin_stop(self) -> None:
        if self.ending:
            self.get_logger().info('driver ended: stopping the robot (zero cmd_vel)')
        else:
            self.get_logger().warning('driver not responding: stopping the robot (zero cmd_vel)')
        self._stop_timer = self.create_wall_timer(_STOP_PERIOD, self._command_zeros)
        self._refresh()
        self._command_zeros()

    def _refresh(self) -> None:
        self._publisher.refresh()
        # Repeated, as Nav2 may be about to accept the driver's last goal.
        if self._stop_timer is not None and self._nav2.service_is_ready():
            self._nav2.call_async(CancelGoal.Request())  # without an id: all goals

    def _command_zeros(self) -> None:
        if self._stop_timer is None:
            return
        command = TwistStamped()
        if self._last:
            command.header.stamp = deserialize_message(self._last, AgentState).header.stamp
        self._publisher.publish(command)
