"""Replay recorded measurements to the filter node and compare the found targets."""

import contextlib
import os
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from rclpy.client import Client
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.serialization import deserialize_message
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future

from maasi_filter.ros.qos import LATCHED_ALL, RELIABLE, UPDATES
from maasi_filter.ros.report_client import KINDS, request_of
from maasi_filter.wording import counted
from maasi_msgs.msg import (
    DetectionArray,
    FilterUpdate,
    FoundTargetArray,
    LockstepDone,
    MeasurementBatch,
    Report,
)
from maasi_sim.run.bag import Bag, BagError
from maasi_sim.run.domain import Domain
from maasi_sim.run.ending import Interruption
from maasi_sim.run.node_plan import NodePlan
from maasi_sim.run.processes import NodeProcess, stop
from maasi_sim.run.run_folder import make_folder
from maasi_sim.run.topics import BATCH, FOUND, REPORTS, UPDATE, within

FILTER = 'filter_node'
EQUAL, DIFFERENT, FAILED, INTERRUPTED = 0, 1, 3, 130
# Timeouts of an update, and of the node's start, which may compile [s].
_PATIENCE = 60.0
_START_PATIENCE = 180.0
# Without clock, lockstep, batch timeout, loading or saving.
REPLAYED = {
    'use_sim_time': False,
    'lockstep': False,
    'batch_timeout': 1e6,
    'save_file': '',
    'save_batches': False,
    'particles_rate': 0.0,
    'markers_rate': 0.0,
}


@dataclass
class Batch:
    """A recorded filter update and its measurements; late: processed after their batch."""

    update: FilterUpdate
    detections: list[bytes]
    namespace: str
    late: bool
    #: Statements of persons that the filter used before it.
    reports: list[Report] = field(default_factory=list)


@dataclass
class Recording:
    """Contents of a recording for a replay."""

    facts: dict[str, Any]  #: scenario, seed and parameters of each node
    #: Batches of all filters, by step and name.
    batches: list[Batch] = field(default_factory=list)
    #: Found targets at the end, by namespace of the filter.
    found: dict[str, FoundTargetArray] = field(default_factory=dict)


def read_recording(path: Path) -> Recording:
    """Return the contents of a recording for a replay."""
    with Bag(path) as bag:
        recording = Recording(bag.scenario())
        team = recording.facts.get('namespace', '')
        for name in recording.facts.get('nodes', {}):
            namespace, _, node = name.strip('/').rpartition('/')
            if node == FILTER:
                recording.found[namespace] = FoundTargetArray()
        if not recording.found:
            raise BagError(f'{path}: contains no parameters of {FILTER}')
        robots = recording.facts['scenario']['robots']
        topics = {within(team, f'/{name}/detections'): name for name in robots}
        detections: dict[tuple[str, int], bytes] = {}
        for topic, _, _, data in bag.raw(topics):
            index = deserialize_message(data, DetectionArray).measurement
            # A restarted driver repeats an index; the filter used the first one.
            detections.setdefault((topics[topic], index), data)
        for namespace in list(recording.found):
            last = told = 0
            reports = _reports_of(bag, within(team, within(namespace, REPORTS)))
            for _, _, _, data in bag.raw([within(team, within(namespace, UPDATE))]):
                update = deserialize_message(data, FilterUpdate)
                used = []
                for member in update.members:
                    robot, index = member.robot, member.measurement
                    if (robot, index) not in detections:
                        raise BagError(
                            f'{path}: measurement {index} of {robot} is not in the recording'
                        )
                    used.append(detections[robot, index])
                late = update.batch_id <= last
                last = max(last, update.batch_id)
                new = [item for item in reports if told < item.id <= update.reports]
                told = max(told, update.reports)
                recording.batches.append(Batch(update, used, namespace, late, new))
            for _, _, _, data in bag.raw([within(team, within(namespace, FOUND))]):
                recording.found[namespace] = deserialize_message(data, FoundTargetArray)
    if len(recording.found) > 1:
        recording.batches.sort(key=lambda batch: (batch.update.step, batch.namespace))
    return recording


def _reports_of(bag: Bag, topic: str) -> list[Report]:
    found: dict[int, Report] = {}
    for _, _, _, data in bag.raw([topic]):
        report = deserialize_message(data, Report)
        if report.kind == Report.CLEARED:
            found.clear()
        else:
            # A restarted filter repeats those that it knows.
            found.setdefault(report.id, report)
    return list(found.values())


class ReplayNode:
    """The peer of one or several filter nodes; an empty namespace is the root.

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
            context=self.context, domain_id=domain, signal_handler_options=SignalHandlerOptions.NO
        )
        self.node = Node('replay', context=self.context, use_global_arguments=False)
        self.updates: list[FilterUpdate] = []
        self._clients: dict[str, Client] = {}
        self.found = {name: FoundTargetArray() for name in namespaces}
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
                FilterUpdate, within(name, UPDATE), self.updates.append, UPDATES
            )
            keep = partial(self.found.__setitem__, name)
            self.node.create_subscription(FoundTargetArray, within(name, FOUND), keep, LATCHED_ALL)
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
        """Publish a batch with the measurements that the filter processed."""
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

    def state(self, namespace: str, report: Report) -> Future:
        """Make the statement of a person to a filter again; return its answer to come."""
        service, request = request_of(report)
        name = within(namespace, f'/search/{service}')
        if name not in self._clients:
            self._clients[name] = self.node.create_client(KINDS[service], name)
        client = self._clients[name]
        client.wait_for_service(_PATIENCE)
        return client.call_async(request)

    def _on_ready(self, message: LockstepDone) -> None:
        self._awaited.discard(message.node)

    def close(self) -> None:
        """Destroy the node."""
        self._executor.shutdown()
        self.node.destroy_node()
        rclpy.try_shutdown(context=self.context)


class _Stopped(Exception):
    """The replay cannot continue: exit code and message."""


def differences(recorded: list[Any], found: list[Any]) -> list[str]:
    """Return the differences of two lists of found targets, as text; empty if bit-identical."""
    lines = []
    if len(recorded) != len(found):
        lines.append(
            f'the recording has {counted(len(recorded), "found target")}, the replay {len(found)}'
        )
    for before, now in zip(recorded, found):
        for key in before.get_fields_and_field_types():
            old, new = getattr(before, key), getattr(now, key)
            if not np.array_equal(old, new):
                lines.append(f'target {before.id}: {key} was {old}, is {new}')
    return lines


def replay(path: Path, out: Path | None, domain_id: int | None, interruption: Interruption) -> int:
    """Replay a recording, print whether the found targets are equal, and return the exit code."""
    recording = read_recording(path)
    folder = make_folder(out, '_replay')
    with Domain(domain_id) as domain, contextlib.ExitStack() as ends:
        os.environ.update(domain.environment())
        processes = []
        for name in recording.found:
            node_facts = recording.facts['nodes'][within(name, f'/{FILTER}')]
            parameters = {**node_facts['parameters'], **REPLAYED}
            kind = node_facts['package'], node_facts['executable']
            processes.append(NodePlan(*kind, FILTER, name, parameters).process(folder))
        ends.callback(stop, processes)
        for process in processes:
            process.start()
        robots = sorted(recording.facts['scenario']['robots'])
        node = ReplayNode(domain.number, robots, list(recording.found))
        ends.callback(node.close)
        try:
            return _feed(node, recording, processes, interruption)
        except _Stopped as stopped:
            code, *words = stopped.args
            print(*words, end='', file=sys.stderr)
            return int(code)


def _feed(
    node: ReplayNode, recording: Recording, processes: list[NodeProcess], interruption: Interruption
) -> int:
    first_difference = None

    def fail(text: str, process: NodeProcess) -> None:
        words = f'error: {text}\n--- {process.log}\n{process.last_words()}\n'
        raise _Stopped(FAILED, words)

    def wait_for(condition: Callable[[], bool], what: str, patience: float = _PATIENCE) -> None:
        deadline = time.monotonic() + patience
        while not condition():
            if interruption:
                raise _Stopped(INTERRUPTED)
            for process in processes:
                if not process.is_alive():
                    fail(f'{process.name} {process.how_it_ended()}', process)
            if time.monotonic() > deadline:
                fail(f'{what} for {patience:g} s', processes[0])
            node.spin()

    wait_for(lambda: node.ready, 'the filter was not ready', _START_PATIENCE)
    for number, batch in enumerate(recording.batches, start=1):
        for report in batch.reports:
            answer = node.state(batch.namespace, report)
            wait_for(answer.done, f'no answer to statement {report.id}')
        node.publish(batch)
        wait_for(
            lambda number=number: len(node.updates) >= number,  # type: ignore[misc]
            f'the filter sent no update for batch {batch.update.batch_id}',
        )
        # Robots without a request have no measurement.
        batch.update.missing = node.updates[-1].missing
        if first_difference is None and node.updates[-1] != batch.update:
            first_difference = batch.update.batch_id
    found = recording.found
    wait_for(
        lambda: all(node.found[key].batch_id >= item.batch_id for key, item in found.items()),
        'the filter published no found targets',
    )
    lines = []
    for namespace, before in found.items():
        texts = differences(before.targets, node.found[namespace].targets)
        lines += [within(namespace, f' {text}').strip() for text in texts]
    for line in lines:
        print(line)
    if first_difference is not None:
        print(f'the first difference is in the update for batch {first_difference}')
    number = sum(len(item.targets) for item in found.values())
    count = len(recording.batches)
    batches = f'{count} batch' if count == 1 else f'{count} batches'
    if lines:
        print(f'{batches} replayed: the found targets differ')
        return DIFFERENT
    print(f'{batches} replayed: {counted(number, "found target")}, bit-identical')
    return EQUAL
