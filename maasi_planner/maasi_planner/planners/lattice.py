"""Places that show an area on passing: a lattice, and a choice that covers what is unseen."""

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
from maasi_planner.team import RobotView, TeamView

# A place is left out if others have taken its gain but for this share, or if it gains less than
# that share of what the best place does.
OVERLAP = 0.3
LEAST = 0.01
# Squares of half the best detection in an area from which on lanes of them are regular enough.
MANY = 30
# Parts of a cell of the map along each axis: each lies in one square. Even: none on a border. On
# fine maps, with more than so many parts, there are fewer.
PARTS, FEWER, FINE = 4, 2, 2_000_000
# A square that holds less than this share of a whole one belongs to its neighbour.
SMALL = 0.3
# A square of which less than this share is unseen is passed in the middle of that.
WHOLE = 0.95
# Squares are turned if they are so many times as wide then, in areas of so many squares.
ASKEW, LARGE = 1.1, 200


def passing(
    view: RobotView, step_time: float, reach: float, heading: float = 0.0
) -> tuple[FloatArray, FloatArray]:
    """Return distances beside a way, (n,) [m], and the probability of detection on passing them.

    reach: the largest distance of interest [m]; heading: of the way [rad].
    """
    half = min(half_view(view.sensor), reach)
    spacing = view.motion.settings.speed * step_time * view.period_steps
    # All measurements nearer than `far` along the way, of targets at four places between two.
    far = min(8.0 * half, reach)
    beside = np.linspace(-far, far, 641)
    places = np.zeros((4, len(beside), 2))
    places[..., 0] = spacing * np.arange(4)[:, None] / 4.0
    places[..., 1] = beside
    places = places @ turned(heading, 2).T
    missed = np.ones(places.shape[:2])
    for number in range(-math.ceil(far / spacing), math.ceil(far / spacing) + 2):
        along = number * spacing
        pose = Pose.from_yaw([along * math.cos(heading), along * math.sin(heading), 0.0], heading)
        found = view.sensor.detection.probability(places.reshape(-1, 2), pose)
        missed *= 1.0 - found.reshape(missed.shape)
    detected = 1.0 - missed.mean(axis=0)
    return beside[320:], 0.5 * (detected[320:] + detected[320::-1])


def turned(heading: float, dimension: int) -> FloatArray:
    """Return a rotation about the vertical (d, d)."""
    turn = np.eye(dimension)
    cos, sin = math.cos(heading), math.sin(heading)
    turn[:2, :2] = [[cos, -sin], [sin, cos]]
    return turn


def pitch_of(exploration: UnexploredMap, beside: FloatArray, detected: FloatArray) -> float:
    """Return how wide squares are [m], by what `passing` returned."""
    sure, half = (
        2.0 * float(beside[detected >= share * detected.max()].max()) for share in (0.9, 0.5)
    )
    return half if exploration.volume >= MANY * half**exploration.dimension else sure


def lanes_of(team: TeamView) -> tuple[float, FloatArray, FloatArray, float]:
    """Return pitch [m], what is seen beside, and heading of lanes, for who sees least to its sides.

    In the plane they lie askew where that shows more, as with a box that does not turn.
    """
    reach = float(np.linalg.norm(team.bounds[:, 1] - team.bounds[:, 0]))

    def narrowest(heading: float) -> tuple[float, FloatArray, FloatArray, float]:
        seen = [passing(view, team.step_time, reach, heading) for view in team.robots.values()]
        lanes = [(pitch_of(team.exploration, *one), *one, heading) for one in seen]
        return min(lanes, key=lambda lane: lane[0])

    level = narrowest(0.0)
    # In small areas the corners that turned squares leave take the gain again.
    if team.dimension == 3 or team.exploration.volume < LARGE * level[0] ** 2:
        return level
    askew = narrowest(0.25 * math.pi)
    return askew if askew[0] > ASKEW * level[0] else level


class Lattice:
    """Squares (in 3D: cubes) as wide as is seen on passing: with half the best detection or more.

    Where that gives few squares, as wide as with 0.9 of it, so that places can be chosen finely.

    turn (d, d): axes of the squares, in columns; kernel: probability of detection on passing, by
    offset in squares from the place that is passed; trust (n,): in what a visit gains, for its
    user to reduce. Beside and detected are those of `passing`, for ways of the heading [rad].
    """

    def __init__(
        self,
        exploration: UnexploredMap,
        beside: FloatArray,
        detected: FloatArray,
        heading: float = 0.0,
    ) -> None:
        d, nodes = exploration.dimension, exploration.values.size
        self.turn, self.pitch = turned(heading, d), pitch_of(exploration, beside, detected)
        parts = PARTS if nodes * PARTS**d <= FINE else FEWER
        samples = _samples(exploration, parts)
        corners = np.array(list(itertools.product(*exploration.bounds))) @ self.turn
        low, high = corners.min(axis=0), corners.max(axis=0)
        size = np.maximum(self.pitch, exploration.step)
        counts = np.maximum(1, np.ceil((high - low) / size - 0.1)).astype(int)
        widths = (high - low) / counts
        number = int(counts.prod())
        squares = _squares_of(samples, self.turn, low, widths, counts)
        held, sums = _middles(samples, squares, number)
        squares = _joined(held, sums[:, :d] / np.maximum(held, 1e-12)[:, None])[squares]
        self.shape = (*counts.tolist(), 1)[:3]
        self.trust = np.ones(number)
        # Share of each cell of the map that lies in each square.
        table = _shares(squares, samples.parts, number)
        self._parts = csr_array(table, (number, nodes))
        self._cells = _cell_sizes(samples)
        self._held, sums = _middles(samples, squares, number)
        self._centres = sums[:, :d] / np.maximum(self._held, 1e-12)[:, None]
        centres = (low + (np.indices(tuple(counts)).reshape(d, -1).T + 0.5) * widths) @ self.turn.T
        whole = np.abs(self._held / widths.prod() - 1.0) < 1.0 - WHOLE
        self._centres[whole] = centres[whole]
        far = float(beside[detected >= 0.05].max(initial=0.0))
        reach = [min(int(far / width), size) for width, size in zip(widths, self.shape)]
        reach += [0] * (3 - d)
        offsets = np.meshgrid(*(np.arange(-count, count + 1) for count in reach), indexing='ij')
        square = sum((offset * width) ** 2 for offset, width in zip(offsets, widths))
        self.kernel = np.interp(np.sqrt(square), beside, detected, right=0.0)

    def unseen(self, exploration: UnexploredMap) -> FloatArray:
        """Return the share of all targets that is unseen in each square, (nx, ny, nz)."""
        volumes = exploration.cell_volumes()
        share = exploration.values * volumes / volumes.sum()
        return np.ascontiguousarray((self._parts @ share.ravel()).reshape(self.shape))

    def points(self, exploration: UnexploredMap, chosen: IntArray) -> FloatArray:
        """Return where to pass squares, (m, d) [m]: in the middle, or that of what is unseen."""
        unseen = exploration.values.ravel() * self._cells
        parts, nodes = self._parts[chosen], np.meshgrid(*exploration.axes(), indexing='ij')
        held = np.maximum(parts @ unseen, 1e-12)
        middles = np.stack([parts @ (unseen * axis.ravel()) / held for axis in nodes], axis=1)
        whole = held > WHOLE * self._held[chosen]
        return np.where(whole[:, None], self._centres[chosen], middles)

    def choose(self, exploration: UnexploredMap, enough: int = 1) -> tuple[IntArray, FloatArray]:
        """Return places from which what is unseen is seen, and the share each adds (m,).

        enough: so many are chosen even if they overlap.
        """
        unseen = self.unseen(exploration)
        return _choose(unseen, self.kernel, self.trust, OVERLAP, LEAST, enough)

    def gains(self, exploration: UnexploredMap, chosen: IntArray) -> FloatArray:
        """Return the share that each of some places adds to those before it, (m,)."""
        return self.trust[chosen] * _gains(self.unseen(exploration), self.kernel, chosen)


class _Samples(NamedTuple):
    """Parts of the map's cells, in rows along each axis; in 2D the third one has one part.

    axes: positions [m]; sizes: lengths, in 2D 1 along the third axis; inside: which cells are in
    the area; parts: of a cell along the axes.
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
def _squares_of(samples, turn, low, widths, counts):  # type: ignore[no-untyped-def]
    """Return the square that each part is in, (nx, ny, nz)."""
    x, y, z = samples.axes
    out = np.empty((len(x), len(y), len(z)), np.int32)
    for i in range(len(x)):
        for j in range(len(y)):
            for k in range(len(z)):
                square = 0
                for axis in range(len(low)):
                    along = x[i] * turn[0, axis] + y[j] * turn[1, axis]
                    if len(low) == 3:
                        along += z[k] * turn[2, axis]
                    row = int((along - low[axis]) / widths[axis])
                    square = square * counts[axis] + min(max(row, 0), counts[axis] - 1)
                out[i, j, k] = square
    return out


@njit(cache=True)
def _size(samples, i, j, k):  # type: ignore[no-untyped-def]
    a, b, c = samples.parts
    inside = samples.inside[i // a, j // b, k // c]
    return samples.sizes[0][i] * samples.sizes[1][j] * samples.sizes[2][k] if inside else 0.0


@njit(cache=True)
def _middles(samples, squares, number):  # type: ignore[no-untyped-def]
    """Return how much of the area squares hold, (n,), and the sum of that times place, (n, 3)."""
    held, sums = np.zeros(number), np.zeros((number, 3))
    x, y, z = samples.axes
    for i in range(len(x)):
        for j in range(len(y)):
            for k in range(len(z)):
                square, size = squares[i, j, k], _size(samples, i, j, k)
                held[square] += size
                sums[square, 0] += size * x[i]
                sums[square, 1] += size * y[j]
                sums[square, 2] += size * z[k]
    return held, sums


@njit(cache=True)
def _cell_sizes(samples):  # type: ignore[no-untyped-def]
    """Return how much of the area each cell of the map holds, (n,)."""
    out = np.zeros(samples.inside.shape)
    a, b, c = samples.parts
    for i in range(len(samples.axes[0])):
        for j in range(len(samples.axes[1])):
            for k in range(len(samples.axes[2])):
                out[i // a, j // b, k // c] += _size(samples, i, j, k)
    return out.ravel()


@njit(cache=True)
def _shares(squares, parts, number):  # type: ignore[no-untyped-def]
    """Return the share of each cell in each square: data, cells, and where the squares begin."""
    a, b, c = parts
    shape = squares.shape[0] // a, squares.shape[1] // b, squares.shape[2] // c
    begin, last = np.zeros(number + 1, np.int64), np.zeros(number, np.int64)
    data, cells = np.zeros(0), np.zeros(0, np.int64)
    # First how many cells each square has; cells come in order, so its last one is the same or not.
    for fill in range(2):
        last[:] = -1
        used = begin[:-1].copy()
        for cell in range(shape[0] * shape[1] * shape[2]):
            i, j = cell // (shape[1] * shape[2]), cell // shape[2] % shape[1]
            k = cell % shape[2]
            for square in squares[
                i * a : (i + 1) * a, j * b : (j + 1) * b, k * c : (k + 1) * c
            ].flat:
                if last[square] != cell:
                    last[square] = cell
                    used[square] += 1
                if fill:
                    cells[used[square] - 1] = cell
                    data[used[square] - 1] += 1.0 / (a * b * c)
        if not fill:
            begin[1:] = np.cumsum(used)
            data, cells = np.zeros(begin[-1]), np.zeros(begin[-1], np.int64)
    return data, cells, begin


def _joined(held: FloatArray, middles: FloatArray) -> IntArray:
    """Return for each square itself, or for one that holds little the nearest other one, (n,).

    held (n,): how much of the area squares hold; middles (n, d): the middle of that [m].
    """
    small = (held > 0.0) & (held < SMALL * held.max())
    large = np.flatnonzero(held >= SMALL * held.max())
    owner = np.arange(len(held))
    owner[small] = large[cKDTree(middles[large]).query(middles[small])[1]]
    return owner.astype(np.int32)


@njit(cache=True)
def _seen(unseen, kernel, place, take):  # type: ignore[no-untyped-def]
    """Return how much is seen from a place, and take it away if wanted."""
    nx, ny, nz = unseen.shape
    a, b, c = kernel.shape
    i, j, k = place // (ny * nz), place // nz % ny, place % nz
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
def _gains(unseen, kernel, chosen):  # type: ignore[no-untyped-def]
    gains = np.empty(len(chosen))
    for number, place in enumerate(chosen):
        gains[number] = _seen(unseen, kernel, place, True)
    return gains


@njit(cache=True)
def _choose(unseen, kernel, trust, overlap, least, enough):  # type: ignore[no-untyped-def]
    """Take the place that sees most, as long as it is not mostly seen from those before."""
    alone = np.empty(unseen.size)
    for place in range(unseen.size):
        alone[place] = trust[place] * _seen(unseen, kernel, place, False)
    chosen, gains = np.empty(unseen.size, np.int64), np.empty(unseen.size)
    number, least = 0, least * alone.max()
    # What a place adds only falls: it is computed again when it is the largest one. Of equal ones
    # the first is taken.
    queue = [(-alone[place], place, -1) for place in range(unseen.size) if alone[place] > least]
    heapq.heapify(queue)
    while queue:
        bound, place, fresh = heapq.heappop(queue)
        if -bound <= least:
            break
        if fresh < number:
            left = trust[place] * _seen(unseen, kernel, place, False)
            if number < enough or left >= overlap * alone[place]:
                heapq.heappush(queue, (-left, place, number))
            continue
        chosen[number], gains[number] = place, trust[place] * _seen(unseen, kernel, place, True)
        number += 1
    return chosen[:number], gains[:number]
