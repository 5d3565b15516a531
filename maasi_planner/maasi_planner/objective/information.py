"""Refinement T as information about clusters, exploration E as expected new targets."""

from collections.abc import Sequence

import numpy as np
from numba import njit

from maasi_filter.arrays import FloatArray, IntArray
from maasi_filter.models.detection import BOX
from maasi_filter.models.pose import Pose
from maasi_planner.objective.predicted_measurements import (
    NEVER,
    Measurements,
    apply_misses,
    chances,
)
from maasi_planner.objective.terms import Terms
from maasi_planner.settings import PlannerSettings
from maasi_planner.team import RobotView, TeamView


@njit(cache=True)
def _add_information(
    rows: FloatArray,
    lower: FloatArray,
    chance: FloatArray,
    owner: IntArray,
    cluster: IntArray,
    out: FloatArray,
) -> None:
    """Add pi H' R^-1 H to out; rows H (n, d, d) become H in units of the noise, in place."""
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
    views: Sequence[RobotView], measured: Measurements, first: int, centres: FloatArray, d: int
) -> FloatArray:
    """Return sum pi H' R^-1 H over the planned measurements from `first` on, (G, C, d, d)."""
    out = np.zeros((len(measured.own), len(centres), d, d))
    chance = chances(measured, first, centres)
    for robot, view in enumerate(views):
        lower: FloatArray = np.linalg.cholesky(view.sensor.covariance).astype(float)
        owner, index, cluster = np.nonzero(chance * (measured.robot == robot)[:, None, None])
        offsets = (centres[cluster] - measured.places[owner, index])[:, :d]
        # Nearer than the noise of the range the linear model would promise too much.
        distance = np.sqrt((offsets * offsets).sum(axis=1))
        offsets *= np.maximum(1.0, lower[0, 0] / np.maximum(distance, 1e-12))[:, None]
        jacobian = view.sensor.measurement.jacobian(offsets, Pose(np.zeros(3)))
        seen = chance[owner, index, cluster]
        _add_information(jacobian, lower, seen, owner, cluster, out)
    return out


def _unseen(
    team: TeamView, settings: PlannerSettings, every_node: bool
) -> tuple[FloatArray, FloatArray]:
    """Return places (3, L) [m], nodes of e or blocks of them, and the unseen targets of each."""
    values, lower, step = team.exploration.kernel()
    volumes = team.exploration.cell_volumes().reshape(values.shape)
    most, stride = settings.exploration_nodes, 1
    while not every_node and np.prod([-(-size // stride) for size in values.shape]) > most:
        stride += 1
    # Nodes of each axis by the block that they are in.
    x, y, z = np.ix_(*(np.arange(size) // stride for size in values.shape))
    shape = [int(blocks.max()) + 1 for blocks in (x, y, z)]
    block = (x * shape[1] + y) * shape[2] + z
    left = np.bincount(block.ravel(), (values * volumes).ravel()).astype(float)
    start = lower + 0.5 * (stride - 1) * step
    places = start[:, None] + (stride * step)[:, None] * np.indices(shape).reshape(3, -1)
    return places, left * (team.area.expected_targets / float(volumes.sum()))


@njit(cache=True)
def _misses(measured: Measurements, first: int, places: FloatArray) -> FloatArray:
    """Return the product of 1 - pi of planned measurements from `first` on, at places, (G, L)."""
    out = np.ones((measured.own.shape[0], places.shape[1]))
    until, at = np.full(places.shape[1], NEVER), (places[0], places[1], places[2])
    for g in range(out.shape[0]):
        apply_misses(at, until, out[g], measured, g, first, measured.own[g])
    return out


def information_terms(
    team: TeamView,
    settings: PlannerSettings,
    planned: tuple[Sequence[RobotView], Measurements],
    settled: tuple[Sequence[RobotView], Measurements],
    first: int,
    centres: FloatArray,
) -> Terms:
    """Return the terms of candidates by measurements from `first` on, beside `settled` ones."""
    d, clusters = team.dimension, team.clusters
    places, left = _unseen(team, settings, bool((planned[1].kind >= BOX).any()))
    for miss in _misses(settled[1], 0, places):
        left *= miss
    kept = np.flatnonzero(left > 0.0)
    miss = _misses(planned[1], first, np.ascontiguousarray(places[:, kept]))
    total = len(miss)
    return Terms(
        refinement=np.zeros(total),
        filled=np.full(total, len(kept)),
        value=left[kept] * (1.0 - miss),
        slot=np.tile(np.arange(total), (total, 1)),
        cache=miss,
        mass=np.array([min(1.0, max(0.0, cluster.mass)) for cluster in clusters], float),
        covariance=np.array([c.covariance[:d, :d] for c in clusters], float).reshape(-1, d, d),
        base=_information(*settled, 0, centres, d).sum(axis=0),
        gain=_information(*planned, first, centres, d),
    )
