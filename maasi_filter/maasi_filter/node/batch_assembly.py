"""Assembles the measurements of each batch."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from maasi_filter.make_filter import Progress
from maasi_filter.models.sensor import Sensor
from maasi_filter.records import AgentMeasurement
from maasi_filter.ros.clocks import Silence, batch_id_limit
from maasi_filter.ros.conversions import measurement_from_ros, stamp_from_ros
from maasi_filter.ros.lifecycle_node import LockstepLifecycleNode
from maasi_filter.ros.node_settings import FilterNodeSettings
from maasi_msgs.msg import BatchMember, DetectionArray, MeasurementBatch

# Largest lead of the stamp of a measurement over that of its batch [ns].
_STAMP_AHEAD = 60_000_000_000
_MOST_EARLY = 64  # capacity of the buffer of detections that arrive before their batch


@dataclass
class PendingBatch:
    """A batch with missing measurements."""

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


class BatchAssembly:
    """Matches detections to batches; the node counts what is dropped."""

    def __init__(
        self,
        node: LockstepLifecycleNode[FilterNodeSettings],
        sensors: Mapping[str, Sensor],
        progress: Progress,
    ) -> None:
        self._node, self._sensors, self._progress = node, sensors, progress
        #: Incomplete batches, by id.
        self.pending: dict[int, PendingBatch] = {}
        self._early: dict[tuple[int, str], DetectionArray] = {}

    def add(self, batch: MeasurementBatch) -> None:
        """Add a batch and the detections that arrived before it."""
        node, last = self._node, self._progress.batch
        number = int(batch.id)
        stamp = stamp_from_ros(batch.stamp)
        known = {key: item.stamp for key, item in self.pending.items()}
        known[last] = self._progress.stamp
        if known.get(number) == stamp:
            return  # duplicate batch: the planner republishes batches that may have been missed
        if number <= last or (number in self.pending and not node.settings.lockstep):
            node.drop('old batch', f'measurement_batch.id: read {number}, allowed is a new one')
            return
        if number > batch_id_limit(last):
            node.drop(
                'bad batch',
                f'measurement_batch.id: read {number}, allowed is up to {batch_id_limit(last)}',
            )
            return
        for item in batch.members:
            if item.robot not in self._sensors:
                node.drop(
                    'unknown robot',
                    f'measurement_batch.members: read {item.robot!r}, allowed are '
                    f'{", ".join(self._sensors)}',
                )
        members = [item for item in batch.members if item.robot in self._sensors]
        members.sort(key=lambda item: item.robot)
        pending = PendingBatch(number, int(batch.step), stamp, members, silence=Silence(node))
        if node.settings.lockstep:
            # A planner waits for each batch: older ones are from a planner that has ended.
            for other in self.pending.values():
                other.failed.update(other.missing)
        self.pending[number] = pending
        for member in members:
            early = self._early.pop((number, member.robot), None)
            # Stamped before the batch: for a batch of an earlier planner with that number.
            if (
                early is not None
                and 0 <= stamp_from_ros(early.header.stamp) - stamp <= _STAMP_AHEAD
            ):
                self._receive(pending, early)

    def receive(self, name: str, message: DetectionArray) -> PendingBatch | None:
        """Add detections; return a separate batch if they are late or were not requested."""
        node = self._node
        number = int(message.batch_id)
        pending = self.pending.get(number)
        expected = pending if pending is not None and name in pending.missing else None
        problem = self._problem(name, message, expected)
        if problem is not None:
            node.drop('bad detections', f'{name}/detections.{problem}')
            if expected is not None:
                expected.failed.add(name)
            return None
        key = (number, int(message.measurement), stamp_from_ros(message.header.stamp))
        if self._progress.heard.get(name) == key:
            return None  # duplicate: drivers also republish
        self._progress.heard[name] = key
        if expected is not None:
            self._receive(expected, message)
        elif number > self._progress.batch and pending is None:
            # Its batch has not arrived yet.
            self._early[(number, name)] = message
            if len(self._early) > _MOST_EARLY:
                oldest = next(iter(self._early))
                del self._early[oldest]
                node.drop(
                    'no batch', f'{oldest[1]}/detections.batch_id: batch {oldest[0]} did not arrive'
                )
        else:
            return self._late(name, message)
        return None

    def next_complete(self) -> PendingBatch | None:
        """Remove and return the first batch if it is complete."""
        first = self.first
        if first is None or not first.failed.issuperset(first.missing):
            return None
        del self.pending[first.id]
        self._progress.batch, self._progress.stamp = first.id, first.stamp
        for key in [key for key in self._early if key[0] <= first.id]:
            del self._early[key]
        return first

    @property
    def first(self) -> PendingBatch | None:
        """The pending batch of the lowest id."""
        return self.pending[min(self.pending)] if self.pending else None

    def give_up(self, timeout: float) -> bool:
        """Complete the first batch after `timeout` [s] without its missing measurements."""
        first = self.first
        if first is None or first.silence is None or first.silence.length <= timeout:
            return False
        missing = [name for name in first.missing if name not in first.failed]
        self._node.warn_throttled(
            'missing', f'batch {first.id}: processed without detections from {", ".join(missing)}'
        )
        first.failed.update(missing)
        return True

    def _problem(
        self, name: str, message: DetectionArray, expected: PendingBatch | None
    ) -> str | None:
        if message.robot != name:
            return f'robot: read {message.robot!r}, allowed on this topic is {name!r}'
        if message.header.frame_id != self._node.settings.frame:
            return (
                f'header.frame_id: read {message.header.frame_id!r}, allowed is '
                f'{self._node.settings.frame!r}'
            )
        if message.measurement > batch_id_limit(0):
            return f'measurement: read {message.measurement}, allowed is up to {batch_id_limit(0)}'
        stamp = stamp_from_ros(message.header.stamp)
        last = self._progress.heard[name][2] if name in self._progress.heard else 0
        if expected is not None:
            # After one stamp from the future, later messages with valid stamps are not late.
            earliest, latest = min(last, expected.stamp), expected.stamp + _STAMP_AHEAD
        elif message.batch_id > self._progress.batch:
            return None  # its batch may still arrive
        else:
            # Without batches of a planner, the first stamp can be any up to now.
            now = self._node.get_clock().now().nanoseconds
            earliest, latest = last, max(self._progress.stamp, last, now) + _STAMP_AHEAD
        if earliest <= stamp <= latest:
            return None
        return (
            f'header.stamp: read {stamp * 1e-9:.6f} s, allowed is {earliest * 1e-9:.6f} to '
            f'{latest * 1e-9:.6f} s'
        )

    def _measurement(self, message: DetectionArray) -> AgentMeasurement | None:
        name = message.robot

        def drop(reason: str, text: str, number: int = 1) -> None:
            self._node.drop(reason, f'{name}/detections.{text}', number)

        try:
            return measurement_from_ros(message, self._sensors[name], drop)
        except ValueError as error:
            drop('bad detections', f'pose.{error}')
            return None

    def _receive(self, pending: PendingBatch, message: DetectionArray) -> None:
        measurement = self._measurement(message)
        if measurement is None:
            pending.failed.add(message.robot)
        else:
            pending.measurements[message.robot] = measurement
            member = next(item for item in pending.members if item.robot == message.robot)
            member.pose = message.pose.pose

    def _late(self, name: str, message: DetectionArray) -> PendingBatch | None:
        measurement = self._measurement(message)
        if measurement is None:
            return None
        if message.batch_id:
            self._node.warn_throttled(
                'late',
                f'{name}/detections: late detections for batch {message.batch_id}: processed as a '
                'separate batch',
            )
        return PendingBatch(
            int(message.batch_id),
            int(message.step),
            stamp_from_ros(message.header.stamp),
            [BatchMember(robot=name, measurement=message.measurement, pose=message.pose.pose)],
            {name: measurement},
        )
