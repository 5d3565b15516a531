"""Plausibility of the stamps of messages. Without ROS."""

from __future__ import annotations

from typing import Any

_NANOSECONDS = 1_000_000_000

#: Smallest difference of consecutive stamps that counts as a jump [ns].
JUMP = _NANOSECONDS

#: Largest valid stamp [s].
LAST_STAMP = 2**31 - 1

# Limit of the first batch id, and of the lead of later ids over the last one.
_FIRST_IDS = 2**62
_IDS_AHEAD = 10**6


def stamp_problem(message: Any) -> str | None:
    """Return the error of the stamp of a message: field, what was read, what is allowed.

    Parameters
    ----------
    message : object
        With `header.stamp`, `stamp`, or neither, which is no error.
    """
    name, owner = 'header.stamp', getattr(message, 'header', None)
    if owner is None:
        name, owner = 'stamp', message
    stamp = getattr(owner, 'stamp', None)
    if stamp is None:
        return None
    if stamp.sec < 0:
        return f'{name}.sec: read {stamp.sec}, allowed is from 0 [s]'
    if stamp.nanosec >= _NANOSECONDS:
        return f'{name}.nanosec: read {stamp.nanosec}, allowed is below {_NANOSECONDS} [ns]'
    return None


def batch_id_limit(last: int) -> int:
    """Return the highest batch id that is accepted after `last`.

    Ids increase, and uint64 is bounded: a node that accepted an id near the bound could not
    continue from it. Ids below the limit are accepted, so that filter and planner agree again.
    """
    return max(last, _FIRST_IDS) + _IDS_AHEAD


class StampGate:
    """
    Distinguishes a jump of a stream of stamps from a single wrong stamp.

    A stamp that jumps is refused; if the next one follows it, the stream has really jumped (its
    source was restarted, messages were lost), and is accepted from there.

    Parameters
    ----------
    jump : int
        Largest difference of two stamps that is not a jump, in the unit of the stamps.

    """

    def __init__(self, jump: int = JUMP) -> None:
        self.jump = jump
        self._last: int | None = None
        self._suspect: int | None = None

    def accepts(self, stamp: int) -> bool:
        """Return whether a stamp is accepted."""
        last, suspect = self._last, self._suspect
        self._suspect = None
        if last is not None and abs(stamp - last) > self.jump:
            if suspect is None or not 0 < stamp - suspect <= self.jump:
                self._suspect = stamp
                return False
        elif last is not None and stamp < last:
            # A late message, not a jump: the reference stays at the last stamp.
            return True
        self._last = stamp
        return True

    def clear(self) -> None:
        """Reset: the next stamp is accepted."""
        self._last = self._suspect = None
