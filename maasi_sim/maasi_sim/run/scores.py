"""Found targets against the truth."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np
from numpy.typing import ArrayLike

from maasi_filter.arrays import FloatArray
from maasi_filter.metrics import Gospa, Match, gospa, match_targets
from maasi_filter.records import FoundTarget
from maasi_sim.scenario.schema import Scenario


def scoring_radius(scenario: Scenario, truth: FloatArray) -> float:
    """Return the distance within which a found target is true [m]; true positions (n, d) [m].

    The scenario's, or 3 T_z, at most half the smallest distance of two targets, so that a find
    matches only one target.
    """
    if scenario.scoring.radius is not None:
        return scenario.scoring.radius
    radius = 3.0 * scenario.removal_distance()
    if len(truth) > 1:
        # Deferred: the slowest import of a run.
        from scipy.spatial.distance import pdist

        nearest = float(pdist(truth).min())
        if nearest == 0.0:
            raise ValueError(
                'truth: read two targets at the same position, allowed are different ones'
            )
        radius = min(radius, 0.5 * nearest)
    return radius


@dataclass(frozen=True)
class Scores:
    """One-to-one pairs of found and true targets, and GOSPA.

    `radius`: distance within which a find is true, and c of GOSPA [m]; `order`: p.
    """

    radius: float
    order: float
    match: Match
    gospa: Gospa

    @property
    def complete(self) -> bool:
        """Whether every true target is found."""
        return self.match.missed == 0


def score(
    found: Sequence[FoundTarget] | FloatArray, truth: ArrayLike, radius: float, order: float = 2.0
) -> Scores:
    """Return the scores of found targets or positions (n, d) against true ones (m, d) [m]."""
    if not isinstance(found, np.ndarray):
        found = np.array([getattr(item, 'position', item) for item in found])
    return Scores(
        radius,
        order,
        match_targets(found, truth, radius),
        gospa(found, truth, cutoff=radius, power=order),
    )


class Scoreboard:
    """Scores of the current finds of all filters.

    radius: distance within which a find is true [m], None: no scores. order: p of GOSPA. truth:
    true targets (n, d) [m], or None. found: targets found by the filter of each team.
    """

    def __init__(self, radius: float | None, order: float, truth: FloatArray | None) -> None:
        self._radius, self._order, self.truth = radius, order, truth
        self.found: dict[str, Sequence[FoundTarget]] = {}

    def scores(self) -> Scores | None:
        """Return the scores, or None without a truth."""
        return None if self.truth is None else self.scores_against(self.truth)

    def scores_against(self, truth: FloatArray) -> Scores | None:
        """Return the scores against true targets (n, d) [m]."""
        if self._radius is None:
            return None
        found = numbered(list(self.found.values()))
        return score(found, truth, self._radius, self._order)


def numbered(found: Sequence[Sequence[FoundTarget]]) -> list[FoundTarget]:
    """Return the found targets of several filters as one list, numbered by time."""
    if len(found) == 1:
        return list(found[0])
    every = sorted(chain(*found), key=lambda item: (item.time, item.robot, item.id))
    return [replace(item, id=number) for number, item in enumerate(every, start=1)]
