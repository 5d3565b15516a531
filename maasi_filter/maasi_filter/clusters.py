"""Clusters of particles: potential targets."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


@dataclass
class Cluster:
    """A potential target.

    Parameters
    ----------
    position : (d,) array
        Weighted mean, metres, frame `map`.
    covariance : (d, d) array
        Weighted covariance, square metres.
    radius : float
        Weighted root mean square distance from the mean (or the largest), metres.
    mass : float
        Expected number of targets in it.
    """

    position: FloatArray
    covariance: FloatArray
    radius: float
    mass: float
