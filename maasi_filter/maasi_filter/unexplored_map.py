"""The exploration function e(x) on a grid: what is still unseen (000, eq. (20), (30))."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from maasi_filter.area import Area
from maasi_filter.arrays import FloatArray
from maasi_filter.models.detection import DetectionModel
from maasi_filter.models.pose import Pose

_PARTS = 5  # places along each axis at which the density of a cell is sampled
# Cells along the mean side of the environment, in 2D and 3D.
CELLS = {2: 54, 3: 13}
MAXIMUM_NODES = 20_000_000


@njit(cache=True, error_model='numpy')
def interpolate_at(
    values: FloatArray, lower: FloatArray, step: FloatArray, x: float, y: float, z: float
) -> float:
    """Return the multilinear interpolation of a grid at one position, clamped to it.

    `values` (nx, ny, nz) are of nodes from `lower` (3,) on, `step` (3,) apart, metres; in 2D nz is
    1, and z plays no part.
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
    """Return the spacing of the grid where none is given, metres."""
    size = bounds[:, 1] - bounds[:, 0]
    return float(np.prod(size)) ** (1.0 / len(bounds)) / CELLS[len(bounds)]


class UnexploredMap:
    """The exploration function e on a grid: 1 is unseen, 0 is explored.

    Parameters
    ----------
    area : Area or (d, 2) array
        Where targets may be, or lower and upper bound on each axis, metres; d = 2 or 3.
    spacing : float, optional
        Wanted spacing of the nodes, metres; none: `default_spacing`. On each axis the largest
        spacing up to this one is used that puts nodes on both bounds.

    Attributes
    ----------
    values : (nx, ny) or (nx, ny, nz) array
        e at the nodes, in [0, 1].
    step : (d,) array
        Spacing used on each axis, metres.
    volume : float
        Of the area, m^d.

    Raises
    ------
    ValueError
        If the bounds or the spacing are not usable, or the grid would be too large.
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
        grids = np.meshgrid(*self.axes(), indexing='ij')
        # One row for each axis, as kernels read them.
        self._nodes = np.array([grid.ravel() for grid in grids]).T
        cells = np.ones(())
        for number, step in zip(shape, self.step):
            lengths = np.full(number, step)
            lengths[[0, -1]] *= 0.5
            cells = np.multiply.outer(cells, lengths)
        self._cells = cells
        self.take_area(area)

    def take_area(self, area: Area) -> None:
        """Take another area within the same bounds; e stays."""
        self.area, self.volume = area, area.volume
        #: Prior times inside at the nodes, (nx, ny, 1), with mean 1 over the area; 1: uniform.
        self.density = np.ones((1, 1, 1))
        self._volumes = self._cells
        if area.uniform:
            return
        parts = (np.arange(_PARTS) + 0.5) / _PARTS - 0.5
        x, y = (
            np.clip(axis[:, None] + parts * step, low, high)
            for axis, step, (low, high) in zip(self.axes()[:2], self.step, self.bounds)
        )
        places = np.stack(np.meshgrid(x.ravel(), y.ravel(), indexing='ij'), axis=-1)
        density = area.density(places.reshape(-1, 2)).reshape(*x.shape, *y.shape)
        self.density = density.mean(axis=(1, 3))[:, :, None]
        volumes = self._cells.reshape(self._values.shape) * self.density
        self._volumes = volumes.reshape(self.values.shape)

    @property
    def values(self) -> FloatArray:
        """Value of e at the nodes; a view, write through `values[...] =`."""
        return self._values if self.dimension == 3 else self._values[:, :, 0]

    def axes(self) -> list[FloatArray]:
        """Return the coordinates of the nodes along each axis, metres."""
        parts = zip(self._lower, self._step, self.values.shape)
        return [lower + step * np.arange(number) for lower, step, number in parts]

    def nodes(self) -> FloatArray:
        """Return the positions of all nodes, (n, d), in the order of `values.ravel()`."""
        return self._nodes

    def kernel(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return (values (nx, ny, nz), lower (3,), step (3,)) for `interpolate_at`."""
        return self._values, self._lower, self._step

    def update(self, detection: DetectionModel, pose: Pose) -> None:
        """Multiply e by 1 - pi for one measurement at `pose` (000, eq. (20))."""
        missed = 1.0 - detection.probability(self._nodes, pose)
        self._values *= missed.reshape(self._values.shape)

    def diffuse(self, variance: float) -> None:
        """Diffuse e as for targets in a random walk, `variance` [m^2], with reflecting bounds."""
        values = self.values
        for axis in range(self.dimension):
            rate = 0.5 * variance / float(self.step[axis]) ** 2
            # The explicit scheme is stable and positive up to a ratio of 1/2.
            parts = max(1, math.ceil(rate / 0.25))
            for _ in range(parts):
                flow = rate / parts * np.diff(values, axis=axis)
                values += np.diff(flow, axis=axis, prepend=0.0, append=0.0)

    def at(self, positions: ArrayLike) -> FloatArray:
        """Return e at positions (n, d) by multilinear interpolation, shape (n,).

        Positions outside the bounds are moved to the nearest point on them. Coordinates beyond
        the problem's dimension are ignored.
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
        """Return the volume (2D: area) each node stands for times its density, as `values`.

        The trapezoid rule: half a step at the ends of each axis. The density is prior times inside,
        with mean 1 over the area.
        """
        return self._volumes

    def expected(self) -> FloatArray:
        """Return the intensity of unseen targets at the nodes, prior inside e, 1 at most.

        It is e where no prior is given. Of the shape of `values`.
        """
        shown = self._values * (self.density / self.density.max())
        return np.asarray(shown.reshape(self.values.shape))

    def explored_fraction(self) -> float:
        """Return 1 - mean of e over the environment, in [0, 1]."""
        return 1.0 - float((self._volumes * self.values).sum() / self._volumes.sum())

    def copy(self) -> UnexploredMap:
        """Return an independent copy."""
        other = UnexploredMap(self.area, self.spacing)
        other._values[...] = self._values
        return other
