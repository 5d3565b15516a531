"""Why a robot cannot follow goals: its present faults by kind. Without ROS."""

from __future__ import annotations

from collections.abc import Callable

# Kinds of faults that every robot can have.
ODOMETRY, FROZEN_POSE, SENSOR = 'odometry', 'frozen pose', 'sensor'
BATTERY, STOP = 'battery', 'stop'


class Health:
    """The present faults of a robot; without any it can follow goals.

    Parameters
    ----------
    on_fault : callable
        Called with the text of each new fault.
    """

    def __init__(self, on_fault: Callable[[str], None]) -> None:
        self._on_fault = on_fault
        self._faults: dict[str, str] = {}

    def __contains__(self, kind: str) -> bool:
        return kind in self._faults

    @property
    def text(self) -> str:
        """All faults; empty without any."""
        return '; '.join(self._faults.values())

    def get(self, kind: str) -> str:
        """Return the text of a fault; empty if there is none of this kind."""
        return self._faults.get(kind, '')

    def begin(self, kind: str, text: str) -> bool:
        """Set a fault, or the text of one that is set; return whether it is new.

        Parameters
        ----------
        kind : str
            To end it by.
        text : str
            The cause, for the planner.
        """
        new = kind not in self._faults
        self._faults[kind] = text
        if new:
            self._on_fault(text)
        return new

    def end(self, kind: str) -> bool:
        """Clear a fault; return whether it was set."""
        return self._faults.pop(kind, None) is not None
