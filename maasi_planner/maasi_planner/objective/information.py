"""Refinement T as information about clusters, exploration E as expected new targets."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from maasi_filter.models.detection import detection_probability_at
from maasi_filter.models.pose import Pose
from maasi_planner.objective.candidate_table import CandidateTable
from maasi_planner.objective.predicted_measurements import Events, Kernel
from maasi_planner.team import RobotView

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@njit(cache=True)
def _information(
    matrices: FloatArray, probabilities: FloatArray, first: int, own: IntArray, out: FloatArray
) -> None:
    """Sum pi H' R^-1 H over measurements: matrices (W, H, C, d, d) into out (W, C, d, d)."""
    d = matrices.shape[3]
    for w in range(matrices.shape[0]):
        for i in range(first, own[w]):
            for c in range(matrices.shape[2]):
                p = probabilities[w, i, c]
                if p > 0.0:
                    for a in range(d):
                        for b in range(d):
                            out[w, c, a, b] += p * matrices[w, i, c, a, b]


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
def _is_credited(table: CandidateTable, other: int, g: int) -> bool:
    """Return whether what `other` and g both see counts for `other`: its way is shorter."""
    if table.norm[other] != table.norm[g]:
        return table.norm[other] < table.norm[g]
    return table.robot[other] < table.robot[g]


@njit(cache=True)
def information_gain(table: CandidateTable, g: int, chosen: IntArray, work: FloatArray) -> float:
    """Return T of `information` for candidate g, given the others with a shorter way."""
    d = table.dimension
    total = 0.0
    robot = table.robot[g]
    for c in range(table.mass.shape[0]):
        helps = False
        for a in range(d):
            if table.gain[g, c, a, a] > 0.0:
                helps = True
        if not helps:
            continue
        for a in range(d):
            for b in range(d):
                work[0, a, b] = table.base[c, a, b]
        for r in range(chosen.shape[0]):
            if r != robot and chosen[r] >= 0 and _is_credited(table, chosen[r], g):
                for a in range(d):
                    for b in range(d):
                        work[0, a, b] += table.gain[chosen[r], c, a, b]
        for a in range(d):
            for b in range(d):
                without = 1.0 if a == b else 0.0
                extra = 0.0
                for k in range(d):
                    without += table.covariance[c, a, k] * work[0, k, b]
                    extra += table.covariance[c, a, k] * table.gain[g, c, k, b]
                work[1, a, b] = without
                work[2, a, b] = without + extra
        total += (
            0.5 * table.mass[c] * max(0.0, _log_det(work[2, :d, :d]) - _log_det(work[1, :d, :d]))
        )
    return total


@njit(cache=True)
def expected_new_targets(table: CandidateTable, g: int, chosen: IntArray) -> float:
    """Return E of `information` for candidate g, given the others with a shorter way."""
    robot = table.robot[g]
    others = 0
    first = -1
    for r in range(chosen.shape[0]):
        if r != robot and chosen[r] >= 0 and _is_credited(table, chosen[r], g):
            others += 1
            first = chosen[r]
    total = 0.0
    if others == 0:
        for node in range(table.unseen.shape[0]):
            total += table.unseen[node] * (1.0 - table.miss[g, node])
    elif others == 1:
        for node in range(table.unseen.shape[0]):
            seen = 1.0 - table.miss[g, node]
            if seen > 0.0:
                total += table.unseen[node] * seen * table.miss[first, node]
    else:
        for node in range(table.unseen.shape[0]):
            seen = 1.0 - table.miss[g, node]
            if seen > 0.0:
                left = table.unseen[node] * seen
                for r in range(chosen.shape[0]):
                    if r != robot and chosen[r] >= 0 and _is_credited(table, chosen[r], g):
                        left *= table.miss[chosen[r], node]
                total += left
    return total


def add_information(
    view: RobotView,
    kernel: Kernel,
    item: Events,
    first: int,
    centres: FloatArray,
    dimension: int,
    out: FloatArray,
) -> None:
    """Add sum pi H' R^-1 H over the measurements to out (W, C, d, d)."""
    most = int(item.own.max(initial=0))
    if most <= first:
        return
    places = item.places[:, :most]
    offsets = centres[None, None, :, :] - places[:, :, None, :]
    if dimension == 2:
        offsets[..., 2] = 0.0
    sensor = view.sensor
    probabilities = np.zeros(offsets.shape[:3])
    _probabilities(item, offsets, first, kernel, probabilities)
    flat = np.ascontiguousarray(offsets[..., :dimension].reshape(-1, dimension))
    # Nearer than the noise of the range the linear model would promise too much.
    least = math.sqrt(float(sensor.covariance[0, 0]))
    distance = np.sqrt((flat * flat).sum(axis=1))
    flat = flat * np.maximum(1.0, least / np.maximum(distance, 1e-12))[:, None]
    needed = np.flatnonzero(probabilities.ravel() > 0.0)
    matrices = np.zeros((len(flat), dimension, dimension))
    if len(needed):
        jacobian = sensor.measurement.jacobian(flat[needed], Pose(np.zeros(3)))
        matrices[needed] = _whitened(jacobian, sensor.covariance)
    blocks = matrices.reshape(*probabilities.shape, dimension, dimension)
    _information(blocks, probabilities, first, item.own, out)


def _whitened(jacobian: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return H' R^-1 H for each H (n, d, d), by Cholesky's factors in plain sums."""
    d = covariance.shape[0]
    lower = np.zeros((d, d))
    for i in range(d):
        for j in range(i + 1):
            rest = float(covariance[i, j]) - sum(float(lower[i, k] * lower[j, k]) for k in range(j))
            lower[i, j] = math.sqrt(rest) if i == j else rest / lower[j, j]
    rows: list[FloatArray] = []
    for i in range(d):
        row = jacobian[:, i, :].copy()
        for k in range(i):
            row -= lower[i, k] * rows[k]
        rows.append(row / lower[i, i])
    out = np.zeros((len(jacobian), d, d))
    for row in rows:
        out += row[:, :, None] * row[:, None, :]
    return out


@njit(cache=True)
def _probabilities(
    item: Events, offsets: FloatArray, first: int, kernel: Kernel, out: FloatArray
) -> None:
    kind, parameters = kernel
    for w in range(offsets.shape[0]):
        for i in range(first, item.own[w]):
            for c in range(offsets.shape[2]):
                out[w, i, c] = detection_probability_at(
                    kind,
                    parameters,
                    offsets[w, i, c, 0],
                    offsets[w, i, c, 1],
                    offsets[w, i, c, 2],
                    item.turns[w, i, 0],
                    item.turns[w, i, 1],
                )
