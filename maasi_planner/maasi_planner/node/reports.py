"""Statements of persons that the filter has used, for the planner."""

from collections.abc import Callable

from maasi_filter.reports import MOST_REPORTS, Report
from maasi_filter.ros.conversions import check_frame, report_from_ros
from maasi_filter.ros.lifecycle_node import LockstepLifecycleNode
from maasi_filter.ros.qos import LATCHED_ALL
from maasi_msgs.msg import Report as ReportMessage
from maasi_planner.node_settings import PlannerNodeSettings


class Reports:
    """Passes statements to the planner: at once, in lockstep with the update that includes them."""

    def __init__(
        self, node: LockstepLifecycleNode[PlannerNodeSettings], use: Callable[[Report], None]
    ) -> None:
        self._node, self._use = node, use
        self._waiting: list[ReportMessage] = []
        self._used: list[ReportMessage] = []

    def set_up(self) -> None:
        """Subscribe."""
        self._subscription = self._node.create_subscription(
            ReportMessage, 'reports', self._on_report, LATCHED_ALL
        )

    def reset(self) -> None:
        """Begin a new search: running freely, what the filter has used is used again."""
        lockstep = self._node.settings.lockstep
        self._waiting, self._used = [] if lockstep else [*self._used, *self._waiting], []
        self._use_waiting()

    def include(self, number: int) -> None:
        """Use the first `number` statements, which an update of the filter includes."""
        if number > len(self._used):
            # They have arrived, but may not have been read yet.
            subscription = self._subscription
            handle, raw = subscription.handle, subscription.raw
            while (taken := handle.take_message(ReportMessage, raw)) is not None:
                subscription.callback(taken[0])
            self._use_waiting(number)

    def _on_report(self, message: ReportMessage) -> None:
        # Also before the node is active: a latched message arrives only once.
        if message.kind == ReportMessage.CLEARED:
            used, self._waiting, self._used = self._used, [], []
            if used and not self._node.settings.lockstep:
                # The filter has begun a new search; used statements cannot be taken back.
                self._node.reset()
        elif message not in self._used and message not in self._waiting:
            # A restarted filter repeats those that it knows.
            if len(self._used) + len(self._waiting) >= MOST_REPORTS:
                self._node.drop(
                    'bad report', f'reports: allowed are {MOST_REPORTS} statements in one search'
                )
                return
            self._waiting.append(message)
            if not self._node.settings.lockstep:
                self._use_waiting()

    def _use_waiting(self, last: float = float('inf')) -> None:
        due = [message for message in self._waiting if message.id <= last]
        self._waiting = [message for message in self._waiting if message.id > last]
        settings = self._node.settings
        for message in due:
            self._used.append(message)
            try:
                check_frame(message.header, settings.frame)
                self._use(report_from_ros(message, settings.environment.dimension))
            except ValueError as error:
                self._node.drop('bad report', f'reports.{error}')
