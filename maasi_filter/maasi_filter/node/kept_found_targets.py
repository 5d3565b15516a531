"""Found targets that another node keeps for a filter restarted without its state."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from maasi_filter.models.sensor import is_covariance
from maasi_filter.records import FoundTarget

# Longest wait for a latched message [s].
_PATIENCE = 5.0


class KeptFoundTargets:
    """Takes the kept targets once in the life of a process.

    Only the first message is used: later ones contain the targets that this filter found itself.
    """

    def __init__(self) -> None:
        self._taken = False
        self._since: float | None = None

    def begin(self, now: float) -> None:
        """Note that the node is active; wall time [s]."""
        self._since = now if self._since is None else self._since

    def take(self) -> bool:
        """Return whether a message is the first one."""
        first, self._taken = not self._taken, True
        return first

    def is_awaited(self, publishers: int, now: float) -> bool:
        """Return whether batches have to wait for the message.

        Parameters
        ----------
        publishers : int
            Number of publishers of the topic; without any there is nothing to wait for.
        now : float
            Wall time [s].
        """
        if self._taken or not publishers or self._since is None:
            return False
        return now - self._since < _PATIENCE


def checked_found(targets: Sequence[FoundTarget]) -> list[FoundTarget]:
    """Return found targets of a message.

    Raises
    ------
    ValueError
        If an id is not from 1, or comes twice, or a number is not finite.
    """
    ids: set[int] = set()
    for target in targets:
        if target.id < 1 or target.id in ids:
            raise ValueError(f'targets.id: read {target.id}, allowed are different ones from 1')
        ids.add(target.id)
        if not np.isfinite(target.position).all() or not is_covariance(target.covariance):
            raise ValueError(
                f'targets: id {target.id}: read {target.position.tolist()} with covariance '
                f'{target.covariance.tolist()}, allowed are finite numbers, and a positive '
                'definite matrix'
            )
    return list(targets)
