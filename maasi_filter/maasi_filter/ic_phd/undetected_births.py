"""Births of a robot that measures after others in the same step: those that the others missed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from maasi_filter.ic_phd.births import MeasurementBirths
from maasi_filter.models.detection import DetectionModel
from maasi_filter.models.pose import Pose


def missed_before(
    births: MeasurementBirths, before: Sequence[tuple[DetectionModel, Pose]]
) -> MeasurementBirths:
    """Return births with the intensity Y prod(1 - pi) that earlier robots of the step leave.

    000, eq. (15), (16) and 002, eq. (8), (9): robot o corrects D^{o-1}, in which the constant
    intensity Y of new targets has been multiplied by 1 - pi of each robot before.

    Parameters
    ----------
    births : MeasurementBirths
        Drawn with the intensity Y.
    before : sequence of (DetectionModel, Pose)
        Of the robots that were processed before in the step.
    """
    intensity = births.intensity.copy()
    for detection, pose in before:
        intensity *= 1.0 - detection.probability(births.particles, pose)
    totals = np.array([intensity[i:j].sum() for i, j in zip(births.starts[:-1], births.starts[1:])])
    return replace(births, intensity=intensity, totals=totals)
