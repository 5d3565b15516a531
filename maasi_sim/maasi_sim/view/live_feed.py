"""Takes the records of a run that goes on, and makes events of them in a thread of its own."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from typing import Any

# Items that wait at most; further ones are dropped, and that is said.
MOST_WAITING = 50_000
# Wait for more before the next look, so that the run has the processor [s].
_PERIOD = 0.05


class LiveFeed:
    """Hand items to a function in a thread of its own; `put` never waits.

    Parameters
    ----------
    take : callable
        Takes an item.
    most : int
        Items that wait at most.
    """

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
