"""Services with which persons state what they know, and the topic of what was used."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from rclpy.duration import Duration
from std_msgs.msg import Header

from maasi_filter.reports import (
    MOST_REPORTS,
    Report,
    origin_of,
    position_on_map,
    review,
    searched,
    sighting,
    zone_on_map,
)
from maasi_filter.ros.conversions import report_to_ros, stamp_to_ros
from maasi_filter.ros.lifecycle_node import LockstepLifecycleNode
from maasi_filter.ros.node_settings import FilterNodeSettings
from maasi_filter.ros.qos import LATCHED_ALL
from maasi_filter.search_filter import SearchFilter
from maasi_msgs.msg import Report as ReportMessage
from maasi_msgs.srv import AddSighting, MarkSearched, ReviewTarget

_PATIENCE = 0.5  # longest wait for readers to acknowledge a report, in lockstep [s]


class ReportServices:
    """Checks statements, uses them between batches, and publishes those used.

    `on_used` is called after statements were used at once: running freely. In lockstep they wait
    for a batch.
    """

    def __init__(
        self,
        node: LockstepLifecycleNode[FilterNodeSettings],
        search: Callable[[], tuple[SearchFilter, int]],
        on_used: Callable[[], None],
    ) -> None:
        self._node, self._search, self._on_used = node, search, on_used
        # First step, and statement, of those that wait for a batch.
        self._waiting: list[tuple[int, Report]] = []

    def reset(self) -> None:
        """Begin a new search: earlier statements no longer count."""
        self._waiting.clear()
        header = Header(stamp=self._node.get_clock().now().to_msg(), frame_id=self._frame)
        self._publisher.publish(ReportMessage(header=header))

    def set_up(self) -> None:
        """Offer the services."""
        node = self._node
        self._publisher = node.create_publisher(ReportMessage, 'reports', LATCHED_ALL)
        for name, kind, read in (
            ('review_target', ReviewTarget, self._review),
            ('add_sighting', AddSighting, self._sighting),
            ('mark_searched', MarkSearched, self._searched),
        ):
            node.offer_service(f'search/{name}', partial(self._accept, read), kind)

    @property
    def _frame(self) -> str:
        return self._node.settings.frame

    # ---- requests ------------------------------------------------------------------------------

    def _review(self, request: Any) -> Report:
        search, _ = self._search()
        own = search.reviewable()
        for target in search.found_targets:
            if target.id == request.id and target.id not in own:
                raise ValueError(
                    f'id: read {target.id}, which {target.robot} found: allowed are targets of '
                    f'this filter; use the service of the filter of {target.robot}'
                )
        return review(request.id, request.confirmed, request.reliability, request.source, own)

    def _sighting(self, request: Any) -> Report:
        at = request.position
        search, _ = self._search()
        origin = origin_of(request.frame_id, self._frame, self._node.settings.environment)
        position = (at.x, at.y, at.z)
        if origin is not None:
            position = (*position_on_map(at.x, at.y, origin), 0.0)
        return sighting(position, request.radius, request.weight, request.source, search.area)

    def _searched(self, request: Any) -> Report:
        search, _ = self._search()
        probability, environment = request.detection_probability, self._node.settings.environment
        origin = origin_of(request.frame_id, self._frame, environment)
        zone = request.zone if origin is None else zone_on_map(request.zone, origin)
        return searched(zone, probability, request.source, environment, search.area)

    def _accept(self, read: Callable[[Any], Report], request: Any) -> tuple[bool, str]:
        try:
            if not self._node.active:
                raise ValueError('the filter is not active')
            search, _ = self._search()
            if len(search.reports) + len(self._waiting) >= MOST_REPORTS:
                raise ValueError(f'allowed are {MOST_REPORTS} statements in one search')
            report = read(request)
        except ValueError as error:
            self._node.get_logger().warning(f'refused statement: {error}')
            return False, str(error)
        if self._node.settings.lockstep:
            self._waiting.append((int(request.step), report))
            return True, f'{report}; waits for the next batch'
        used = self._use(report, self._node.get_clock().now().nanoseconds)
        effect = self._effect(used)
        self._on_used()
        self.publish([used])
        return True, f'{report}{effect}'

    def _effect(self, report: Report) -> str:
        if not report.target:
            return ''
        search, _ = self._search()
        found = report.target in {target.id for target in search.found_targets}
        return '; it counts as found' if found else '; it is withdrawn'

    # ---- use -----------------------------------------------------------------------------------

    def use_waiting(self, step: int, stamp: int) -> list[Report]:
        """Use what waits for a batch of this step and stamp [ns]; return it."""
        search, _ = self._search()
        used, later = [], []
        for first, report in self._waiting:
            if first > step:
                later.append((first, report))
            elif report.target and report.target not in search.reviewable():
                # Withdrawn since it was accepted.
                self._node.drop('bad statement', f'{report}: the target is no longer found')
            else:
                used.append(self._use(report, stamp))
        self._waiting = later
        return used

    def _use(self, report: Report, stamp: int) -> Report:
        search, batch = self._search()
        used = search.use(report, 1e-9 * stamp, batch)
        self._node.get_logger().info(f'{used}{self._effect(used)}')
        return used

    def publish(self, reports: list[Report], wait: bool = False) -> None:
        """Publish statements; `wait` until they have arrived, so that an update can follow."""
        for report in reports:
            stamp = stamp_to_ros(round(1e9 * report.time))
            self._publisher.publish(
                report_to_ros(report, Header(stamp=stamp, frame_id=self._frame))
            )
        if reports and wait:
            self._publisher.wait_for_all_acked(Duration(seconds=_PATIENCE))
