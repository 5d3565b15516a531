"""A recording as a replay needs it, and the node that plays planner and drivers from it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.serialization import deserialize_message
from rclpy.signals import SignalHandlerOptions

from maasi_filter.ros.qos import LATCHED_ALL, RELIABLE
from maasi_msgs.msg import (
    DetectionArray,
    FilterUpdate,
    FoundTarget,
    FoundTargetArray,
    LockstepDone,
    MeasurementBatch,
)
from maasi_sim.run.bag import Bag, BagError
from maasi_sim.run.topics import BATCH, FOUND, UPDATE, within

FILTER = 'filter_node'


@dataclass
class Batch:
    """One recorded update of a filter, in a namespace, and its serialised measurements in order.

    `late` is a measurement that arrived after its batch, or without a request.
    """

    update: FilterUpdate
    detections: list[bytes]
    namespace: str
    late: bool


@dataclass
class Recording:
    """Contents of a recording for a replay.

    `facts` are scenario, seed and parameters of each node; batches of several filters are in the
    order of steps and names. By namespace of the filter: found targets at the end, and the batch
    after which they were published.
    """

    facts: dict[str, Any]
    batches: list[Batch] = field(default_factory=list)
    found: dict[str, list[FoundTarget]] = field(default_factory=dict)
    found_batch: dict[str, int] = field(default_factory=dict)

    @property
    def namespaces(self) -> list[str]:
        """Namespaces of the filters."""
        return list(self.found)


def read_recording(path: Path) -> Recording:
    """Return the contents of a recording for a replay."""
    with Bag(path) as bag:
        recording = Recording(bag.scenario())
        team = recording.facts.get('namespace', '')
        for name in recording.facts.get('nodes', {}):
            namespace, _, node = name.strip('/').rpartition('/')
            if node == FILTER:
                recording.found[namespace] = []
        if not recording.found:
            raise BagError(f'{path}: holds no parameters of {FILTER}')
        robots = recording.facts['scenario']['robots']
        topics = {within(team, f'/{name}/detections'): name for name in robots}
        detections: dict[tuple[str, int], bytes] = {}
        for topic, _, _, data in bag.raw(topics):
            index = deserialize_message(data, DetectionArray).measurement
            # Duplicate index: a restarted driver; the filter used the first.
            detections.setdefault((topics[topic], index), data)
        for namespace in recording.namespaces:
            last = 0
            for _, _, _, data in bag.raw([within(team, within(namespace, UPDATE))]):
                update = deserialize_message(data, FilterUpdate)
                used = [
                    _find(detections, member.robot, member.measurement, path)
                    for member in update.members
                ]
                late = update.batch_id <= last
                last = max(last, update.batch_id)
                recording.batches.append(Batch(update, used, namespace, late))
            for _, _, _, data in bag.raw([within(team, within(namespace, FOUND))]):
                array = deserialize_message(data, FoundTargetArray)
                recording.found[namespace] = list(array.targets)
                recording.found_batch[namespace] = array.batch_id
    if len(recording.found) > 1:
        recording.batches.sort(key=lambda batch: (batch.update.step, batch.namespace))
    return recording


def _find(
    detections: dict[tuple[str, int], bytes], robot: str, measurement: int, path: Path
) -> bytes:
    if (robot, measurement) not in detections:
        raise BagError(f'{path}: measurement {measurement} of {robot} is not in the recording')
    return detections[robot, measurement]


class ReplayNode:
    """The peer of one or several filter nodes, in namespaces of which an empty one is the root.

    Publishes
    ---------
    `measurement_batch` (maasi_msgs/MeasurementBatch),
    `<robot>/detections` (maasi_msgs/DetectionArray)

    Subscribes
    ----------
    `filter_update` (maasi_msgs/FilterUpdate), `found_targets` (maasi_msgs/FoundTargetArray),
    `lockstep/ready` (maasi_msgs/LockstepDone)
    """

    def __init__(
        self, domain: int, robots: Sequence[str], namespaces: Sequence[str] = ('',)
    ) -> None:
        self.context = Context()
        rclpy.init(
            context=self.context,
            domain_id=domain,
            signal_handler_options=SignalHandlerOptions.NO,
        )
        self.node = Node('replay', context=self.context, use_global_arguments=False)
        self.updates: list[FilterUpdate] = []
        self.found: dict[str, list[FoundTarget]] = {name: [] for name in namespaces}
        self.found_batch = dict.fromkeys(namespaces, 0)
        self._awaited = {within(name, f'/{FILTER}') for name in namespaces}
        self._batches = {
            name: self.node.create_publisher(MeasurementBatch, within(name, BATCH), RELIABLE)
            for name in namespaces
        }
        self._detections = {
            name: self.node.create_publisher(DetectionArray, f'/{name}/detections', RELIABLE)
            for name in robots
        }
        for name in namespaces:
            self.node.create_subscription(
                FilterUpdate, within(name, UPDATE), self.updates.append, RELIABLE
            )
            self.node.create_subscription(
                FoundTargetArray, within(name, FOUND), partial(self._on_found, name), LATCHED_ALL
            )
        self.node.create_subscription(LockstepDone, '/lockstep/ready', self._on_ready, LATCHED_ALL)
        self._executor = SingleThreadedExecutor(context=self.context)
        self._executor.add_node(self.node)

    @property
    def ready(self) -> bool:
        """Whether the filters are ready and subscribe to all topics that will be published."""
        publishers = [*self._batches.values(), *self._detections.values()]
        return not self._awaited and all(item.get_subscription_count() for item in publishers)

    def spin(self, timeout: float = 0.05) -> None:
        """Process the messages that arrive within a time [s]."""
        self._executor.spin_once(timeout_sec=timeout)

    def publish(self, batch: Batch) -> None:
        """Publish a batch with the measurements that the filter had processed."""
        update = batch.update
        if not batch.late:
            self._batches[batch.namespace].publish(
                MeasurementBatch(
                    id=update.batch_id,
                    step=update.step,
                    stamp=update.header.stamp,
                    members=update.members,
                )
            )
        for member, data in zip(update.members, batch.detections):
            self._detections[member.robot].publish(deserialize_message(data, DetectionArray))

    def _on_found(self, namespace: str, message: FoundTargetArray) -> None:
        self.found[namespace] = list(message.targets)
        self.found_batch[namespace] = message.batch_id

    def _on_ready(self, message: LockstepDone) -> None:
        self._awaited.discard(message.node)

    def close(self) -> None:
        """Leave the graph."""
        self._executor.shutdown()
        self.node.destroy_node()
        rclpy.try_shutdown(context=self.context)
