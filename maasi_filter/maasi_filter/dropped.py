"""Detections that a filter does not use, counted by reason."""

from __future__ import annotations

import numpy as np

from maasi_filter.arrays import FloatArray
from maasi_filter.measurement_check import CheckedMeasurement

# Reasons that are no faults: a found target took it, or another one of the scan is the same.
FOUND = 'found'
REPEATED = 'repeated'


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


def without_repeats(member: CheckedMeasurement, dropped: dict[str, int]) -> CheckedMeasurement:
    """Return a measurement with one detection where several are one by the sensor's resolution.

    Detections with different identities are of different targets.
    """
    values, gate = member.values, member.sensor.resolution
    # Detections are sorted by range, which is within the gate first of all.
    reach = values[:, 0] - gate * np.sqrt(member.covariances[:, 0, 0])
    first = np.searchsorted(values[:, 0], reach, side='right')
    keep = np.ones(len(values), np.bool_)
    for j in np.flatnonzero(first < np.arange(len(values))).tolist():
        others = first[j] + np.flatnonzero(keep[first[j] : j])
        errors = member.sensor.measurement.residual(values[others], values[j])
        solved = np.linalg.solve(member.covariances[j], errors.T).T
        same = (errors * solved).sum(axis=1) < gate**2
        if member.labels:
            same &= [member.labels[i].identity == member.labels[j].identity for i in others]
        keep[j] = not same.any()
    count_dropped(dropped, REPEATED, int((~keep).sum()))
    return member if keep.all() else member.only(keep)


def count_unexplained(centres: FloatArray, bounds: FloatArray, dropped: dict[str, int]) -> None:
    """Count detections that only clutter explains, by the places (m, d) they point at."""
    inside = ((centres >= bounds[:, 0]) & (centres <= bounds[:, 1])).all(axis=1)
    count_dropped(dropped, 'outside', int((~inside).sum()))
    count_dropped(dropped, 'unseen', int(inside.sum()))
