"""The filter node: turns detections into clusters and found targets."""

import math
import time
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rclpy.duration import Duration
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header
from visualization_msgs.msg import MarkerArray

from maasi_filter.geometry.area import Area
from maasi_filter.make_filter import Progress, load_state, make_filter, warm_up
from maasi_filter.measurement_check import FOUND, REPEATED
from maasi_filter.node.batch_assembly import BatchAssembly, PendingBatch
from maasi_filter.node.found_target_exchange import SharedFoundTargets
from maasi_filter.node.report_services import ReportServices
from maasi_filter.ros.conversions import (
    MarkerBoard,
    cluster_to_ros,
    filter_markers,
    found_fixes_to_ros,
    found_target_from_ros,
    found_target_to_ros,
    particles_to_ros,
    stamp_to_ros,
)
from maasi_filter.ros.keep_outs import KeepOutTopic
from maasi_filter.ros.lifecycle_node import LockstepLifecycleNode, SettingsError
from maasi_filter.ros.node_settings import FilterNodeSettings
from maasi_filter.ros.qos import LATCHED, RELIABLE, UPDATES
from maasi_filter.settings import unsuitable_lengths
from maasi_filter.state_file import StateFileError, write_state
from maasi_msgs.msg import (
    ClusterArray,
    DetectionArray,
    FilterUpdate,
    FoundFixArray,
    FoundTargetArray,
    MeasurementBatch,
)

_TIMEOUT_PERIOD = 0.05
_MOST_STEPS = 864_000  # upper bound on predicted steps: a day at 10 steps per second
_KEPT_PATIENCE = 5.0  # longest wait for the latched message with kept targets [s]
_SHARING_PATIENCE = 0.5  # longest wait for other filters to acknowledge found targets [s]


class FilterNode(LockstepLifecycleNode[FilterNodeSettings]):
    """Estimate the targets of a team by the particle PHD or the Poisson multi-Bernoulli filter.

    In the namespace of its only robot, the node filters for that robot alone and exchanges found
    targets with the filters of the other robots. Received found targets take effect in batches
    with a later stamp.

    Subscribes
    ----------
    `measurement_batch` (maasi_msgs/MeasurementBatch): robots that measure at a step;
    `<robot>/detections` (maasi_msgs/DetectionArray): their detections;
    `keep_outs` (maasi_msgs/KeepOuts, latched): active keep-outs, which the node publishes again;
    `found_targets/kept` (maasi_msgs/FoundTargetArray, latched): targets found before a restart;
    `<robot>/found_targets` (maasi_msgs/FoundTargetArray) of robots with their own filters

    Services
    --------
    `search/review_target` (maasi_msgs/ReviewTarget): a person confirms or rejects a found target;
    `search/add_sighting` (maasi_msgs/AddSighting): a person expects targets near a position;
    `search/mark_searched` (maasi_msgs/MarkSearched): others have searched ground.
    Running freely they are used at once, in lockstep before a batch

    Publishes
    ---------
    `filter_update` (maasi_msgs/FilterUpdate, latched): one per batch, in the order of their ids;
    `clusters` (maasi_msgs/ClusterArray), `found_targets` (maasi_msgs/FoundTargetArray, latched),
    `found_targets/fixes` (maasi_msgs/FoundFixArray, latched) if the map has an origin,
    `reports` (maasi_msgs/Report, latched): statements of persons that were used;
    `particles` (sensor_msgs/PointCloud2), `markers` (visualization_msgs/MarkerArray)
    """

    def __init__(self, **options: Any) -> None:
        super().__init__('filter_node', FilterNodeSettings, **options)

    def prepare(self) -> None:
        """Create the filter, or load it from `save_file`."""
        settings = self.settings
        self._dimension = settings.environment.dimension
        self._sensors = {
            name: robot.sensor.build(name, self._dimension)
            for name, robot in sorted(settings.robots.items())
        }
        self._shared = SharedFoundTargets(self)
        self._reports = ReportServices(
            self, lambda: (self.filter, self._progress.batch), self._save_and_publish
        )
        bounds = settings.environment.array()
        self.area = Area(settings.environment)
        self._marker_size = 0.01 * float((bounds[:, 1] - bounds[:, 0]).max())
        self._reset_state()
        # Batches wait this long for the found targets that the planner retained.
        # Later messages contain what this filter found itself.
        self._kept_until, self.kept_received = math.inf, False
        if settings.save_file and Path(settings.save_file).exists():
            self._restore(Path(settings.save_file))

    def _reset_state(self) -> None:
        settings = self.settings
        self.filter = make_filter(settings.filter, self.area, np.random.default_rng(settings.seed))
        warning = unsuitable_lengths(settings.filter, settings.environment.array())
        if warning:
            self.get_logger().warning(warning)
        self._continue_from(Progress())
        self._restored = False
        self._found_published = False
        self._shared.reset()
        self._board = MarkerBoard()
        self._particles_at = self._markers_at = -math.inf
        self._latency = 0.0
        self._no_faults = {FOUND: 0, REPEATED: 0}
        self._misfits: dict[str, str] = {}

    def _continue_from(self, progress: Progress) -> None:
        self._progress = progress
        self.batches = BatchAssembly(self, self._sensors, progress)

    def _restore(self, file: Path) -> None:
        """Resume the saved search, or the run of a process that died."""
        settings = self.settings
        try:
            saved, progress = load_state(file)
            if saved.environment.without_keep_outs() != settings.environment.without_keep_outs():
                raise SettingsError(
                    f'{file}: environment: got {saved.environment}, allowed is that of the '
                    f'parameters, {settings.environment}'
                )
        except (StateFileError, SettingsError) as error:
            if not settings.save_batches:
                raise SettingsError(f'parameter save_file: {error}') from None
            # The rest of the team continues, so this node starts without the saved state.
            aside = file.replace(file.with_name(f'{file.name}.refused'))
            self.get_logger().error(f'{error}; renamed to {aside}')
            return
        if saved.settings != settings.filter:
            self.get_logger().warning(
                f'{file} was saved with other filter settings, which stay in use'
            )
        self._adopt_area(saved.area)
        self.filter = saved
        found = f'{len(saved.found_targets)} found targets'
        if progress is None or not settings.save_batches:
            self.get_logger().info(f'state loaded from {file}: {found}')
            return
        self._continue_from(progress)
        self._restored = True
        self.get_logger().warning(f'resumed after batch {progress.batch} with {found}, from {file}')

    def set_up(self) -> None:
        """Compile the kernels, create publishers and subscriptions."""
        settings = self.settings
        warm_up(settings.filter.method)
        self._update_publisher = self.create_publisher(FilterUpdate, 'filter_update', UPDATES)
        self._clusters_publisher = self.create_publisher(ClusterArray, 'clusters', 10)
        self._found_publisher = self.create_publisher(FoundTargetArray, 'found_targets', LATCHED)
        if settings.environment.origin is not None:
            self._fixes = self.create_publisher(FoundFixArray, 'found_targets/fixes', LATCHED)
        self._particles_publisher = self.create_publisher(PointCloud2, 'particles', 2)
        self._markers_publisher = self.create_publisher(MarkerArray, 'markers', 10)
        kept = self.create_subscription(
            FoundTargetArray, 'found_targets/kept', self._on_kept, LATCHED
        )
        self._kept_topic = kept.topic_name
        self.create_subscription(MeasurementBatch, 'measurement_batch', self._on_batch, RELIABLE)
        for name in self._sensors:
            self.create_subscription(
                DetectionArray,
                self.team_topic(f'{name}/detections'),
                partial(self._on_detections, name),
                RELIABLE,
            )
        self._shared.set_up()
        self._reports.set_up()
        KeepOutTopic(self, self._adopt_area, keep=True)
        self.expect_subscribers(self._found_publisher, len(self._shared) + 1 if self._shared else 0)
        if not settings.lockstep:
            self.create_wall_timer(_TIMEOUT_PERIOD, self._give_up_waiting)
        if settings.save_period > 0.0 and not settings.save_batches:
            self.create_wall_timer(settings.save_period, self._save)

    def start(self) -> None:
        """Publish the restored state again, as latched messages end with their process."""
        self._kept_until = min(self._kept_until, time.monotonic() + _KEPT_PATIENCE)
        self._reports.publish(self.filter.reports)
        if not self._restored:
            return
        self._restored = False
        update = deserialize_message(self._progress.update.tobytes(), FilterUpdate)
        self._publish_found(update.header, self._progress.batch)
        # The process may have died before it sent this update; receivers ignore a duplicate.
        self._update_publisher.publish(update)

    def _adopt_area(self, area: Area) -> None:
        self.filter.adopt_area(area)
        self.area = self.filter.area

    def halt(self) -> None:
        """Save the state."""
        if self.active and not self.settings.save_batches:
            self._save()

    def _save(self) -> None:
        settings = self.settings
        if not settings.save_file:
            return
        file = Path(settings.save_file)
        try:
            if settings.save_batches:
                file.parent.mkdir(parents=True, exist_ok=True)
            # A copy after each batch only has to survive the process, not a power failure.
            durable = not settings.save_batches
            progress = self._progress if settings.save_batches else None
            write_state(file, {**self.filter.state(), 'progress': progress}, durable=durable)
        except OSError as error:
            # The search continues without a saved copy.
            self.warn_throttled('state', f'{file}: state not saved: {error.strerror}')

    def reset(self) -> None:
        """Begin a new search."""
        reported = bool(self.filter.reports)
        self.area = self.filter.area.with_sightings(()) if reported else self.area
        self._reset_state()
        if reported:
            self._reports.reset()
        if self.settings.save_file and self.settings.save_batches:
            Path(self.settings.save_file).unlink(missing_ok=True)

    def status(self) -> dict[str, Any]:
        """Return the state of the search."""
        return {
            'batches': self._progress.batch,
            'waiting batches': len(self.batches.pending),
            'particles': len(self.filter.weights),
            'expected number': f'{self.filter.expected_number:.3f}',
            'found': len(self.filter.found_targets),
            'detections of found targets': self._no_faults[FOUND],
            'repeated detections': self._no_faults[REPEATED],
            'last step [ms]': f'{1e3 * self._latency:.2f}',
        }

    def warnings(self) -> list[str]:
        """Return warnings about robots whose detections do not fit their settings."""
        return list(self._misfits.values())

    # ---- input -------------------------------------------------------------------------------

    def _on_batch(self, batch: MeasurementBatch) -> None:
        if not self.active:
            return
        if self.settings.lockstep and batch.step < (self._progress.step or 0):
            self.get_logger().warning(
                f'measurement_batch.step went back from {self._progress.step} to {batch.step}: '
                'the search starts again'
            )
            self.reset()
        self.batches.add(batch)
        self._process_complete()

    def _on_detections(self, name: str, message: DetectionArray) -> None:
        if not self.active:
            return
        late = self.batches.receive(name, message)
        if late is not None:
            late.step = max(late.step, self._progress.step or 0)
            self._process(late)
        self._process_complete()

    def _give_up_waiting(self) -> None:
        if self.batches.give_up(self.settings.batch_timeout):
            self._process_complete()

    # ---- the step ----------------------------------------------------------------------------

    def _process_complete(self) -> None:
        # New ids must differ from those of targets that were found before a restart.
        awaited = not self.kept_received and time.monotonic() < self._kept_until
        if awaited and self.batches.pending and self.count_publishers(self._kept_topic):
            return
        while (batch := self.batches.next_complete()) is not None:
            self._process(batch)

    def _process(self, batch: PendingBatch) -> None:
        begin, settings = time.perf_counter(), self.settings
        last = self._progress.step
        steps = 1 if last is None else min(max(batch.step - last, 0), _MOST_STEPS)
        self._progress.step = batch.step
        members = [item for item in batch.members if item.robot in batch.measurements]
        now = batch.stamp * 1e-9
        before = [target.id for target in self.filter.found_targets]
        reports = self._reports.use_waiting(batch.step, batch.stamp)
        changed = before != [target.id for target in self.filter.found_targets]
        changed |= self._shared.merge_into(self.filter, batch.stamp)
        try:
            result = self.filter.step(
                [batch.measurements[item.robot] for item in members], steps, now
            )
        except ValueError as error:
            # A refused measurement leaves the filter unchanged.
            self.drop('refused measurement', f'batch {batch.id}: {error}')
            for item in members:
                del batch.measurements[item.robot]
            members = []
            result = self.filter.step([], steps, now)
        for reason, number in sorted(result.dropped.items()):
            if reason in self._no_faults:
                self._no_faults[reason] += number
            else:
                self.dropped[reason] += number
        for robot in sorted(result.misfits.keys() - self._misfits.keys()):
            self.warn_throttled(f'misfit of {robot}', result.misfits[robot])
        self._misfits = result.misfits
        header = Header(stamp=stamp_to_ros(batch.stamp), frame_id=settings.frame)
        for target in result.newly_found:
            self._progress.settled_by[target.id] = batch.id
        clusters = [cluster_to_ros(cluster) for cluster in result.clusters]
        update = FilterUpdate(
            header=header,
            batch_id=batch.id,
            step=batch.step,
            members=members,
            missing=batch.missing,
            expected_number=float(result.expected_number),
            found=len(self.filter.found_targets),
            newly_found=[found_target_to_ros(target, batch.id) for target in result.newly_found],
            clusters=clusters,
            reports=len(self.filter.reports),
        )
        if settings.save_batches:
            # Save before publishing, so that no published result is lost with this process.
            self._progress.update = np.frombuffer(serialize_message(update), np.uint8)
            self._save()
        self._reports.publish(reports, wait=True)
        # Found targets first, so that subscribers have them when the update arrives.
        if changed or result.found_changed or not self._found_published:
            self._publish_found(header, batch.id)
            if self._shared:
                # Delivered before the step ends, so that it takes effect from the next one.
                self._found_publisher.wait_for_all_acked(Duration(seconds=_SHARING_PATIENCE))
        self._update_publisher.publish(update)
        for target in result.newly_found:
            self.get_logger().info(
                f'found target {target.id} at '
                f'{", ".join(f"{value:.3f}" for value in target.position)} m ({target.robot})'
            )
        self._clusters_publisher.publish(
            ClusterArray(header=header, batch_id=batch.id, clusters=clusters)
        )
        self._publish_views(header, now)
        self._latency = time.perf_counter() - begin

    def _save_and_publish(self) -> None:
        """Save and publish the state after a statement of a person."""
        self._save()
        stamp = self.get_clock().now().to_msg()
        header = Header(stamp=stamp, frame_id=self.settings.frame)
        self._publish_found(header, self._progress.batch)

    def _publish_views(self, header: Header, now: float) -> None:
        settings, search = self.settings, self.filter
        if _is_due(settings.particles_rate, now, self._particles_at):
            self._particles_at = now
            self._particles_publisher.publish(
                particles_to_ros(search.particles, search.weights, header)
            )
        if _is_due(settings.markers_rate, now, self._markers_at):
            self._markers_at = now
            clusters, found = search.clusters, search.found_targets
            markers = filter_markers(header, clusters, found, self._marker_size)
            self._markers_publisher.publish(self._board.replace(markers))

    def _publish_found(self, header: Header, batch: int) -> None:
        self._found_published = True
        if self.settings.environment.origin is not None:
            found, origin = self.filter.found_targets, self.settings.environment.origin
            self._fixes.publish(found_fixes_to_ros(found, origin, header, batch))
        self._found_publisher.publish(
            FoundTargetArray(
                header=header,
                batch_id=batch,
                targets=[
                    found_target_to_ros(target, self._progress.settled_by.get(target.id, 0))
                    for target in self.filter.found_targets
                ],
            )
        )

    def _on_kept(self, message: FoundTargetArray) -> None:
        """Restore found targets after a restart without a saved state."""
        if not self.active or self.kept_received:
            return
        self.kept_received = True
        try:
            if message.header.frame_id != self.settings.frame and message.targets:
                raise ValueError(
                    f'kept.header.frame_id: read {message.header.frame_id!r}, allowed is '
                    f'{self.settings.frame!r}'
                )
            targets = [found_target_from_ros(item, self._dimension) for item in message.targets]
            new = self.filter.keep_found(targets)
        except ValueError as error:
            self.drop('bad found targets', f'found_targets/{error}')
            new = []
        if new:
            known = {item.id: int(item.batch_id) for item in message.targets}
            for target in new:
                self._progress.settled_by[target.id] = known.get(target.id, 0)
            self.get_logger().warning(
                f'restarted without a saved state: {len(new)} found targets were restored from '
                'found_targets/kept; estimates of all other targets are lost'
            )
            self._publish_found(message.header, int(message.batch_id))
        self._process_complete()


def _is_due(rate: float, now: float, last: float) -> bool:
    return rate > 0.0 and abs(now - last) >= 1.0 / rate
