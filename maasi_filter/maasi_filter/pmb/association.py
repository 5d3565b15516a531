"""Association by loopy belief propagation (Williams and Lau 2014)."""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from maasi_filter.arrays import FloatArray, IntArray

ITERATIONS = 500
TOLERANCE = 1e-9
# Scans with more pairs of a component and a detection are large: pairs far apart are left out.
MANY_PAIRS = 40_000
LEAST_ODDS = 1e-9  # that a pair has in a large scan
MOST_MESSAGES = 20_000_000  # in all iterations of a large scan


class Marginals(NamedTuple):
    """Probabilities of associations in one scan."""

    missed: FloatArray  # (n,): That component i caused no detection
    caused: FloatArray  # (n, m): That component i caused detection j
    new: FloatArray  # (m,): That no component caused detection j


@njit(cache=True, error_model='numpy')
def propagate(psi, missed, caused, new):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Fill the marginals; return the log of all weights (Yedidia, Freeman and Weiss 2005)."""
    n, m = psi.shape
    mu = np.zeros((n, m))
    nu = np.ones((n, m))
    for _ in range(ITERATIONS):
        change = 0.0
        for i in range(n):
            total = 1.0
            for j in range(m):
                total += psi[i, j] * nu[i, j]
            for j in range(m):
                # The sum over the others; the difference loses nothing that matters above 1.
                others = max(total - psi[i, j] * nu[i, j], 1.0)
                mu[i, j] = psi[i, j] / others
        for j in range(m):
            total = 1.0
            for i in range(n):
                total += mu[i, j]
            for i in range(n):
                message = 1.0 / max(total - mu[i, j], 1.0)
                change = max(change, abs(message - nu[i, j]))
                nu[i, j] = message
        if change < TOLERANCE:
            break
    log_sum = 0.0
    for i in range(n):
        total = 1.0
        for j in range(m):
            total += psi[i, j] * nu[i, j]
        missed[i] = 1.0 / total
        log_sum += math.log(total)
        for j in range(m):
            caused[i, j] = psi[i, j] * nu[i, j] / total
            log_sum -= math.log(1.0 + mu[i, j] * nu[i, j])
    for j in range(m):
        total = 1.0
        for i in range(n):
            total += mu[i, j]
        new[j] = 1.0 / total
        log_sum += math.log(total)
    return log_sum


@njit(cache=True, error_model='numpy')
def _propagate_pairs(component, detection, psi, iterations, shape, probability):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Fill the marginals of pairs (p,) as `propagate` does; return those of no pair, (n,), (m,)."""
    to_detection, to_component = np.zeros(len(psi)), np.ones(len(psi))
    rows, columns = np.ones(shape[0]), np.ones(shape[1])
    for iteration in range(iterations + 1):
        rows[:] = 1.0
        for p in range(len(psi)):
            rows[component[p]] += psi[p] * to_component[p]
        if iteration == iterations:
            break
        columns[:] = 1.0
        for p in range(len(psi)):
            others = max(rows[component[p]] - psi[p] * to_component[p], 1.0)
            to_detection[p] = psi[p] / others
            columns[detection[p]] += to_detection[p]
        change = 0.0
        for p in range(len(psi)):
            message = 1.0 / max(columns[detection[p]] - to_detection[p], 1.0)
            change = max(change, abs(message - to_component[p]))
            to_component[p] = message
        if change < TOLERANCE:
            iterations = iteration + 1
    for p in range(len(psi)):
        probability[p] = psi[p] * to_component[p] / rows[component[p]]
    return 1.0 / rows, 1.0 / columns


def associate_pairs(
    psi: FloatArray, component: IntArray, detection: IntArray, shape: tuple[int, int]
) -> Marginals:
    """Return the marginals of a large scan, of pairs with weights psi (p,)."""
    iterations = min(ITERATIONS, max(1, MOST_MESSAGES // max(1, len(psi))))
    caused, probability = np.zeros(shape), np.empty(len(psi))
    missed, new = _propagate_pairs(component, detection, psi, iterations, shape, probability)
    caused[component, detection] = probability
    return Marginals(missed, caused, new)


def associate(odds: FloatArray, other: FloatArray) -> Marginals:
    """Return the marginal probabilities of which component caused which detection.

    Exact for one component or one detection, else approximate (Williams and Lau 2014). `odds`
    (n, m) are r L_j / (1 - r p_D), per unit of measurement space, `other` (m,) the intensity of
    clutter and new targets, above 0.
    """
    n, m = odds.shape
    marginals = Marginals(np.ones(n), np.zeros((n, m)), np.ones(m))
    if n * m > MANY_PAIRS:
        psi = odds / other
        component, detection = np.nonzero(psi > LEAST_ODDS)
        return associate_pairs(psi[component, detection], component, detection, (n, m))
    if n and m:
        propagate(odds / other, marginals.missed, marginals.caused, marginals.new)
    return marginals
