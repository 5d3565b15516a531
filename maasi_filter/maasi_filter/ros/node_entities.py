"""Records the entities of a node created in *configure*, so that *cleanup* can destroy them."""

from __future__ import annotations

from typing import Any

from rclpy.event_handler import EventHandler
from rclpy.node import Node


class NodeEntities:
    """Publishers, subscriptions, services, clients, timers and actions made since `mark`.

    Parameters
    ----------
    node : Node
        Owner of the entities.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._kept: list[Any] | None = None

    def mark(self) -> None:
        """Mark the present entities as kept: `clear` destroys only later ones."""
        self._kept = self._all()

    def clear(self) -> None:
        """Destroy the entities created since `mark`; nothing without a mark."""
        if self._kept is None:
            return
        kept, self._kept = {id(item) for item in self._kept}, None
        node = self._node
        # Action servers and clients are waitables; owners destroy their event handlers.
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
