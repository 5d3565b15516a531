"""Battery failures, and rewards given the plans of other robots: 004, (3), (11) to (14)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from maasi_filter.arrays import BoolArray


@dataclass(frozen=True)
class Hazard:
    """Probability p_b that a battery fails at a step, t steps after it was charged: (3)."""

    alpha: float
    beta: float
    failures: bool = True

    def __call__(self, steps: float) -> float:
        """Return p_b(t) [1]."""
        if not self.failures:
            return 0.0
        exponent = min(max(-self.beta * (steps - self.alpha), -700.0), 700.0)
        return 1.0 / (1.0 + self.alpha * math.exp(exponent))


@dataclass(frozen=True)
class HeardPlan:
    """Plan of another robot of the previous step, as received.

    Attributes
    ----------
    visits : mapping
        tau by cuboid: steps from now until the visit.
    flight_steps : int
        t_Fl, since its last recharge.
    hazard : Hazard
        Failure hazard of its battery.
    """

    visits: Mapping[int, int]
    flight_steps: int
    hazard: Hazard


def rewards(
    number: int,
    own_steps: int,
    horizon: int,
    hazard: Hazard,
    heard: Sequence[HeardPlan],
    alpha: float,
    beta: float,
    condition: Literal['low_hazard', 'printed'],
    rng: np.random.Generator,
) -> BoolArray:
    """Draw r(n) for all cuboids, (number,): (11) to (14).

    Always takes one draw per cuboid from `rng`, so that the sequence does not depend on the plans.
    """
    draws = rng.random(number)
    result = np.ones(number, dtype=bool)
    own = hazard(own_steps + horizon)
    for n in sorted({n for plan in heard for n in plan.visits}):
        product, expected = 1.0, 0.0
        for plan in heard:
            if n in plan.visits:
                fails = plan.hazard(plan.flight_steps + plan.visits[n] - 1)  # (11)
                product *= fails
                expected += 1.0 - fails
        missed = (1.0 - own) * product  # (12)
        holds = own <= 0.5 if condition == 'low_hazard' else own > 0.5
        joins = 1.0 - 1.0 / (1.0 + alpha * math.exp(-beta * (expected - alpha))) if holds else 0.0
        result[n] = draws[n] < max(missed, joins)  # (13), (14)
    return result
