"""A word on stderr while kernels are compiled: once on a machine, for a minute or two."""

import sys
from time import perf_counter
from typing import Any

from numba.core.event import Listener, install_listener

# Of compiling: before it is said, which a function or two do not reach, and between two words [s].
PATIENCE, PERIOD = 1.0, 10.0
KERNELS = 80  # of the suite, in a first search, about


class _Compiling(Listener):
    """Hears of each kernel that Numba compiles; of none that it loads from its cache."""

    def __init__(self) -> None:
        self._begun: list[float] = []
        self._done, self._before, self._next = 0, 0.0, PATIENCE

    def on_start(self, event: Any) -> None:
        """Say it; those that a kernel calls are compiled meanwhile."""
        self._begun.append(perf_counter())
        passed = self._before + self._begun[-1] - self._begun[0]
        if passed >= self._next:
            first = ', once: a minute or two' if self._next == PATIENCE else ''
            print(f'compiling{first} ({self._done} of about {KERNELS})', file=sys.stderr)
            self._next = passed + PERIOD

    def on_end(self, event: Any) -> None:
        """Count it, if it is one of the suite."""
        self._done += event.data['dispatcher'].py_func.__module__.startswith('maasi_')
        begun = self._begun.pop()
        if not self._begun:
            self._before += perf_counter() - begun


def compiling_said() -> Any:
    """Return a context in which it is said on stderr that kernels are compiled, and how far."""
    return install_listener('numba:compile', _Compiling())
