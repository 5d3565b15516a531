"""Keeps found targets for a filter that is restarted without its state."""

from __future__ import annotations

from rclpy.node import Node

from maasi_filter.ros.qos import LATCHED
from maasi_msgs.msg import FoundTarget, FoundTargetArray


class FoundKeeper:
    """Republishes found targets, latched: a latched message is lost with its publisher.

    Targets are kept until a new search, even if the filter no longer has them.

    Subscribes
    ----------
    `found_targets` (maasi_msgs/FoundTargetArray, latched)

    Publishes
    ---------
    `found_targets/kept` (maasi_msgs/FoundTargetArray, latched): from the start, empty at first

    Parameters
    ----------
    node : Node
        In the namespace of the filter; its subscriptions and publishers are destroyed with it.
    """

    def __init__(self, node: Node) -> None:
        self._targets: dict[int, FoundTarget] = {}
        self._publisher = node.create_publisher(FoundTargetArray, 'found_targets/kept', LATCHED)
        self._publisher.publish(FoundTargetArray())
        node.create_subscription(FoundTargetArray, 'found_targets', self._on_found, LATCHED)

    def _on_found(self, message: FoundTargetArray) -> None:
        self._targets.update({item.id: item for item in message.targets})
        self._publisher.publish(
            FoundTargetArray(
                header=message.header,
                batch_id=message.batch_id,
                targets=[self._targets[number] for number in sorted(self._targets)],
            )
        )

    def forget(self) -> None:
        """Remove all targets for a new search."""
        self._targets.clear()
        self._publisher.publish(FoundTargetArray())
