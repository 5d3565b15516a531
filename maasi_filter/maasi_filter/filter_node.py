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
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header
from visualization_msgs.msg import MarkerArray

from maasi_filter import warm_up
from maasi_filter.filter_memory import FilterMemory, Progress
from maasi_filter.kept_found_targets import KeptFoundTargets, checked_found
from maasi_filter.make_filter import load_filter, make_filter
from maasi_filter.records import AgentMeasurement
from maasi_filter.ros.conversions import (
    cluster_to_ros,
    filter_markers,
    found_target_from_ros,
    found_target_to_ros,
    measurement_from_ros,
    particles_to_ros,
    stamp_from_ros,
    stamp_to_ros,
)
from maasi_filter.ros.lifecycle_node import LockstepLifecycleNode, SettingsError, run
from maasi_filter.ros.marker_board import MarkerBoard
from maasi_filter.ros.node_settings import FilterNodeSettings
from maasi_filter.ros.qos import LATCHED, LATCHED_ALL, RELIABLE, UPDATES
from maasi_filter.ros.silence import Silence
from maasi_filter.ros.stamps import batch_id_limit
from maasi_filter.search_filter import SearchFilter
from maasi_filter.settings import unsuitable_lengths
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
# Largest lead of the stamp of a measurement over that of its batch [ns].
_STAMP_AHEAD = 60_000_000_000
# Capacity of the buffer of detections that arrive before their batch.
_MOST_EARLY = 64
# Upper bound on predicted steps: a day at 10 steps per second.
_MOST_STEPS = 864_000
# Longest wait for other filters to acknowledge found targets [s].
_SHARING_PATIENCE = 0.5


@dataclass
class PendingBatch:
    """A batch whose measurements have not all arrived."""

    id: int
    step: int
    stamp: int
    members: list[BatchMember]
    measurements: dict[str, AgentMeasurement] = field(default_factory=dict)
    failed: set[str] = field(default_factory=set)
    silence: Silence | None = None

    @property
    def missing(self) -> list[str]:
        """Names of the members whose measurements have not arrived."""
        return [item.robot for item in self.members if item.robot not in self.measurements]

    @property
    def complete(self) -> bool:
        """Whether no measurement is missing."""
        return all(name in self.failed for name in self.missing)


class FilterNode(LockstepLifecycleNode[FilterNodeSettings]):
    """The filter of the team: particle PHD (000, sections 3.1 to 3.3) or Poisson multi-Bernoulli.

    In the namespace of its only robot it is the filter of that robot alone, and exchanges found
    targets with the filters of the other robots (002, section 4, independent planner). Received
    found targets take effect for batches with a later stamp.

    Subscribes
    ----------
    `measurement_batch` (maasi_msgs/MeasurementBatch): which robots measure;
    `<robot>/detections` (maasi_msgs/DetectionArray): their measurements;
    `found_targets/kept` (maasi_msgs/FoundTargetArray, latched): targets found before a restart;
    `<robot>/found_targets` (maasi_msgs/FoundTargetArray) of robots with filters of their own

    Publishes
    ---------
    `filter_update` (maasi_msgs/FilterUpdate, latched): for every batch, in the order of their ids;
    `clusters` (maasi_msgs/ClusterArray), `found_targets` (maasi_msgs/FoundTargetArray, latched),
    `particles` (sensor_msgs/PointCloud2), `markers` (visualization_msgs/MarkerArray)
    """

    def __init__(self, **options: Any) -> None:
        super().__init__('filter_node', FilterNodeSettings, **options)

    def prepare(self) -> None:
        """Create the filter, or load it from its file."""
        settings = self.settings
        self._dimension = settings.environment.dimension
        self._sensors = {
            name: robot.sensor.build(name, self._dimension)
            for name, robot in sorted(settings.robots.items())
        }
        bounds = settings.environment.array()
        self._size = 0.01 * float((bounds[:, 1] - bounds[:, 0]).max())
        self._memory = (
            FilterMemory(settings.save_file)
            if settings.save_file and settings.save_batches
            else None
        )
        self._begin_anew()
        self._kept = KeptFoundTargets()
        self._restored = b''
        if self._memory is not None:
            self._restore(self._memory)
        elif settings.save_file and Path(settings.save_file).exists():
            self._load()

    def _begin_anew(self) -> None:
        settings = self.settings
        self.filter = make_filter(
            settings.filter, settings.environment.array(), np.random.default_rng(settings.seed)
        )
        warning = unsuitable_lengths(settings.filter, settings.environment.array())
        if warning:
            self.get_logger().warning(warning)
        self._pending: dict[int, PendingBatch] = {}
        self._early: dict[tuple[int, str], DetectionArray] = {}
        # Last detections of each robot: batch, measurement, stamp [ns].
        self._last_heard: dict[str, tuple[int, int, int]] = {}
        self._last_batch = 0
        self._last_batch_stamp = -1
        self._last_step: int | None = None
        self._settled_by: dict[int, int] = {}
        self._found_published = False
        self._board = MarkerBoard()
        self._shared: dict[str, deque[FoundTargetArray]] = {
            name: deque() for name in sorted(settings.share_with)
        }
        self._particles_at = self._markers_at = -math.inf
        self._latency = 0.0

    def _restore(self, memory: FilterMemory) -> None:
        """Resume after the last batch of a process that died."""
        try:
            saved = memory.load()
            if saved is not None:
                self._check_bounds(saved[0])
        except (StateFileError, SettingsError) as error:
            # The rest of the team continues, so this node starts without the saved state.
            self.get_logger().error(f'{error}; set aside as {memory.set_aside()}')
            return
        if saved is None:
            return
        self.filter, progress = saved
        self._last_batch, self._last_batch_stamp = progress.batch, progress.stamp
        self._last_step = progress.step
        self._settled_by = dict(progress.settled_by)
        self._last_heard = dict(progress.heard)
        self._restored = progress.update
        self.get_logger().warning(
            f'restarted after batch {progress.batch} with {len(self.filter.found_targets)} found '
            f'targets, from {memory.path}'
        )

    def _load(self) -> None:
        """Resume the saved search.

        Raises
        ------
        SettingsError
            If the file is damaged, or of another environment.
        """
        settings = self.settings
        try:
            saved = load_filter(settings.save_file)
        except StateFileError as error:
            raise SettingsError(f'parameter save_file: {error}') from None
        self._check_bounds(saved)
        if saved.settings != settings.filter:
            self.get_logger().warning(
                f'{settings.save_file} was saved with other settings of the filter; they go on'
            )
        self.filter = saved
        self.get_logger().info(
            f'state loaded from {settings.save_file}: {len(saved.found_targets)} found targets'
        )

    def _check_bounds(self, saved: SearchFilter) -> None:
        bounds = self.settings.environment.array()
        if not np.array_equal(saved.bounds, bounds):
            raise SettingsError(
                f'parameter save_file: {self.settings.save_file}: bounds: got '
                f'{saved.bounds.tolist()}, allowed are those of the environment, {bounds.tolist()}'
            )

    def set_up(self) -> None:
        """Compile and connect."""
        settings = self.settings
        warm_up()
        self._update_publisher = self.create_publisher(FilterUpdate, 'filter_update', UPDATES)
        self._clusters_publisher = self.create_publisher(ClusterArray, 'clusters', 10)
        self._found_publisher = self.create_publisher(FoundTargetArray, 'found_targets', LATCHED)
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
        self._sharing = []
        for name in self._shared:
            topic = self.team_topic(f'{name}/found_targets')
            self._sharing.append(
                self.create_subscription(
                    FoundTargetArray, topic, partial(self._on_shared, name), LATCHED_ALL
                )
            )
            self.expect_publisher(topic)
        # Subscribers: the filters of the others, and the planner that keeps the found targets.
        self.expect_subscribers(self._found_publisher, len(self._shared) + 1 if self._shared else 0)
        if not settings.lockstep:
            self.create_wall_timer(_TIMEOUT_PERIOD, self._look_at_waiting)
        if settings.save_file and settings.save_period > 0.0:
            self.create_wall_timer(settings.save_period, self._save)

    def start(self) -> None:
        """Republish the restored state: the latched messages of the dead process are lost."""
        self._kept.begin(time.monotonic())
        if not self._restored:
            return
        update = deserialize_message(self._restored, FilterUpdate)
        self._restored = b''
        self._publish_found(update.header, self._last_batch)
        # The process may have died before it sent this update; receivers ignore a duplicate.
        self._update_publisher.publish(update)

    def halt(self) -> None:
        """Save the state."""
        if self.active:
            self._save()

    def _save(self) -> None:
        if not self.settings.save_file or self._memory is not None:
            return
        try:
            self.filter.save(self.settings.save_file)
        except OSError as error:
            # The search is worth more than its copy.
            self.get_logger().error(f'{self.settings.save_file}: state not saved: {error.strerror}')

    def reset(self) -> None:
        """Begin a new search."""
        self._begin_anew()
        if self._memory is not None:
            self._memory.forget()

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
            # Duplicate batch: the planner republishes batches that may have been missed.
            return
        if number <= self._last_batch or (number in self._pending and not self.settings.lockstep):
            self.drop('old batch', f'measurement_batch.id: read {number}, allowed is a new one')
            return
        if number > batch_id_limit(self._last_batch):
            self.drop(
                'bad batch',
                f'measurement_batch.id: read {number}, allowed is up to '
                f'{batch_id_limit(self._last_batch)}',
            )
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
            silence=Silence(self),
        )
        if self.settings.lockstep:
            # A planner waits for each batch: older pending ones are from a planner that is gone.
            for item in self._pending.values():
                item.failed.update(item.missing)
        self._pending[number] = pending
        for member in pending.members:
            early = self._early.pop((number, member.robot), None)
            # Stamped before the batch: it answered an earlier planner's batch with that number.
            if (
                early is not None
                and 0 <= stamp_from_ros(early.header.stamp) - stamp <= _STAMP_AHEAD
            ):
                self._take(pending, early)
        self._process_complete()

    def _on_detections(self, name: str, message: DetectionArray) -> None:
        if not self.active:
            return
        number = int(message.batch_id)
        problem = self._problem(name, message)
        pending = self._pending.get(number)
        expected = pending is not None and name in pending.missing
        problem = problem or self._stamp_problem(name, message, pending if expected else None)
        if problem is not None:
            self.drop('bad detections', f'{name}/detections.{problem}')
            if pending is not None and expected:
                pending.failed.add(name)
                self._process_complete()
            return
        key = (number, int(message.measurement), stamp_from_ros(message.header.stamp))
        if self._last_heard.get(name) == key:
            # Duplicate: drivers also republish.
            return
        self._last_heard[name] = key
        if pending is not None and expected:
            self._take(pending, message)
            self._process_complete()
        elif number > self._last_batch and pending is None:
            # Its batch has not arrived yet.
            self._early[(number, name)] = message
            if len(self._early) > _MOST_EARLY:
                oldest = next(iter(self._early))
                del self._early[oldest]
                self.drop('no batch', f'{oldest[1]}/detections.batch_id: no batch {oldest[0]} came')
        else:
            self._take_late(name, message)

    def _problem(self, name: str, message: DetectionArray) -> str | None:
        """Return why a whole message is refused, or None."""
        if message.robot != name:
            return f'robot: read {message.robot!r}, allowed on this topic is {name!r}'
        if message.header.frame_id != self.settings.frame:
            return (
                f'header.frame_id: read {message.header.frame_id!r}, allowed is '
                f'{self.settings.frame!r}'
            )
        if message.measurement > batch_id_limit(0):
            return f'measurement: read {message.measurement}, allowed is up to {batch_id_limit(0)}'
        pose = message.pose.pose
        numbers = (
            *(pose.position.x, pose.position.y, pose.position.z),
            *(pose.orientation.x, pose.orientation.y, pose.orientation.z, pose.orientation.w),
        )
        if not all(math.isfinite(number) for number in numbers):
            return f'pose: read {numbers}, allowed are finite numbers'
        return None

    def _stamp_problem(
        self, name: str, message: DetectionArray, expected: PendingBatch | None
    ) -> str | None:
        """Return why the stamp of detections is refused, or None.

        Parameters
        ----------
        name : str
            Of the robot.
        message : DetectionArray
            From it.
        expected : PendingBatch, optional
            The batch that it answers.
        """
        stamp = stamp_from_ros(message.header.stamp)
        last = self._last_heard[name][2] if name in self._last_heard else 0
        if expected is not None:
            # After one stamp from the future, later messages with valid stamps are not late.
            earliest, latest = min(last, expected.stamp), expected.stamp + _STAMP_AHEAD
        elif message.batch_id > self._last_batch:
            # Its batch may still arrive.
            return None
        else:
            earliest, latest = last, max(self._last_batch_stamp, last) + _STAMP_AHEAD
        if earliest <= stamp <= latest:
            return None
        return (
            f'header.stamp: read {stamp * 1e-9:.6f} s, allowed is {earliest * 1e-9:.6f} to '
            f'{latest * 1e-9:.6f} s'
        )

    def _measurement(self, message: DetectionArray) -> AgentMeasurement | None:
        name = message.robot
        try:
            measurement, problems = measurement_from_ros(
                message, self._sensors[name], self._dimension
            )
        except ValueError as error:
            self.drop('bad detections', f'{name}/detections.pose.{error}')
            return None
        for reason, texts in problems.items():
            for text, number in texts.items():
                self.drop(reason, f'{name}/detections.{text}', number)
        return measurement

    def _take(self, pending: PendingBatch, message: DetectionArray) -> None:
        measurement = self._measurement(message)
        if measurement is None:
            pending.failed.add(message.robot)
        else:
            pending.measurements[message.robot] = measurement

    def _take_late(self, name: str, message: DetectionArray) -> None:
        """Process a late or unrequested measurement as a batch of its own."""
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
        """Merge targets found by others before a batch; return whether anything changed."""
        for subscription in self._sharing:
            # Lockstep only guarantees that the messages have arrived, not that they were read.
            while (taken := subscription.handle.take_message(FoundTargetArray, False)) is not None:
                subscription.callback(taken[0])
        changed = False
        for name, waiting in self._shared.items():
            last = None
            while waiting and stamp_from_ros(waiting[0].header.stamp) < stamp:
                last = waiting.popleft()
            if last is None:
                continue
            # Targets that it received itself arrive from the filter that found them.
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
        if first.silence is not None and first.silence.length > self.settings.batch_timeout:
            missing = [name for name in first.missing if name not in first.failed]
            self.warn_throttled(
                'missing', f'batch {first.id}: no detections from {", ".join(missing)}, goes on'
            )
            first.failed.update(missing)
            self._process_complete()

    # ---- the step ----------------------------------------------------------------------------

    def _process_complete(self) -> None:
        """Process the batches that are complete, in the order of their ids."""
        # New ids must differ from those of targets that were found before a restart.
        if self._pending and self._kept.is_awaited(
            self.count_publishers(self._kept_topic), time.monotonic()
        ):
            return
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
        steps = 1 if last is None else min(max(batch.step - last, 0), _MOST_STEPS)
        self._last_step = batch.step
        members = [item for item in batch.members if item.robot in batch.measurements]
        now = batch.stamp * 1e-9
        changed = self._take_over(batch.stamp)
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
            self.dropped[reason] += number
        header = Header(stamp=stamp_to_ros(batch.stamp), frame_id=self.settings.frame)
        for target in result.newly_found:
            self._settled_by[target.id] = batch.id
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
        )
        if self._memory is not None:
            # Save before publishing, so that no published result is lost with this process.
            self._remember(self._memory, update)
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
        self._publish_views(header, batch.stamp * 1e-9)
        self._latency = time.perf_counter() - begin

    def _publish_found(self, header: Header, batch: int) -> None:
        self._found_published = True
        self._found_publisher.publish(
            FoundTargetArray(
                header=header,
                batch_id=batch,
                targets=[
                    found_target_to_ros(target, self._settled_by.get(target.id, 0))
                    for target in self.filter.found_targets
                ],
            )
        )

    def _remember(self, memory: FilterMemory, update: FilterUpdate) -> None:
        progress = Progress(
            batch=self._last_batch,
            stamp=self._last_batch_stamp,
            step=self._last_step or 0,
            settled_by=self._settled_by,
            heard=self._last_heard,
            update=serialize_message(update),
        )
        try:
            memory.save(self.filter, progress)
        except OSError as error:
            # The search is worth more than its copy.
            self.warn_throttled('state', f'{memory.path}: state not saved: {error.strerror}')

    def _on_kept(self, message: FoundTargetArray) -> None:
        """Restore targets found before a restart of this node without its state."""
        if not self.active or not self._kept.take():
            return
        try:
            if message.header.frame_id != self.settings.frame and message.targets:
                raise ValueError(
                    f'header.frame_id: read {message.header.frame_id!r}, allowed is '
                    f'{self.settings.frame!r}'
                )
            targets = [found_target_from_ros(item, self._dimension) for item in message.targets]
            new = self.filter.keep_found(checked_found(targets))
        except ValueError as error:
            self.drop('bad found targets', f'found_targets/kept.{error}')
            new = []
        if new:
            known = {item.id: int(item.batch_id) for item in message.targets}
            for target in new:
                self._settled_by[target.id] = known.get(target.id, 0)
            self.get_logger().warning(
                f'restarted without the state of the search: {len(new)} found targets taken from '
                'found_targets/kept; what was believed of others is lost'
            )
            self._publish_found(message.header, int(message.batch_id))
        self._process_complete()

    def _publish_views(self, header: Header, now: float) -> None:
        """Publish visualization at a limited rate."""
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
            markers = filter_markers(
                header, self.filter.clusters, self.filter.found_targets, self._size
            )
            self._markers_publisher.publish(self._board.replace(markers))


def main(arguments: list[str] | None = None) -> int:
    """Run the filter node."""
    return run(FilterNode, arguments)


if __name__ == '__main__':
    raise SystemExit(main())
