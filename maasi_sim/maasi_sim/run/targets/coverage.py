"""What was searched, as a search coordinator counts it: passes over the ground, and sectors."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from maasi_filter.arrays import BoolArray, FloatArray
from maasi_filter.geometry.terrain import Terrain
from maasi_filter.models.detection import DetectionModel
from maasi_filter.models.line_of_sight import probability_in_sight
from maasi_filter.models.pose import Pose
from maasi_filter.unexplored_map import UnexploredMap, reach_of
from maasi_sim.run.log import RunLog

_CELLS = {2: 150, 3: 40}  # along the longest side
_MOST_POLYGONS = 12  # of an area that are sectors
_LETTERS = 'ABC'  # columns of sectors, from the west
# Detection probability from which ground is searched: relative to the sensor's largest, at least.
_SEEN, _LEAST = 0.5, 1e-6


@dataclass(frozen=True)
class Sector:
    """A part of the area: its probability of area (POA) and of detection (POD) until now."""

    name: str
    shape: BaseGeometry
    poa: float
    pod: float

    @property
    def pos(self) -> float:
        """Cumulative probability of success."""
        return self.poa * self.pod


def searched_at_least(record: RunLog, explored: UnexploredMap) -> tuple[list[float], float]:
    """Return the shares of the open ground that were searched once and twice, and its size.

    Consecutive measurements of one robot that see a location search it once. The size is in
    square metres, in space in cubic metres.
    """
    area, dimension = explored.area, explored.dimension
    low, high = explored.bounds.T
    cell = float((high - low).max()) / _CELLS[dimension]
    numbers = np.maximum(1, np.ceil((high - low) / cell - 1e-9)).astype(int)
    axes = [a + (b - a) * (np.arange(n) + 0.5) / n for a, b, n in zip(low, high, numbers)]
    passes = np.zeros(numbers, np.int64)
    for name, poses in record.measured_from.items():
        sensor = record.scenario.robots[name].sensor.build(name, dimension)
        before = np.zeros(passes.shape, bool)
        measured = [pose for _, pose in poses]
        for seen in _fields(axes, sensor.detection, measured, area.terrain):
            passes += seen & ~before
            before = seen
    ground = np.stack(np.meshgrid(*axes[:2], indexing='ij'), axis=-1)
    opened = passes[(area.density(ground.reshape(-1, 2)) > 0.0).reshape(ground.shape[:2])]
    size = float(np.prod(high - low)) * opened.size / passes.size
    return [float((opened >= number).mean()) if opened.size else 0.0 for number in (1, 2)], size


def _fields(
    axes: Sequence[FloatArray],
    detection: DetectionModel,
    poses: Sequence[Pose],
    terrain: Terrain | None,
) -> Iterator[BoolArray]:
    """Yield the cells that each measurement of a robot has searched."""
    largest = [_probabilities(axes, detection, pose, None)[1].max(initial=0.0) for pose in poses]
    least = max(_SEEN * max(largest, default=0.0), _LEAST)
    for pose in poses:
        seen = np.zeros([len(axis) for axis in axes], bool)
        near, values = _probabilities(axes, detection, pose, terrain)
        seen[near] = values >= least
        yield seen


def _probabilities(
    axes: Sequence[FloatArray], detection: DetectionModel, pose: Pose, terrain: Terrain | None
) -> tuple[tuple[slice, ...], FloatArray]:
    """Return the detection probabilities in the cells within reach, and which these are."""
    near = tuple(
        slice(*np.searchsorted(axis, (at - reach, at + reach)).tolist())
        for axis, at, reach in zip(axes, pose.position, np.repeat(reach_of(detection), [2, 1]))
    )
    parts = [axis[part] for axis, part in zip(axes, near)]
    points = np.stack(np.meshgrid(*parts, indexing='ij'), axis=-1)
    if not points.size:
        return near, np.zeros(points.shape[:-1])
    values = probability_in_sight(detection, points.reshape(-1, len(axes)), pose, terrain)
    return near, np.asarray(values).reshape(points.shape[:-1])


def sectors(explored: UnexploredMap) -> list[Sector]:
    """Return the polygons of an area of several as sectors, else up to 3 x 3 equal boxes."""
    named = _sector_shapes(explored)
    nodes = explored.nodes()[:, :2]
    tree = shapely.STRtree([shape for _, shape in named])
    owner = np.asarray(tree.nearest(shapely.points(nodes)))
    weights = explored.ground.ravel() / explored.ground.sum()
    success = weights * (1.0 - explored.values.ravel())
    poa, pos = (np.bincount(owner, value, len(named)) for value in (weights, success))
    return [
        Sector(name, shape, float(share), float(done / share) if share > 0.0 else 0.0)
        for (name, shape), share, done in zip(named, poa, pos)
        if share > 0.0
    ]


def _sector_shapes(explored: UnexploredMap) -> list[tuple[str, BaseGeometry]]:
    parts = [
        part for shape in explored.area.shapes['area'] for part in shapely.get_parts(shape).tolist()
    ]
    if 1 < len(parts) <= _MOST_POLYGONS:
        return [(str(index), part) for index, part in enumerate(parts, 1)]
    (west, east), (south, north) = explored.bounds[:2]
    sides = np.array([east - west, north - south])
    columns, rows = np.clip(np.rint(3.0 * sides / sides.max()), 1, 3).astype(int).tolist()
    x, y = np.linspace(west, east, columns + 1), np.linspace(north, south, rows + 1)
    return [
        (f'{_LETTERS[i]}{j + 1}', shapely.box(x[i], y[j + 1], x[i + 1], y[j]))
        for j in range(rows)
        for i in range(columns)
    ]
