"""Association by identity: a detection that names its target was caused by no other."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from maasi_filter.arrays import BoolArray, FloatArray
from maasi_filter.models.label import Label, LabelTally
from maasi_filter.pmb.component import Component

# Odds of clutter against the target that a detection names.
MISREAD = 1e-6
# Association probability from which a component gets the identity of a detection.
LEAST_SHARE = 0.5


def associate_by_identity(
    labels: Sequence[Label], components: Sequence[Component], odds: FloatArray, other: FloatArray
) -> BoolArray:
    """Leave each detection with an identity only the component of that identity, in place.

    Where no component has the identity yet, those without any remain.

    Parameters
    ----------
    labels : sequence of Label
        Of the m detections; empty: none has one.
    odds : (n, m) array
        r L_j / (1 - r p_D); as in `associate`.
    other : (m,) array
        Intensity of clutter and new targets.

    Returns
    -------
    (m,) bool array
        Detections whose identity a component has: no new target causes them.
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
    """Count classes, and give a component the identity of a detection that it caused.

    Parameters
    ----------
    caused : (n, m) array
        Probability that component i caused detection j.
    """
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
