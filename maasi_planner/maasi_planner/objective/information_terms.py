"""Terms of the objective `information`: T about clusters, and E as expected new targets."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numba import njit

from maasi_filter.arrays import BoolArray, FloatArray, IntArray
from maasi_filter.models.detection import BOX, detection_probability_at
from maasi_filter.models.pose import Pose
from maasi_planner.objective.predicted_measurements import (
    NEVER,
    Measurements,
    apply_misses,
    chance_in_sight,
    chances,
    part_of,
    parts_of,
)
from maasi_planner.objective.settings import InformationSettings
from maasi_planner.objective.terms import IndexArray, Terms
from maasi_planner.team import RobotView, TeamView

# Rows up to this size have all nodes, which is faster for few robots.
MOST_WHOLE = 4_000_000
# Neglected information about a cluster in large teams, in units of its covariance.
LEAST_GAIN = 1e-7


class Nodes(NamedTuple):
    """L nodes with unseen targets.

    numbers (nx, ny, nz): index of each cell or -1; lower (3,) and step (3,) of the grid [m];
    positions (3, L) [m]; unseen (L,): expected targets.
    """

    numbers: IndexArray
    lower: FloatArray
    step: FloatArray
    positions: FloatArray
    unseen: FloatArray


@njit(cache=True)
def _add_information(
    rows: FloatArray,
    lower: FloatArray,
    chance: FloatArray,
    owner: IntArray,
    cluster: IntArray,
    out: FloatArray,
) -> None:
    """Add pi H' R^-1 H to out; rows H (n, d, d) are scaled by the noise, in place."""
    d = lower.shape[0]
    for i in range(chance.shape[0]):
        for a in range(d):
            for b in range(d):
                for k in range(a):
                    rows[i, a, b] -= lower[a, k] * rows[i, k, b]
                rows[i, a, b] /= lower[a, a]
        for a in range(d):
            for b in range(d):
                total = 0.0
                for k in range(d):
                    total += rows[i, k, a] * rows[i, k, b]
                out[owner[i], cluster[i], a, b] += chance[i] * total


def _information(
    view: RobotView, measured: Measurements, first: int, centres: FloatArray, d: int
) -> FloatArray:
    """Return sum pi H' R^-1 H of one robot's measurements from `first` on, (W, C, d, d)."""
    out = np.zeros((len(measured.own), len(centres), d, d))
    lower: FloatArray = np.linalg.cholesky(view.sensor.covariance).astype(float)
    for where, part in parts_of(measured, len(centres)):
        chance = chances(part, first, centres)
        owner, index, cluster = np.nonzero(chance)
        offsets = (centres[cluster] - part.positions[owner, index])[:, :d]
        # Nearer than the noise of the range, the linear model would be too optimistic.
        distance = np.sqrt((offsets * offsets).sum(axis=1))
        offsets *= np.maximum(1.0, lower[0, 0] / np.maximum(distance, 1e-12))[:, None]
        jacobian = view.sensor.measurement.jacobian(offsets, Pose(np.zeros(3)))
        seen = chance[owner, index, cluster]
        _add_information(jacobian, lower, seen, owner, cluster, out[where])
    return out


def _nodes(team: TeamView, settings: InformationSettings, every_node: bool) -> Nodes:
    """Return the nodes of e, or blocks of them, with their unseen targets."""
    values, lower, step = team.exploration.kernel()
    volumes = team.exploration.cell_volumes().reshape(values.shape)
    most, stride = settings.exploration_nodes, 1
    while not every_node and np.prod([-(-size // stride) for size in values.shape]) > most:
        stride += 1
    # Nodes of each axis by block.
    x, y, z = np.ix_(*(np.arange(size) // stride for size in values.shape))
    shape = [int(blocks.max()) + 1 for blocks in (x, y, z)]
    block = (x * shape[1] + y) * shape[2] + z
    left = np.bincount(block.ravel(), (values * volumes).ravel()).astype(float)
    start, distance = lower + 0.5 * (stride - 1) * step, stride * step
    positions = start[:, None] + distance[:, None] * np.indices(shape).reshape(3, -1)
    if stride > 1 and team.area.terrain is not None:
        # A node that is left unseen may be hidden from where others are in sight.
        positions[:2] = _least_seen(team, block.ravel(), positions[:2])
    unseen = left * (team.area.expected_targets / float(volumes.sum()))
    index = np.arange(len(left), dtype=np.int32).reshape(shape)
    return Nodes(index, start, distance, positions, unseen)


def _least_seen(team: TeamView, block: IntArray, middles: FloatArray) -> FloatArray:
    """Return the node of each block with most unseen targets, the nearest to its middle, (2, L)."""
    nodes = team.exploration.nodes()
    left = (team.exploration.values * team.exploration.cell_volumes()).ravel()
    offsets = nodes - middles.T[block]
    order = np.lexsort(((offsets * offsets).sum(axis=1), -left, block))
    first = np.unique(block[order], return_index=True)[1]
    return np.asarray(nodes[order[first]].T)


def _without(nodes: Nodes, settled: Measurements) -> Nodes:
    """Return the nodes that are still unseen after the measurements of robots that do not plan."""
    unseen = nodes.unseen.copy()
    counts, node, miss = rows_of(settled, 0, nodes, False)
    for last, count in zip(counts.cumsum().tolist(), counts.tolist()):
        unseen[node[last - count : last]] *= miss[last - count : last]
    kept = np.flatnonzero(unseen > 0.0)
    index = np.full(nodes.numbers.size, -1, np.int32)
    index[kept] = np.arange(len(kept))
    positions = np.ascontiguousarray(nodes.positions[:, kept])
    return Nodes(
        index.reshape(nodes.numbers.shape), nodes.lower, nodes.step, positions, unseen[kept]
    )


@njit(cache=True)
def _miss_near(
    measured: Measurements, g: int, first: int, nodes: Nodes, miss: FloatArray, seen: IndexArray
) -> int:
    """Multiply miss (L,) by 1 - pi within the reach; fill and count the changed nodes."""
    robot, count = measured.robot[g], 0
    reach, shape = measured.reach[robot], nodes.numbers.shape
    low, high = np.zeros(2, np.int64), np.zeros(2, np.int64)
    for e in range(first, measured.own[g]):
        for axis in range(2):
            begin = measured.positions[g, e, axis] - nodes.lower[axis]
            low[axis] = max(0, np.int64((begin - reach) / nodes.step[axis]) - 1)
            last = np.int64(max(-1.0, (begin + reach) / nodes.step[axis])) + 2
            high[axis] = min(shape[axis], last)
        x, y, z = measured.positions[g, e]
        cosine, sine = math.cos(measured.yaws[g, e]), math.sin(measured.yaws[g, e])
        kind, parameters = measured.kind[robot], measured.parameters[robot]
        for i in range(low[0], high[0]):
            for j in range(low[1], high[1]):
                for n in nodes.numbers[i, j]:
                    if n < 0 or miss[n] == 0.0:
                        continue
                    dx, dy = nodes.positions[0, n] - x, nodes.positions[1, n] - y
                    if abs(dx) > reach or abs(dy) > reach:
                        continue
                    chance = detection_probability_at(
                        kind, parameters, dx, dy, nodes.positions[2, n] - z, cosine, sine
                    )
                    if 1.0 - chance < 1.0:
                        if miss[n] == 1.0:
                            seen[count] = n
                            count += 1
                        miss[n] *= 1.0 - chance
    return count


@njit(cache=True)
def _miss_in_sight(
    measured: Measurements, g: int, first: int, nodes: Nodes, miss: FloatArray, seen: IndexArray
) -> int:
    """Multiply miss (L,) by 1 - pi over terrain; fill and count the changed nodes."""
    count, reach = 0, measured.reach[measured.robot[g]]
    shape = nodes.numbers.shape
    low, high = np.zeros(2, np.int64), np.array(shape[:2])
    for e in range(first, measured.own[g]):
        for axis in range(2 if reach < np.inf else 0):
            begin = (measured.positions[g, e, axis] - nodes.lower[axis]) / nodes.step[axis]
            width = reach / nodes.step[axis]
            low[axis] = max(0, np.int64(math.floor(begin - width)))
            high[axis] = min(shape[axis], np.int64(math.ceil(begin + width)) + 1)
        cosine, sine = math.cos(measured.yaws[g, e]), math.sin(measured.yaws[g, e])
        for i in range(low[0], high[0]):
            for n in nodes.numbers[i, low[1] : high[1], 0]:
                if n < 0 or miss[n] == 0.0:
                    continue
                x, y = nodes.positions[0, n], nodes.positions[1, n]
                chance = chance_in_sight(measured, g, e, x, y, cosine, sine)
                if chance > 0.0:
                    if miss[n] == 1.0:
                        seen[count] = n
                        count += 1
                    miss[n] *= 1.0 - chance
    return count


@njit(cache=True)
def rows_of(
    measured: Measurements, first: int, nodes: Nodes, whole: bool
) -> tuple[IntArray, IndexArray, FloatArray]:
    """Return the nodes seen by the planned measurements from `first` on, by trajectory.

    These are the number of each (G,), the nodes in order, and the product of 1 - pi there (N,).
    With `whole` each row has all nodes.
    """
    total, number = measured.own.shape[0], nodes.unseen.shape[0]
    counts, used = np.zeros(total, np.int64), 0
    node, row = np.empty(number, np.int32), np.empty(number)
    miss, seen = np.ones(number), np.empty(number, np.int32)
    until = np.full(number, NEVER)
    at = nodes.positions[0], nodes.positions[1], nodes.positions[2]
    for g in range(total):
        if measured.sight.surface.heights.size > 0:
            count = _miss_in_sight(measured, g, first, nodes, miss, seen)
            seen[:count].sort()
        elif measured.reach[measured.robot[g]] < np.inf:
            count = _miss_near(measured, g, first, nodes, miss, seen)
            seen[:count].sort()
        else:
            apply_misses(at, until, miss, measured, g, first, measured.own[g])
            count = 0
            for n in range(number):
                if miss[n] < 1.0:
                    seen[count] = n
                    count += 1
        length = number if whole else count
        if used + length > node.shape[0]:
            more = np.empty(2 * (used + length), np.int32), np.empty(2 * (used + length))
            more[0][:used], more[1][:used] = node[:used], row[:used]
            node, row = more
        for i in range(length):
            n = i if whole else seen[i]
            node[used + i], row[used + i] = n, miss[n]
        for i in range(count):
            miss[seen[i]] = 1.0
        counts[g], used = length, used + length
    return counts, node[:used].copy(), row[:used].copy()


def starts_of(counts: IntArray) -> IntArray:
    """Return the begin of rows of so many entries (G,), and the end of the last one, (G + 1,)."""
    return np.concatenate([[0], counts.cumsum()])


class InformationTerms:
    """Terms of the candidates of each robot, then of all of them.

    settled: robots whose measurements do not depend on the choice, and these measurements; kinds
    (R,): kinds of pi of the planning robots.
    """

    def __init__(
        self,
        team: TeamView,
        settings: InformationSettings,
        settled: tuple[Sequence[RobotView], Measurements],
        kinds: IntArray,
    ) -> None:
        self._d = d = team.dimension
        self._centres = np.zeros((len(team.clusters), 3))
        nodes = _nodes(team, settings, bool((kinds >= BOX).any()))
        self._nodes = _without(nodes, settled[1])
        for centre, cluster in zip(self._centres, team.clusters):
            centre[:d] = cluster.position[:d]
        self._base = np.zeros((len(self._centres), d, d))
        views, measured = settled
        for robot, view in enumerate(views):
            begin, end = np.searchsorted(measured.robot, [robot, robot + 1]).tolist()
            part = part_of(measured, begin, end)
            gains = _information(view, part, 0, self._centres, d)
            self._base += gains.sum(axis=0)
        self._mass = np.array([min(1.0, max(0.0, c.mass)) for c in team.clusters], float)
        covariance = np.array([c.covariance[:d, :d] for c in team.clusters], float)
        self._covariance = covariance.reshape(-1, d, d)

    def are_few(self, candidates: int) -> bool:
        """Return whether rows of so many candidates can have all nodes."""
        return candidates * len(self._nodes.unseen) <= MOST_WHOLE

    def of(self, view: RobotView, planned: Measurements, first: int, whole: bool) -> Terms:
        """Return the terms of one robot's candidates for measurements from `first` on."""
        counts, node, miss = rows_of(planned, first, self._nodes, whole)
        gains = _information(view, planned, first, self._centres, self._d)
        if whole:
            known = np.ones(gains.shape[:2], np.bool_)
        else:
            known = np.einsum('cab,gcba->gc', self._covariance, gains) > LEAST_GAIN
        return Terms(
            information=True,
            refinement=np.zeros(len(counts)),
            first=starts_of(counts),
            node=node,
            miss=miss,
            unseen=self._nodes.unseen,
            mass=self._mass,
            covariance=self._covariance,
            base=self._base,
            gain_first=starts_of(known.sum(axis=1)),
            cluster=np.nonzero(known)[1].astype(np.int32),
            gain=gains[known],
        )


def reduced(terms: Terms, kept: BoolArray) -> Terms:
    """Return terms with only the rows of `kept` candidates (G,)."""
    if kept.all():
        return terms
    counts, gains = np.diff(terms.first), np.diff(terms.gain_first)
    entries, rows = np.repeat(kept, counts), np.repeat(kept, gains)
    return terms._replace(
        first=starts_of(np.where(kept, counts, 0)),
        node=terms.node[entries],
        miss=terms.miss[entries],
        gain_first=starts_of(np.where(kept, gains, 0)),
        cluster=terms.cluster[rows],
        gain=terms.gain[rows],
    )


def joined(parts: Sequence[Terms]) -> Terms:
    """Return the terms of all robots from those of each."""
    if len(parts) == 1:
        return parts[0]
    first = starts_of(np.concatenate([np.diff(part.first) for part in parts]))
    gain_first = starts_of(np.concatenate([np.diff(part.gain_first) for part in parts]))
    rows = ('refinement', 'node', 'miss', 'cluster', 'gain')
    together: Any = {name: np.concatenate([getattr(part, name) for part in parts]) for name in rows}
    return parts[0]._replace(first=first, gain_first=gain_first, **together)
