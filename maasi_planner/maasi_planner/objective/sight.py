"""What terrain hides from the robots of a team, in tables that are filled when they are needed."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from maasi_filter.arrays import FloatArray, IntArray
from maasi_filter.geometry.area import Area
from maasi_filter.geometry.terrain import FLAT, Surface, Terrain, hides
from maasi_filter.models.detection import DetectionModel
from maasi_filter.models.line_of_sight import probability_in_sight
from maasi_filter.models.pose import Pose
from maasi_filter.unexplored_map import UnexploredMap, reach_of
from maasi_planner.team import RobotView

# Largest table, and distances of its robot positions in steps of the map.
MOST_BYTES, STEPS = 40_000_000, (0.5, 1.0, 2.0)
_SEEN, _HIDDEN = 1, 2  # entries; 0: not computed yet


class Sight(NamedTuple):
    """Lines of sight from robots at fixed heights above a surface, to points on it.

    values (H, sx, sy, wx, wy): entry of each of H heights [m], position of a grid of sx x sy, and
    node in a window of wx x wy of the nodes (nx, ny) of the map around it; lower (2,) and
    step (2,): first node and distances of nodes [m]; apart (2,): distances of positions [m]. An
    empty table: lines of sight are computed each time.
    """

    surface: Surface = FLAT
    heights: FloatArray = np.zeros(1)
    values: NDArray[np.uint8] = np.zeros((0, 0, 0, 0, 0), np.uint8)
    lower: FloatArray = np.zeros(2)
    step: FloatArray = np.ones(2)
    apart: FloatArray = np.ones(2)
    nodes: IntArray = np.zeros(2, np.int64)


#: Over flat ground, which hides nothing.
CLEAR = Sight()


@njit(cache=True, error_model='numpy')
def _near(value: float, first: float, step: float, number: int) -> int:
    return min(max(np.int64(math.floor((value - first) / step + 0.5)), 0), number - 1)


@njit(cache=True, error_model='numpy')
def is_hidden(sight: Sight, layer: int, x0: float, y0: float, x: float, y: float) -> bool:
    """Return whether ground at x, y is hidden from a robot at x0, y0.

    Both are rounded to the positions of a table.
    """
    height, values = sight.heights[layer], sight.values
    if values.size == 0:
        return hides(sight.surface, x0, y0, height, x, y)
    a = _near(x0, sight.lower[0], sight.apart[0], values.shape[1])
    b = _near(y0, sight.lower[1], sight.apart[1], values.shape[2])
    i = _near(x, sight.lower[0], sight.step[0], sight.nodes[0])
    j = _near(y, sight.lower[1], sight.step[1], sight.nodes[1])
    from_x, from_y = sight.lower[0] + a * sight.apart[0], sight.lower[1] + b * sight.apart[1]
    u = i - _window(sight, 0, from_x, values.shape[3])
    v = j - _window(sight, 1, from_y, values.shape[4])
    if not (0 <= u < values.shape[3] and 0 <= v < values.shape[4]):
        return hides(sight.surface, x0, y0, height, x, y)
    known = values[layer, a, b, u, v]
    if known == 0:
        to_x, to_y = sight.lower[0] + i * sight.step[0], sight.lower[1] + j * sight.step[1]
        hidden = hides(sight.surface, from_x, from_y, height, to_x, to_y)
        known = _HIDDEN if hidden else _SEEN
        values[layer, a, b, u, v] = known
    return known == _HIDDEN


@njit(cache=True, error_model='numpy')
def _window(sight: Sight, axis: int, position: float, width: int) -> int:
    """Return the first node of the window around a position."""
    middle = np.int64(math.floor((position - sight.lower[axis]) / sight.step[axis] + 0.5))
    return min(max(middle - width // 2, 0), sight.nodes[axis] - width)


class SightTables:
    """The table of a team, retained as long as terrain, map, heights and sensors are the same."""

    def __init__(self) -> None:
        self._terrain: Terrain | None = None
        self._key: tuple[float, ...] = ()
        self._sight = CLEAR

    def of(self, exploration: UnexploredMap, views: Iterable[RobotView]) -> Sight:
        """Return the table for the robots of a team, at the heights of their waypoints."""
        terrain = exploration.area.terrain
        if terrain is None:
            return CLEAR
        heights, reach = set(), 0.0
        for view in views:
            heights.add(round(view.height, 1))
            reach = max(reach, reach_of(view.sensor.detection)[0])
        key = *sorted(heights), reach, *exploration.step.tolist()
        if terrain is not self._terrain or key != self._key:
            self._terrain, self._key = terrain, key
            self._sight = _table(exploration, terrain, np.array(sorted(heights)), reach)
        return self._sight


def _table(
    exploration: UnexploredMap, terrain: Terrain, heights: FloatArray, reach: float
) -> Sight:
    _, lower, step = exploration.kernel()
    nodes, step = np.array(exploration.values.shape), step[:2].copy()
    width = np.minimum(2.0 * np.ceil(reach / step) + 3.0, nodes).astype(int)
    values = np.zeros((0, 0, 0, 0, 0), np.uint8)
    for share in STEPS:
        number = np.ceil((nodes - 1) / share).astype(int) + 1
        if math.prod(map(float, (len(heights), *number, *width))) <= MOST_BYTES:
            values = np.zeros((len(heights), *number, *width), np.uint8)
            break
    return Sight(terrain.surface, heights, values, lower[:2].copy(), step, share * step, nodes)


def layer_of(sight: Sight, height: float) -> int:
    """Return the index of a height [m] in a table."""
    return int(np.abs(sight.heights - height).argmin())


def probability_over(
    area: Area, detection: DetectionModel, points: FloatArray, pose: Pose
) -> FloatArray:
    """Return pi (n,) at points (n, d) for a pose whose height is above the ground."""
    if area.terrain is not None:
        pose = Pose(area.above_ground(pose.position), pose.orientation)
    return probability_in_sight(detection, points, pose, area.terrain)
