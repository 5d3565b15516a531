"""Progress of a run: one updated line on a terminal, else plain lines."""

import contextlib
import shutil
import sys
import time
from typing import TextIO

_ERASE = '\r\x1b[K'  # ECMA-48: back to the begin of the line, which is erased


class ProgressDisplay:
    """Shows progress: on a terminal a line that changes, else lines, at least each period [s]."""

    def __init__(self, stream: TextIO | None = None, period: float = 5.0) -> None:
        self._stream = stream or sys.stderr
        self._terminal = self._stream.isatty()
        self._period = 0.1 if self._terminal else period
        self._last = -1e9
        self._found = -1
        self._line = ''  # on a terminal: the line that changes

    @property
    def due(self) -> bool:
        """Whether an update is due."""
        return time.monotonic() - self._last >= self._period

    def say(self, text: str, instead: bool = False) -> None:
        """Print a line, before the one that changes or instead of it; no error ends the run."""
        erase = _ERASE if self._line else ''
        self._line = '' if instead else self._line
        with contextlib.suppress(OSError):
            print(f'{erase}{text}\n{self._line}', end='', file=self._stream, flush=True)

    def warn(self, *texts: str) -> None:
        """Print warnings, but no empty ones."""
        for text in filter(None, texts):
            self.say(f'warning: {text}')

    def show(self, text: str, found: int) -> None:
        """Show a status, if an update is due or it has a new target."""
        if not self.due and (self._terminal or found == self._found):
            return
        self._found = found
        self._write(text)

    def share(self, what: str, part: float) -> None:
        """Show how much of something is done, if an update is due."""
        self.update(f'{what}: {100.0 * part:.0f} %')

    def update(self, text: str, quiet: bool = False) -> None:
        """Show how far something is, if an update is due; quiet: only on a terminal."""
        if self.due and (self._terminal or not quiet):
            self._write(text)

    def _write(self, text: str) -> None:
        self._last = time.monotonic()
        if not self._terminal:
            self.say(text)
            return
        # A line that wraps could not be erased.
        self._line = text[: shutil.get_terminal_size().columns - 1]
        with contextlib.suppress(OSError):
            print(f'{_ERASE}{self._line}', end='', file=self._stream, flush=True)

    def close(self) -> None:
        """Leave the line that changes as it is."""
        if self._line:
            self._line = ''
            self.say('')
