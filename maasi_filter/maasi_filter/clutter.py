"""Clutter: the volume of its density, and a lower bound of its intensity."""

from __future__ import annotations

import math

import numpy as np

from maasi_filter.arrays import FloatArray
from maasi_filter.models.detection import BoxDetection
from maasi_filter.models.sensor import Sensor

# Lower bound of the expected number of false detections in a scan: no sensor is without clutter.
LEAST_PER_SCAN = 0.05


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
        # A box in two axes does not limit the height.
        if len(corner) == len(bounds):
            reach = min(reach, math.sqrt(float((corner * corner).sum())))
    return reach * 2.0 * math.pi * (math.pi if len(bounds) == 3 else 1.0)


def least_clutter(sensor: Sensor, bounds: FloatArray) -> float:
    """Return the lower bound of the clutter intensity, per unit of measurement space.

    Without it, a few stray particles suffice to explain a false detection as a target.
    """
    return LEAST_PER_SCAN / measurement_space(sensor, bounds)
