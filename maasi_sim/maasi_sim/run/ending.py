"""Reasons and exit codes of runs, and signals as a condition that a run polls."""

import contextlib
import signal
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from types import FrameType

DONE, NOT_ALL_FOUND, WRONG_INPUT, NODE_FAILED, NOT_WRITTEN, INTERRUPTED = 0, 1, 2, 3, 4, 130
EXIT_CODES = {
    DONE: 'all targets found (or the planner finished, with stop: planner_done)',
    NOT_ALL_FOUND: 'not all targets found, or planner finished with less than half explored',
    WRONG_INPUT: 'wrong input',
    NODE_FAILED: 'a node died or hung',
    NOT_WRITTEN: 'bag or report not written or incomplete',
    INTERRUPTED: 'interrupted',
}
LEAST_EXPLORED = 0.5  # explored share that a complete search needs [1]
_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@dataclass(frozen=True)
class Ending:
    """Why a run ended, its exit code, a text for the user, and the nodes that caused it."""

    reason: str
    code: int
    text: str = ''
    nodes: Collection[str] = ()


def end_of_planners(reason: str, explored: float, meant: bool) -> Ending:
    """Return the ending of a run whose planners have all finished."""
    if explored < LEAST_EXPLORED:
        text = f'{reason}; the search is incomplete: only {100.0 * explored:.1f} % explored'
        return Ending('planner_done', NOT_ALL_FOUND, text)
    return Ending('planner_done', DONE if meant else NOT_ALL_FOUND, reason)


class Interruption:
    """Handles SIGINT, SIGTERM and SIGHUP; true after the first one."""

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
        """Let `signals` (none: all) end the context immediately, for code without clean-up."""
        self._at_once = signals or _SIGNALS
        with contextlib.suppress(KeyboardInterrupt):
            try:
                yield
            finally:
                self._at_once = ()

    def __bool__(self) -> bool:
        """Whether a signal has arrived."""
        return self.count > 0
