"""What a detector tells of a target beside its position: class, score and identity."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True)
class Label:
    """Class and identity of a detection or a found target.

    Parameters
    ----------
    class_id : str
        Name of the class; empty: not known.
    score : float
        Confidence in the class, 0 to 1; 0: not known.
    identity : str
        What tells this target from all others, such as the id of a marker; empty: not known.

    Raises
    ------
    ValueError
        If the score is not from 0 to 1.
    """

    class_id: str = ''
    score: float = 0.0
    identity: str = ''

    def __post_init__(self) -> None:
        # Negated, so that NaN is refused too.
        if not 0.0 <= self.score <= 1.0:
            raise ValueError(f'score: got {self.score}, allowed is 0 to 1')


#: Of a detection about which nothing is known but its position.
UNLABELLED = Label()


@dataclass
class LabelTally:
    """What is known of the class and identity of one potential target.

    Parameters
    ----------
    identity : str
        Empty: not known.
    classes : dict
        Sum of the scores of its detections, by class.
    """

    identity: str = ''
    classes: dict[str, float] = field(default_factory=dict)

    @classmethod
    def of(cls, label: Label) -> LabelTally:
        """Return the tally of one label."""
        tally = cls(label.identity)
        tally.add(label, 1.0)
        return tally

    def add(self, label: Label, share: float) -> None:
        """Count the class of a detection that this target caused with probability `share`.

        A score that is not known counts as 1.
        """
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
            return Label(identity=self.identity)
        # Of equal sums the first by name: the order of detections does not matter.
        best = min(self.classes, key=lambda name: (-self.classes[name], name))
        total = sum(self.classes[name] for name in sorted(self.classes))
        score = self.classes[best] / total if total > 0.0 else 0.0
        return Label(best, min(score, 1.0), self.identity)
