"""Whether the detections of found targets are where the settings lead to expect them."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from maasi_filter.arrays import FloatArray

# Share of the weight of earlier detections that each new one leaves.
MEMORY = 1.0 - 1.0 / 50.0
# A single outlier, such as a detection of another target, is no misfit: squares count up to this
# for each dimension.
MOST_SQUARE = 6.0
# Deviations of a standard normal number above which detections do not fit.
BOUND = 4.0
# Sums of a robot of which no detection was counted.
NOTHING = np.zeros(3)


@dataclass
class Consistency:
    """Forgetting sums of the squared normalised innovations of each robot.

    Where noise, positions and stillness are as believed, a sum with weights w, divided by d sum w,
    is nearly chi-squared over its degrees of freedom, d (sum w)^2 / sum w^2.

    Attributes
    ----------
    sums : dict
        By robot: sums of w e' S^-1 e, of d w, and of d w^2.
    """

    sums: dict[str, FloatArray] = field(default_factory=dict)

    def count(self, robot: str, square: float, dimension: int) -> None:
        """Count a detection that a found target caused."""
        memory = np.array([MEMORY, MEMORY, MEMORY**2])
        new = np.array([min(square, MOST_SQUARE * dimension), dimension, dimension])
        self.sums[robot] = memory * self.sums.get(robot, NOTHING) + new

    def misfits(self) -> dict[str, str]:
        """Return a warning for each robot whose detections do not fit."""
        found = {}
        for robot, (squares, expected, weights) in sorted(self.sums.items()):
            if expected > 0.0 and _excess(squares / expected, expected**2 / weights) > BOUND:
                found[robot] = (
                    f'{robot}: detections of found targets are {math.sqrt(squares / expected):.1f} '
                    'times as far from where they are expected as the settings say: its noise or '
                    'the errors of its positions are larger, or targets do not stand still'
                )
        return found


def _excess(ratio: float, freedom: float) -> float:
    """Return chi-squared over its degrees of freedom in deviations from what is expected.

    Its cube root is nearly normal (Wilson and Hilferty 1931).
    """
    variance = 2.0 / (9.0 * freedom)
    return (ratio ** (1.0 / 3.0) - (1.0 - variance)) / math.sqrt(variance)
