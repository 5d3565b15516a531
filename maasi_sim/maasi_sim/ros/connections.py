"""Which subscriptions of other nodes are connected to the publishers of a node."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from rclpy.node import Node
from rclpy.publisher import Publisher


class Connections:
    """Tells whether expected nodes would receive what is published now.

    Parameters
    ----------
    node : Node
        That publishes.
    expected : mapping
        By the full name of each expected node: topics that it subscribes to.
    """

    def __init__(self, node: Node, expected: Mapping[str, Sequence[str]]) -> None:
        self._node = node
        self._expected = expected
        self._endpoints: dict[tuple[str, str], set[bytes]] = {}

    def unheard(self, name: str) -> list[str]:
        """Return the topics without a subscription of a node since `remember`."""
        return [
            topic
            for topic in self._expected[name]
            if not self._subscriptions(name, topic) - self._endpoints.get((name, topic), set())
        ]

    def unmatched(self, entities: Iterable[Any]) -> list[str]:
        """Return the topics of publishers with a known subscription that is not connected yet."""
        return [
            publisher.topic_name
            for publisher in entities
            if isinstance(publisher, Publisher)
            and publisher.get_subscription_count()
            < len(self._node.get_subscriptions_info_by_topic(publisher.topic_name))
        ]

    def remember(self) -> None:
        """Remember all subscriptions: a restarted node has others."""
        for name, topics in self._expected.items():
            for topic in topics:
                self._endpoints[name, topic] = self._subscriptions(name, topic)

    def _subscriptions(self, name: str, topic: str) -> set[bytes]:
        return {
            bytes(info.endpoint_gid)
            for info in self._node.get_subscriptions_info_by_topic(topic)
            if f'{info.node_namespace.rstrip("/")}/{info.node_name}' == name
        }
