"""Progress of a run: one updated line on a terminal, else plain lines."""

from __future__ import annotations

import contextlib
import sys
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, TextIO

if TYPE_CHECKING:
    from rich.live import Live
    from rich.text import Text


@dataclass(frozen=True)
class Status:
    """Shown values: simulated time [s], counts, explored share, real-time factor."""

    time: float
    measurements: int
    found: int
    targets: int
    explored: float
    factor: float
    word: str = 'found'

    def text(self) -> str:
        """Return it as one line."""
        targets = f' of {self.targets}' if self.targets else ''
        return (
            f'{self.time:7.1f} s   {self.measurements:4d} measurements   '
            f'{self.found} {self.word}{targets}   {100.0 * self.explored:3.0f} % explored   '
            f'{self.factor:.1f} x real time'
        )


class ProgressDisplay:
    """Shows progress: on a terminal one line that changes, else lines now and then.

    Without a terminal `period` is the time between lines without news [s].
    """

    def __init__(self, stream: TextIO | None = None, period: float = 5.0) -> None:
        self._stream = stream or sys.stderr
        self._terminal = self._stream.isatty()
        self._period = 0.1 if self._terminal else period
        self._last = -1e9
        self._found = -1
        self._live: Live | None = None

    @property
    def due(self) -> bool:
        """Whether an update is due."""
        return time.monotonic() - self._last >= self._period

    def say(self, text: str) -> None:
        """Print a line; a closed terminal or a full disk does not end the run."""
        with contextlib.suppress(OSError):
            if self._live is not None:
                self._live.console.print(text, markup=False, highlight=False)
            else:
                print(text, file=self._stream, flush=True)

    def show(self, status: Status) -> None:
        """Show a status, if an update is due or it has a new target."""
        if not self.due and (self._terminal or status.found == self._found):
            return
        self._found = status.found
        self._write(status.text())

    def share(self, what: str, part: float) -> None:
        """Show how much of something is done, if an update is due."""
        if self.due:
            self._write(f'{what}: {100.0 * part:.0f} %')

    def _write(self, text: str) -> None:
        self._last = time.monotonic()
        if not self._terminal:
            self.say(text)
            return
        if self._live is None:
            self._live = _live(self._stream)
            self._live.start()
        # Without markup and without highlighting of numbers.
        self._live.update(_plain_text(text), refresh=True)

    def close(self) -> None:
        """Leave the terminal as it was."""
        if self._live is not None:
            self._live.stop()
            self._live = None


def _plain_text(text: str) -> Text:
    from rich.text import Text

    return Text(text)


def _live(stream: TextIO) -> Live:
    from rich.console import Console
    from rich.live import Live

    return Live(console=Console(file=stream), auto_refresh=False, transient=False)
