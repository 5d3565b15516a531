"""Records the entities of a node created in *configure*, so that *cleanup* can destroy them."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import Any, TypeVar

from rclpy.event_handler import EventHandler
from rclpy.node import Node

T = TypeVar('T')


class NodeEntities:
    """Publishers, subscriptions, services, clients, timers and actions made since `mark`.

    Action clients, action servers and subscriptions with event callbacks are permanent: rclpy's
    events executor crashes (SIGSEGV) if one is destroyed while an event of it is queued, as it
    then calls Python without the interpreter's lock.

    Parameters
    ----------
    node : Node
        Owner of the entities.
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
        self._kept = self._all()

    def clear(self) -> None:
        """Destroy the entities created since `mark`; nothing without a mark."""
        if self._kept is None:
            return
        kept = {id(item) for item in (*self._kept, *self._permanent.values())}
        self._kept = None
        node = self._node
        # Of plugins; owners destroy their event handlers.
        for waitable in list(node.waitables):
            if id(waitable) not in kept and not isinstance(waitable, EventHandler):
                waitable.destroy()  # type: ignore[attr-defined]
        owners: list[tuple[Any, Any]] = [
            (node.timers, node.destroy_timer),
            (node.subscriptions, node.destroy_subscription),
            (node.services, node.destroy_service),
            (node.clients, node.destroy_client),
            (node.publishers, node.destroy_publisher),
        ]
        for items, destroy in owners:
            for item in list(items):
                if id(item) not in kept:
                    destroy(item)

    def _all(self) -> list[Any]:
        node = self._node
        return [
            *node.publishers,
            *node.subscriptions,
            *node.services,
            *node.clients,
            *node.timers,
            *node.waitables,
        ]
