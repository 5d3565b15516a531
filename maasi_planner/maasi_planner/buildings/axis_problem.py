"""The quadratic problem of one axis of P2 (004): rows, costs, and a dual active-set method."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit

from maasi_filter.arrays import FloatArray, IntArray
from maasi_planner.buildings.dynamics import Dynamics

SCALE = 1e4  # of the objective, so that its rows are of magnitude 1
TOLERANCE = 1e-7  # of the bounds of rows [m, m/s, N]
DEPENDENT = 1e-10  # share of a row's length below which active rows span it


class AxisScratch(NamedTuple):
    """Scratch arrays of `solve_axis` for n forces: (n + 1,) twice, (n + 1, n + 1), (2, n + 1)."""

    active: IntArray
    multipliers: FloatArray
    factor: FloatArray
    work: FloatArray


@dataclass(frozen=True)
class AxisRows:
    """Linear functions of the forces u_0 to u_{T-1} of an axis, m rows; the state gives P_1."""

    matrix: FloatArray
    gram: FloatArray  # (m, m): matrix H^-1 matrix', H the Hessian of the objective
    inverse: FloatArray  # (T, T): H^-1
    pull: FloatArray  # (T + 1,): weight of the squared distance from the target, scaled [1/m^2]


def axis_rows(
    dynamics: Dynamics, horizon: int, pull: FloatArray, smoothness: float, rolling: FloatArray
) -> AxisRows:
    """Return the rows of an axis for unscaled weights and rolling distances (J,) [m]."""
    forces = np.eye(horizon)
    gamma = dynamics.step / dynamics.mass
    velocities = np.zeros((horizon + 1, horizon))
    positions = np.zeros((horizon + 1, horizon))
    for k in range(horizon):
        velocities[k + 1] = dynamics.retained * velocities[k] + gamma * forces[k]
        positions[k + 1] = positions[k] + dynamics.step * velocities[k]
    terminal = positions[horizon] + rolling[:, None] * velocities[horizon]
    matrix = np.vstack([positions[2:], velocities[1:], forces, terminal])
    differences = np.diff(forces, axis=0)
    hessian = (
        2.0 * SCALE * (smoothness * differences.T @ differences + (positions.T * pull) @ positions)
    )
    inverse = np.linalg.inv(hessian)
    inverse = 0.5 * (inverse + inverse.T)
    gram = np.ascontiguousarray(matrix @ (inverse @ matrix.T))
    return AxisRows(np.ascontiguousarray(matrix), gram, inverse, SCALE * pull)


@njit(cache=True, error_model='numpy')
def solve_axis(
    gram: FloatArray,
    free: FloatArray,
    lower: FloatArray,
    upper: FloatArray,
    most: int,
    cutoff: float,
    y: FloatArray,
    axis_scratch: AxisScratch,
) -> float:
    """Minimise over the rows' values y = free + gram lambda in their bounds (Goldfarb, Idnani).

    Return the objective above that of the free minimum; inf without a solution, or above `cutoff`.
    """
    active, multipliers, factor, work = axis_scratch
    m = free.shape[0]
    for i in range(m):
        y[i] = free[i]
    count = 0
    objective = 0.0
    row, step = work[0], work[1]
    for _ in range(400):
        # The most violated row, each measured by its own length.
        worst, p, sign = 0.0, -1, 1.0
        for i in range(m):
            low = lower[i] - y[i]
            high = y[i] - upper[i]
            gap = low if low > high else high
            if gap > TOLERANCE:
                score = gap * gap / (gram[i, i] + 1e-300)
                if score > worst:
                    taken = False
                    for a in range(count):
                        if active[a] == i:
                            taken = True
                            break
                    if not taken or gap > 1e-5:
                        worst = score
                        p = i
                        sign = 1.0 if low > high else -1.0
        if p < 0:
            return objective
        multiplier = 0.0
        while True:
            # factor is the lower Cholesky factor of the active rows' part of gram.
            left = gram[p, p]
            for a in range(count):
                value = gram[active[a], p]
                for b in range(a):
                    value -= factor[a, b] * row[b]
                row[a] = value / factor[a, a]
                left -= row[a] * row[a]
            for a in range(count - 1, -1, -1):
                value = row[a]
                for b in range(a + 1, count):
                    value -= factor[b, a] * step[b]
                step[a] = value / factor[a, a]
            dependent = left <= DEPENDENT * gram[p, p] or count >= most
            shortest, leaving = math.inf, -1
            for a in range(count):
                side = 1.0 if multipliers[a] > 0.0 else -1.0
                fall = sign * step[a] * side
                if fall > 1e-13:
                    length = multipliers[a] * side / fall
                    if length < shortest:
                        shortest = length
                        leaving = a
            full = math.inf
            if not dependent:
                gap = lower[p] - y[p] if sign > 0.0 else y[p] - upper[p]
                full = gap / left
            length = shortest if shortest < full else full
            if length == math.inf:
                return math.inf
            if not dependent:
                for i in range(m):
                    value = gram[i, p]
                    for a in range(count):
                        value -= gram[i, active[a]] * step[a]
                    y[i] += sign * length * value
                objective += length * left * (0.5 * length + multiplier)
                if objective > cutoff:
                    return math.inf
            for a in range(count):
                multipliers[a] -= sign * length * step[a]
            multiplier += length
            if length == full:
                if count >= most:
                    return math.inf
                for a in range(count):
                    factor[count, a] = row[a]
                factor[count, count] = math.sqrt(left)
                active[count] = p
                multipliers[count] = sign * multiplier
                count += 1
                break
            # The blocking row leaves; recompute the factor from there on.
            count -= 1
            for a in range(leaving, count):
                active[a] = active[a + 1]
                multipliers[a] = multipliers[a + 1]
            for a in range(leaving, count):
                for b in range(a + 1):
                    value = gram[active[a], active[b]]
                    for c in range(b):
                        value -= factor[a, c] * factor[b, c]
                    if b == a:
                        factor[a, a] = math.sqrt(value if value > 1e-14 else 1e-14)
                    else:
                        factor[a, b] = value / factor[b, b]
    return math.inf
