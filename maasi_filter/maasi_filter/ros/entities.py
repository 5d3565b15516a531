"""Entities of a node: what they wait for, how long they live, and bad requests to them."""

import time
from collections.abc import Callable, Collection, Hashable
from functools import partial
from operator import methodcaller
from typing import Any, TypeVar

from rclpy.event_handler import EventHandler
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.publisher import Publisher

T = TypeVar('T')

# Exceptions of rclpy on bad requests, by package of the service type.
_ERRORS: dict[str, tuple[type[Exception], ...]] = {
    'rcl_interfaces': (TypeError, ValueError, AttributeError, KeyError, AssertionError),
    'lifecycle_msgs': (rclpy_implementation.RCLError,),
}


class NodeEntities:
    """Publishers, subscriptions, services, clients, timers and actions made since `mark`.

    Actions and subscriptions with event callbacks are permanent: rclpy's events executor crashes
    (SIGSEGV) if one is destroyed while an event of it is queued.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._kept: list[Any] | None = None
        self._permanent: dict[Hashable, Any] = {}

    def permanent(self, key: Hashable, make: Callable[[], T]) -> T:
        """Return the entity of a key, made at the first call, which lives as long as the node."""
        if key not in self._permanent:
            self._permanent[key] = make()
        made: T = self._permanent[key]
        return made

    def mark(self) -> None:
        """Mark the present entities as kept: `clear` destroys only later ones."""
        self._kept = [item for item, _ in self._made()]

    def clear(self) -> None:
        """Destroy the entities created since `mark`; nothing without a mark."""
        if self._kept is None:
            return
        kept = {id(item) for item in (*self._kept, *self._permanent.values())}
        self._kept = None
        for item, destroy in self._made():
            if id(item) not in kept:
                destroy(item)

    def _made(self) -> list[tuple[Any, Callable[[Any], object]]]:
        node = self._node
        # Of plugins; owners destroy their event handlers.
        waitables = [item for item in node.waitables if not isinstance(item, EventHandler)]
        kinds: list[tuple[Any, Callable[[Any], object]]] = [
            (waitables, methodcaller('destroy')),
            (node.timers, node.destroy_timer),
            (node.subscriptions, node.destroy_subscription),
            (node.services, node.destroy_service),
            (node.clients, node.destroy_client),
            (node.publishers, node.destroy_publisher),
        ]
        return [(item, destroy) for items, destroy in kinds for item in items]


def survive_bad_requests(node: Node, drop: Callable[[str, str], None]) -> None:
    """Answer bad types and undefined transitions, on which rclpy raises, with an empty response."""

    def answer(name: str, errors: Any, callback: Any, request: Any, response: Any) -> Any:
        try:
            return callback(request, response)
        except errors as error:
            drop('bad request', f'{name}: {type(error).__name__}: {error}')
            return type(response)()

    for service in node.services:
        errors = _ERRORS.get(service.srv_type.__module__.partition('.')[0])
        if errors is not None:
            service.callback = partial(answer, service.srv_name, errors, service.callback)


# Longest time from the discovery of an endpoint to its connection [s].
_CONNECTION_PATIENCE = 5.0
_OBSERVERS = ('recorder', 'guard', 'rosbag2_recorder')
_EVERYWHERE = ('/parameter_events', '/diagnostics')


class Endpoints:
    """Endpoints of a node's topics: to whom a message would get, and what never connects.

    Event callbacks of rclpy must not be destroyed while their node spins (`NodeEntities`).
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        # Since when an endpoint has been known, but not connected [s of wall time].
        self._since: dict[str, float] = {}
        self._lasting: set[str] = set()

    def look(self) -> list[str]:
        """Return a warning, once, for each topic with a known endpoint that never connects."""
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
        lasting = {
            text for text, since in self._since.items() if now - since > _CONNECTION_PATIENCE
        }
        warnings = [f'{text}: its quality of service or type differs' for text in sorted(lasting)]
        for text, warning in zip(sorted(lasting), warnings):
            if text not in self._lasting:
                node.get_logger().warning(warning)
        self._lasting = lasting
        return warnings

    def reach(self, publisher: Publisher, number: int, names: Collection[str]) -> bool:
        """Return whether a message would reach so many subscribers, and nodes of all names."""
        topic = publisher.topic_name
        known = [info.node_name for info in self._node.get_subscriptions_info_by_topic(topic)]
        peers = [name for name in known if name not in _OBSERVERS and not name.startswith('_')]
        if not set(names) <= set(known) or len(peers) < number:
            return False
        # An observer with an incompatible quality of service never connects.
        late = f'{topic}: a subscription does not connect' in self._lasting
        return late or publisher.get_subscription_count() >= len(known)

    def unpublished(self) -> list[str]:
        """Return the topics that the node subscribes to and nobody publishes."""
        topics = {item.topic_name for item in self._node.subscriptions}.difference(_EVERYWHERE)
        return sorted(topic for topic in topics if not self._node.count_publishers(topic))
