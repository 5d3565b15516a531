"""Detects nodes that hang, by missing heartbeats."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

# A heartbeat this soon after a restart is from the previous process [s].
_LEAST_START = 0.5
# A longer gap between two checks means that the run itself was suspended [s].
_LONGEST_LOOK = 1.0


@dataclass
class _Node:
    """Times in seconds of wall time."""

    pid: int | None
    started: float
    beat: float | None = None
    # Time spent waiting for a processor until the last heartbeat.
    waited: float = 0.0


def waited_for_processor(pid: int | None) -> float:
    """Return how long the main thread of a process was runnable without running [s]."""
    try:
        return 1e-9 * int(Path(f'/proc/{pid}/schedstat').read_text().split()[1])
    except (OSError, IndexError, ValueError):
        return 0.0


class NodeWatch:
    """Detects nodes that hang, by the heartbeats that their executors publish each second.

    Time in which a node waited for a processor does not count. Until its first heartbeat a node
    counts as starting, which may include compilation.

    Parameters
    ----------
    silence : float
        Longest time without a heartbeat [s of wall time].
    start : float
        Longest time from the start of the process to its first heartbeat [s of wall time].
    waited : callable, optional
        Returns how long a process waited for a processor [s].
    """

    def __init__(
        self,
        silence: float,
        start: float,
        waited: Callable[[int | None], float] = waited_for_processor,
    ) -> None:
        self._silence = silence
        self._start = start
        self._waited = waited
        self._nodes: dict[str, _Node] = {}
        self._looked: float | None = None

    def begin(self, name: str, pid: int | None, now: float) -> None:
        """Note that the process of a node was started."""
        self._nodes[name] = _Node(pid, now)

    def beat(self, name: str, now: float) -> None:
        """Note a heartbeat."""
        node = self._nodes.get(name)
        if node is None or (node.beat is None and now - node.started < _LEAST_START):
            return
        node.beat, node.waited = now, self._waited(node.pid)

    def starting(self) -> list[str]:
        """Return the names of the nodes that have not had a heartbeat."""
        return [name for name, node in self._nodes.items() if node.beat is None]

    def late(self, now: float) -> list[str]:
        """Return the names of the nodes that have been starting for too long."""
        return [name for name in self.starting() if now - self._nodes[name].started > self._start]

    def hung(self, now: float) -> dict[str, float]:
        """Return the nodes that hang, and for how long [s]; to be called several times a second."""
        gap = 0.0 if self._looked is None else now - self._looked
        self._looked = now
        hung = {}
        for name, node in self._nodes.items():
            if node.beat is None:
                continue
            if gap > _LONGEST_LOOK:
                node.beat += gap
            silent = now - node.beat
            if silent > self._silence:
                silent -= self._waited(node.pid) - node.waited
            if silent > self._silence:
                hung[name] = silent
        return hung
