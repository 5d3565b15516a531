"""Whether the filter still answers, for a planner that runs freely."""

from __future__ import annotations


class FilterWatch:
    """Judges a filter by its heartbeat and by the oldest batch without an update.

    Both count only once there was something to wait for: a filter that was never heard of, while
    no batch is open, is no fault.

    Parameters
    ----------
    timeout : float
        Longest silence [s of wall time]; 0: it is not watched.
    """

    def __init__(self, timeout: float) -> None:
        self.timeout = timeout
        self._beat: float | None = None
        self._open: dict[int, float] = {}

    def beat(self, now: float) -> None:
        """Note a heartbeat: the executor of the filter runs."""
        self._beat = now

    def asked(self, batch: int, now: float) -> None:
        """Note that a batch was published."""
        self._open[batch] = now

    def answered(self, batch: int) -> None:
        """Note the update of a batch: those before will not come any more."""
        self._open = {number: since for number, since in self._open.items() if number > batch}

    def stalled(self, seconds: float) -> None:
        """Note that the planner itself has stood still: what was sent meanwhile is not read yet."""
        if self._beat is not None:
            self._beat += seconds
        self._open = {number: since + seconds for number, since in self._open.items()}

    def problem(self, now: float) -> str:
        """Return why the filter counts as absent, empty where it does not."""
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
