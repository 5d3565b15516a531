"""Destinations exchanged between planners of single robots (002, section 4)."""

from collections.abc import Callable, Collection, Mapping
from functools import partial

import numpy as np
from geometry_msgs.msg import PointStamped
from rclpy.publisher import Publisher
from std_msgs.msg import Header

from maasi_filter.arrays import FloatArray
from maasi_filter.ros.clocks import Silence
from maasi_filter.ros.conversions import point_to_ros, stamp_from_ros
from maasi_filter.ros.lifecycle_node import LockstepLifecycleNode
from maasi_filter.ros.qos import RELIABLE
from maasi_planner.node_settings import PlannerNodeSettings


class OtherPlanners:
    """Exchanges destinations with planners of other robots, which plan in the order of names."""

    def __init__(
        self,
        node: LockstepLifecycleNode[PlannerNodeSettings],
        names: Collection[str],
        on_change: Callable[[], None],
    ) -> None:
        self._node = node
        self._own = sorted(names)
        self._on_change = on_change
        self._publishers: dict[str, Publisher] = {}
        self.reset()

    def reset(self) -> None:
        """Reset for a new search, with the others at their starts."""
        others = self._node.settings.others
        # The last two received, by step.
        self._destinations: dict[str, dict[int, FloatArray]] = {
            name: {-1: np.array(others[name].start)} for name in sorted(others)
        }
        self._silence: dict[str, Silence] = {}
        self.before: set[str] = set()  #: in lockstep, robots of the step before

    def set_up(self) -> None:
        """Create publishers and subscriptions if there are others."""
        node = self._node
        others = sorted(node.settings.others)
        for name in self._own if others else ():
            publisher = node.create_publisher(
                PointStamped, node.team_topic(f'{name}/destination'), RELIABLE
            )
            node.expect_subscribers(publisher, len(others))
            self._publishers[name] = publisher
        for name in others:
            topic = node.team_topic(f'{name}/destination')
            node.create_subscription(PointStamped, topic, partial(self._on_point, name), RELIABLE)
            node.expect_publisher(topic)

    def _on_point(self, name: str, message: PointStamped) -> None:
        node = self._node
        if not node.active:
            return
        point = np.array([message.point.x, message.point.y, message.point.z])
        frame = message.header.frame_id
        if frame != node.settings.frame or not np.isfinite(point).all():
            node.drop(
                'bad destination',
                f'{name}/destination: read {point.tolist()} in {frame!r}, allowed are finite '
                f'numbers in {node.settings.frame!r}',
            )
            return
        known = self._destinations[name]
        known[round(stamp_from_ros(message.header.stamp) * 1e-9 / node.settings.step)] = point
        while len(known) > 2:
            del known[min(known)]
        self._silence[name] = Silence(node)
        self._on_change()

    def missing(self, step: int, robots: Collection[str]) -> bool:
        """Return whether destinations are missing in lockstep; later names: of the last step."""
        for name, known in self._destinations.items():
            if name not in robots:
                continue
            if name < self._own[0]:
                if max(known) < step:
                    return True
            elif name in self.before and max(known) < step - 1:
                return True
        return False

    def taken(self, step: int, robots: Collection[str] | None) -> list[tuple[FloatArray, float]]:
        """Return destinations and radii of other planners' robots; running freely, recent ones."""
        settings = self._node.settings
        taken = []
        for name, known in self._destinations.items():
            if robots is None:
                silence = self._silence.get(name)
                there = silence is None or silence.length <= settings.state_timeout
                last = max(known)
            else:
                there = name in robots
                last = max(
                    (k for k in known if k < step or name < self._own[0]), default=max(known)
                )
            if there:
                taken.append((known[last], settings.others[name].radius))
        return taken

    def publish(self, header: Header, destinations: Mapping[str, FloatArray]) -> None:
        """Publish the destinations of this planner's robots."""
        for name in sorted(self._publishers.keys() & destinations.keys()):
            message = PointStamped(header=header, point=point_to_ros(destinations[name]))
            self._publishers[name].publish(message)
