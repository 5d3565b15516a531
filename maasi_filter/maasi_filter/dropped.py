"""Detections that a filter does not use, counted by reason."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from maasi_filter.measurement_check import CheckedMeasurement

FloatArray = NDArray[np.float64]

# Reason of detections that a found target took: every search has them.
FOUND = 'found'


def count_dropped(dropped: dict[str, int], reason: str, number: int) -> None:
    """Add a number of detections to those dropped for a reason."""
    if number:
        dropped[reason] = dropped.get(reason, 0) + number


def within_range(member: CheckedMeasurement, dropped: dict[str, int]) -> CheckedMeasurement:
    """Return a measurement without detections beyond the range of its sensor."""
    reach = member.values[:, 0] <= member.sensor.maximum_range
    if reach.all():
        return member
    count_dropped(dropped, 'range', int((~reach).sum()))
    return member.only(reach)


def count_unexplained(centres: FloatArray, bounds: FloatArray, dropped: dict[str, int]) -> None:
    """Count detections that only clutter explains, by the places (m, d) they point at."""
    inside = ((centres >= bounds[:, 0]) & (centres <= bounds[:, 1])).all(axis=1)
    count_dropped(dropped, 'outside', int((~inside).sum()))
    count_dropped(dropped, 'unseen', int(inside.sum()))
