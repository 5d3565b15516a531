"""The event log of a run: JSON lines, of which the first is the scene (docs/view.md)."""

import base64
import gzip
import json
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from maasi_filter.arrays import FloatArray

Event = list[Any]
Scene = dict[str, Any]
Listener = Callable[[Event], None]

LARGEST = 4_500_000  # largest packed log: keeps a replay page below 5 MB
# Shortest time between states of a robot, and between other events that may be thinned [s].
STATE_PERIOD = 0.1
_THINNED = ('robot', 'seen', 'filter', 'map', 'way', 'score', 'cuboid', 'picture')


# Letters for shares from 0 to 1 in equal steps, and for an unknown share.
_LETTERS = np.frombuffer(b'0123456789abcdefghijklmnopqrstuvwxyz-', np.uint8)
_SHARES = np.full(128, -1.0)
_SHARES[_LETTERS[:-1]] = np.linspace(0.0, 1.0, len(_LETTERS) - 1)


def shades(values: ArrayLike) -> str:
    """Return a letter for each share; a share below 0 or nan is unknown."""
    levels = np.rint((len(_LETTERS) - 2) * np.nan_to_num(np.asarray(values, float), nan=-1.0))
    chosen = np.clip(levels, -1, len(_LETTERS) - 2).astype(int)
    return _LETTERS[chosen].tobytes().decode()


def shares(text: str) -> FloatArray:
    """Return the shares of `shades`, (n,); -1 if unknown."""
    return _SHARES[np.frombuffer(text.encode(), np.uint8)]


def line(event: Event | Scene) -> str:
    """Return an event as a line of JSON, which may not contain nan or infinity."""
    return json.dumps(event, separators=(',', ':'), allow_nan=False)


@dataclass
class EventLog:
    """Scene and events of a run, by arrival."""

    scene: Scene = field(default_factory=dict)
    events: list[Event] = field(default_factory=list)

    @property
    def duration(self) -> float:
        """Time of the last event [s]."""
        return max((event[0] for event in self.events), default=0.0)

    def packed(self, largest: int = LARGEST) -> str:
        """Return the log compressed (gzip) in base64, thinned to a size.

        Pictures may use half of it. `thinned` in its scene gives the periods of the other
        thinned events: states, then gradual changes. Decisions, found targets and log lines
        stay.
        """
        period = 0.0
        events = fewer_pictures(self.events, largest // 2)
        log = EventLog(self.scene, events)
        while True:
            text = '\n'.join([line(log.scene), *map(line, log.events)])
            packed = base64.b64encode(gzip.compress(text.encode(), 7, mtime=0)).decode()
            # At this period nothing more is thinned.
            if len(packed) <= largest or period > 1e5:
                return packed
            period = max(2.0 * period, 2.0 * STATE_PERIOD)
            log = EventLog({**self.scene, 'thinned': period}, thin(events, period))


def fewer_pictures(events: list[Event], room: int) -> list[Event]:
    """Return events with as many pictures as fit into `room` [bytes], evenly for each robot."""
    pictures = sorted((item for item in events if item[1] == 'picture'), key=lambda item: item[2])
    # Packed they are slightly larger.
    stride = math.ceil(1.05 * sum(len(item[3]) for item in pictures) / room) or 1
    dropped = {id(item) for item in pictures} - {id(item) for item in pictures[::stride]}
    return [item for item in events if id(item) not in dropped]


class Thinning:
    """Thins events so that those of the same kind and owner are at least a period apart.

    Other kinds, status and reason changes, and detections that are not empty stay.
    """

    def __init__(self, period: float) -> None:
        self._period = period
        self._last: dict[tuple[str, str], Event] = {}

    def keeps(self, event: Event) -> bool:
        """Return whether to keep an event."""
        time, kind, owner = event[:3]
        seen = (kind == 'seen' and event[4]) or (kind == 'cuboid' and event[8])
        if kind not in _THINNED or seen:
            return True
        last = self._last.get((kind, owner))
        # A new status or reason of a robot, or a new plan or activity at buildings.
        parts = {'robot': (5, 6), 'cuboid': (3, 7)}.get(kind, ())
        news = last is not None and any(event[part] != last[part] for part in parts)
        if last is None or news or time - last[0] >= self._period - 1e-6:
            self._last[kind, owner] = event
            return True
        return False


def thin(events: Iterable[Event], period: float) -> list[Event]:
    """Return events with at least a period [s] between gradual changes, and the last of each."""
    thinning = Thinning(period)
    every = list(events)
    last = {(event[1], event[2]): index for index, event in enumerate(every)}
    return [
        event
        for index, event in enumerate(every)
        if thinning.keeps(event) or last[event[1], event[2]] == index
    ]
