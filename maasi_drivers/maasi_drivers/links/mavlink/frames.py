"""Between the frames of MAVLink, NED and FRD, and ours, ENU and FLU (REP-103)."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from maasi_filter.models.pose import quaternion_product

FloatArray = NDArray[np.float64]

_HALF = math.sqrt(0.5)
# Turns ENU into NED, and FRD into FLU; w first.
_NED_TO_ENU = np.array([0.0, _HALF, _HALF, 0.0])
_FLU_TO_FRD = np.array([0.0, 1.0, 0.0, 0.0])


def swap_enu_ned(vector: ArrayLike) -> FloatArray:
    """Return a vector (3,) of ENU in NED, or the other way round: it is the same swap."""
    x, y, z = np.asarray(vector, dtype=float)
    return np.array([y, x, -z])


def swap_flu_frd(vector: ArrayLike) -> FloatArray:
    """Return a vector (3,) of a body's FLU axes in FRD, or the other way round."""
    x, y, z = np.asarray(vector, dtype=float)
    return np.array([x, -y, -z])


def swap_yaw(yaw: float) -> float:
    """Return a yaw [rad] from east, to the left, as one from north, to the right, or back."""
    turned = 0.5 * math.pi - yaw
    return math.atan2(math.sin(turned), math.cos(turned))


def swap_orientation(quaternion: ArrayLike) -> FloatArray:
    """Return the orientation (4,) of FLU in ENU from that of FRD in NED, or back; w first."""
    # Two half turns, each its own inverse but for the sign: the same both ways.
    given = np.asarray(quaternion, dtype=float)
    return quaternion_product(quaternion_product(_NED_TO_ENU, given), _FLU_TO_FRD)
