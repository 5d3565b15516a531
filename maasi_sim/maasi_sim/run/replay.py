"""Feed a recording's measurements to the filter node again, and compare what it finds."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from maasi_sim.run.bag import Bag, BagError
from maasi_sim.run.node_plan import NodePlan
from maasi_sim.run.observer import FOUND, UPDATE, within
from maasi_sim.run.processes import Domain, NodeProcess, find_executable, stop
from maasi_sim.run.run_folder import make_folder, write_text

FILTER = 'filter_node'
EQUAL, DIFFERENT, FAILED, INTERRUPTED = 0, 1, 3, 130
# Wall time that one update may take, and the start of the node, which may have to compile [s].
_PATIENCE = 60.0
_START_PATIENCE = 180.0
# There is no clock, no step and nobody late; nothing is loaded, and nothing saved.
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
    """One recorded update: what went in, in which order, and what came out.

    Attributes
    ----------
    id, step : int
        Of the batch.
    stamp : (int, int)
        Seconds and nanoseconds.
    members : list of (robot, decision, measurement)
        That were processed, in their order.
    detections : list of bytes
        Serialised DetectionArray of each member.
    update : dict
        What the filter published.
    late : bool
        Whether it is what one robot sent too late for its batch, or unasked.
    namespace : str
        Of the filter; empty for the root.
    """

    id: int
    step: int
    stamp: tuple[int, int]
    members: list[tuple[str, int, int]]
    detections: list[bytes]
    update: Any
    late: bool = False
    namespace: str = ''


@dataclass
class Recording:
    """What a replay takes from a recording.

    Attributes
    ----------
    facts : dict
        Scenario, seed and parameters of each node.
    batches : list of Batch
        In order; those of several filters in the order of steps and names.
    found : dict
        By the namespace of the filter: found targets at the end, a list of dict.
    found_batch : dict
        By the namespace: the batch after which they stood so.
    """

    facts: dict[str, Any]
    batches: list[Batch] = field(default_factory=list)
    found: dict[str, list[dict[str, Any]]] = field(default_factory=dict)
    found_batch: dict[str, int] = field(default_factory=dict)

    @property
    def namespaces(self) -> list[str]:
        """Namespaces of the filters."""
        return list(self.found)


def read_recording(path: Path) -> Recording:
    """Return what a replay needs of a recording.

    Raises
    ------
    BagError
        If it is none, or measurements that the filter processed are not in it.
    """
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
        for topic, kind, _, data in bag.raw(topics):
            message = bag.decode(data, kind)
            # An index comes again only where a driver was started again: the first was used.
            detections.setdefault((topics[topic], int(message.measurement)), data)
        for namespace in recording.namespaces:
            last = 0
            for item in bag.messages([within(team, within(namespace, UPDATE))]):
                batch = _batch(item.message, detections, path)
                batch.namespace = namespace
                batch.late = batch.id <= last
                last = max(last, batch.id)
                recording.batches.append(batch)
            for item in bag.messages([within(team, within(namespace, FOUND))]):
                recording.found[namespace] = [plain(target) for target in item.message.targets]
                recording.found_batch[namespace] = int(item.message.batch_id)
    if len(recording.found) > 1:
        recording.batches.sort(key=lambda batch: (batch.step, batch.namespace))
    return recording


def _batch(update: Any, detections: dict[tuple[str, int], bytes], path: Path) -> Batch:
    members = [
        (member.robot, int(member.decision), int(member.measurement)) for member in update.members
    ]
    missing = [
        key for key in ((name, index) for name, _, index in members) if key not in detections
    ]
    if missing:
        name, index = missing[0]
        raise BagError(f'{path}: measurement {index} of {name} is not in the recording')
    stamp = update.header.stamp
    return Batch(
        int(update.batch_id),
        int(update.step),
        (int(stamp.sec), int(stamp.nanosec)),
        members,
        [detections[name, index] for name, _, index in members],
        plain(update),
    )


def plain(message: Any) -> Any:
    """Return a message, of `rosbags` or of ROS, as plain values that can be compared."""
    fields = getattr(message, '__dataclass_fields__', None)
    names = [name for name in fields if name != '__msgtype__'] if fields else None
    if names is None and hasattr(message, 'get_fields_and_field_types'):
        names = list(message.get_fields_and_field_types())
    if names is not None:
        return {name: plain(getattr(message, name)) for name in names}
    if isinstance(message, str):
        return message
    if hasattr(message, 'tolist'):
        return message.tolist()
    if isinstance(message, (list, tuple)):
        return [plain(item) for item in message]
    return message


def differences(recorded: list[dict[str, Any]], found: list[dict[str, Any]]) -> list[str]:
    """Return in words how two lists of found targets differ; empty if they are equal to the bit."""
    lines = []
    if len(recorded) != len(found):
        lines.append(f'{len(recorded)} found targets were recorded, {len(found)} found now')
    for before, now in zip(recorded, found):
        for key, value in before.items():
            if now.get(key) != value:
                lines.append(f'target {before["id"]}: {key} was {value}, is {now.get(key)}')
    return lines


def replay(
    path: Path,
    out: Path | None,
    domain_id: int | None,
    interrupted: Callable[[], bool],
) -> int:
    """Replay a recording, say whether the filter finds the same, and return the exit code.

    Parameters
    ----------
    path : Path
        Recording, or folder of the run that holds it.
    out : Path, optional
        Folder for the node's log and parameters.
    domain_id : int, optional
        ROS domain; one of its own if not given.
    interrupted : callable
        Becomes true when the user wants it to end.

    Raises
    ------
    BagError
        If the recording cannot be replayed.
    """
    recording = read_recording(path)
    folder = make_folder(out, '_replay')
    with Domain(domain_id) as domain:
        os.environ.update(domain.environment())
        processes = [
            _process(recording.facts, namespace, folder) for namespace in recording.namespaces
        ]
        try:
            for process in processes:
                process.start()
            from maasi_sim.run.replay_node import ReplayNode

            robots = sorted(recording.facts['scenario']['robots'])
            node = ReplayNode(domain.number, robots, recording.namespaces)
            try:
                return _feed(node, recording, processes, interrupted)
            finally:
                node.close()
        finally:
            stop(processes)


def _process(facts: dict[str, Any], namespace: str, folder: Path) -> NodeProcess:
    recorded = facts['nodes'][within(namespace, f'/{FILTER}')]
    plan = NodePlan(
        recorded['package'],
        recorded['executable'],
        FILTER,
        namespace,
        {**recorded['parameters'], **REPLAYED},
    )
    parameters = folder / f'{plan.file_name}.yaml'
    write_text(parameters, plan.parameter_text())
    executable = find_executable(plan.package, plan.executable)
    log = folder / f'{plan.file_name}.log'
    return NodeProcess(plan.full_name, plan.command(executable, parameters), log)


def _feed(
    node: Any,
    recording: Recording,
    processes: list[NodeProcess],
    interrupted: Callable[[], bool],
) -> int:
    first_difference = None

    def wait_for(
        condition: Callable[[], bool], what: str, patience: float = _PATIENCE
    ) -> int | None:
        deadline = time.monotonic() + patience
        while not condition():
            if interrupted():
                return INTERRUPTED
            for process in processes:
                if not process.running:
                    return _failed(f'{process.name} {process.how_it_ended()}', process)
            if time.monotonic() > deadline:
                return _failed(f'{what} for {patience:g} s', processes[0])
            node.spin()
        return None

    code = wait_for(lambda: node.ready, 'the filter was not ready', _START_PATIENCE)
    if code is not None:
        return code
    for index, batch in enumerate(recording.batches):
        node.publish(batch)
        code = wait_for(
            lambda number=index + 1: len(node.updates) >= number,  # type: ignore[misc]
            f'the filter did not answer batch {batch.id}',
        )
        if code is not None:
            return code
        if first_difference is None and not _same(plain(node.updates[-1]), batch.update):
            first_difference = batch
    code = wait_for(
        lambda: all(node.found_batch[key] >= last for key, last in recording.found_batch.items()),
        'the filter published no found targets',
    )
    if code is not None:
        return code
    lines = []
    for namespace, found in recording.found.items():
        now = [plain(target) for target in node.found[namespace]]
        lines += [within(namespace, f' {line}').strip() for line in differences(found, now)]
    for line in lines:
        print(line)
    if first_difference is not None:
        print(f'the first update that differs is that of batch {first_difference.id}')
    number = sum(len(found) for found in recording.found.values())
    if lines:
        print(f'{len(recording.batches)} batches replayed: the found targets are NOT equal')
        return DIFFERENT
    print(f'{len(recording.batches)} batches replayed: {number} found targets, equal to the bit')
    return EQUAL


def _same(update: dict[str, Any], recorded: dict[str, Any]) -> bool:
    """Compare updates; who was missing then is not asked now."""
    return {**update, 'missing': []} == {**recorded, 'missing': []}


def _failed(text: str, process: NodeProcess) -> int:
    print(f'error: {text}\n--- {process.log}\n{process.last_words()}', file=sys.stderr)
    return FAILED
