"""Readiness of a node: all peers are connected."""

import math
import time
from collections.abc import Callable, Collection
from typing import Any

from rclpy.publisher import Publisher

from maasi_filter.ros.loopback import loopback_fault
from maasi_filter.ros.qos import LATCHED
from maasi_filter.ros.rclpy_workarounds import SafeNode
from maasi_msgs.msg import LockstepDone

_PEERS_PERIOD = 0.02  # of the check for peers [s]
_NOTICE_DELAY = 3.0  # from activation to the report of missing peers [s]
# Longest time from the discovery of an endpoint to its connection [s].
_CONNECTION_PATIENCE = 5.0
_OBSERVERS = ('recorder', 'guard', 'rosbag2_recorder')
_EVERYWHERE = ('/parameter_events', '/diagnostics')


class ReadyNode(SafeNode):
    """A node that publishes `lockstep/ready` (maasi_msgs/LockstepDone) once all peers are there."""

    def __init__(self, name: str, **options: Any) -> None:
        super().__init__(name, **options)
        self._peers: list[Callable[[], bool]] = []
        self._peers_timer: Any = None
        # Wall time of the report of missing publishers [s].
        self._notice_at = math.inf
        self._ready_publisher: Publisher | None = None
        # Wall time of discovery of endpoints that are not connected [s], and endpoints that never
        # connect.
        self._unconnected: dict[str, float] = {}
        self._lasting: set[str] = set()

    def expect(self, condition: Callable[[], bool]) -> None:
        """Add a condition for being ready."""
        self._peers.append(condition)

    def expect_subscribers(
        self,
        publisher: Callable[[], Publisher | None] | Publisher,
        number: int = 1,
        names: Collection[str] = (),
    ) -> None:
        """Be ready only when messages reach `number` subscribers and all nodes of `names`.

        Mere observers do not count; `publisher` may be a function that returns it; `names` are
        without namespace.
        """

        def reached() -> bool:
            present = publisher() if callable(publisher) else publisher
            return present is not None and self._reaches(present, number, names)

        self.expect(reached)

    def expect_publisher(self, topic: str) -> None:
        """Be ready only with a publisher of a topic."""
        self.expect(lambda: self.count_publishers(topic) > 0)

    def offer_ready(self, topic: str) -> None:
        """Create the publisher last: receivers of its message have discovered all others."""
        self._ready_publisher = self.create_publisher(LockstepDone, topic, LATCHED)

    def await_peers(self) -> None:
        """Begin to check for peers."""
        self._peers_timer = self.create_wall_timer(_PEERS_PERIOD, self._look_for_peers)
        self._notice_at = time.monotonic() + _NOTICE_DELAY

    def end_wait(self) -> None:
        """Stop checking for peers."""
        self._notice_at = math.inf
        self._end_timer()

    def forget_peers(self) -> None:
        """Forget the expected peers before the entities are destroyed."""
        self._peers.clear()
        self._ready_publisher = self._peers_timer = None

    def _end_timer(self) -> None:
        if self._peers_timer is not None:
            self._peers_timer.cancel()
            self.destroy_timer(self._peers_timer)
            self._peers_timer = None

    def _look_for_peers(self) -> None:
        if not self.active or not all(condition() for condition in self._peers):
            return
        self._end_timer()
        if self._ready_publisher is not None:
            self._ready_publisher.publish(LockstepDone(node=self.get_fully_qualified_name()))

    def _reaches(self, publisher: Publisher, number: int, names: Collection[str]) -> bool:
        topic = publisher.topic_name
        known = [info.node_name for info in self.get_subscriptions_info_by_topic(topic)]
        peers = [name for name in known if name not in _OBSERVERS and not name.startswith('_')]
        if not set(names) <= set(known) or len(peers) < number:
            return False
        # An observer with an incompatible quality of service never connects.
        late = f'{topic}: a subscription does not connect' in self._lasting
        return late or publisher.get_subscription_count() >= len(known)

    def check_peers(self) -> list[str]:
        """Log, once, topics without publisher; warn of endpoints that never connect."""
        now = time.monotonic()
        if now >= self._notice_at:
            self._notice_at = math.inf
            self._say_what_is_missing()
        unconnected = {
            f'{item.topic_name}: a publisher does not connect'
            for item in self.subscriptions
            if item.handle.get_publisher_count() < self.count_publishers(item.topic_name)
        } | {
            f'{item.topic_name}: a subscription does not connect'
            for item in self.publishers
            if item.get_subscription_count() < self.count_subscribers(item.topic_name)
        }
        self._unconnected = {text: self._unconnected.get(text, now) for text in unconnected}
        before, self._lasting = (
            self._lasting,
            {
                text
                for text, since in self._unconnected.items()
                if now - since > _CONNECTION_PATIENCE
            },
        )
        reason = 'its quality of service or type differs'
        for text in sorted(self._lasting - before):
            self.get_logger().warning(f'{text}: {reason}')
        return [f'{text}: {reason}' for text in sorted(self._lasting)]

    def _say_what_is_missing(self) -> None:
        topics = {item.topic_name for item in self.subscriptions}.difference(_EVERYWHERE)
        missing = sorted(topic for topic in topics if not self.count_publishers(topic))
        text = f'active, waiting for publishers of {", ".join(missing)}'
        if '/clock' in missing:
            self.get_logger().warning(f'{text}; use_sim_time is true')
        elif missing:
            self.get_logger().info(text)
        if missing and (fault := loopback_fault()):
            self.get_logger().warning(fault)
