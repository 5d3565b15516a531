"""The filter node: from detections to clusters and found targets."""

from __future__ import annotations

import math
import time
from collections import deque
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rclpy.duration import Duration
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header
from visualization_msgs.msg import MarkerArray

from maasi_filter import warm_up
from maasi_filter.conversions import (
    cluster_to_ros,
    filter_markers,
    found_target_from_ros,
    found_target_to_ros,
    measurement_from_ros,
    particles_to_ros,
    stamp_from_ros,
    stamp_to_ros,
)
from maasi_filter.node_settings import FilterNodeSettings
from maasi_filter.qos import LATCHED, LATCHED_ALL, RELIABLE, UPDATES
from maasi_filter.search_filter import AgentMeasurement, SearchFilter
from maasi_filter.search_node import SearchNode, SettingsError, run
from maasi_filter.state_file import StateFileError
from maasi_msgs.msg import (
    BatchMember,
    ClusterArray,
    DetectionArray,
    FilterUpdate,
    FoundTargetArray,
    MeasurementBatch,
)

_TIMEOUT_PERIOD = 0.05
# Longest wait until the filters of other robots have what was found [s].
_SHARING_PATIENCE = 0.5


@dataclass
class PendingBatch:
    """A batch whose measurements are not all there yet."""

    id: int
    step: int
    stamp: int
    members: list[BatchMember]
    measurements: dict[str, AgentMeasurement] = field(default_factory=dict)
    failed: set[str] = field(default_factory=set)
    since: float = field(default_factory=time.monotonic)

    @property
    def missing(self) -> list[str]:
        """Names of the members whose measurements are not there."""
        return [item.robot for item in self.members if item.robot not in self.measurements]

    @property
    def complete(self) -> bool:
        """Whether nobody is waited for."""
        return all(name in self.failed for name in self.missing)


class FilterNode(SearchNode[FilterNodeSettings]):
    """The particle PHD filter of the team (000, sections 3.1 to 3.3).

    In the namespace of its only robot it is that robot's own: beside others of the kind that tell
    each other what they have found (002, section 4, independent planner). What another one found
    counts for the batches with a later stamp.

    Subscribes
    ----------
    `measurement_batch` (maasi_msgs/MeasurementBatch): who measures;
    `<robot>/detections` (maasi_msgs/DetectionArray): what they see;
    `<robot>/found_targets` (maasi_msgs/FoundTargetArray) of robots with filters of their own

    Publishes
    ---------
    `filter_update` (maasi_msgs/FilterUpdate, latched): for every batch, in the order of their ids;
    `clusters` (maasi_msgs/ClusterArray), `found_targets` (maasi_msgs/FoundTargetArray, latched),
    `particles` (sensor_msgs/PointCloud2), `markers` (visualization_msgs/MarkerArray)
    """

    def __init__(self, **options: Any) -> None:
        super().__init__('filter_node', FilterNodeSettings, **options)
        settings = self.settings
        self._dimension = settings.environment.dimension
        self._sensors = {
            name: robot.sensor.build(name, self._dimension)
            for name, robot in sorted(settings.robots.items())
        }
        bounds = settings.environment.array()
        self._size = 0.01 * float((bounds[:, 1] - bounds[:, 0]).max())
        self._begin_anew()
        if self.settings.save_file and Path(self.settings.save_file).exists():
            self._load()

    def _load(self) -> None:
        """Go on where the saved search was.

        Raises
        ------
        SettingsError
            If the file is damaged, or of another environment.
        """
        settings = self.settings
        try:
            saved = SearchFilter.load(settings.save_file)
        except StateFileError as error:
            raise SettingsError(f'parameter save_file: {error}') from None
        bounds = settings.environment.array()
        if not np.array_equal(saved.bounds, bounds):
            raise SettingsError(
                f'parameter save_file: {settings.save_file}: bounds: got {saved.bounds.tolist()}, '
                f'allowed are those of the environment, {bounds.tolist()}'
            )
        if saved.settings != settings.filter:
            self.get_logger().warning(
                f'{settings.save_file} was saved with other settings of the filter; they go on'
            )
        self.filter = saved
        self.get_logger().info(
            f'state loaded from {settings.save_file}: {len(saved.found_targets)} found targets'
        )

    def _begin_anew(self) -> None:
        settings = self.settings
        self.filter = SearchFilter(
            settings.filter, settings.environment.array(), np.random.default_rng(settings.seed)
        )
        self._pending: dict[int, PendingBatch] = {}
        self._early: dict[tuple[int, str], DetectionArray] = {}
        # Of each robot's last detections: batch, measurement, stamp [ns].
        self._last_heard: dict[str, tuple[int, int, int]] = {}
        self._last_batch = 0
        self._last_batch_stamp = -1
        self._last_step: int | None = None
        self._settled_by: dict[int, int] = {}
        self._found_published = False
        self._shown_clusters = 0
        self._shared: dict[str, deque[FoundTargetArray]] = {
            name: deque() for name in sorted(settings.share_with)
        }
        self._particles_at = self._markers_at = -math.inf
        self._latency = 0.0

    def set_up(self) -> None:
        """Compile and connect."""
        settings = self.settings
        warm_up()
        self._update_publisher = self.create_publisher(FilterUpdate, 'filter_update', UPDATES)
        self._clusters_publisher = self.create_publisher(ClusterArray, 'clusters', 10)
        self._found_publisher = self.create_publisher(FoundTargetArray, 'found_targets', LATCHED)
        self._particles_publisher = self.create_publisher(PointCloud2, 'particles', 2)
        self._markers_publisher = self.create_publisher(MarkerArray, 'markers', 10)
        self.create_subscription(MeasurementBatch, 'measurement_batch', self._on_batch, RELIABLE)
        self.hurry(self.step_subscription)
        for name in self._sensors:
            self.hurry(
                self.create_subscription(
                    DetectionArray,
                    self.team_topic(f'{name}/detections'),
                    partial(self._on_detections, name),
                    RELIABLE,
                )
            )
        self._sharing = []
        for name in self._shared:
            topic = self.team_topic(f'{name}/found_targets')
            self._sharing.append(
                self.create_subscription(
                    FoundTargetArray, topic, partial(self._on_shared, name), LATCHED_ALL
                )
            )
            self.expect_publisher(topic)
        self.hurry(*self._sharing)
        self.expect_subscribers(self._found_publisher, len(self._shared))
        if not settings.lockstep:
            self.create_wall_timer(_TIMEOUT_PERIOD, self._look_at_waiting)
        if settings.save_file and settings.save_period > 0.0:
            self.create_wall_timer(settings.save_period, self._save)

    def halt(self) -> None:
        """Save the state."""
        if self.active:
            self._save()

    def _save(self) -> None:
        if not self.settings.save_file:
            return
        try:
            self.filter.save(self.settings.save_file)
        except OSError as error:
            # The search is worth more than its copy.
            self.get_logger().error(f'{self.settings.save_file}: state not saved: {error.strerror}')

    def reset(self) -> None:
        """Begin a new search."""
        self._begin_anew()

    def status(self) -> dict[str, Any]:
        """Return the state of the search."""
        return {
            'batches': self._last_batch,
            'waiting batches': len(self._pending),
            'particles': len(self.filter.weights),
            'expected number': f'{self.filter.expected_number:.3f}',
            'found': len(self.filter.found_targets),
            'last step [ms]': f'{1e3 * self._latency:.2f}',
        }

    # ---- what comes in -----------------------------------------------------------------------

    def _on_batch(self, batch: MeasurementBatch) -> None:
        if not self.active:
            return
        number = int(batch.id)
        stamp = stamp_from_ros(batch.stamp)
        known = {key: item.stamp for key, item in self._pending.items()}
        known[self._last_batch] = self._last_batch_stamp
        if known.get(number) == stamp:
            # A planner says again what may have been missed.
            return
        if number <= self._last_batch or (number in self._pending and not self.settings.lockstep):
            self.drop('old batch', f'measurement_batch.id: read {number}, allowed is a new one')
            return
        unknown = [item.robot for item in batch.members if item.robot not in self._sensors]
        for name in unknown:
            self.drop(
                'unknown robot',
                f'measurement_batch.members: read {name!r}, allowed are {", ".join(self._sensors)}',
            )
        pending = PendingBatch(
            number,
            int(batch.step),
            stamp,
            sorted(
                (item for item in batch.members if item.robot in self._sensors),
                key=lambda item: item.robot,
            ),
        )
        if self.settings.lockstep:
            # A planner waits for what it asks for: these are of one that is gone.
            for item in self._pending.values():
                item.failed.update(item.missing)
        self._pending[number] = pending
        for member in pending.members:
            early = self._early.pop((number, member.robot), None)
            # One before the batch answered another planner's of that number.
            if early is not None and stamp_from_ros(early.header.stamp) >= stamp:
                self._take(pending, early)
        self._process_complete()

    def _on_detections(self, name: str, message: DetectionArray) -> None:
        if not self.active:
            return
        number = int(message.batch_id)
        problem = self._problem(name, message)
        pending = self._pending.get(number)
        expected = pending is not None and name in pending.missing
        if problem is not None:
            self.drop('bad detections', f'{name}/detections.{problem}')
            if pending is not None and expected:
                pending.failed.add(name)
                self._process_complete()
            return
        key = (number, int(message.measurement), stamp_from_ros(message.header.stamp))
        if self._last_heard.get(name) == key:
            # A driver too.
            return
        self._last_heard[name] = key
        if pending is not None and expected:
            self._take(pending, message)
            self._process_complete()
        elif number > self._last_batch and pending is None:
            # Its batch has not come yet; batches are few and small, so this stays small too.
            self._early[(number, name)] = message
        else:
            self._take_late(name, message)

    def _problem(self, name: str, message: DetectionArray) -> str | None:
        """Return what is wrong with a whole message, if anything."""
        if message.robot != name:
            return f'robot: read {message.robot!r}, allowed on this topic is {name!r}'
        if message.header.frame_id != self.settings.frame:
            return (
                f'header.frame_id: read {message.header.frame_id!r}, allowed is '
                f'{self.settings.frame!r}'
            )
        stamp = stamp_from_ros(message.header.stamp)
        last = self._last_heard[name][2] if name in self._last_heard else stamp
        if stamp < last:
            return (
                f'header.stamp: read {stamp * 1e-9:.6f} s, allowed is from the last one, '
                f'{last * 1e-9:.6f} s'
            )
        pose = message.pose.pose
        numbers = (
            *(pose.position.x, pose.position.y, pose.position.z),
            *(pose.orientation.x, pose.orientation.y, pose.orientation.z, pose.orientation.w),
        )
        if not all(math.isfinite(number) for number in numbers):
            return f'pose: read {numbers}, allowed are finite numbers'
        return None

    def _measurement(self, message: DetectionArray) -> AgentMeasurement | None:
        name = message.robot
        try:
            measurement, problems = measurement_from_ros(
                message, self._sensors[name], self._dimension
            )
        except ValueError as error:
            self.drop('bad detections', f'{name}/detections.pose.{error}')
            return None
        for problem in problems:
            self.drop('bad detection', f'{name}/detections.{problem}')
        return measurement

    def _take(self, pending: PendingBatch, message: DetectionArray) -> None:
        measurement = self._measurement(message)
        if measurement is None:
            pending.failed.add(message.robot)
        else:
            pending.measurements[message.robot] = measurement

    def _take_late(self, name: str, message: DetectionArray) -> None:
        """Process what came after its batch, or was not asked for, as a batch of its own."""
        measurement = self._measurement(message)
        if measurement is None:
            return
        self.warn_throttled(
            'late', f'{name}/detections: batch {message.batch_id} came late: a batch of its own'
        )
        late = PendingBatch(
            int(message.batch_id),
            max(int(message.step), self._last_step or 0),
            stamp_from_ros(message.header.stamp),
            [BatchMember(robot=name, measurement=message.measurement)],
            {name: measurement},
        )
        self._process(late)

    def _on_shared(self, name: str, message: FoundTargetArray) -> None:
        if not self.active:
            return
        if message.header.frame_id != self.settings.frame:
            self.drop(
                'bad found targets',
                f'{name}/found_targets.header.frame_id: read {message.header.frame_id!r}, allowed '
                f'is {self.settings.frame!r}',
            )
            return
        self._shared[name].append(message)

    def _take_over(self, stamp: int) -> bool:
        """Take over what others found before a batch; return whether anything changed."""
        for subscription in self._sharing:
            # The others go on once this has come, which does not mean that it has been read.
            while (taken := subscription.handle.take_message(FoundTargetArray, False)) is not None:
                subscription.callback(taken[0])
        changed = False
        for name, waiting in self._shared.items():
            last = None
            while waiting and stamp_from_ros(waiting[0].header.stamp) < stamp:
                last = waiting.popleft()
            if last is None:
                continue
            # What it took over itself comes from whoever found it.
            targets = [item for item in last.targets if item.robot == name]
            try:
                changed |= self.filter.take_over(
                    name, [found_target_from_ros(item, self._dimension) for item in targets]
                )
            except ValueError as error:
                self.drop('bad found targets', f'{name}/found_targets: {error}')
        return changed

    def _look_at_waiting(self) -> None:
        if not self._pending:
            return
        first = self._pending[min(self._pending)]
        if time.monotonic() - first.since > self.settings.batch_timeout:
            missing = [name for name in first.missing if name not in first.failed]
            self.warn_throttled(
                'missing', f'batch {first.id}: no detections from {", ".join(missing)}, goes on'
            )
            first.failed.update(missing)
            self._process_complete()

    # ---- the step ----------------------------------------------------------------------------

    def _process_complete(self) -> None:
        """Process the batches that are complete, in the order of their ids."""
        while self._pending:
            first = self._pending[min(self._pending)]
            if not first.complete:
                return
            del self._pending[first.id]
            self._last_batch = first.id
            self._last_batch_stamp = first.stamp
            for key in [key for key in self._early if key[0] <= first.id]:
                del self._early[key]
            self._process(first)

    def _process(self, batch: PendingBatch) -> None:
        begin = time.perf_counter()
        last = self._last_step
        steps = 1 if last is None else max(batch.step - last, 0)
        self._last_step = batch.step
        members = [item for item in batch.members if item.robot in batch.measurements]
        now = batch.stamp * 1e-9
        changed = self._take_over(batch.stamp)
        try:
            result = self.filter.step(
                [batch.measurements[item.robot] for item in members], steps, now
            )
        except ValueError as error:
            # What the filter refuses leaves it as it was.
            self.drop('refused measurement', f'batch {batch.id}: {error}')
            for item in members:
                del batch.measurements[item.robot]
            members = []
            result = self.filter.step([], steps, now)
        for reason, number in sorted(result.dropped.items()):
            self.dropped[reason] += number
        header = Header(stamp=stamp_to_ros(batch.stamp), frame_id=self.settings.frame)
        for target in result.newly_found:
            self._settled_by[target.id] = batch.id
        clusters = [cluster_to_ros(cluster) for cluster in result.clusters]
        # Found targets first, so that they are there for whoever hears of the update.
        if changed or result.found_changed or not self._found_published:
            self._found_published = True
            self._found_publisher.publish(
                FoundTargetArray(
                    header=header,
                    batch_id=batch.id,
                    targets=[
                        found_target_to_ros(target, self._settled_by.get(target.id, 0))
                        for target in self.filter.found_targets
                    ],
                )
            )
            if self._shared:
                # With everybody before the step ends, so that it counts from the next one on.
                self._found_publisher.wait_for_all_acked(Duration(seconds=_SHARING_PATIENCE))
        self._update_publisher.publish(
            FilterUpdate(
                header=header,
                batch_id=batch.id,
                step=batch.step,
                members=members,
                missing=batch.missing,
                expected_number=float(result.expected_number),
                found=len(self.filter.found_targets),
                newly_found=[
                    found_target_to_ros(target, batch.id) for target in result.newly_found
                ],
                clusters=clusters,
            )
        )
        for target in result.newly_found:
            self.get_logger().info(
                f'found target {target.id} at '
                f'{", ".join(f"{value:.3f}" for value in target.position)} m ({target.robot})'
            )
        self._clusters_publisher.publish(
            ClusterArray(header=header, batch_id=batch.id, clusters=clusters)
        )
        self._publish_views(header, batch.stamp * 1e-9)
        self._latency = time.perf_counter() - begin

    def _publish_views(self, header: Header, now: float) -> None:
        """Publish what is for the eye, seldom enough."""
        settings = self.settings
        if settings.particles_rate > 0.0 and abs(now - self._particles_at) >= (
            1.0 / settings.particles_rate
        ):
            self._particles_at = now
            self._particles_publisher.publish(
                particles_to_ros(self.filter.particles, self.filter.weights, header)
            )
        if settings.markers_rate > 0.0 and abs(now - self._markers_at) >= (
            1.0 / settings.markers_rate
        ):
            self._markers_at = now
            markers, self._shown_clusters = filter_markers(
                header,
                self.filter.clusters,
                self.filter.found_targets,
                self._size,
                self._shown_clusters,
            )
            self._markers_publisher.publish(markers)


def main(arguments: list[str] | None = None) -> int:
    """Run the filter node."""
    return run(FilterNode, arguments)


if __name__ == '__main__':
    raise SystemExit(main())
