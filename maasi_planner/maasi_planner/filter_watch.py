"""Supervision of the filter by a free-running planner."""

from __future__ import annotations


class FilterWatch:
    """Detects a silent filter by its heartbeat and by the oldest batch without an update.

    Both count only if there was something to wait for: a filter that never sent a heartbeat, while
    no batch is open, is no fault.

    Parameters
    ----------
    timeout : float
        Longest silence [s of wall time]; 0 disables the supervision.
    """

    def __init__(self, timeout: float) -> None:
        self.timeout = timeout
        self._beat: float | None = None
        self._open: dict[int, float] = {}

    def beat(self, now: float) -> None:
        """Note a heartbeat of the executor of the filter."""
        self._beat = now

    def asked(self, batch: int, now: float) -> None:
        """Note that a batch was published."""
        self._open[batch] = now

    def answered(self, batch: int) -> None:
        """Note the update of a batch: updates of earlier ones will not arrive any more."""
        self._open = {number: since for number, since in self._open.items() if number > batch}

    def stalled(self, seconds: float) -> None:
        """Note that the planner itself was suspended: messages of that time are not read yet."""
        if self._beat is not None:
            self._beat += seconds
        self._open = {number: since + seconds for number, since in self._open.items()}

    def problem(self, now: float) -> str:
        """Return why the filter counts as absent; empty if it does not."""
        if not self.timeout:
            return ''
        if self._beat is not None and now - self._beat > self.timeout:
            return f'no heartbeat of the filter for {now - self._beat:.1f} s'
        if self._open:
            number = min(self._open)
            waited = now - self._open[number]
            if waited > self.timeout:
                return f'no filter_update of batch {number} for {waited:.1f} s'
        return ''
