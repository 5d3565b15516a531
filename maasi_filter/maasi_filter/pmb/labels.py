"""Classes and identities of potential targets, from the labels of their detections."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from maasi_filter.arrays import BoolArray, FloatArray
from maasi_filter.records import UNLABELLED, Label

MISREAD = 1e-6  # odds of clutter against the target that a detection names
LEAST_SHARE = 0.5  # association probability from which a component gets the identity of a detection


@dataclass
class LabelTally:
    """What is known of the class and identity of one potential target."""

    identity: str = ''  # Empty: not known
    #: Sum of the scores of its detections, by class.
    classes: dict[str, float] = field(default_factory=dict)

    @classmethod
    def of(cls, label: Label) -> LabelTally:
        """Return the tally of one label."""
        tally = cls(label.identity)
        tally.add(label, 1.0)
        return tally

    def add(self, label: Label, share: float) -> None:
        """Count a detection's class by its `share` of this target; an unknown score counts as 1."""
        if label.class_id:
            weight = share * (label.score or 1.0)
            self.classes[label.class_id] = self.classes.get(label.class_id, 0.0) + weight

    def merge(self, other: LabelTally) -> None:
        """Add what is known of the same target."""
        self.identity = self.identity or other.identity
        for name, score in other.classes.items():
            self.classes[name] = self.classes.get(name, 0.0) + score

    @property
    def label(self) -> Label:
        """The class of the largest sum, with its share of all sums, and the identity."""
        if not self.classes:
            return Label(identity=self.identity) if self.identity else UNLABELLED
        # Of equal sums the first by name: the order of detections does not matter.
        best = min(self.classes, key=lambda name: (-self.classes[name], name))
        total = sum(self.classes[name] for name in sorted(self.classes))
        score = self.classes[best] / total if total > 0.0 else 0.0
        return Label(best, min(score, 1.0), self.identity)


def associate_by_identity(
    labels: Sequence[Label], tallies: Sequence[LabelTally], odds: FloatArray, other: FloatArray
) -> BoolArray:
    """Leave each detection with an identity only the component of that identity, in place.

    Where no component has the identity yet, those without any remain. Returns the detections (m,)
    whose identity a component has: no new target causes them.
    """
    known = np.zeros(odds.shape[1], np.bool_)
    identities = [tally.identity for tally in tallies]
    for j, label in enumerate(labels):
        if label.identity in identities and label.identity:
            owner = identities.index(label.identity)
            owned = odds[owner, j]
            odds[:, j], odds[owner, j], known[j] = 0.0, owned, True
            # Out of its gate it is a misread identity: clutter.
            if owned > 0.0:
                other[j] = min(other[j], MISREAD * owned)
        elif label.identity:
            odds[[bool(identity) for identity in identities], j] = 0.0
    return known


def learn_labels(
    labels: Sequence[Label], tallies: Sequence[LabelTally], caused: FloatArray
) -> None:
    """Count classes, and give a component the identity of a detection that it caused."""
    taken = {tally.identity for tally in tallies}
    for j, label in enumerate(labels if tallies else ()):
        for i in np.flatnonzero(caused[:, j] > 0.0).tolist():
            tallies[i].add(label, float(caused[i, j]))
        best = int(caused[:, j].argmax())
        free = label.identity not in taken and not tallies[best].identity
        if label.identity and free and caused[best, j] > LEAST_SHARE:
            tallies[best].identity = label.identity
            taken.add(label.identity)
