"""Between a live run and its browsers: neither waits for the other."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from typing import Any

from maasi_sim.view.event_log import STATE_PERIOD, Event, Scene, line, thin

# Events that are kept; beyond them those that change gradually are thinned.
MOST_EVENTS = 200_000
# Events in one message to a browser.
_MOST_AT_ONCE = 2000
# Items that wait at most; further ones are dropped, and that is said.
MOST_WAITING = 50_000
# Wait for more before the next look, so that the run has the processor [s].
_PERIOD = 0.05


class Hub:
    """Keeps the events of a run; nothing that puts an event waits for a browser.

    With more than `most` events those that change gradually are thinned, and browsers start over.
    """

    def __init__(self, scene: Scene, most: int = MOST_EVENTS) -> None:
        self._scene = dict(scene)
        self._most = most
        self._events: list[Event] = []
        self._period = STATE_PERIOD
        self._generation = 0
        self._closed = False
        self._changed = threading.Condition()

    def put(self, event: Event) -> None:
        """Add an event."""
        with self._changed:
            if event[1] == 'scene':
                self._scene.update(event[3])
            self._events.append(event)
            if len(self._events) > self._most:
                self._thin()
            self._changed.notify_all()

    def restart(self, scene: Scene) -> None:
        """Forget all events: another run begins."""
        with self._changed:
            self._scene = dict(scene)
            self._events.clear()
            self._generation += 1
            self._changed.notify_all()

    def close(self) -> None:
        """Say that no event follows."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    @property
    def size(self) -> int:
        """Number of events kept."""
        return len(self._events)

    def next(
        self, generation: int, position: int, patience: float
    ) -> tuple[str, tuple[int, int], bool]:
        """Return what follows a position, as Server-Sent Events.

        And generation and position of the next portion, and whether nothing follows. A browser
        begins with generation -1; where another one has begun it gets the scene, and starts over.
        Nothing new within the patience [s] is a comment.
        """
        with self._changed:
            self._changed.wait_for(
                lambda: (
                    self._closed or generation != self._generation or position < len(self._events)
                ),
                patience,
            )
            text = ''
            if generation != self._generation:
                text, position = f'event: scene\ndata: {line(self._scene)}\n\n', 0
            events = self._events[position : position + _MOST_AT_ONCE]
            position += len(events)
            closed = self._closed and position == len(self._events)
            generation = self._generation
        # Outside of the lock: a large portion takes a while.
        if events:
            text += f'event: events\ndata: [{",".join(map(line, events))}]\n\n'
        if closed:
            text += 'event: end\ndata:\n\n'
        return text or ': \n\n', (generation, position), closed

    def _thin(self) -> None:
        """Halve what changes gradually, until a tenth of the room is free."""
        while len(self._events) > 0.9 * self._most and self._period < 1e5:
            self._period *= 2.0
            self._events = thin(self._events, self._period)
        # Where nothing can be thinned, the oldest go.
        del self._events[: max(0, len(self._events) - self._most)]
        self._scene['thinned'] = self._period
        self._generation += 1


class LiveFeed:
    """Hand items to a function in a thread of its own; `put` never waits."""

    def __init__(self, take: Callable[[Any], object], most: int = MOST_WAITING) -> None:
        self._take = take
        self._most = most
        self._waiting: deque[Any] = deque()
        self._ended = threading.Event()
        self.dropped = 0
        self.refused = 0
        self._thread = threading.Thread(target=self._work, name='view feed', daemon=True)
        self._thread.start()

    def put(self, item: Any) -> None:
        """Take an item; where too many wait it is dropped."""
        if len(self._waiting) < self._most:
            self._waiting.append(item)
        else:
            self.dropped += 1

    def close(self, patience: float = 5.0) -> None:
        """Take what waits, and end."""
        self._ended.set()
        self._thread.join(patience)

    def _work(self) -> None:
        while True:
            ended = self._ended.wait(_PERIOD)
            while self._waiting:
                try:
                    self._take(self._waiting.popleft())
                except (ValueError, ArithmeticError, LookupError, AttributeError, TypeError):
                    # A message that cannot be shown must not end the view.
                    self.refused += 1
            if ended:
                return
