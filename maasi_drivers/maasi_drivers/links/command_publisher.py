"""Velocity commands on a topic, in the type that the robot subscribes to."""

from __future__ import annotations

from collections import Counter
from typing import Any

from geometry_msgs.msg import Twist, TwistStamped
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher

from maasi_drivers.agent.driver_settings import CommandType
from maasi_filter.ros.qos import COMMANDS, RELIABLE

_TYPES: dict[str, type] = {
    'geometry_msgs/msg/TwistStamped': TwistStamped,
    'geometry_msgs/msg/Twist': Twist,
}


class CommandPublisher:
    """Publishes commands as TwistStamped, as Twist, or as what is subscribed.

    TurtleBot3s of Jazzy listen to TwistStamped, those of Humble to Twist, on the same topic.

    Parameters
    ----------
    node : Node
        Whose publishers they are.
    topic : str
        Relative name.
    kind : {'auto', 'stamped', 'twist'}
        auto: determined from the graph, by `refresh`.
    lockstep : bool
        Whether no command may be lost; there, auto is stamped.
    """

    def __init__(self, node: Node, topic: str, kind: CommandType, lockstep: bool = False) -> None:
        self._node = node
        self._quality = RELIABLE if lockstep else COMMANDS
        self.topic = node.resolve_topic_name(topic)
        self._publisher: Any = None
        self._kind: type = TwistStamped
        self._auto = kind == 'auto' and not lockstep
        if self._auto:
            self.refresh()
        else:
            self._use(Twist if kind == 'twist' else TwistStamped)

    def _use(self, kind: type) -> None:
        # A process can have only one type under one name.
        self.destroy()
        self._kind = kind
        self._publisher = self._node.create_publisher(kind, self.topic, self._quality)

    def refresh(self) -> None:
        """Follow the type that is subscribed to; call it repeatedly."""
        if not self._auto or self.listeners():
            return
        for name in self.wanted():
            kind = _TYPES.get(name)
            if kind is not None:
                if self._publisher is None or kind is not self._kind:
                    self._use(kind)
                return

    def wanted(self) -> list[str]:
        """Return the names of the types that are subscribed, the most frequent first."""
        known = self._node.get_subscriptions_info_by_topic(self.topic)
        return [name for name, _ in Counter(item.topic_type for item in known).most_common()]

    @property
    def publisher(self) -> Publisher | None:
        """The present one; None where the type is not known yet."""
        return self._publisher

    def listeners(self) -> int:
        """Return how many subscriptions are matched."""
        return 0 if self._publisher is None else self._publisher.get_subscription_count()

    def problem(self) -> str:
        """Return why no command is received; empty where one is."""
        if self.listeners():
            return ''
        wanted = self.wanted()
        if not wanted:
            return f'{self.topic}: no subscription; is the robot running?'
        return (
            f'{self.topic}: no subscription of this type; the robot wants {", ".join(wanted)}, '
            'see the parameter command_type'
        )

    def publish(self, command: TwistStamped) -> None:
        """Publish a command, without its header where that is subscribed to."""
        if self._publisher is not None:
            self._publisher.publish(command if self._kind is TwistStamped else command.twist)

    def wait(self, seconds: float) -> None:
        """Wait until all commands have arrived, for at most so many seconds."""
        if self._publisher is not None:
            self._publisher.wait_for_all_acked(Duration(nanoseconds=round(seconds * 1e9)))

    def destroy(self) -> None:
        """Destroy the publisher."""
        if self._publisher is not None:
            self._node.destroy_publisher(self._publisher)
            self._publisher = None
