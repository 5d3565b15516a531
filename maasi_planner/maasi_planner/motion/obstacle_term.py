"""The obstacle term of 001, eq. (14) and (15).

It subtracts k_obs from each input while an obstacle is nearer than d_l. Inputs grow in proportion
to the velocity command, so that this equals a change of the command, and needs no access to a
robot's torques. As printed the term has no direction; `away` gives it the direction from the
obstacle to the robot.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from maasi_filter.arrays import FloatArray
from maasi_planner.motion.steering import Command, turned
from maasi_planner.obstacles import Vector, from_centre, norm

TERMS = ('none', 'printed', 'away')
PRINTED = 1


class ObstacleTerm(NamedTuple):
    """Obstacle term of a robot.

    kind: index in TERMS; distance: d_l [m]; push: change of the velocity command whose input is
    k_obs [m/s, rad/s], to the left 0 for a robot that cannot move sideways; circles (n, 5):
    obstacles: x, y, z, radius, 1 for a sphere; the nearest surface counts.
    """

    kind: int
    distance: float
    push: Command
    circles: FloatArray


@njit(cache=True)
def with_obstacle_term(
    position: Vector, yaw: float, command: Command, term: ObstacleTerm
) -> Command:
    """Return a command with the obstacle term."""
    nearest, way = np.inf, (0.0, 0.0, 0.0)
    for i in range(term.circles.shape[0]):
        offset = from_centre(position, term.circles, i)
        size = norm(offset)
        if size - term.circles[i, 3] < nearest:
            nearest, size = size - term.circles[i, 3], max(size, 1e-9)
            way = (offset[0] / size, offset[1] / size, offset[2] / size)
    if nearest >= term.distance:
        return command
    x, y, z, turn = command
    by_x, by_y, by_z, by_turn = term.push
    if term.kind == PRINTED:
        return x - by_x, y - by_y, z - by_z, turn - by_turn
    forward, left = turned(way[0], way[1], -yaw)
    # What cannot move sideways turns to that side.
    turn += by_turn * left if by_y == 0.0 else 0.0
    return x + abs(by_x) * forward, y + abs(by_y) * left, z + by_z * way[2], turn
