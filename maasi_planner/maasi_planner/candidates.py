"""Candidate waypoints, and the parts of an area that are invisible from them."""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from maasi_filter.arrays import BoolArray, FloatArray
from maasi_filter.geometry.area import Area
from maasi_filter.models.detection import (
    BOX,
    CUSTOM,
    EXPONENTIAL,
    GAUSSIAN,
    detection_probability_at,
)
from maasi_filter.models.sensor import Sensor
from maasi_filter.unexplored_map import UnexploredMap, spacing_for
from maasi_planner.objective.predicted_measurements import reach_of
from maasi_planner.settings import CandidateSettings


class CandidateSet:
    """Candidate waypoints of one robot: a grid, a ring, or a list."""

    def __init__(
        self, settings: CandidateSettings, area: Area | ArrayLike, height: float = 0.0
    ) -> None:
        self.settings = settings
        self.area = Area.of(area)
        self.bounds = self.area.bounds
        self.dimension = len(self.bounds)
        self.height = float(height)
        if not math.isfinite(self.height):
            raise ValueError(f'height: got {height}, allowed are finite numbers')
        self._fixed = None
        if settings.grid is not None:
            self._fixed = self._complete(self._grid())
        elif settings.points is not None:
            self._fixed = self._complete(np.array(settings.points, dtype=float))
        else:
            steps = [(1.0, 0.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, -1.0, 0.0)]
            if settings.ring == 6:
                if self.dimension == 2:
                    raise ValueError('ring: got 6, allowed in 2D are 4 and 8')
                steps += [(0.0, 0.0, 1.0), (0.0, 0.0, -1.0)]
            elif settings.ring == 8:
                half = math.sqrt(0.5)
                steps += [(half, half, 0.0), (-half, half, 0.0), (-half, -half, 0.0)]
                steps.append((half, -half, 0.0))
            self._ring = (settings.distance or 0.0) * np.array(steps)

    def _grid(self) -> FloatArray:
        settings = self.settings
        numbers = settings.grid or []
        if len(numbers) != self.dimension:
            raise ValueError(
                f'grid: got {numbers}, allowed in {self.dimension}D are {self.dimension} numbers'
            )
        spacing = np.broadcast_to(np.array(settings.spacing, dtype=float), (self.dimension,))
        if settings.corner is not None:
            corner = np.array(settings.corner, dtype=float)
        else:
            corner = self.bounds.mean(axis=1) - 0.5 * (spacing * (np.array(numbers) - 1))
        return corner + spacing * np.indices(numbers).reshape(self.dimension, -1).T

    def _complete(self, points: FloatArray) -> FloatArray:
        if points.ndim != 2 or points.shape[1] not in (self.dimension, 3):
            raise ValueError(
                f'points: got shape {points.shape}, allowed in {self.dimension}D are '
                f'(n, {self.dimension})'
            )
        inside = self.area.inside(points)
        outside = points[~(Area(self.bounds).inside(points) if self.settings.grid else inside)]
        if len(outside):
            raise ValueError(
                f'candidates: got a waypoint at {outside[0].tolist()}, allowed are waypoints '
                f'inside {self.bounds.tolist()}'
            )
        points = points[inside]
        complete = np.full((len(points), 3), self.height)
        complete[:, : points.shape[1]] = points
        return complete

    def restrict(self, area: Area) -> None:
        """Keep only candidates inside a smaller area."""
        self.area = area
        if self._fixed is not None:
            self._fixed = self._fixed[area.inside(self._fixed)]

    def at(self, position: ArrayLike) -> FloatArray:
        """Return the candidates at a position (3,), (W, 3), without those outside."""
        if self._fixed is not None:
            return self._fixed.copy()
        points = np.asarray(position, dtype=float)[None, :] + self._ring
        if self.dimension == 2:
            points[:, 2] = self.height
        return points[self.area.inside(points)]


@dataclass
class Unseen:
    """Share of the area that no robot can see, and bounds (d, 2) [m] of its largest parts."""

    fraction: float
    boxes: list[FloatArray]

    def __bool__(self) -> bool:
        return bool(self.boxes)

    def describe(self) -> str:
        """Return a warning about the parts, or an empty text."""
        if not self.boxes:
            return ''
        parts = []
        for box in self.boxes[:6]:
            axes = ', '.join(
                f'{name} {low:.3g} to {high:.3g} m' for name, (low, high) in zip('xyz', box)
            )
            parts.append(f'({axes})')
        more = f' and {len(self.boxes) - 6} more' if len(self.boxes) > 6 else ''
        return (
            f'{_percent(self.fraction)} of the environment can never be seen from the '
            f'candidates: {"; ".join(parts)}{more}'
        )


def _percent(share: float) -> str:
    percent = 100.0 * share
    if percent < 0.01:
        return 'less than 0.01 %'
    return f'{percent:.0f} %' if percent >= 10.0 else f'{percent:.2g} %'


@dataclass
class Viewer:
    """One robot for `unseen_parts`.

    candidates (W, 3) and start (3,): metres; spacing: distance between measurements on the path,
    metres; yaw: constant heading, radians; None: that of travel.
    """

    candidates: FloatArray
    start: FloatArray
    sensor: Sensor
    spacing: float
    yaw: float | None = None


def unseen_parts(
    area: Area | ArrayLike,
    viewers: Iterable[Viewer],
    margin: float = 0.0,
    probability: float = 0.01,
    cells: int = 80,
) -> Unseen:
    """Return the parts that are invisible from all straight paths between candidates."""
    area = Area.of(area)
    box = np.stack([area.bounds[:, 0] + margin, area.bounds[:, 1] - margin], axis=1)
    size = float((box[:, 1] - box[:, 0]).max())
    grid = UnexploredMap(box, size / (cells if len(box) == 2 else min(cells, 40)))
    values, lower, step = grid.kernel()
    seen = np.ascontiguousarray(area.density(grid.nodes()).reshape(values.shape) <= 0.0)
    for viewer in viewers:
        positions, yaws = _poses(viewer, size)
        detection = viewer.sensor.detection
        kernel, reach = detection.kernel(), reach_of(detection)
        _mark_seen(seen, (lower, step), positions, yaws, grid.dimension, kernel, reach, probability)
    return _parts(grid, seen)


@njit(cache=True)
def _mark_seen(
    seen: BoolArray,
    grid: tuple[FloatArray, FloatArray],
    positions: FloatArray,
    yaws: FloatArray,
    dimension: int,
    kernel: tuple[int, FloatArray],
    reach: float,
    probability: float,
) -> None:
    """Mark nodes that some pose sees in seen (nx, ny, nz); `grid`: first node and distances."""
    lower, step = grid
    kind, parameters = kernel
    low, high = np.zeros(3, np.int64), np.array(seen.shape)
    left = seen.size - np.sum(seen)
    for m in range(positions.shape[0]):
        if left == 0:
            break
        cosine = math.cos(yaws[m])
        sine = math.sin(yaws[m])
        for axis in range(3):
            if reach < np.inf and step[axis] > 0.0:
                centre = (positions[m, axis] - lower[axis]) / step[axis]
                width = reach / step[axis]
                low[axis] = max(math.floor(centre - width), 0)
                high[axis] = min(math.ceil(centre + width) + 1, seen.shape[axis])
        for i in range(low[0], high[0]):
            for j in range(low[1], high[1]):
                for k in range(low[2], high[2]):
                    if seen[i, j, k]:
                        continue
                    dz = lower[2] + k * step[2] - positions[m, 2] if dimension == 3 else 0.0
                    found = detection_probability_at(
                        kind,
                        parameters,
                        lower[0] + i * step[0] - positions[m, 0],
                        lower[1] + j * step[1] - positions[m, 1],
                        dz,
                        cosine,
                        sine,
                    )
                    if found >= probability:
                        seen[i, j, k] = True
                        left -= 1


def _poses(viewer: Viewer, size: float) -> tuple[FloatArray, FloatArray]:
    """Return thinned positions (n, 3) and headings (n,) on all paths between candidates."""
    points = np.vstack([viewer.start[None, :], viewer.candidates])
    paths = viewer.candidates[None, :, :] - points[:, None, :]
    lengths = np.sqrt((paths * paths).sum(axis=2))
    number = max(1, math.ceil(float(lengths.max(initial=0.0)) / viewer.spacing))
    # Backwards, so that the view on arrival is included.
    along = np.arange(number + 1) * viewer.spacing
    share = np.maximum(0.0, 1.0 - along / np.maximum(lengths, 1e-12)[..., None])
    positions = points[:, None, None, :] + share[..., None] * paths[:, :, None, :]
    if viewer.yaw is None:
        yaws = np.arctan2(paths[..., 1], paths[..., 0])
    else:
        yaws = np.full(lengths.shape, viewer.yaw)
    headings = np.broadcast_to(yaws[..., None], positions.shape[:3]).ravel()
    flat = positions.reshape(-1, 3)
    sectors = np.zeros(len(flat), np.int64)
    kind, parameters = viewer.sensor.detection.kernel()
    # Whether the view depends on the heading.
    turns = kind == CUSTOM or (kind == BOX and bool(parameters[8] > 0.5))
    if viewer.yaw is None and turns:
        sectors = np.round(headings / (math.pi / 8.0)).astype(np.int64) % 16
    cells = np.round(flat / (size / 100.0)).astype(np.int64)
    cells -= cells.min(axis=0)
    spans = cells.max(axis=0) + 1
    keys = ((cells[:, 0] * spans[1] + cells[:, 1]) * spans[2] + cells[:, 2]) * 16 + sectors
    _, first = np.unique(keys, return_index=True)
    return np.ascontiguousarray(flat[first]), np.ascontiguousarray(headings[first])


def half_view(sensor: Sensor) -> float:
    """Return the horizontal reach of a sensor to each side [m]: half its box, or F."""
    kind, parameters = sensor.detection.kernel()
    if kind == BOX:
        low, high = parameters[1:3], parameters[4:6]
        return 0.5 * float((high - low).min())
    scale = float(parameters[1:3].max())
    return 1.0 / scale if scale > 0.0 else math.inf


def swath_of(sensor: Sensor) -> float:
    """Return the width of the view with at least half of the best detection [m], or inf.

    For a box it is the smaller side.
    """
    kind, width = sensor.detection.kernel()[0], 2.0 * half_view(sensor)
    if kind == EXPONENTIAL:
        return width * 2.0 * math.log(2.0)
    return width * math.sqrt(2.0 * math.log(2.0)) if kind == GAUSSIAN else width


def map_spacing(bounds: FloatArray, sensors: Iterable[Sensor]) -> tuple[float, str]:
    """Return the spacing of a team's exploration map [m], and a warning if it is too coarse."""
    swath = min(map(swath_of, sensors), default=math.inf)
    spacing, coarse = spacing_for(bounds, swath)
    if not coarse:
        return spacing, ''
    return spacing, (
        f'the exploration map has cells of {spacing:.3g} m, but a sensor sees a swath of only '
        f'{swath:.3g} m: the explored share is underestimated; search a smaller area, or set '
        'filter.exploration_spacing [m]'
    )


def _parts(grid: UnexploredMap, seen: BoolArray) -> Unseen:
    hidden = ~seen.reshape(grid.values.shape)
    if not hidden.any():
        return Unseen(0.0, [])
    from scipy import ndimage

    volumes = grid.cell_volumes()
    fraction = float(volumes[hidden].sum() / volumes.sum())
    labels, number = ndimage.label(hidden)
    sizes = np.bincount(labels.ravel(), minlength=number + 1)[1:]
    axes = grid.axes()
    half = 0.5 * grid.step
    boxes = []
    for region in ndimage.find_objects(labels):
        ends = [[axis[part][0], axis[part][-1]] for axis, part in zip(axes, region)]
        low, high = np.array(ends).T
        low = np.maximum(low - half, grid.bounds[:, 0])
        boxes.append(np.stack([low, np.minimum(high + half, grid.bounds[:, 1])], axis=1))
    return Unseen(fraction, [boxes[i] for i in np.argsort(-sizes, kind='stable')])
