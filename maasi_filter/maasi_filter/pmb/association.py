"""Association: by loopy belief propagation (Williams and Lau 2014), and by identity."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit

from maasi_filter.arrays import BoolArray, FloatArray
from maasi_filter.pmb.component import Component, LabelTally
from maasi_filter.records import Label

ITERATIONS = 500
TOLERANCE = 1e-9
# Odds of clutter against the target that a detection names.
MISREAD = 1e-6
# Association probability from which a component gets the identity of a detection.
LEAST_SHARE = 0.5


@dataclass(frozen=True)
class Marginals:
    """Probabilities of associations in one scan."""

    missed: FloatArray  # (n,): That component i caused no detection
    caused: FloatArray  # (n, m): That component i caused detection j
    new: FloatArray  # (m,): That no component caused detection j


@njit(cache=True, error_model='numpy')
def propagate(psi, missed, caused, new):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Pass messages until they stand still, and fill the marginals; `psi` is odds over `other`.

    Returns the log of the sum of the weights of all associations, by the Bethe free energy
    (Yedidia, Freeman and Weiss 2005).
    """
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


def associate_by_identity(
    labels: Sequence[Label], components: Sequence[Component], odds: FloatArray, other: FloatArray
) -> BoolArray:
    """Leave each detection with an identity only the component of that identity, in place.

    Where no component has the identity yet, those without any remain. Returns the detections (m,)
    whose identity a component has: no new target causes them.
    """
    known = np.zeros(odds.shape[1], np.bool_)
    identities = [item.labels.identity for item in components]
    for j, label in enumerate(labels):
        if not label.identity:
            continue
        owner = identities.index(label.identity) if label.identity in identities else -1
        for i, identity in enumerate(identities):
            if i != owner and (owner >= 0 or identity):
                odds[i, j] = 0.0
        known[j] = owner >= 0
        # Out of its gate it is a misread identity: clutter.
        if known[j] and odds[owner, j] > 0.0:
            other[j] = min(other[j], MISREAD * odds[owner, j])
    return known


def learn_labels(
    labels: Sequence[Label], components: Sequence[Component], caused: FloatArray
) -> None:
    """Count classes, and give a component the identity of a detection that it caused."""
    taken = {item.labels.identity for item in components}
    for j, label in enumerate(labels):
        for i, item in enumerate(components):
            if caused[i, j] > 0.0:
                item.labels.add(label, float(caused[i, j]))
        if label.identity and label.identity not in taken and len(components):
            best = components[int(np.argmax(caused[:, j]))]
            if caused[:, j].max() > LEAST_SHARE and not best.labels.identity:
                best.labels.identity = label.identity
                taken.add(label.identity)


def new_label(labels: Sequence[Label], j: int, components: Sequence[Component]) -> LabelTally:
    """Return the label of a component born from detection j; an identity belongs to one."""
    if not labels:
        return LabelTally()
    tally = LabelTally.of(labels[j])
    if any(item.labels.identity == tally.identity for item in components):
        tally.identity = ''
    return tally
