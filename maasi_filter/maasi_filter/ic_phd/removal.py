"""Found targets remove their measurements from later corrections (000, section 3.3)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from maasi_filter.arrays import BoolArray, FloatArray
from maasi_filter.measurement_check import CheckedMeasurement
from maasi_filter.models.label import UNLABELLED, Label
from maasi_filter.records import FoundTarget


def kept_measurements(
    centres: FloatArray, targets: Sequence[FoundTarget], limit: float, every: bool
) -> BoolArray:
    """Return which of m detections remain after removing those of found targets.

    Parameters
    ----------
    centres : (m, d) array
        g^-1(z), metres.
    limit : float
        T_z, metres.
    every : bool
        Whether to remove all detections within T_z of a found target (003, algorithm 1), or only
        the closest one to each (000, section 3.3; 001, algorithm 1).
    """
    keep = np.ones(len(centres), np.bool_)
    for target in targets:
        apart = np.sqrt(((centres - target.position) ** 2).sum(axis=1))
        near = keep & (apart <= limit)
        if every:
            keep &= ~near
        elif near.any():
            keep[int(np.argmin(np.where(near, apart, np.inf)))] = False
    return keep


def nearest_label(
    position: FloatArray, members: Sequence[CheckedMeasurement], limit: float
) -> Label:
    """Return the label of the detection nearest to a position, within T_z = `limit` metres.

    The PHD filter does not associate detections with targets.
    """
    best, least = UNLABELLED, limit
    for member in members:
        if not member.labels:
            continue
        centres = member.sensor.measurement.inverse(member.values, member.pose)
        for label, apart in zip(member.labels, np.linalg.norm(centres - position, axis=1).tolist()):
            if apart <= least:
                best, least = label, apart
    return best
