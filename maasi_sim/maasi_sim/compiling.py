"""Progress on stderr while Numba compiles kernels, once on a machine."""

import sys
from time import perf_counter
from typing import Any

from numba.core.event import Listener, install_listener

# Compile time before the first line, above that of a few functions, and between lines [s].
PATIENCE, PERIOD = 1.0, 10.0


class _Compiling(Listener):
    """Counts the kernels that Numba compiles, without those it loads from its cache."""

    def __init__(self) -> None:
        self._begun: list[float] = []
        self._done, self._before, self._next, self._printed = 0, 0.0, PATIENCE, False

    def on_start(self, event: Any) -> None:
        """Print a line if due; kernels that this one calls are compiled inside of it."""
        self._begun.append(perf_counter())
        passed = self._before + self._begun[-1] - self._begun[0]
        if passed >= self._next:
            first = ' (once on a machine, takes a minute or two)' if not self._printed else ''
            print(f'compiling kernels{first}: {self._done} done', file=sys.stderr)
            self._printed = True
            self._next = passed + PERIOD

    def on_end(self, event: Any) -> None:
        """Count a kernel of the suite."""
        self._done += event.data['dispatcher'].py_func.__module__.startswith('maasi_')
        begun = self._begun.pop()
        if not self._begun:
            self._before += perf_counter() - begun


def compiling_said() -> Any:
    """Return a context that prints the compile progress on stderr."""
    return install_listener('numba:compile', _Compiling())
