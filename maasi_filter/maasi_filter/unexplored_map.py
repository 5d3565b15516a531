"""The exploration function e(x) on a grid: 1 is unseen, 0 is explored (000, eq. (20), (30))."""

from __future__ import annotations

import math
from functools import cached_property

import numpy as np
import shapely
from numba import njit
from numpy.typing import ArrayLike
from shapely.geometry.base import BaseGeometry

from maasi_filter.arrays import FloatArray
from maasi_filter.geometry.area import Area
from maasi_filter.models.detection import (
    BOX,
    CUSTOM,
    REACH,
    DetectionModel,
    detection_probability_at,
)
from maasi_filter.models.line_of_sight import probability_in_sight
from maasi_filter.models.pose import Pose
from maasi_filter.reports import SEARCHED, SIGHTING, Report, sighting_of

# Density samples per cell on each axis, and the number on a whole axis above which a cell
# gets fewer.
_PARTS, _SAMPLES = 5, 1000
_MOST_SHARED = 200_000  # cells of which the share in a searched zone is computed
# Cells along the mean side of the environment, in 2D and 3D.
CELLS = {2: 54, 3: 13}
MAXIMUM_NODES = 20_000_000
# Cells across a swath, unless the map then has more cells than this: with 1,000,000
# decisions take 0.1 s.
SWATH_CELLS, MOST_CELLS = 3.0, 1_000_000
MOST_SHOWN = 300  # cells per axis of published, stored and drawn maps
_ROUNDING = 1e-9  # of shares of cells that are open


@njit(cache=True, error_model='numpy')
def interpolate_at(
    values: FloatArray, lower: FloatArray, step: FloatArray, x: float, y: float, z: float
) -> float:
    """Return the multilinear interpolation of a grid (nx, ny, nz) at one position, clamped to it.

    The first node is at `lower` (3,), and nodes are `step` (3,) apart, metres; in 2D nz is 1 and z
    is ignored.
    """
    u = min(max((x - lower[0]) / step[0], 0.0), values.shape[0] - 1.0)
    i = min(np.int64(u), values.shape[0] - 2)
    u -= i
    v = min(max((y - lower[1]) / step[1], 0.0), values.shape[1] - 1.0)
    j = min(np.int64(v), values.shape[1] - 2)
    v -= j
    if values.shape[2] == 1:
        low = (1.0 - v) * values[i, j, 0] + v * values[i, j + 1, 0]
        high = (1.0 - v) * values[i + 1, j, 0] + v * values[i + 1, j + 1, 0]
        return (1.0 - u) * low + u * high
    w = min(max((z - lower[2]) / step[2], 0.0), values.shape[2] - 1.0)
    k = min(np.int64(w), values.shape[2] - 2)
    w -= k
    a = (1.0 - w) * values[i, j, k] + w * values[i, j, k + 1]
    b = (1.0 - w) * values[i, j + 1, k] + w * values[i, j + 1, k + 1]
    c = (1.0 - w) * values[i + 1, j, k] + w * values[i + 1, j, k + 1]
    e = (1.0 - w) * values[i + 1, j + 1, k] + w * values[i + 1, j + 1, k + 1]
    return (1.0 - u) * ((1.0 - v) * a + v * b) + u * ((1.0 - v) * c + v * e)


@njit(cache=True, error_model='numpy')
def _interpolate_many(
    values: FloatArray, lower: FloatArray, step: FloatArray, positions: FloatArray
) -> FloatArray:
    out = np.empty(positions.shape[0])
    solid = positions.shape[1] == 3
    for i in range(positions.shape[0]):
        z = positions[i, 2] if solid else 0.0
        out[i] = interpolate_at(values, lower, step, positions[i, 0], positions[i, 1], z)
    return out


def default_spacing(bounds: FloatArray) -> float:
    """Return the default spacing of the grid, metres."""
    size = bounds[:, 1] - bounds[:, 0]
    return float(np.prod(size)) ** (1.0 / len(bounds)) / CELLS[len(bounds)]


def spacing_for(bounds: FloatArray, swath: float) -> tuple[float, bool]:
    """Return the spacing of a grid on which a swath [m] is resolved, and whether it is too coarse.

    It is `default_spacing`, or a third of the swath if that is less, within `MOST_CELLS` cells. It
    is too coarse if the swath is narrower than a cell.
    """
    size = bounds[:, 1] - bounds[:, 0]
    least = (float(np.prod(size)) / MOST_CELLS) ** (1.0 / len(bounds))
    spacing = min(default_spacing(bounds), max(swath / SWATH_CELLS, least))
    return spacing, spacing > swath


def reach_of(detection: DetectionModel) -> tuple[float, float]:
    """Return the horizontal and the vertical distance beyond which pi is 0 [m], or inf."""
    kind, parameters = detection.kernel()
    if kind == CUSTOM:
        return float(parameters[REACH]), float(parameters[REACH])
    if kind != BOX:
        return math.inf, math.inf
    x, y, z = np.maximum(np.abs(parameters[1:4]), np.abs(parameters[4:7])).tolist()
    edge = 2.0 * float(parameters[7])
    return math.hypot(x, y) + edge, z + edge


@njit(cache=True, error_model='numpy')
def _update_near(
    values: FloatArray,
    lower: FloatArray,
    step: FloatArray,
    kernel: tuple[int, FloatArray],
    pose: tuple[FloatArray, float, float],
    reach: tuple[float, float],
    solid: bool,
) -> None:
    """Multiply values (nx, ny, nz) by 1 - pi at the nodes within the reach of a pose."""
    position, cosine, sine = pose
    kind, parameters = kernel
    low, high = np.zeros(3, np.int64), np.ones(3, np.int64)
    for axis in range(3 if solid else 2):
        middle, last = (position[axis] - lower[axis]) / step[axis], float(values.shape[axis])
        width = (reach[1] if axis == 2 else reach[0]) / step[axis]
        # Bounded as floats, as infinite numbers are not integers.
        low[axis] = np.int64(min(max(np.floor(middle - width), 0.0), last))
        high[axis] = np.int64(min(max(np.ceil(middle + width) + 1.0, 0.0), last))
    for i in range(low[0], high[0]):
        dx = lower[0] + step[0] * i - position[0]
        for j in range(low[1], high[1]):
            dy = lower[1] + step[1] * j - position[1]
            for k in range(low[2], high[2]):
                dz = lower[2] + step[2] * k - position[2] if solid else 0.0
                values[i, j, k] *= 1.0 - detection_probability_at(
                    kind, parameters, dx, dy, dz, cosine, sine
                )


class UnexploredMap:
    """The exploration function e on a grid: 1 is unseen, 0 is explored.

    Parameters
    ----------
    area : Area or (d, 2) array
        Search area, or its bounds on each axis, metres; d = 2 or 3.
    spacing : float, optional
        Largest spacing of the nodes, metres; default: `default_spacing`. The spacing of each axis
        is reduced so that nodes are on both bounds.

    Attributes
    ----------
    values : (nx, ny) or (nx, ny, nz) array
        e at the nodes, in [0, 1].
    step : (d,) array
        Spacing on each axis, metres.
    volume : float
        Volume of the area, m^d.
    ground : array
        Volume of each node's cell times its density, of all cells that are or were open; the shape
        is that of `values`.

    Raises
    ------
    ValueError
        If the bounds or the spacing are invalid, or the grid would be too large.
    """

    def __init__(self, area: Area | ArrayLike, spacing: float | None = None) -> None:
        area = Area.of(area)
        self.bounds = area.bounds
        if spacing is None:
            spacing = default_spacing(self.bounds)
        if not (math.isfinite(spacing) and spacing > 0.0):
            raise ValueError(f'spacing: got {spacing}, allowed are finite numbers above 0')
        self.spacing = float(spacing)
        self.dimension = len(self.bounds)
        size = self.bounds[:, 1] - self.bounds[:, 0]
        cells = np.maximum(1.0, np.ceil(size / spacing - 1e-9))
        if np.prod(cells + 1.0) > MAXIMUM_NODES:
            raise ValueError(
                f'spacing: got {spacing}, which needs {np.prod(cells + 1.0):.3g} nodes, '
                f'allowed are at most {MAXIMUM_NODES}'
            )
        self.step = size / cells
        shape = [int(number) + 1 for number in cells]
        self._values = np.ones(shape + [1] * (3 - self.dimension))
        height = [0.0] * (3 - self.dimension)
        self._lower = np.array([*self.bounds[:, 0], *height])
        self._step = np.array([*self.step, *height])
        cells = np.ones(())
        for number, step in zip(shape, self.step):
            lengths = np.full(number, step)
            lengths[[0, -1]] *= 0.5
            cells = np.multiply.outer(cells, lengths)
        self._cells = cells
        self._adopt(area)
        self.ground, self._ever_open = self._volumes, self._open

    def adopt_area(self, area: Area) -> None:
        """Change keep-outs or obstacles: `area` has the same bounds, and e is retained.

        Cells that were open once continue to count as ground, and sightings remain.
        """
        self._adopt(area.with_sightings(self.area.sightings) if self.area.sightings else area)
        opened = np.broadcast_to(self._open > self._ever_open + _ROUNDING, self._values.shape)
        opened = opened.reshape(self.values.shape)
        if not opened.any():
            return
        # Both densities are relative to their areas; unchanged cells give the scale.
        same = (np.abs(self._open - self._ever_open) <= _ROUNDING) & (self._open > 0.0)
        same = np.broadcast_to(same, self._values.shape).reshape(self.values.shape)
        same = same & (self._volumes > 0.0)
        scale = float(np.median(self.ground[same] / self._volumes[same])) if same.any() else 1.0
        added = np.maximum(self.ground, scale * self._volumes)
        self.ground = np.where(opened, added, self.ground)
        self._ever_open = np.maximum(self._open, self._ever_open)

    def adopt_sightings(self, area: Area) -> None:
        """Change the sightings of the same area; the intensity that was searched stays the same.

        e' = 1 - (1 - e) N0 f / (N0' f') with the prior f and the expected targets N0.
        """
        before, ground = self.area.expected_targets * self._volumes, self.ground
        expected = self.area.expected_targets
        self._adopt(area)
        after = area.expected_targets * self._volumes
        kept = np.clip(before / np.maximum(after, 1e-300), 0.0, 1.0)
        values = self.values
        values[...] = 1.0 - (1.0 - values) * np.where(after > 0.0, kept, 1.0)
        self.ground = (expected * ground + np.maximum(after - before, 0.0)) / area.expected_targets

    def search(self, zone: BaseGeometry, probability: float) -> None:
        """Multiply e by 1 - p in the share of each cell that others have searched."""
        if zone.is_empty:
            return
        west, south, east, north = zone.bounds
        axes, near = self.axes()[:2], []
        for axis, low, high, step in zip(axes, (west, south), (east, north), self.step):
            first, last = np.searchsorted(axis, (low - step, high + step))
            near.append(slice(int(first), int(last)))
        # Large parts of a fine map by the nodes alone.
        number = _PARTS if np.prod([part.stop - part.start for part in near]) < _MOST_SHARED else 1
        parts = (np.arange(number) + 0.5) / number - 0.5
        x, y = (
            np.clip(axis[part][:, None] + parts * step, *bounds).ravel()
            for axis, part, step, bounds in zip(axes, near, self.step, self.bounds)
        )
        if not (len(x) and len(y)):
            return
        shapely.prepare(zone)
        inside = shapely.contains_xy(zone, *np.meshgrid(x, y, indexing='ij'))
        share = inside.reshape(-1, number, len(y) // number, number).mean(axis=(1, 3))
        self._values[near[0], near[1]] *= 1.0 - probability * share[:, :, None]

    def use(self, report: Report) -> None:
        """Use a sighting, or a search by others; reviews change nothing here."""
        if report.kind == SIGHTING:
            sightings = (*self.area.sightings, sighting_of(report))
            self.adopt_sightings(self.area.with_sightings(sightings))
        elif report.kind == SEARCHED:
            self.search(report.shape, report.weight)

    def _adopt(self, area: Area) -> None:
        self.area, self.volume = area, area.volume
        #: Prior times inside at the nodes, (nx, ny, 1), with mean 1 over the area; 1: uniform.
        self.density = np.ones((1, 1, 1))
        # Share of each cell where targets may be.
        self._open = np.ones((1, 1, 1))
        self._volumes = self._cells
        if area.uniform:
            return
        shape = self._values.shape[:2]
        number = [min(_PARTS, -(-_SAMPLES // count)) for count in shape]
        x, y = (
            np.clip(axis[:, None] + ((np.arange(n) + 0.5) / n - 0.5) * step, low, high)
            for n, axis, step, (low, high) in zip(number, self.axes(), self.step, self.bounds)
        )
        self.density, self._open = np.empty((2, *shape, 1))
        # Row by row, which needs less memory.
        rows = max(1, _SAMPLES**2 // (number[0] * y.size))
        for first in range(0, shape[0], rows):
            part = x[first : first + rows]
            positions = np.stack(np.meshgrid(part.ravel(), y.ravel(), indexing='ij'), axis=-1)
            density = area.density(positions.reshape(-1, 2)).reshape(*part.shape, *y.shape)
            self.density[first : first + rows, :, 0] = density.mean(axis=(1, 3))
            self._open[first : first + rows, :, 0] = (density > 0.0).mean(axis=(1, 3))
        if not self.density.any():
            # The area is narrower than the spacing of samples.
            low = self._lower[:2] - 0.5 * self._step[:2]
            self.density = self._open = area.outline(low, self._step[:2], shape)[:, :, None]
        volumes = self._cells.reshape(self._values.shape) * self.density
        self._volumes = volumes.reshape(self.values.shape)

    @property
    def values(self) -> FloatArray:
        """Values of e at the nodes; a view, which is written by `values[...] =`."""
        return self._values if self.dimension == 3 else self._values[:, :, 0]

    def axes(self) -> list[FloatArray]:
        """Return the coordinates of the nodes on each axis, metres."""
        parts = zip(self._lower, self._step, self.values.shape)
        return [lower + step * np.arange(number) for lower, step, number in parts]

    def nodes(self) -> FloatArray:
        """Return the positions of all nodes, (n, d), metres, in the order of `values.ravel()`."""
        return self._nodes

    @cached_property
    def _nodes(self) -> FloatArray:
        grids = np.meshgrid(*self.axes(), indexing='ij')
        return np.array([grid.ravel() for grid in grids]).T

    def kernel(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return values (nx, ny, nz), lower (3,) and step (3,) for `interpolate_at`."""
        return self._values, self._lower, self._step

    def update(self, detection: DetectionModel, pose: Pose) -> None:
        """Multiply e by 1 - pi for one measurement at `pose` (000, eq. (20)).

        What terrain hides from there stays unseen.
        """
        reach = reach_of(detection)
        if self.area.terrain is not None:
            self._update_in_sight(detection, pose, reach[0])
            return
        if math.isinf(reach[0]):
            missed = 1.0 - detection.probability(self._nodes, pose)
            self._values *= missed.reshape(self._values.shape)
            return
        turn = pose.position, math.cos(pose.yaw), math.sin(pose.yaw)
        solid = self.dimension == 3
        _update_near(*self.kernel(), detection.kernel(), turn, reach, solid)

    def _update_in_sight(self, detection: DetectionModel, pose: Pose, reach: float) -> None:
        near = tuple(
            slice(*np.searchsorted(axis, (at - reach, at + reach + 1e-9)).tolist())
            for axis, at in zip(self.axes(), pose.position)
        )
        values = self.values[near]
        points = self._nodes.reshape(*self.values.shape, 2)[near].reshape(-1, 2)
        found = probability_in_sight(detection, points, pose, self.area.terrain)
        values *= 1.0 - found.reshape(values.shape)

    def diffuse(self, variance: float) -> None:
        """Diffuse e for targets in a random walk with `variance` [m^2] and reflecting bounds."""
        values = self.values
        for axis in range(self.dimension):
            rate = 0.5 * variance / float(self.step[axis]) ** 2
            # The explicit scheme is stable and positive up to a ratio of 1/2.
            parts = max(1, math.ceil(rate / 0.25))
            for _ in range(parts):
                flow = rate / parts * np.diff(values, axis=axis)
                values += np.diff(flow, axis=axis, prepend=0.0, append=0.0)

    def at(self, positions: ArrayLike) -> FloatArray:
        """Return e at positions (n, d) [m], shape (n,), by multilinear interpolation.

        Positions outside of the bounds are moved to the nearest point on them.
        """
        array = np.ascontiguousarray(np.atleast_2d(np.asarray(positions, dtype=float)))
        if array.shape[1] < self.dimension:
            raise ValueError(
                f'positions: got shape {array.shape}, allowed is (n, {self.dimension})'
            )
        array = np.ascontiguousarray(array[:, : self.dimension])
        if not np.isfinite(array).all():
            raise ValueError('positions: got a number that is not finite')
        return _interpolate_many(self._values, self._lower, self._step, array)

    def cell_volumes(self) -> FloatArray:
        """Return the volume (2D: area) of each node's cell times its density, shaped as `values`.

        Cells at the ends of an axis have half a step. The density is the prior in the open area,
        with mean 1, and 0 elsewhere.
        """
        return self._volumes

    def unseen(self) -> FloatArray:
        """Return e at the nodes, shaped as `values`; -1 where no target can be."""
        shown = np.where(self.density > 0.0, self._values, -1.0)
        return np.asarray(shown.reshape(self.values.shape))

    def shown(self, prior: bool = False) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the first node (d,), steps (d,) [m] and `unseen`, or the density, for display.

        A fine map is averaged over blocks to at most `MOST_SHOWN` nodes on each axis.
        """
        values, number = self.unseen(), -(-max(self.values.shape) // MOST_SHOWN)
        if prior:
            values = np.broadcast_to(self.density, self._values.shape).reshape(values.shape)
        if number > 1:
            counts = (values >= 0.0).astype(float)
            values = values * counts
            for axis, size in enumerate(values.shape):
                begin = np.arange(0, size, number)
                values, counts = (np.add.reduceat(part, begin, axis) for part in (values, counts))
            values = np.where(counts > 0.0, values / np.maximum(counts, 1.0), -1.0)
        return self.bounds[:, 0] + 0.5 * (number - 1) * self.step, number * self.step, values

    def explored_fraction(self) -> float:
        """Return the explored share of the ground, in [0, 1]; closed ground counts."""
        return 1.0 - float((self.ground * self.values).sum() / self.ground.sum())

    def describe(self) -> str:
        """Return the explored share in words."""
        return f'{100.0 * self.explored_fraction():.1f} % of the environment is explored'

    def closed_share(self) -> float:
        """Return the share of the expected targets that is unseen on ground closed later."""
        closed = self._ever_open - self._open > _ROUNDING
        if not closed.any():
            return 0.0
        left = np.where(closed, 1.0 - self._open / np.maximum(self._ever_open, _ROUNDING), 0.0)
        left = np.broadcast_to(left, self._values.shape).reshape(self.values.shape)
        return float((left * self.ground * self.values).sum() / self.ground.sum())

    def copy(self) -> UnexploredMap:
        """Return an independent copy."""
        other = UnexploredMap(self.area, self.spacing)
        other._values[...] = self._values
        other.ground, other._ever_open = self.ground, self._ever_open
        return other
