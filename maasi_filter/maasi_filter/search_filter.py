"""One step of the search filter for a set M_k of measuring robots."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from maasi_filter.clusters import Cluster
from maasi_filter.found_targets import FoundTarget
from maasi_filter.pose import Pose
from maasi_filter.sensor import Sensor

FloatArray = NDArray[np.float64]


@dataclass
class AgentMeasurement:
    """What one robot measured at one step; an empty one counts too.

    Parameters
    ----------
    robot : str
        Its name; robots are processed in the order of their names.
    pose : Pose
        Of the sensor at the time of the measurement.
    sensor : Sensor
        What it measured with.
    values : (m, d) array
        Detections: range, bearing and, in 3D, elevation; m, rad, rad.
    covariances : (m, d, d) array, optional
        Of each detection; they win over the sensor's, except in the `paper_*` presets.
    index : int
        That robot's measurement index.
    """

    robot: str
    pose: Pose
    sensor: Sensor
    values: FloatArray
    covariances: FloatArray | None = None
    index: int = 0


@dataclass
class FilterResult:
    """What a step brought.

    Parameters
    ----------
    clusters : list of Cluster
        Potential targets after the step, found ones not among them.
    newly_found : list of FoundTarget
        Targets found in this step.
    found_changed : bool
        Whether any found target is new or has moved.
    expected_number : float
        Expected number of targets in the intensity; found ones not among them.
    dropped : dict
        Detections that were not used: reason to count.
    """

    clusters: list[Cluster]
    newly_found: list[FoundTarget]
    found_changed: bool
    expected_number: float
    dropped: dict[str, int] = field(default_factory=dict)
