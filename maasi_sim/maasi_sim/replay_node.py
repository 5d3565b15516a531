"""Plays planner and drivers towards the filter node, from a recording."""

from __future__ import annotations

import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from rclpy.signals import SignalHandlerOptions

from maasi_msgs.msg import (
    BatchMember,
    DetectionArray,
    FilterUpdate,
    FoundTarget,
    FoundTargetArray,
    LockstepDone,
    MeasurementBatch,
)
from maasi_sim.observer import BATCH, FOUND, UPDATE
from maasi_sim.replay import FILTER, Batch

_ALL = QoSProfile(history=HistoryPolicy.KEEP_ALL, depth=1, reliability=ReliabilityPolicy.RELIABLE)
_LATCHED = QoSProfile(
    depth=100,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)


class ReplayNode:
    """
    The other end of the filter node.

    Publishes
    ---------
    `measurement_batch` (maasi_msgs/MeasurementBatch),
    `<robot>/detections` (maasi_msgs/DetectionArray)

    Subscribes
    ----------
    `filter_update` (maasi_msgs/FilterUpdate), `found_targets` (maasi_msgs/FoundTargetArray),
    `lockstep/ready` (maasi_msgs/LockstepDone)

    Parameters
    ----------
    domain : int
        ROS domain.
    robots : list of str
        Names.
    """

    def __init__(self, domain: int, robots: list[str]) -> None:
        self.context = Context()
        rclpy.init(
            context=self.context,
            domain_id=domain,
            signal_handler_options=SignalHandlerOptions.NO,
        )
        self.node = Node('replay', context=self.context, use_global_arguments=False)
        self.updates: list[FilterUpdate] = []
        self.found: list[FoundTarget] = []
        self.found_batch = 0
        self.changed_batch = 0
        self._announced = False
        self._batch = self.node.create_publisher(MeasurementBatch, BATCH, _ALL)
        self._detections = {
            name: self.node.create_publisher(DetectionArray, f'/{name}/detections', _ALL)
            for name in robots
        }
        self.node.create_subscription(FilterUpdate, UPDATE, self._on_update, _ALL)
        self.node.create_subscription(FoundTargetArray, FOUND, self._on_found, _LATCHED)
        self.node.create_subscription(LockstepDone, '/lockstep/ready', self._on_ready, _LATCHED)
        self._executor = SingleThreadedExecutor(context=self.context)
        self._executor.add_node(self.node)

    @property
    def ready(self) -> bool:
        """Whether the filter is, and hears all that will be published."""
        publishers = [self._batch, *self._detections.values()]
        return self._announced and all(item.get_subscription_count() for item in publishers)

    def spin(self, timeout: float = 0.05) -> None:
        """Take what comes within a time [s]."""
        self._executor.spin_once(timeout_sec=timeout)

    def publish(self, batch: Batch) -> None:
        """Publish a batch with the measurements that the filter processed then."""
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
        self._batch.publish(message)

    def _on_update(self, message: FilterUpdate) -> None:
        self.updates.append(message)
        if message.newly_found:
            self.changed_batch = message.batch_id

    def _on_found(self, message: FoundTargetArray) -> None:
        self.found = list(message.targets)
        self.found_batch = message.batch_id

    def _on_ready(self, message: LockstepDone) -> None:
        self._announced = self._announced or message.node == FILTER

    def close(self) -> None:
        """Leave the graph."""
        self._executor.shutdown()
        self.node.destroy_node()
        rclpy.try_shutdown(context=self.context)
