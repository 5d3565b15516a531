"""Facts of the messages of a search of buildings."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from maasi_sim.run.facts import Fact, Said, Shown
from maasi_sim.run.topics import point


@dataclass(frozen=True)
class CuboidsDecided(Fact):
    """A `CuboidDecision`."""

    message: Any


_ACTIVITIES = ('searching', 'returning', 'recharging')  # of a `CuboidDecision`


def _decision(facts: Any, _: str, message: Any) -> Iterator[Fact]:
    robot, time = message.robot, facts.time(message)
    activity = _ACTIVITIES[min(int(message.activity), len(_ACTIVITIES) - 1)]
    yield CuboidsDecided(time, message)
    shots = []
    for shot in message.snapshots:
        chance = round(float(shot.detection_probability), 3)
        shots.append((int(shot.cuboid), np.array(point(shot.position)), chance))
        yield Said(time, robot, 'found', f'snapshot of cuboid {shot.cuboid}')
    if facts.notes.setdefault(('activity', robot), activity) != activity:
        facts.notes['activity', robot] = activity
        yield Said(time, robot, 'team', activity)
    planned = [int(item) for item in message.planned]
    if facts.notes.get(('planned', robot), []) != planned:
        facts.notes['planned', robot] = planned
        words = ', '.join(map(str, planned)) or 'none'
        yield Said(time, robot, 'decision', f'cuboids that it plans to visit: {words}')
    target, heard = np.array(point(message.target)), list(message.heard)
    content = (activity, message.how, target, heard, planned, shots, bool(message.done))
    yield Shown(time, 'cuboid', robot, content)


#: Parts of a scene, and readers of messages, which `MessageFacts` has in addition to its own.
PARTS = {('markers', 'cuboids'): 'cuboids'}
READERS = {'maasi_msgs/msg/CuboidDecision': (_decision, ())}
