"""Facts of the messages of a search of buildings."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from maasi_sim.run.facts import Fact, Said, Shown
from maasi_sim.run.topics import finite_numbers, place, point


@dataclass(frozen=True)
class CuboidsDecided(Fact):
    """A `CuboidDecision`."""

    message: Any


_ACTIVITIES = ('searching', 'returning', 'recharging')  # of a `CuboidDecision`


def _decision(facts: Any, _: str, message: Any) -> Iterator[Fact]:
    robot, time = message.robot, facts.time(message)
    if int(message.activity) >= len(_ACTIVITIES):
        raise ValueError(f'activity: read {message.activity}, allowed are 0 to 2')
    activity = _ACTIVITIES[int(message.activity)]
    target = np.array(place('target', message.target))
    finite_numbers('solve_time', float(message.solve_time))
    for shot in message.snapshots:
        numbers = float(shot.distance), float(shot.detection_probability)
        finite_numbers('snapshots', *numbers, *point(shot.position), *point(shot.direction))
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
    content = (activity, message.how, target, list(message.heard), planned, shots)
    yield Shown(time, 'cuboid', robot, (*content, bool(message.done)))


#: Parts of a scene, and readers of messages, which `MessageFacts` has in addition to its own.
PARTS = {('markers', 'cuboids'): 'cuboids'}
READERS = {'maasi_msgs/msg/CuboidDecision': (_decision, ())}
