"""The obstacle term of 001, eq. (14) and (15), for a robot that flies velocity commands.

The paper subtracts k_obs from the input whenever an obstacle is nearer than d_l. With
u = K_v (v - velocity) - ... that equals a change of the velocity command by k_obs / K_v,
so it needs no access to the torques. As printed the term has no direction; `away` gives it the
direction from the obstacle to the robot.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from maasi_filter.arrays import FloatArray

KINDS = ('none', 'printed', 'away')
PRINTED = 1


class ObstacleTerm(NamedTuple):
    """Obstacle term of a robot.

    Attributes
    ----------
    kind : int
        Index in KINDS: none; the same k_obs off every input; k_obs along the way out.
    distance, gain : float
        d_l [m] and k_obs [N m and N].
    circles : (n, 5) array
        Obstacles: x, y, z, radius, 1 for a sphere; the nearest surface counts.
    """

    kind: int
    distance: float
    gain: float
    circles: FloatArray


@njit(cache=True)
def add_obstacle_term(
    position: FloatArray,
    yaw: float,
    term: ObstacleTerm,
    parameters: FloatArray,
    command: FloatArray,
) -> None:
    """Add the term to `command` (4,) in place.

    Parameters
    ----------
    position : (3,) array
        Metres, frame `map`.
    yaw : float
        Heading, radians.
    term : ObstacleTerm
        Kind, distance, gain and obstacles.
    parameters : (13,) array
        Of the Mambo; the first eight are its gains.
    """
    circles = term.circles
    gain = term.gain
    nearest = np.inf
    nx = 0.0
    ny = 0.0
    nz = 0.0
    for i in range(circles.shape[0]):
        ox = position[0] - circles[i, 0]
        oy = position[1] - circles[i, 1]
        oz = (position[2] - circles[i, 2]) if circles[i, 4] > 0.5 else 0.0
        size = math.sqrt(ox * ox + oy * oy + oz * oz)
        if size - circles[i, 3] < nearest:
            nearest = size - circles[i, 3]
            size = max(size, 1e-9)
            nx = ox / size
            ny = oy / size
            nz = oz / size
    if nearest >= term.distance:
        return
    if term.kind == PRINTED:
        command[0] -= gain / parameters[0]
        # A roll torque of -k_obs tips the robot to its left: the roll gain has the other sign.
        command[1] -= gain / parameters[3]
        command[2] -= gain / parameters[6]
        command[3] -= gain / parameters[7]
        return
    cos_yaw = math.cos(yaw)
    sin_yaw = math.sin(yaw)
    command[0] += gain / abs(parameters[0]) * (cos_yaw * nx + sin_yaw * ny)
    command[1] += gain / abs(parameters[3]) * (cos_yaw * ny - sin_yaw * nx)
    command[2] += gain / abs(parameters[6]) * nz
