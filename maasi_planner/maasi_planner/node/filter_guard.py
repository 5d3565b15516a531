"""Supervision of the filter by the planner node."""

from __future__ import annotations

import math
import time

from diagnostic_msgs.msg import DiagnosticArray

from maasi_filter.ros.lifecycle_node import LockstepLifecycleNode
from maasi_planner.filter_watch import FilterWatch
from maasi_planner.node_settings import PlannerNodeSettings

# A longer gap between two checks means that the planner itself was suspended [s].
_LONGEST_GAP = 1.0
# Period of updates of the names of filters [s].
_NAMES_PERIOD = 1.0


class FilterGuard:
    """Tells a planner that runs freely while its filter is silent; robots are held then.

    Subscribes
    ----------
    `/diagnostics` (diagnostic_msgs/DiagnosticArray): heartbeats of the publishers of
    `filter_update`

    Parameters
    ----------
    node : LockstepLifecycleNode
        The planner node.
    """

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
        """Subscribe to heartbeats, where they are used."""
        settings = self._node.settings
        if not settings.lockstep and settings.filter_timeout:
            self._node.create_subscription(
                DiagnosticArray, '/diagnostics', self._on_diagnostics, 10
            )

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        if any(status.name in self.names for status in message.status):
            self.watch.beat(time.monotonic())

    def problem(self, now: float) -> str:
        """Return why the filter counts as absent at a wall time [s]; empty if it does not."""
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
