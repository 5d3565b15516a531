"""Plausibility of the stamps of messages. Without ROS."""

from __future__ import annotations

from typing import Any

_NANOSECONDS = 1_000_000_000

#: Steps back or forward in a stream of stamps from here on are jumps [ns].
JUMP = _NANOSECONDS

#: Stamps are below this [s].
LAST_STAMP = 2**31 - 1

# Batch ids that a node accepts at first, and how far they may be ahead of those that it knows.
_FIRST_IDS = 2**62
_IDS_AHEAD = 10**6


def stamp_problem(message: Any) -> str | None:
    """Return what is wrong with the stamp of a message: field, what was read, what is allowed.

    Parameters
    ----------
    message : object
        With `header.stamp`, `stamp`, or neither: then nothing is wrong.
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

    Ids rise without end, and a uint64 does not. A node that accepted an absurd id could not go on
    from it. Ids below the limit are followed, so that filter and planner agree again.
    """
    return max(last, _FIRST_IDS) + _IDS_AHEAD


class StampGate:
    """
    Tells a jump of a stream of stamps from a single message with a wrong one.

    A stamp that jumps is refused; if the next one follows it, the stream has really jumped (its
    source was restarted, messages were lost), and is accepted from there.

    Parameters
    ----------
    jump : int
        Largest difference of two stamps that is not a jump. In the unit of the stamps.

    """

    def __init__(self, jump: int = JUMP) -> None:
        self.jump = jump
        self._last: int | None = None
        self._suspect: int | None = None

    def accepts(self, stamp: int) -> bool:
        """Return whether a stamp is to be believed."""
        last, suspect = self._last, self._suspect
        self._suspect = None
        if last is not None and abs(stamp - last) > self.jump:
            if suspect is None or not 0 < stamp - suspect <= self.jump:
                self._suspect = stamp
                return False
        elif last is not None and stamp < last:
            # Late, not a jump: the stream does not go back for it.
            return True
        self._last = stamp
        return True

    def clear(self) -> None:
        """Forget everything: the next stamp is believed."""
        self._last = self._suspect = None
