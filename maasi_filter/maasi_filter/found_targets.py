"""Targets that are found: they leave the intensity, and take their measurements with them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


@dataclass
class FoundTarget:
    """A target marked as found.

    Parameters
    ----------
    id : int
        From 1, in the order of being found.
    position : (d,) array
        Metres, frame `map`.
    covariance : (d, d) array
        Of the error of `position`, square metres.
    robot : str
        Whose measurement completed it.
    measurement : int
        That robot's measurement index then.
    time : float
        Seconds.
    """

    id: int
    position: FloatArray
    covariance: FloatArray
    robot: str
    measurement: int
    time: float
