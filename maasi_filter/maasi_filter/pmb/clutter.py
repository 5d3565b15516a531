"""How many false detections a robot's sensor gives, learnt from what no target explains."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from maasi_filter.models.detection import BoxDetection
from maasi_filter.models.sensor import Sensor

FloatArray = NDArray[np.float64]

# No sensor is without: false detections of a scan that are expected at least.
LEAST_PER_SCAN = 0.05
# Scans that the prior is worth.
PRIOR_SCANS = 10.0


def measurement_space(sensor: Sensor, bounds: FloatArray) -> float:
    """Return the volume of the sensor's measurements [m rad, in 3D m rad^2].

    Ranges up to the sensor's largest, the diagonal of the environment, or the farthest corner of
    its field of view; all angles.
    """
    size = bounds[:, 1] - bounds[:, 0]
    reach = min(sensor.maximum_range, math.sqrt(float((size * size).sum())))
    if isinstance(sensor.detection, BoxDetection):
        corner = np.maximum(np.abs(sensor.detection.lower), np.abs(sensor.detection.upper))
        corner = corner[: len(bounds)] + sensor.detection.edge
        # A box of a floor's two axes has any height.
        if len(corner) == len(bounds):
            reach = min(reach, math.sqrt(float((corner * corner).sum())))
    return reach * 2.0 * math.pi * (math.pi if len(bounds) == 3 else 1.0)


class ClutterEstimate:
    """Mean number of false detections in a scan, with a gamma prior, for each robot.

    The prior's mean is what the sensor is said to have, at least LEAST_PER_SCAN; it is worth
    PRIOR_SCANS scans.

    Attributes
    ----------
    scans, counts : dict
        By robot: scans, and expected number of false detections in them.
    """

    def __init__(self) -> None:
        self.scans: dict[str, int] = {}
        self.counts: dict[str, float] = {}

    def per_scan(self, robot: str, told: float) -> float:
        """Return the posterior mean for a robot whose sensor is said to have `told` in a scan."""
        prior = max(told, LEAST_PER_SCAN)
        count = PRIOR_SCANS * prior + self.counts.get(robot, 0.0)
        return count / (PRIOR_SCANS + self.scans.get(robot, 0))

    def count(self, robot: str, false_detections: float) -> None:
        """Count a scan with an expected number of false detections."""
        self.scans[robot] = self.scans.get(robot, 0) + 1
        self.counts[robot] = self.counts.get(robot, 0.0) + false_detections
