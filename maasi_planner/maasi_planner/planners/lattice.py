"""Places that show an area on passing: a lattice, and a choice that covers what is unseen."""

from __future__ import annotations

import functools
import itertools
import math

import numpy as np
from numba import njit
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from maasi_filter.arrays import FloatArray, IntArray
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
# Parts of a cell of the map along each axis: each lies in one square. Even: none on a border.
PARTS = 4
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
        d = exploration.dimension
        self.turn, self.pitch = turned(heading, d), pitch_of(exploration, beside, detected)
        places, sizes, cells = _samples(exploration)
        corners = np.array(list(itertools.product(*exploration.bounds))) @ self.turn
        low, high = corners.min(axis=0), corners.max(axis=0)
        size = np.maximum(self.pitch, exploration.step)
        counts = np.maximum(1, np.ceil((high - low) / size - 0.1)).astype(int)
        widths = (high - low) / counts
        rows = np.clip(((places @ self.turn - low) / widths).astype(int), 0, counts - 1)
        squares = _joined(np.ravel_multi_index(tuple(rows.T), tuple(counts)), places, sizes)
        number = int(counts.prod())
        self.shape = (*counts.tolist(), 1)[:3]
        self.trust = np.ones(number)
        # Share of each cell of the map that lies in each square.
        shares = np.full(len(squares), float(PARTS) ** -d)
        self._parts = csr_array((shares, (squares, cells)), (number, exploration.values.size))
        self._cells = np.bincount(cells, sizes)
        self._held, self._centres = _middles(squares, places, sizes, number)
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


def _samples(exploration: UnexploredMap) -> tuple[FloatArray, FloatArray, IntArray]:
    """Return parts of the map's cells: places (n, d) [m], sizes in the area, and cells (n,)."""
    parts, sizes = [], []
    for (low, high), nodes, step in zip(exploration.bounds, exploration.axes(), exploration.step):
        first, last = np.maximum(nodes - 0.5 * step, low), np.minimum(nodes + 0.5 * step, high)
        shares = (np.arange(PARTS) + 0.5) / PARTS
        parts.append((first[:, None] + shares * (last - first)[:, None]).ravel())
        sizes.append(np.repeat((last - first) / PARTS, PARTS))
    places = np.stack(np.meshgrid(*parts, indexing='ij'), axis=-1)
    size = functools.reduce(np.multiply.outer, sizes).ravel()
    rows = np.indices(places.shape[:-1]).reshape(len(parts), -1) // PARTS
    cells = np.ravel_multi_index(tuple(rows), exploration.values.shape[: len(parts)])
    inside = (exploration.cell_volumes() > 0.0).ravel()[cells]
    return places.reshape(-1, len(parts)), size * inside, np.asarray(cells, np.int64)


def _middles(
    squares: IntArray, places: FloatArray, sizes: FloatArray, number: int
) -> tuple[FloatArray, FloatArray]:
    """Return how much of the area squares hold, (n,), and the middle of that, (n, d)."""
    held = np.asarray(np.bincount(squares, sizes, number), dtype=float)
    sums = [np.bincount(squares, sizes * axis, number) for axis in places.T]
    return held, np.stack(sums, axis=1) / np.maximum(held, 1e-12)[:, None]


def _joined(squares: IntArray, places: FloatArray, sizes: FloatArray) -> IntArray:
    """Return the squares of samples (n,), those that hold little joined with the nearest others."""
    number = int(squares.max()) + 1
    held, middles = _middles(squares, places, sizes, number)
    small = (held > 0.0) & (held < SMALL * held.max())
    large = np.flatnonzero(held >= SMALL * held.max())
    owner = np.arange(number)
    owner[small] = large[cKDTree(middles[large]).query(middles[small])[1]]
    return owner[squares]


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
    # What a place adds only falls: it is computed again when it is the largest one.
    bound, fresh = alone.copy(), np.full(unseen.size, -1)
    chosen, gains = np.empty(unseen.size, np.int64), np.empty(unseen.size)
    number, least = 0, least * alone.max()
    while True:
        place = int(np.argmax(bound))
        if bound[place] <= least or number == unseen.size:
            return chosen[:number], gains[:number]
        if fresh[place] < number:
            bound[place] = trust[place] * _seen(unseen, kernel, place, False)
            fresh[place] = number
            if number >= enough and bound[place] < overlap * alone[place]:
                bound[place] = 0.0
            continue
        chosen[number], gains[number] = place, trust[place] * _seen(unseen, kernel, place, True)
        bound[place] = 0.0
        number += 1
