"""How a run ends: the reason with its exit code, and signals as a condition that a run polls."""

import contextlib
import signal
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from types import FrameType

DONE, NOT_ALL_FOUND, WRONG_INPUT, NODE_FAILED, NOT_WRITTEN, INTERRUPTED = 0, 1, 2, 3, 4, 130
EXIT_CODES = {
    DONE: 'all targets found (or, with stop: planner_done, ended as meant)',
    NOT_ALL_FOUND: 'not all targets were found, or the planners ended with less than half explored',
    WRONG_INPUT: 'wrong input',
    NODE_FAILED: 'a node died or hung',
    NOT_WRITTEN: 'bag or report not written (disk full) or with gaps',
    INTERRUPTED: 'interrupted',
}
LEAST_EXPLORED = 0.5  # share with which a search that its planners end is complete [1]
_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@dataclass(frozen=True)
class Ending:
    """Why a run ended, its exit code, what to say about it, and the nodes that caused it."""

    reason: str
    code: int
    text: str = ''
    nodes: Collection[str] = ()


def end_of_planners(reason: str, explored: float, meant: bool) -> Ending:
    """Return how a run ends whose planners all report that they are finished.

    reason: theirs; explored: share of what is expected, 0 to 1; meant: whether the scenario stops
    there. A search that gave up with less than half explored is no success.
    """
    if explored < LEAST_EXPLORED:
        percent = f'{100.0 * explored:.1f} % explored'
        text = f'{reason}; {percent}, less than half: the search is not complete'
        return Ending('planner_done', NOT_ALL_FOUND, text)
    return Ending('planner_done', DONE if meant else NOT_ALL_FOUND, reason)


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
