"""What a node creates in *configure*, so that *cleanup* can destroy all of it."""

from __future__ import annotations

from typing import Any

from rclpy.event_handler import EventHandler
from rclpy.node import Node


class NodeEntities:
    """Publishers, subscriptions, services, clients, timers and actions made since `mark`.

    Parameters
    ----------
    node : Node
        That makes them.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._kept: list[Any] | None = None

    def mark(self) -> None:
        """Keep what there is now: `clear` destroys only what comes after."""
        self._kept = self._all()

    def clear(self) -> None:
        """Destroy what was made since `mark`; without a mark nothing."""
        if self._kept is None:
            return
        kept, self._kept = {id(item) for item in self._kept}, None
        node = self._node
        # Servers and clients of actions are waitables; event handlers go with their owners.
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
