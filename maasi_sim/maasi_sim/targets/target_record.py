"""The record of a search for targets."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from maasi_filter.models.pose import Pose
from maasi_sim.run.run_record import RunRecord
from maasi_sim.targets.scoring import Scores, score, scoring_radius
from maasi_sim.targets.tally import Found, Progress

FloatArray = NDArray[np.float64]


@dataclass
class TargetRecord(RunRecord):
    """The record of a search for targets.

    Attributes
    ----------
    truth : (n, d) array
        True targets [m].
    found : list of Found
        At the end.
    progress : list of Progress
        After each filter update.
    measurements : dict
        Number by robot.
    decisions : int
        Waypoints chosen, of all robots.
    waypoints : dict
        By robot: chosen ones in order, (n, 3) [m].
    measured_from : dict
        By robot: poses at which it measured, in order.
    explored, expected_number : float
        Share of the environment, and targets believed not yet found, at the end.
    """

    truth: FloatArray
    found: list[Found] = field(default_factory=list)
    progress: list[Progress] = field(default_factory=list)
    measurements: dict[str, int] = field(default_factory=dict)
    decisions: int = 0
    waypoints: dict[str, FloatArray] = field(default_factory=dict)
    measured_from: dict[str, list[Pose]] = field(default_factory=dict)
    explored: float = 0.0
    expected_number: float = 0.0

    @property
    def radius(self) -> float:
        """Distance within which a found target is true [m]."""
        return scoring_radius(self.scenario, self.truth)

    def scores(self) -> Scores:
        """Return the scores at the end."""
        positions = [target.position for target in self.found]
        return score(positions, self.truth, self.radius, self.scenario.scoring.order)
