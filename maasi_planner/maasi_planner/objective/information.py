"""Refinement T as information about clusters, exploration E as expected new targets."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba import njit

from maasi_filter.arrays import FloatArray, IntArray
from maasi_filter.models.detection import BOX, detection_probability_at
from maasi_filter.models.pose import Pose
from maasi_planner.objective.predicted_measurements import (
    NEVER,
    Measurements,
    apply_misses,
    first_of_each,
)
from maasi_planner.settings import PlannerSettings
from maasi_planner.team import RobotView, TeamView


class InformationTerms(NamedTuple):
    """What T and E of candidates consist of.

    Of the clusters mass (C,) and covariance (C, d, d), and the sum of pi H' R^-1 H of measurements
    that do not depend on the choice, base (C, d, d), and of each candidate, gain (G, C, d, d).
    unseen (L,): targets that are expected beside them; miss (G, L): share that a candidate misses.
    """

    mass: FloatArray
    covariance: FloatArray
    base: FloatArray
    gain: FloatArray
    unseen: FloatArray
    miss: FloatArray


# Of the objective `paper`.
NO_INFORMATION = InformationTerms(
    mass=np.zeros(0),
    covariance=np.zeros((0, 3, 3)),
    base=np.zeros((0, 3, 3)),
    gain=np.zeros((0, 0, 3, 3)),
    unseen=np.zeros(0),
    miss=np.zeros((0, 0)),
)


@njit(cache=True)
def _chances(measured: Measurements, rows: IntArray, robot: int, centres: FloatArray) -> FloatArray:
    """Return pi at centres (C, 3) of some measurements of a robot, (n, C)."""
    out = np.empty((rows.shape[0], centres.shape[0]))
    for i in range(rows.shape[0]):
        place, turn = measured.places[rows[i]], measured.turns[rows[i]]
        for c in range(centres.shape[0]):
            out[i, c] = detection_probability_at(
                measured.kind[robot],
                measured.parameters[robot],
                centres[c, 0] - place[0],
                centres[c, 1] - place[1],
                centres[c, 2] - place[2],
                turn[0],
                turn[1],
            )
    return out


@njit(cache=True)
def _add_weighed(
    matrices: FloatArray, weights: FloatArray, owners: IntArray, out: FloatArray
) -> None:
    """Add weights (n, C) times matrices (n, C, d, d) to the rows of out of their owners (n,)."""
    for i in range(owners.shape[0]):
        for c in range(weights.shape[1]):
            for a in range(matrices.shape[2]):
                for b in range(matrices.shape[3]):
                    out[owners[i], c, a, b] += weights[i, c] * matrices[i, c, a, b]


def _whitened(jacobian: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return H' R^-1 H for each H (n, d, d), by Cholesky's factors in plain sums."""
    d = covariance.shape[0]
    lower = np.zeros((d, d))
    for i in range(d):
        for j in range(i + 1):
            rest = float(covariance[i, j]) - sum(float(lower[i, k] * lower[j, k]) for k in range(j))
            lower[i, j] = math.sqrt(rest) if i == j else rest / lower[j, j]
    out = np.zeros((len(jacobian), d, d))
    rows: list[FloatArray] = []
    for i in range(d):
        row = jacobian[:, i, :].copy()
        for k in range(i):
            row -= lower[i, k] * rows[k]
        rows.append(row / lower[i, i])
        out += rows[i][:, :, None] * rows[i][:, None, :]
    return out


def _information(
    views: Sequence[RobotView], measured: Measurements, first: int, centres: FloatArray, d: int
) -> FloatArray:
    """Return sum pi H' R^-1 H over the planned measurements from `first` on, (W, C, d, d)."""
    out = np.zeros((len(measured.own), len(centres), d, d))
    if not len(centres):
        return out
    owner = np.repeat(np.arange(len(measured.own)), np.diff(measured.start))
    index = np.arange(len(owner)) - measured.start[owner]
    counts = (index >= first) & (index < measured.own[owner])
    for robot, view in enumerate(views):
        sensor = view.sensor
        rows = np.flatnonzero(counts & (measured.robot[owner] == robot))
        chances = _chances(measured, rows, robot, centres)
        offsets = (centres[None, :, :] - measured.places[rows][:, None, :])[..., :d]
        # Nearer than the noise of the range the linear model would promise too much.
        least = math.sqrt(float(sensor.covariance[0, 0]))
        distance = np.sqrt((offsets * offsets).sum(axis=2))
        offsets = offsets * np.maximum(1.0, least / np.maximum(distance, 1e-12))[..., None]
        matrices = np.zeros((*chances.shape, d, d))
        seen = chances > 0.0
        if seen.any():
            jacobian = sensor.measurement.jacobian(offsets[seen], Pose(np.zeros(3)))
            matrices[seen] = _whitened(jacobian, sensor.covariance)
        _add_weighed(matrices, chances, owner[rows], out)
    return out


@njit(cache=True)
def _block_sums(values: FloatArray, stride: int) -> FloatArray:
    """Return sums over blocks of `stride` nodes on each axis."""
    x, y, z = values.shape
    out = np.zeros((-(-x // stride), -(-y // stride), -(-z // stride)))
    for i in range(x):
        for j in range(y):
            for k in range(z):
                out[i // stride, j // stride, k // stride] += values[i, j, k]
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
    left = _block_sums(values * volumes, stride)
    start = lower + 0.5 * (stride - 1) * step
    places = start[:, None] + (stride * step)[:, None] * np.indices(left.shape).reshape(3, -1)
    if team.dimension == 2:
        places[2] = 0.0
    return places, left.ravel() * (settings.expected_targets / float(volumes.sum()))


@njit(cache=True)
def _misses(measured: Measurements, first: int, places: FloatArray) -> FloatArray:
    """Return the product of 1 - pi of planned measurements from `first` on, at places, (W, L)."""
    out = np.ones((measured.own.shape[0], places.shape[1]))
    until = np.full(places.shape[1], NEVER)
    for w in range(out.shape[0]):
        apply_misses(places, until, out[w], measured, w, first, measured.own[w])
    return out


def information_terms(
    team: TeamView,
    settings: PlannerSettings,
    planned: tuple[Sequence[RobotView], Measurements],
    settled: tuple[Sequence[RobotView], Measurements],
    first: int,
    centres: FloatArray,
) -> InformationTerms:
    """Return the terms of candidates: robots that plan, and their measurements from `first` on.

    `settled`: the robots that do not plan, and their measurements.
    """
    d, clusters = team.dimension, team.clusters
    # What does not depend on the choice: settled robots, and the present measurements.
    given = [settled, (planned[0], first_of_each(planned[1]))][: 1 + first]
    places, left = _unseen(team, settings, bool((planned[1].kind >= BOX).any()))
    for _, measured in given:
        for miss in _misses(measured, 0, places):
            left *= miss
    kept = np.flatnonzero(left > 0.0)
    return InformationTerms(
        mass=np.array([min(1.0, max(0.0, cluster.mass)) for cluster in clusters], float),
        covariance=np.array([c.covariance[:d, :d] for c in clusters], float).reshape(-1, d, d),
        base=sum(_information(*group, 0, centres, d).sum(axis=0) for group in given),
        gain=_information(*planned, first, centres, d),
        unseen=left[kept],
        miss=_misses(planned[1], first, np.ascontiguousarray(places[:, kept])),
    )


@njit(cache=True)
def _log_det(matrix: FloatArray) -> float:
    """Return log det of a (2, 2) or (3, 3) matrix with determinant of at least 1."""
    if matrix.shape[0] == 2:
        det = matrix[0, 0] * matrix[1, 1] - matrix[0, 1] * matrix[1, 0]
    else:
        det = (
            matrix[0, 0] * (matrix[1, 1] * matrix[2, 2] - matrix[1, 2] * matrix[2, 1])
            - matrix[0, 1] * (matrix[1, 0] * matrix[2, 2] - matrix[1, 2] * matrix[2, 0])
            + matrix[0, 2] * (matrix[1, 0] * matrix[2, 1] - matrix[1, 1] * matrix[2, 0])
        )
    return math.log(max(det, 1.0))


@njit(cache=True)
def information_gain(terms: InformationTerms, g: int, others: IntArray, work: FloatArray) -> float:
    """Return T of candidate g, given the candidates `others` that count before it."""
    d = terms.base.shape[1]
    known, before, after = work[0, :d, :d], work[1, :d, :d], work[2, :d, :d]
    total = 0.0
    for c in range(terms.mass.shape[0]):
        helps = False
        for a in range(d):
            helps |= terms.gain[g, c, a, a] > 0.0
        if not helps:
            continue
        known[:] = terms.base[c]
        for other in others:
            known += terms.gain[other, c]
        for a in range(d):
            for b in range(d):
                before[a, b] = 1.0 if a == b else 0.0
                extra = 0.0
                for k in range(d):
                    before[a, b] += terms.covariance[c, a, k] * known[k, b]
                    extra += terms.covariance[c, a, k] * terms.gain[g, c, k, b]
                after[a, b] = before[a, b] + extra
        total += 0.5 * terms.mass[c] * max(0.0, _log_det(after) - _log_det(before))
    return total
