"""Ctrl-C and termination as a condition that a run polls, so that nothing is cut short."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Iterator
from types import FrameType

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class Interruption:
    """Handles SIGINT, SIGTERM and SIGHUP; true once one of them has arrived."""

    def __init__(self) -> None:
        self.count = 0
        self._at_once: tuple[signal.Signals, ...] = ()
        for number in _SIGNALS:
            signal.signal(number, self._note)

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.count += 1
        if number in self._at_once:
            raise KeyboardInterrupt

    @contextlib.contextmanager
    def at_once(self, *signals: signal.Signals) -> Iterator[None]:
        """End the context at one of `signals` (none: any): for what needs no clean-up."""
        self._at_once = signals or _SIGNALS
        with contextlib.suppress(KeyboardInterrupt):
            try:
                yield
            finally:
                self._at_once = ()

    def __bool__(self) -> bool:
        """Whether a signal has arrived."""
        return self.count > 0
