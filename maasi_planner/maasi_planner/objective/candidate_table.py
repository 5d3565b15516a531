"""Candidates of the planning robots as arrays for the joint search."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


CACHE_ROWS = 8000


class CandidateTable(NamedTuple):
    """Data of the planning robots for the joint search.

    G candidates of R robots, one robot after the other; robot r has start[r] to start[r + 1].
    """

    start: IntArray
    robot: IntArray
    allowed: BoolArray
    waypoints: FloatArray
    radii: FloatArray
    control: FloatArray
    norm: FloatArray
    alpha: float
    beta: float
    control_weight: float
    information: bool
    dimension: int
    refinement: FloatArray  # T of paper, (G,)
    # Predicted measurements, which reduce e for others: rows of events.
    event_start: IntArray
    event_time: IntArray
    event_place: FloatArray
    event_turn: FloatArray
    kind: IntArray
    parameters: FloatArray
    # Interpolation nodes of a candidate's own measurements.
    entry_start: IntArray
    entry_value: FloatArray
    entry_node: FloatArray
    entry_time: IntArray
    # Factors by which the measurements of one candidate reduce the entries of another: slot (G, G)
    # is a row of cache (S, longest), filled on first use; used (1,) counts the rows in use.
    slot: NDArray[np.int32]
    cache: FloatArray
    used: IntArray
    # Information about clusters.
    mass: FloatArray
    covariance: FloatArray
    base: FloatArray
    gain: FloatArray
    # Expected new targets.
    unseen: FloatArray
    miss: FloatArray
