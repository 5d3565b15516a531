"""A lattice of positions, and a choice of those from which the unseen area is seen in passing."""

from __future__ import annotations

import heapq
import itertools
import math
from typing import NamedTuple

import numpy as np
from numba import njit
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from maasi_filter.arrays import BoolArray, FloatArray, IntArray
from maasi_filter.models.pose import Pose
from maasi_filter.unexplored_map import UnexploredMap
from maasi_planner.candidates import half_view
from maasi_planner.planners.lattice_sight import Cells, View, view_over
from maasi_planner.team import RobotView, TeamView

# A cell is omitted if others leave less than this share of its gain, or if its gain is less than
# that share of the best cell's.
OVERLAP = 0.3
LEAST = 0.01
# Number of cells for half of the best detection above which lanes are regular enough.
MANY = 30
# Parts of a map cell on each axis, each in one lattice cell; even, so that none is on a border.
# Maps with more parts in all than this have fewer.
PARTS, FEWER, FINE = 4, 2, 2_000_000
# A cell with less than this share of a full one belongs to its neighbour.
SMALL = 0.3
# A cell with less than this share unseen is passed in the centre of that part.
WHOLE = 0.95
# Cells are turned if that makes them wider by this factor, in areas of so many cells in all or for
# each robot: elsewhere the corners of turned cells cancel the gain.
ASKEW, LARGE, EACH = 1.1, 200, 60
# A corner of a tour leaves parts of a turned cell unseen: with at least so many for each robot,
# tours are planned as if their second axis were longer by this factor, so that lanes are straight.
STRAIGHT, LONG = 1.5, 45


def passing(
    view: RobotView, step_time: float, reach: float, heading: float = 0.0
) -> tuple[FloatArray, FloatArray]:
    """Return lateral distances from a path, (n,) [m], and the probability of detection in passing.

    reach: the largest distance of interest [m]; heading: of the path [rad].
    """
    half = min(half_view(view.sensor), reach)
    spacing = view.motion.settings.speed * step_time * view.period_steps
    # All measurements within `far` along the path, for targets at four positions between two.
    far = min(8.0 * half, reach)
    lateral = np.linspace(-far, far, 641)
    points = np.zeros((4, len(lateral), 2))
    points[..., 0] = spacing * np.arange(4)[:, None] / 4.0
    points[..., 1] = lateral
    points = points @ turned(heading, 2).T
    missed = np.ones(points.shape[:2])
    for number in range(-math.ceil(far / spacing), math.ceil(far / spacing) + 2):
        along = number * spacing
        pose = Pose.from_yaw([along * math.cos(heading), along * math.sin(heading), 0.0], heading)
        found = view.sensor.detection.probability(points.reshape(-1, 2), pose)
        missed *= 1.0 - found.reshape(missed.shape)
    detected = 1.0 - missed.mean(axis=0)
    return lateral[320:], 0.5 * (detected[320:] + detected[320::-1])


def turned(heading: float, dimension: int) -> FloatArray:
    """Return a rotation about the vertical axis (d, d)."""
    turn = np.eye(dimension)
    cos, sin = math.cos(heading), math.sin(heading)
    turn[:2, :2] = [[cos, -sin], [sin, cos]]
    return turn


def pitch_of(exploration: UnexploredMap, lateral: FloatArray, detected: FloatArray) -> float:
    """Return the width of cells [m] by the result of `passing`."""
    sure, half = (
        2.0 * float(lateral[detected >= share * detected.max()].max()) for share in (0.9, 0.5)
    )
    return half if exploration.volume >= MANY * half**exploration.dimension else sure


def lanes_of(team: TeamView) -> tuple[float, FloatArray, FloatArray, float]:
    """Return pitch [m], the result of `passing`, and heading of lanes for the narrowest view.

    In 2D they are diagonal if that shows more, as with a box that does not turn.
    """
    reach = float(np.linalg.norm(team.bounds[:, 1] - team.bounds[:, 0]))

    def narrowest(heading: float) -> tuple[float, FloatArray, FloatArray, float]:
        seen = [passing(view, team.step_time, reach, heading) for view in team.robots.values()]
        lanes = [(pitch_of(team.exploration, *one), *one, heading) for one in seen]
        return min(lanes, key=lambda lane: lane[0])

    level = narrowest(0.0)
    least = min(LARGE, EACH * len(team.robots))
    if team.dimension == 3 or team.exploration.volume < least * level[0] ** 2:
        return level
    askew = narrowest(0.25 * math.pi)
    return askew if askew[0] > ASKEW * level[0] else level


class Lattice:
    """Cells as wide as is seen in passing with at least half of the best detection, in 2D or 3D.

    If that gives few cells, 0.9 replaces the half, for a finer choice of positions.

    turn (d, d): axes of the cells, in columns; kernel: probability of detection in passing, by
    offset in cells; trust (n,): factor on the gain of a visit, which its user can reduce; area: of
    all cells, in cells. height: of robots above terrain, which hides ground from them [m].
    """

    def __init__(
        self,
        exploration: UnexploredMap,
        lateral: FloatArray,
        detected: FloatArray,
        heading: float = 0.0,
        height: float = 0.0,
    ) -> None:
        d, nodes = exploration.dimension, exploration.values.size
        self.turn, self.pitch = turned(heading, d), pitch_of(exploration, lateral, detected)
        parts = PARTS if nodes * PARTS**d <= FINE else FEWER
        samples = _samples(exploration, parts)
        corners = np.array(list(itertools.product(*exploration.bounds))) @ self.turn
        low, high = corners.min(axis=0), corners.max(axis=0)
        size = np.maximum(self.pitch, exploration.step)
        counts = np.maximum(1, np.ceil((high - low) / size - 0.1)).astype(int)
        widths = (high - low) / counts
        number = int(counts.prod())
        cells = _cells_of(samples, self.turn, low, widths, counts)
        held, sums = _middles(samples, cells, number)
        cells = _joined(held, sums[:, :d] / np.maximum(held, 1e-12)[:, None])[cells]
        self.shape = (*counts.tolist(), 1)[:3]
        self.trust = np.ones(number)
        # Share of each map cell in each lattice cell.
        table = _shares(cells, samples.parts, number)
        self._parts = csr_array(table, (number, nodes))
        self._sizes = _cell_sizes(samples)
        self._held, sums = _middles(samples, cells, number)
        self.area = float(self._held.sum() / widths.prod())
        self._centres = sums[:, :d] / np.maximum(self._held, 1e-12)[:, None]
        centres = (low + (np.indices(tuple(counts)).reshape(d, -1).T + 0.5) * widths) @ self.turn.T
        whole = np.abs(self._held / widths.prod() - 1.0) < 1.0 - WHOLE
        self._centres[whole] = centres[whole]
        far = float(lateral[detected >= 0.05].max(initial=0.0))
        reach = [min(int(far / width), size) for width, size in zip(widths, self.shape)]
        reach += [0] * (3 - d)
        offsets = np.meshgrid(*(np.arange(-count, count + 1) for count in reach), indexing='ij')
        squared = sum((offset * width) ** 2 for offset, width in zip(offsets, widths))
        self.kernel = np.interp(np.sqrt(squared), lateral, detected, right=0.0)
        self._view, terrain = View(self.kernel), exploration.area.terrain
        if terrain is not None:
            table = self._parts.indptr.astype(np.int64), self._parts.indices.astype(np.int64)
            seen = Cells(self.shape, self._centres, exploration.nodes(), *table, self._parts.data)
            self._view = view_over(seen, self.kernel, terrain.surface, height)

    def frame(self, robots: int) -> FloatArray:
        """Return the axes (d, d), in columns, in which tours of so many robots are planned."""
        axes = self.turn.copy()
        if self.turn[0, 1] != 0.0 and self.area >= LONG * robots:
            axes[:, 1] *= STRAIGHT
        return axes

    def unseen(self, exploration: UnexploredMap) -> FloatArray:
        """Return the share of all targets that is unseen in each cell, (nx, ny, nz)."""
        volumes = exploration.cell_volumes()
        share = exploration.values * volumes / volumes.sum()
        return np.ascontiguousarray((self._parts @ share.ravel()).reshape(self.shape))

    def points(self, exploration: UnexploredMap, chosen: IntArray) -> FloatArray:
        """Return where to pass cells, (m, d) [m]: their centres, or those of the unseen part."""
        unseen = exploration.values.ravel() * self._sizes
        parts, nodes = self._parts[chosen], np.meshgrid(*exploration.axes(), indexing='ij')
        held = np.maximum(parts @ unseen, 1e-12)
        middles = np.stack([parts @ (unseen * axis.ravel()) / held for axis in nodes], axis=1)
        whole = held > WHOLE * self._held[chosen]
        return np.where(whole[:, None], self._centres[chosen], middles)

    def choose(self, exploration: UnexploredMap, enough: int = 1) -> tuple[IntArray, FloatArray]:
        """Return at least `enough` cells that show the unseen area, and their gains (m,)."""
        return _choose(*self._now(exploration), self.trust, OVERLAP, LEAST, enough)

    def gains(self, exploration: UnexploredMap, chosen: IntArray) -> FloatArray:
        """Return the gain of each of some cells after those before it, (m,)."""
        return self.trust[chosen] * _gains(*self._now(exploration), chosen)

    def _now(self, exploration: UnexploredMap) -> tuple[FloatArray, View]:
        """Return the share of all targets that is unseen in each cell; over terrain, node."""
        if exploration.area.terrain is None:
            return self.unseen(exploration), self._view
        share = exploration.values * exploration.cell_volumes() / exploration.cell_volumes().sum()
        left = self._parts @ (exploration.values.ravel() * self._sizes)
        return share.reshape(-1, 1, 1), self._view._replace(whole=left > WHOLE * self._held)


class _Samples(NamedTuple):
    """Parts of the map's cells on each axis; in 2D the third axis has one part of size 1.

    axes: positions [m]; sizes: lengths [m]; inside: cells in the area; parts: per cell and axis.
    """

    axes: tuple[FloatArray, FloatArray, FloatArray]
    sizes: tuple[FloatArray, FloatArray, FloatArray]
    inside: BoolArray
    parts: tuple[int, int, int]


def _samples(exploration: UnexploredMap, parts: int) -> _Samples:
    axes: list[FloatArray] = []
    sizes: list[FloatArray] = []
    for (low, high), nodes, step in zip(exploration.bounds, exploration.axes(), exploration.step):
        first, last = np.maximum(nodes - 0.5 * step, low), np.minimum(nodes + 0.5 * step, high)
        shares = (np.arange(parts) + 0.5) / parts
        axes.append((first[:, None] + shares * (last - first)[:, None]).ravel())
        sizes.append(np.repeat((last - first) / parts, parts))
    inside = (exploration.cell_volumes() > 0.0).reshape(exploration.kernel()[0].shape)
    several = (parts, parts, parts)
    if len(axes) == 2:
        axes, sizes, several = [*axes, np.zeros(1)], [*sizes, np.ones(1)], (parts, parts, 1)
    return _Samples((axes[0], axes[1], axes[2]), (sizes[0], sizes[1], sizes[2]), inside, several)


@njit(cache=True)
def _cells_of(samples, turn, low, widths, counts):  # type: ignore[no-untyped-def]
    x, y, z = samples.axes
    out = np.empty((len(x), len(y), len(z)), np.int32)
    for i in range(len(x)):
        for j in range(len(y)):
            for k in range(len(z)):
                cell = 0
                for axis in range(len(low)):
                    along = x[i] * turn[0, axis] + y[j] * turn[1, axis]
                    if len(low) == 3:
                        along += z[k] * turn[2, axis]
                    row = int((along - low[axis]) / widths[axis])
                    cell = cell * counts[axis] + min(max(row, 0), counts[axis] - 1)
                out[i, j, k] = cell
    return out


@njit(cache=True)
def _size(samples, i, j, k):  # type: ignore[no-untyped-def]
    a, b, c = samples.parts
    inside = samples.inside[i // a, j // b, k // c]
    return samples.sizes[0][i] * samples.sizes[1][j] * samples.sizes[2][k] if inside else 0.0


@njit(cache=True)
def _middles(samples, cells, number):  # type: ignore[no-untyped-def]
    """Return the area in each cell, (n,), and its first moment, (n, 3)."""
    held, sums = np.zeros(number), np.zeros((number, 3))
    x, y, z = samples.axes
    for i in range(len(x)):
        for j in range(len(y)):
            for k in range(len(z)):
                cell, size = cells[i, j, k], _size(samples, i, j, k)
                held[cell] += size
                sums[cell, 0] += size * x[i]
                sums[cell, 1] += size * y[j]
                sums[cell, 2] += size * z[k]
    return held, sums


@njit(cache=True)
def _cell_sizes(samples):  # type: ignore[no-untyped-def]
    out = np.zeros(samples.inside.shape)
    a, b, c = samples.parts
    for i in range(len(samples.axes[0])):
        for j in range(len(samples.axes[1])):
            for k in range(len(samples.axes[2])):
                out[i // a, j // b, k // c] += _size(samples, i, j, k)
    return out.ravel()


@njit(cache=True)
def _shares(cells, parts, number):  # type: ignore[no-untyped-def]
    """Return the share of each map cell in each lattice cell, in the form of a CSR matrix."""
    a, b, c = parts
    shape = cells.shape[0] // a, cells.shape[1] // b, cells.shape[2] // c
    begin, last = np.zeros(number + 1, np.int64), np.zeros(number, np.int64)
    data, columns = np.zeros(0), np.zeros(0, np.int64)
    # Count first; map cells come in order, so comparing with the last one suffices.
    for fill in range(2):
        last[:] = -1
        used = begin[:-1].copy()
        for column in range(shape[0] * shape[1] * shape[2]):
            i, j = column // (shape[1] * shape[2]), column // shape[2] % shape[1]
            k = column % shape[2]
            for cell in cells[i * a : (i + 1) * a, j * b : (j + 1) * b, k * c : (k + 1) * c].flat:
                if last[cell] != column:
                    last[cell] = column
                    used[cell] += 1
                if fill:
                    columns[used[cell] - 1] = column
                    data[used[cell] - 1] += 1.0 / (a * b * c)
        if not fill:
            begin[1:] = np.cumsum(used)
            data, columns = np.zeros(begin[-1]), np.zeros(begin[-1], np.int64)
    return data, columns, begin


def _joined(held: FloatArray, middles: FloatArray) -> IntArray:
    """Return for each cell itself or, for one with little area, its nearest large one, (n,)."""
    small = (held > 0.0) & (held < SMALL * held.max())
    large = np.flatnonzero(held >= SMALL * held.max())
    owner = np.arange(len(held))
    owner[small] = large[cKDTree(middles[large]).query(middles[small])[1]]
    return owner.astype(np.int32)


@njit(cache=True)
def _seen(unseen, view, cell, take):  # type: ignore[no-untyped-def]
    """Return how much is seen from a cell; `take` removes it."""
    if len(view.begin) > 0:
        total = 0.0
        for row in range(view.begin[cell], view.begin[cell + 1]):
            if view.behind[row] and view.whole[cell]:
                continue
            seen = unseen[view.node[row], 0, 0] * view.chance[row]
            total += seen
            if take:
                unseen[view.node[row], 0, 0] -= seen
        return total
    kernel = view.kernel
    nx, ny, nz = unseen.shape
    a, b, c = kernel.shape
    i, j, k = cell // (ny * nz), cell // nz % ny, cell % nz
    total = 0.0
    for u in range(max(i - a // 2, 0), min(i + a // 2 + 1, nx)):
        for v in range(max(j - b // 2, 0), min(j + b // 2 + 1, ny)):
            for w in range(max(k - c // 2, 0), min(k + c // 2 + 1, nz)):
                seen = unseen[u, v, w] * kernel[u - i + a // 2, v - j + b // 2, w - k + c // 2]
                total += seen
                if take:
                    unseen[u, v, w] -= seen
    return total


@njit(cache=True)
def _gains(unseen, view, chosen):  # type: ignore[no-untyped-def]
    gains = np.empty(len(chosen))
    for number, cell in enumerate(chosen):
        gains[number] = _seen(unseen, view, cell, True)
    return gains


@njit(cache=True)
def _choose(unseen, view, trust, overlap, least, enough):  # type: ignore[no-untyped-def]
    """Choose the cell that sees most, as long as earlier ones have not seen most of that."""
    cells = len(trust)
    alone = np.empty(cells)
    for cell in range(cells):
        alone[cell] = trust[cell] * _seen(unseen, view, cell, False)
    chosen, gains = np.empty(cells, np.int64), np.empty(cells)
    number, least = 0, least * alone.max()
    # Gains only decrease: the largest one is computed again. Of equal ones
    # the first is chosen.
    queue = [(-alone[cell], cell, -1) for cell in range(cells) if alone[cell] > least]
    heapq.heapify(queue)
    while queue:
        bound, cell, fresh = heapq.heappop(queue)
        if -bound <= least:
            break
        if fresh < number:
            left = trust[cell] * _seen(unseen, view, cell, False)
            if number < enough or left >= overlap * alone[cell]:
                heapq.heappush(queue, (-left, cell, number))
            continue
        chosen[number], gains[number] = cell, trust[cell] * _seen(unseen, view, cell, True)
        number += 1
    return chosen[:number], gains[:number]
