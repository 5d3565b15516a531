"""Found targets of the filters of other robots (002, section 4)."""

from collections import deque
from functools import partial

from rclpy.subscription import Subscription

from maasi_filter.measurement_check import check_shared
from maasi_filter.ros.conversions import found_target_from_ros, stamp_from_ros
from maasi_filter.ros.lifecycle_node import LockstepLifecycleNode
from maasi_filter.ros.node_settings import FilterNodeSettings
from maasi_filter.ros.qos import LATCHED_ALL
from maasi_filter.search_filter import SearchFilter
from maasi_msgs.msg import FoundTargetArray


class SharedFoundTargets:
    """Found targets received from the filters of other robots."""

    def __init__(self, node: LockstepLifecycleNode[FilterNodeSettings]) -> None:
        self._node = node
        self._subscriptions: list[Subscription] = []
        self.reset()

    def __len__(self) -> int:
        return len(self._waiting)

    def reset(self) -> None:
        """Discard what was received."""
        robots = sorted(self._node.settings.share_with)
        self._waiting: dict[str, deque[FoundTargetArray]] = {name: deque() for name in robots}

    def set_up(self) -> None:
        """Subscribe."""
        node = self._node
        for name in self._waiting:
            topic = node.team_topic(f'{name}/found_targets')
            self._subscriptions.append(
                node.create_subscription(
                    FoundTargetArray, topic, partial(self._on_found, name), LATCHED_ALL
                )
            )
            node.expect_publisher(topic)

    def merge_into(self, search: SearchFilter, stamp: int) -> bool:
        """Merge targets found before a stamp [ns] into a filter; return whether it changed."""
        for subscription in self._subscriptions:
            # Lockstep only guarantees that the messages have arrived, not that they were read.
            handle, raw = subscription.handle, subscription.raw
            while (taken := handle.take_message(FoundTargetArray, raw)) is not None:
                subscription.callback(taken[0])
        newest = {}
        for name, waiting in self._waiting.items():
            last = None
            while waiting and stamp_from_ros(waiting[0].header.stamp) < stamp:
                last = waiting.popleft()
            if last is None:
                continue
            # Targets that it received from others arrive from their own filters.
            theirs = [item for item in last.targets if item.robot == name]
            try:
                targets = [found_target_from_ros(item, search.dimension) for item in theirs]
                check_shared(name, targets, search.dimension)
            except ValueError as error:
                self._node.drop('bad found targets', f'{name}/found_targets: {error}')
                continue
            newest[name] = targets
        return search.merge(newest)

    def _on_found(self, name: str, message: FoundTargetArray) -> None:
        node = self._node
        if not node.active:
            return
        if message.header.frame_id != node.settings.frame:
            node.drop(
                'bad found targets',
                f'{name}/found_targets.header.frame_id: read {message.header.frame_id!r}, allowed '
                f'is {node.settings.frame!r}',
            )
            return
        self._waiting[name].append(message)
