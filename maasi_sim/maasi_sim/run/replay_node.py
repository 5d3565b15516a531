"""Replaces planner and drivers for the filter node, from a recording."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.serialization import deserialize_message
from rclpy.signals import SignalHandlerOptions

from maasi_filter.ros.qos import LATCHED_ALL, RELIABLE
from maasi_msgs.msg import (
    BatchMember,
    DetectionArray,
    FilterUpdate,
    FoundTarget,
    FoundTargetArray,
    LockstepDone,
    MeasurementBatch,
)
from maasi_sim.run.recording import FILTER, Batch
from maasi_sim.run.topics import BATCH, FOUND, UPDATE, within


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
        if not batch.late:
            self._publish_batch(batch)
        for (robot, _, _), data in zip(batch.members, batch.detections):
            self._detections[robot].publish(deserialize_message(data, DetectionArray))

    def _publish_batch(self, batch: Batch) -> None:
        message = MeasurementBatch(id=batch.id, step=batch.step)
        message.stamp.sec, message.stamp.nanosec = batch.stamp
        message.members = [
            BatchMember(robot=robot, decision=decision, measurement=measurement)
            for robot, decision, measurement in batch.members
        ]
        self._batches[batch.namespace].publish(message)

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
