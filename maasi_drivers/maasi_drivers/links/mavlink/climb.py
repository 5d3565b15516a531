"""The progress of a vehicle on the way to its height after take-off."""

from __future__ import annotations

import math

# The height is reached within this; a smaller change is no progress [m].
_REACHED, _PROGRESS = 0.2, 0.1


class Climb:
    """Detects the end or a stall of a climb or dive.

    Parameters
    ----------
    timeout : float
        Time without progress after which it is stalled [s].

    Attributes
    ----------
    accepted : bool
        Whether the autopilot has accepted the take-off: it refuses another one.
    """

    def __init__(self, timeout: float) -> None:
        self.timeout = timeout
        self.begin(-math.inf)

    def begin(self, now: float) -> None:
        """Begin, at `now` on the steady clock [s]."""
        self.accepted = False
        # Smallest distance left so far [m], and its time [s].
        self._least = math.inf
        self._progress_at = now

    def update(self, left: float, now: float) -> None:
        """Update with the distance left [m]."""
        if left < self._least - _PROGRESS:
            self._least, self._progress_at = left, now

    def is_over(self, left: float) -> bool:
        """Return whether the height is reached, with this way left [m]."""
        return left <= _REACHED

    def is_stalled(self, now: float) -> bool:
        """Return whether there was no progress for the timeout."""
        return now - self._progress_at > self.timeout
