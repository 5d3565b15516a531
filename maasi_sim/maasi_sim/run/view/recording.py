"""The page events of a recording, or of a search in one process."""

from collections.abc import Callable
from pathlib import Path

from maasi_sim.run.bag import Bag, BagError
from maasi_sim.run.log import RunLog
from maasi_sim.run.message_facts import MARKERS, STEP, MessageFacts, is_read
from maasi_sim.run.view.event_log import Event, EventLog, Scene
from maasi_sim.run.view.event_maker import EventMaker
from maasi_sim.run.view.scene import empty_scene, scene_of, scene_of_facts

_PROGRESS = 1000  # messages between two progress reports


def facts_for(
    scene: Scene, waits: bool, on_restart: Callable[[], object] | None = None
) -> MessageFacts:
    """Return the converter from messages to facts for a run with a scene."""
    dimension = len(scene.get('bounds') or (0, 0, 0))
    return MessageFacts(waits, scene.get('robots', {}).keys(), dimension, on_restart)


def read_events(path: Path, progress: Callable[[float], None] | None = None) -> EventLog:
    """Return the event log of a recording or run folder; `progress` receives the share read."""
    with Bag(path) as bag:
        shown = {topic: kind for topic, kind in bag.types.items() if is_read(topic, kind)}
        if not any(kind.startswith('maasi_msgs/') for kind in shown.values()):
            raise BagError(f'{path}: contains no topics of a search')
        try:
            scene = scene_of_facts(bag.scenario())
        except (BagError, ValueError, KeyError):
            scene = empty_scene(bag.path.name)
        events: list[Event] = []
        maker = EventMaker(scene, events.append)
        facts = facts_for(scene, STEP in {shown[topic] for topic in shown if bag.counts[topic]})
        # The scenario's values are better than markers.
        known = 'bounds' in scene
        topics = [topic for topic, kind in shown.items() if not (known and kind == MARKERS)]
        total = sum(bag.counts[topic] for topic in topics)
        for index, item in enumerate(bag.messages(topics)):
            if progress is not None and index % _PROGRESS == 0:
                progress(index / total)
            for fact in facts.of(item.topic, item.type, item.message):
                maker.add(fact)
        maker.end()
    # Parts that became known later belong to the scene of a replay.
    return EventLog(maker.scene, [event for event in events if event[1] != 'scene'])


def event_log(log: RunLog, name: str = 'search') -> EventLog:
    """Return the event log of a search."""
    events: list[Event] = []
    maker = EventMaker(scene_of(name, log.scenario, log.seed), events.append)
    for fact in log.facts:
        maker.add(fact)
    maker.end(log.end_reason)
    return EventLog(maker.scene, events)
