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

    The scenario's, or three times T_z, at most half the smallest distance between two targets, so
    that none can be matched with its neighbour.
    """
    if scenario.scoring.radius is not None:
        return scenario.scoring.radius
    radius = 3.0 * scenario.removal_distance()
    if len(truth) > 1:
        # Deferred: it is the slowest import of a run.
        from scipy.spatial.distance import pdist

        nearest = float(pdist(truth).min())
        if nearest == 0.0:
            raise ValueError('truth: got two targets at the same place, allowed are different ones')
        radius = min(radius, 0.5 * nearest)
    return radius


@dataclass(frozen=True)
class Scores:
    """Found targets against the truth: one-to-one pairs, and GOSPA.

    `radius` is the distance within which a found target is true, and c of GOSPA [m]; `order` its p.
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
    """Return the scores of found targets, or of places (n, d), against true ones (m, d) [m]."""
    if not isinstance(found, np.ndarray):
        found = np.array([getattr(item, 'position', item) for item in found])
    return Scores(
        radius,
        order,
        match_targets(found, truth, radius),
        gospa(found, truth, cutoff=radius, power=order),
    )


class Scoreboard:
    """Found targets of all filters against the true ones, now.

    Parameters
    ----------
    radius : float or None
        Distance within which a found target is true [m]; None: nothing is scored.
    order : float
        p of GOSPA.
    truth : (n, d) array or None
        True targets [m], where they are known.

    Attributes
    ----------
    found : dict
        Targets that the filter of a team has found, by team.
    """

    def __init__(self, radius: float | None, order: float, truth: FloatArray | None) -> None:
        self._radius, self._order, self.truth = radius, order, truth
        self.found: dict[str, Sequence[FoundTarget]] = {}

    def scores(self) -> Scores | None:
        """Return the scores; None if there is nothing to score against."""
        return None if self.truth is None else self.scores_against(self.truth)

    def scores_against(self, truth: FloatArray) -> Scores | None:
        """Return the scores of what is found against true targets (n, d) [m]."""
        if self._radius is None:
            return None
        found = numbered(list(self.found.values()))
        return score(found, truth, self._radius, self._order)


def numbered(found: Sequence[Sequence[FoundTarget]]) -> list[FoundTarget]:
    """Return the found targets of several filters as one list, numbered in the order of time."""
    if len(found) == 1:
        return list(found[0])
    every = sorted(chain(*found), key=lambda item: (item.time, item.robot, item.id))
    return [replace(item, id=number) for number, item in enumerate(every, start=1)]
