"""Ctrl-C and termination as a condition that a run polls, so that nothing is cut short."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Iterator
from types import FrameType


class Interruption:
    """Handles SIGINT, SIGTERM and SIGHUP; true once one of them has arrived."""

    def __init__(self) -> None:
        self.count = 0
        self._at_once = False
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, self._note)

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.count += 1
        if self._at_once:
            raise KeyboardInterrupt

    @contextlib.contextmanager
    def at_once(self) -> Iterator[None]:
        """Raise KeyboardInterrupt inside the context: for what takes long and needs no clean-up."""
        self._at_once = True
        try:
            yield
        finally:
            self._at_once = False

    def __bool__(self) -> bool:
        """Whether a signal has arrived."""
        return self.count > 0
