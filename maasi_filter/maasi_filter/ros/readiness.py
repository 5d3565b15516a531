"""Which publishers and subscribers a node still waits for."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection
from typing import Any

from rclpy.node import Node
from rclpy.publisher import Publisher

# Longest time from the discovery of a subscription to its connection [s].
_CONNECTION_PATIENCE = 5.0
_EVERYWHERE = ('/parameter_events', '/clock', '/diagnostics')


def subscribers_connected(
    node: Node,
    publisher: Callable[[], Publisher | None] | Publisher,
    number: int,
    names: Collection[str],
) -> Callable[[], bool]:
    """Return a function that tells whether a message would reach all expected subscribers.

    Arguments as of `LockstepLifecycleNode.expect_subscribers`.
    """
    get = publisher if callable(publisher) else lambda: publisher
    known_since: list[float] = []

    def connected() -> bool:
        present = get()
        if present is None:
            return False
        kind: Any = present.msg_type
        known = [
            info.node_name
            for info in node.get_subscriptions_info_by_topic(present.topic_name)
            if info.topic_type == f'{kind.__module__.split(".")[0]}/msg/{kind.__name__}'
        ]
        if not set(names) <= set(known) or sum(map(_takes_part, known)) < number:
            return False
        known_since.append(time.monotonic())
        # An observer with an incompatible quality of service never connects.
        late = known_since[-1] - known_since[0] > _CONNECTION_PATIENCE
        del known_since[1:]
        return late or present.get_subscription_count() >= len(known)

    return connected


def _takes_part(name: str) -> bool:
    """Return whether a subscribing node is a peer, not a mere observer."""
    return name not in ('recorder', 'guard', 'rosbag2_recorder') and not name.startswith('_')


class Unconnected:
    """Topics with an endpoint that is known but never connects.

    In place of the event callbacks of rclpy, which publishers and subscriptions that are destroyed
    while their node spins must not have (`NodeEntities`).
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        # Since when an endpoint has been known, but not connected [s of wall time].
        self._since: dict[str, float] = {}
        self._said: set[str] = set()

    def look(self) -> list[str]:
        """Return a warning for each such topic, logged once; call about once per second."""
        node, now = self._node, time.monotonic()
        unconnected = {
            f'{item.topic_name}: a publisher does not connect'
            for item in node.subscriptions
            if item.handle.get_publisher_count() < node.count_publishers(item.topic_name)
        } | {
            f'{item.topic_name}: a subscription does not connect'
            for item in node.publishers
            if item.get_subscription_count() < node.count_subscribers(item.topic_name)
        }
        self._since = {text: self._since.get(text, now) for text in unconnected}
        lasting = [
            f'{text}: its quality of service or type differs'
            for text, since in sorted(self._since.items())
            if now - since > _CONNECTION_PATIENCE
        ]
        for text in set(lasting) - self._said:
            node.get_logger().warning(text)
        self._said = set(lasting)
        return lasting


def unpublished_topics(node: Node) -> list[str]:
    """Return the topics that a node subscribes to and nobody publishes."""
    topics = {item.topic_name for item in node.subscriptions}
    return sorted(
        topic for topic in topics if topic not in _EVERYWHERE and not node.count_publishers(topic)
    )
