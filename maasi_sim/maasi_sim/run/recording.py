"""The part of a recording that a replay needs: measurement batches and filter updates."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from maasi_sim.run.bag import Bag, BagError
from maasi_sim.run.topics import FOUND, UPDATE, within

FILTER = 'filter_node'


@dataclass
class Batch:
    """One recorded update of a filter, in a namespace: its inputs in their order, and its output.

    Members are robot, decision and measurement, the stamp seconds and nanoseconds. `late` is a
    measurement that arrived after its batch, or without a request.
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
    """Contents of a recording for a replay.

    `facts` are scenario, seed and parameters of each node; batches of several filters are in the
    order of steps and names. By namespace of the filter: found targets at the end, and the batch
    after which they were published.
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
        for topic, kind, _, data in bag.raw(topics):
            message = bag.decode(data, kind)
            # Duplicate index: a restarted driver; the filter used the first.
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
