"""Detection of targets on ground that is not flat."""

import numpy as np

from maasi_filter.arrays import FloatArray
from maasi_filter.geometry.terrain import Terrain
from maasi_filter.models.detection import DetectionModel
from maasi_filter.models.pose import Pose

# Share of pi with which a filter expects detections of hidden targets, as grids of heights and
# poses have errors: a target at the edge of a hill is not false.
HIDDEN = 0.05


def probability_in_sight(
    detection: DetectionModel,
    positions: FloatArray,
    pose: Pose,
    terrain: Terrain | None,
    hidden: float = 0.0,
) -> FloatArray:
    """Return pi(x, q) (n,) for targets on the ground at (n, 2) [m, map].

    Where it hides them, that is multiplied by `hidden`.
    """
    found = detection.probability(positions, pose)
    if terrain is not None:
        found *= sight(positions, pose, terrain, hidden, found)
    return found


def sight(
    positions: FloatArray, pose: Pose, terrain: Terrain, hidden: float, found: FloatArray
) -> FloatArray:
    """Return 1 for positions (n, 2) [m, map] on the ground in sight, else `hidden`.

    Those with nothing `found` (n,) are not checked.
    """
    factor = np.ones(len(positions))
    near = found > 0.0
    seen = terrain.visible(pose.position, terrain.on_ground(positions[near]))
    factor[near] = np.where(seen, 1.0, hidden)
    return factor
