"""The event log of a recording: one of ours, or one that `ros2 bag record -a` made."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

from maasi_sim.run.bag import Bag, BagError
from maasi_sim.run.topics import STEP
from maasi_sim.view.event_log import Event, EventLog, Scene
from maasi_sim.view.event_maker import EventMaker
from maasi_sim.view.messages import MessageEvents, is_shown
from maasi_sim.view.scene import empty_scene, scene_of_facts

_MARKERS = 'visualization_msgs/msg/MarkerArray'


# Messages between two words on the progress.
_PROGRESS = 1000


def read_events(path: Path, progress: Callable[[float], None] | None = None) -> EventLog:
    """Return the event log of a recording, or of the run whose folder holds one.

    Parameters
    ----------
    path : Path
        Recording or folder.
    progress : callable, optional
        Called now and then with the share that is read.

    Raises
    ------
    BagError
        If it cannot be read, or shows no search.
    """
    with Bag(path) as bag:
        shown = {topic: kind for topic, kind in bag.types.items() if is_shown(topic, kind)}
        if not any(kind.startswith('maasi_msgs/') for kind in shown.values()):
            raise BagError(f'{path}: holds no topic of a search')
        scene = _scene(bag)
        events: list[Event] = []
        maker = EventMaker(scene, events.append)
        takes = MessageEvents(maker, _begin(bag, shown))
        # Markers hold what a scenario says better.
        known = 'bounds' in scene
        topics = [topic for topic, kind in shown.items() if not (known and kind == _MARKERS)]
        counts = bag.counts
        total = sum(counts[topic] for topic in topics)
        for index, item in enumerate(bag.messages(topics)):
            if progress is not None and index % _PROGRESS == 0:
                progress(index / total)
            takes.take(item.topic, item.type, item.message)
        maker.end()
    # Parts that became known later belong to the scene of a replay.
    return EventLog(maker.scene, [event for event in events if event[1] != 'scene'])


def _scene(bag: Bag) -> Scene:
    try:
        return scene_of_facts(bag.scenario())
    except (BagError, ValueError, KeyError):
        return empty_scene(bag.path.name)


def _begin(bag: Bag, shown: dict[str, str]) -> float | None:
    """Return the time of the first step, where the recording has steps [s]."""
    steps = [topic for topic in shown if topic.endswith(STEP)]
    for _, _, _, data in bag.raw(steps):
        # Header of the serialisation, step, stamp.
        sec, nanosec = struct.unpack_from('<iI', data, 12)
        return float(sec) + 1e-9 * float(nanosec)
    return None
