"""Places that show an area on passing: a lattice, and a choice that covers what is unseen."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from maasi_filter.arrays import FloatArray, IntArray
from maasi_filter.models.pose import Pose
from maasi_filter.unexplored_map import UnexploredMap
from maasi_planner.candidates import half_view
from maasi_planner.team import RobotView

# A place is left out if others have taken its gain but for this share, or if it gains less than
# that share of what the best place does.
OVERLAP = 0.3
LEAST = 0.01
# Squares of half the best detection in an area from which on lanes of them are regular enough.
MANY = 30


def passing(view: RobotView, step_time: float, reach: float) -> tuple[FloatArray, FloatArray]:
    """Return distances beside a way, (n,) [m], and the probability of detection on passing them.

    reach: the largest distance of interest [m].
    """
    half = min(half_view(view.sensor), reach)
    spacing = view.motion.settings.speed * step_time * view.period_steps
    # All measurements nearer than `far` along the way, of targets at four places between two.
    far = min(8.0 * half, reach)
    beside = np.linspace(-far, far, 641)
    places = np.zeros((4, len(beside), 2))
    places[..., 0] = spacing * np.arange(4)[:, None] / 4.0
    places[..., 1] = beside
    missed = np.ones(places.shape[:2])
    for number in range(-math.ceil(far / spacing), math.ceil(far / spacing) + 2):
        pose = Pose.from_yaw([number * spacing, 0.0, 0.0], 0.0)
        found = view.sensor.detection.probability(places.reshape(-1, 2), pose)
        missed *= 1.0 - found.reshape(missed.shape)
    detected = 1.0 - missed.mean(axis=0)
    return beside[320:], 0.5 * (detected[320:] + detected[320::-1])


class Lattice:
    """Squares (in 3D: cubes) as wide as is seen on passing: with half the best detection or more.

    Where that gives few squares, as wide as with 0.9 of it, so that places can be chosen finely.

    points (n, d): their centres [m]; kernel: probability of detection on passing, by offset in
    squares from the place that is passed; trust (n,): in what a visit gains, for
    its user to reduce.
    """

    def __init__(self, exploration: UnexploredMap, beside: FloatArray, detected: FloatArray):
        sure, half = (
            2.0 * float(beside[detected >= share * detected.max()].max()) for share in (0.9, 0.5)
        )
        self.pitch = half if exploration.volume >= MANY * half**exploration.dimension else sure
        centres, self._parts, widths = [], [], []
        for (low, high), nodes, step in zip(
            exploration.bounds, exploration.axes(), exploration.step
        ):
            number = max(1, math.ceil((high - low) / max(self.pitch, step) - 0.1))
            edges = np.linspace(low, high, number + 1)
            centres.append(0.5 * (edges[1:] + edges[:-1]))
            widths.append(edges[1] - edges[0])
            # Share of the cell of each node of the map that lies in each square.
            first, last = np.maximum(nodes - 0.5 * step, low), np.minimum(nodes + 0.5 * step, high)
            begin, end = np.maximum(edges[:-1, None], first), np.minimum(edges[1:, None], last)
            self._parts.append(np.maximum(end - begin, 0.0) / (last - first))
        points = np.stack(np.meshgrid(*centres, indexing='ij'), axis=-1)
        self.points = points.reshape(-1, exploration.dimension)
        self.trust = np.ones(len(self.points))
        self.shape = (*points.shape[:-1], 1)[:3]
        far = float(beside[detected >= 0.05].max(initial=0.0))
        counts = [min(int(far / width), size) for width, size in zip(widths, self.shape)]
        counts += [0] * (3 - len(counts))
        offsets = np.meshgrid(*(np.arange(-count, count + 1) for count in counts), indexing='ij')
        square = sum((offset * width) ** 2 for offset, width in zip(offsets, widths))
        self.kernel = np.interp(np.sqrt(square), beside, detected, right=0.0)

    def unseen(self, exploration: UnexploredMap) -> FloatArray:
        """Return the share of all targets that is unseen in each square, (nx, ny, nz)."""
        volumes = exploration.cell_volumes()
        share = exploration.values * volumes / volumes.sum()
        for axis, part in enumerate(self._parts):
            share = np.moveaxis(np.tensordot(part, share, (1, axis)), 0, axis)
        return np.ascontiguousarray(share.reshape(self.shape))

    def choose(self, exploration: UnexploredMap, enough: int = 1) -> tuple[IntArray, FloatArray]:
        """Return places from which what is unseen is seen, and the share each adds (m,).

        enough: so many are chosen even if they overlap.
        """
        unseen = self.unseen(exploration)
        return _choose(unseen, self.kernel, self.trust, OVERLAP, LEAST, enough)

    def gains(self, exploration: UnexploredMap, chosen: IntArray) -> FloatArray:
        """Return the share that each of some places adds to those before it, (m,)."""
        return self.trust[chosen] * _gains(self.unseen(exploration), self.kernel, chosen)


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
