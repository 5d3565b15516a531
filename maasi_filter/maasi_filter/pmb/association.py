"""Association by loopy belief propagation (Williams and Lau 2014)."""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from maasi_filter.arrays import FloatArray

ITERATIONS = 500
TOLERANCE = 1e-9


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


def associate(odds: FloatArray, other: FloatArray) -> Marginals:
    """Return the marginal probabilities of which component caused which detection.

    Exact for one component or one detection, else approximate (Williams and Lau 2014). `odds`
    (n, m) are r L_j / (1 - r p_D), per unit of measurement space, `other` (m,) the intensity of
    clutter and new targets, above 0.
    """
    n, m = odds.shape
    marginals = Marginals(np.ones(n), np.zeros((n, m)), np.ones(m))
    if n and m:
        propagate(odds / other, marginals.missed, marginals.caused, marginals.new)
    return marginals
