"""Progress of a run: one updated line on a terminal, else plain lines."""

import contextlib
import shutil
import sys
import time
from typing import TextIO

_ERASE = '\r\x1b[K'  # ECMA-48: return to the begin of the line and erase it


class ProgressDisplay:
    """Shows progress: one changing line on a terminal, else lines, at least one per period [s]."""

    def __init__(self, stream: TextIO | None = None, period: float = 5.0) -> None:
        self._stream = stream or sys.stderr
        self._terminal = self._stream.isatty()
        self._period = 0.1 if self._terminal else period
        self._last = -1e9
        self._found = -1
        self._line = ''  # the line that changes, on a terminal

    @property
    def due(self) -> bool:
        """Whether an update is due."""
        return time.monotonic() - self._last >= self._period

    def say(self, text: str, instead: bool = False) -> None:
        """Print a line before the changing line or instead of it, ignoring write errors."""
        erase = _ERASE if self._line else ''
        self._line = '' if instead else self._line
        with contextlib.suppress(OSError):
            print(f'{erase}{text}\n{self._line}', end='', file=self._stream, flush=True)

    def warn(self, *texts: str) -> None:
        """Print the warnings that are not empty."""
        for text in filter(None, texts):
            self.say(f'warning: {text}')

    def show(self, text: str, found: int) -> None:
        """Show a status if an update is due or the number of found targets has changed."""
        if not self.due and (self._terminal or found == self._found):
            return
        self._found = found
        self._write(text)

    def share(self, what: str, part: float) -> None:
        """Show the completed share of a task if an update is due, but not 0 %."""
        if part >= 0.005:
            self.update(f'{what}: {100.0 * part:.0f} %')

    def update(self, text: str, quiet: bool = False) -> None:
        """Show a text if an update is due; quiet: only on a terminal."""
        if self.due and (self._terminal or not quiet):
            self._write(text)

    def _write(self, text: str) -> None:
        self._last = time.monotonic()
        if not self._terminal:
            self.say(text)
            return
        # A line that wraps cannot be erased.
        self._line = text[: shutil.get_terminal_size().columns - 1]
        with contextlib.suppress(OSError):
            print(f'{_ERASE}{self._line}', end='', file=self._stream, flush=True)

    def close(self) -> None:
        """End the changing line."""
        if self._line:
            self._line = ''
            self.say('')
