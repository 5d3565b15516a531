"""Supervision of the filter by the planner node, and found targets retained for its restart."""

import math
import time

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node

from maasi_filter.ros.lifecycle_node import LockstepLifecycleNode
from maasi_filter.ros.qos import LATCHED
from maasi_msgs.msg import FoundTarget, FoundTargetArray
from maasi_planner.node_settings import PlannerNodeSettings


class FilterWatch:
    """Detects a silent filter by its heartbeat and by batches without update; 0 disables it."""

    def __init__(self, timeout: float) -> None:
        self.timeout = timeout
        #: Time of the last heartbeat of the filter's executor.
        self.beat: float | None = None
        self._open: dict[int, float] = {}

    def asked(self, batch: int, now: float) -> None:
        """Note that a batch was published."""
        self._open[batch] = now

    def answered(self, batch: int) -> None:
        """Note the update of a batch, after which none of earlier batches can arrive."""
        self._open = {number: since for number, since in self._open.items() if number > batch}

    def stalled(self, seconds: float) -> None:
        """Note that the planner was suspended, and has not read the messages of that time yet."""
        if self.beat is not None:
            self.beat += seconds
        self._open = {number: since + seconds for number, since in self._open.items()}

    def problem(self, now: float) -> str:
        """Return why the filter counts as absent; empty if it is present."""
        if not self.timeout:
            return ''
        if self.beat is not None and now - self.beat > self.timeout:
            return f'no heartbeat of the filter for {now - self.beat:.1f} s'
        if self._open:
            number = min(self._open)
            waited = now - self._open[number]
            if waited > self.timeout:
                return f'no filter_update of batch {number} for {waited:.1f} s'
        return ''


# A longer gap between checks means that the planner was suspended [s].
_LONGEST_GAP = 1.0
_NAMES_PERIOD = 1.0  # period of updates of the names of filters [s]


class FilterGuard:
    """Detects a silent filter of a planner that runs freely; robots are held then."""

    def __init__(self, node: LockstepLifecycleNode[PlannerNodeSettings]) -> None:
        self._node = node
        self.reset()

    def reset(self) -> None:
        """Reset for a new search."""
        self.watch = FilterWatch(self._node.settings.filter_timeout)
        self.names: set[str] = set()
        self._names_at = -math.inf
        self._checked_at = time.monotonic()

    def set_up(self) -> None:
        """Subscribe to heartbeats if they are used."""
        settings = self._node.settings
        if not settings.lockstep and settings.filter_timeout:
            self._node.create_subscription(
                DiagnosticArray, '/diagnostics', self._on_diagnostics, 10
            )

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        if any(status.name in self.names for status in message.status):
            self.watch.beat = time.monotonic()

    def problem(self, now: float) -> str:
        """Return why the filter counts as absent at a wall time [s]; empty if it is present."""
        since, self._checked_at = now - self._checked_at, now
        if since > _LONGEST_GAP:
            self.watch.stalled(since)
        if now - self._names_at >= _NAMES_PERIOD:
            self._names_at = now
            self.names |= {
                f'{info.node_namespace.rstrip("/")}/{info.node_name}'
                for info in self._node.get_publishers_info_by_topic('filter_update')
            }
        return self.watch.problem(now)


class FoundKeeper:
    """Republishes found targets, latched, until a new search, also those of a restarted filter.

    A target that a filter no longer publishes is withdrawn.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._targets: dict[int, FoundTarget] = {}
        self._filters: set[bytes] = set()  # earlier publishers, by endpoint
        self._published: set[int] = set()  # ids in the last message of the newest publisher
        self._publisher = node.create_publisher(FoundTargetArray, 'found_targets/kept', LATCHED)
        self._publisher.publish(FoundTargetArray())
        found = node.create_subscription(FoundTargetArray, 'found_targets', self._on_found, LATCHED)
        self._topic = found.topic_name

    def _on_found(self, message: FoundTargetArray) -> None:
        filters = {
            bytes(info.endpoint_gid)
            for info in self._node.get_publishers_info_by_topic(self._topic)
        }
        if filters - self._filters:
            self._published = set()
        self._filters |= filters
        kept = {key: item for key, item in self._targets.items() if key not in self._published}
        now = {item.id: item for item in message.targets}
        self._targets, self._published = kept | now, set(now)
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
        self._published.clear()
        self._publisher.publish(FoundTargetArray())
