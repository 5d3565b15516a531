"""Measurement batches of the planner node, and their updates from the filter."""

import time
from collections import deque
from collections.abc import Callable, Sequence

from std_msgs.msg import Header

from maasi_filter.ros.lifecycle_node import LockstepLifecycleNode
from maasi_filter.ros.qos import RELIABLE, UPDATES
from maasi_msgs.msg import BatchMember, FilterUpdate, MeasurementBatch
from maasi_planner.conversions import checked_update
from maasi_planner.coordinator import Coordinator
from maasi_planner.node.filter_guard import FilterGuard
from maasi_planner.node.reports import Reports
from maasi_planner.node_settings import PlannerNodeSettings
from maasi_planner.robot_plan import Member

_MEASUREMENTS_KEPT = 1000  # remembered to detect duplicate updates


class Batches:
    """Requests measurements, and passes updates of the filter to the coordinator."""

    def __init__(
        self,
        node: LockstepLifecycleNode[PlannerNodeSettings],
        guard: FilterGuard,
        reports: Reports,
        on_answer: Callable[[], None],
    ) -> None:
        self._node, self._guard, self._reports = node, guard, reports
        self._on_answer = on_answer

    def reset(self, coordinator: Coordinator) -> None:
        """Reset for a new search."""
        self._coordinator = coordinator
        # Ids of the last batch and of the last used update; number of measurements.
        self.last = self.used = self.measurements = 0
        self.waiting = False
        self.published_at = time.monotonic()
        self.update = FilterUpdate()  # last used one
        self._message = MeasurementBatch()
        self._before = 0  # last batch of an earlier planner process
        # Robot and index of the last measurements whose update was used.
        self._processed: deque[tuple[str, int]] = deque(maxlen=_MEASUREMENTS_KEPT)

    def set_up(self) -> None:
        """Create publisher and subscription."""
        node = self._node
        self._publisher = node.create_publisher(MeasurementBatch, 'measurement_batch', RELIABLE)
        node.expect_subscribers(self._publisher, 1 + len(self._coordinator.names))
        node.create_subscription(FilterUpdate, 'filter_update', self._on_update, UPDATES)

    def publish(self, step: int, members: Sequence[Member], header: Header) -> None:
        """Request the measurements of a step."""
        self.last += 1
        self.waiting = True
        self._message = MeasurementBatch(
            id=self.last,
            step=step,
            stamp=header.stamp,
            members=[BatchMember(**vars(item)) for item in members],
        )
        self.published_at = time.monotonic()
        self._guard.watch.asked(self.last, self.published_at)
        self._publisher.publish(self._message)

    def publish_again(self) -> None:
        """Republish the last batch if it has no update; receivers ignore duplicates."""
        if self.waiting:
            self.published_at = time.monotonic()
            self._publisher.publish(self._message)

    def _on_update(self, message: FilterUpdate) -> None:
        node, coordinator = self._node, self._coordinator
        if not node.active:
            return
        try:
            clusters, poses = checked_update(message, coordinator.names, node.settings, self.last)
        except ValueError as error:
            node.drop('bad update', f'filter_update.{error}')
            return
        number = int(message.batch_id)
        if number > self.last:
            self.last = self._before = number
        if number <= self._before:
            # An update of an earlier planner process: continue after its indices.
            for member in message.members:
                schedule = coordinator.robots[member.robot].schedule
                schedule.number = max(schedule.number, int(member.measurement) + 1)
            return
        self._guard.watch.answered(number)
        measured = [(member.robot, int(member.measurement)) for member in message.members]
        if measured and all(item in self._processed for item in measured):
            return  # duplicate, from a restarted filter
        self._processed.extend(measured)
        self._reports.include(int(message.reports))
        coordinator.absorb(poses, clusters)
        self.used = max(self.used, number)
        self.update = message
        self.measurements += len(measured)
        if self.waiting and number == self.last:
            self.waiting = False
            self._on_answer()
