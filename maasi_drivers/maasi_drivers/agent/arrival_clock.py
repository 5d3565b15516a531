"""Stamps for what arrives without one: the node's time at an arrival on the steady clock."""

from __future__ import annotations

from collections import deque

# Length of the window of observations [s].
_WINDOW = 2.0
# A lead that falls by more at once is a jump back of the node's time [ns].
_JUMP = 1_000_000_000


class ArrivalClock:
    """The node's time at any instant of the steady clock.

    Simulated time arrives in steps and late, so that its largest recent lead over the steady clock
    is the true one. With system time the result is exact.
    """

    def __init__(self) -> None:
        # Recent instants [s] and leads of the node's time [ns], with falling leads.
        self._leads: deque[tuple[float, int]] = deque()

    def observe(self, now: float, time: int) -> None:
        """Note the node's time [ns] at an instant of the steady clock [s]; 0: it has not begun."""
        leads = self._leads
        if time <= 0:
            leads.clear()
            return
        lead = time - round(now * 1e9)
        if leads and lead < leads[-1][1] - _JUMP:
            leads.clear()
        while leads and leads[-1][1] <= lead:
            leads.pop()
        leads.append((now, lead))
        while leads[0][0] < now - _WINDOW:
            leads.popleft()

    def stamp(self, instant: float) -> int | None:
        """Return the node's time [ns] at an instant [s]; None while it has not begun."""
        if not self._leads:
            return None
        time = round(instant * 1e9) + self._leads[0][1]
        return time if time > 0 else None
