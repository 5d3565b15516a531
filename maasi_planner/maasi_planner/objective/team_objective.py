"""The objective J of joint candidates: control cost, target refinement, exploration."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from maasi_filter.arrays import FloatArray, IntArray
from maasi_planner.objective.information import information_terms
from maasi_planner.objective.joint_search import CandidateTable, search, total_value, values_given
from maasi_planner.objective.paper import paper_terms
from maasi_planner.objective.predicted_measurements import (
    Ways,
    predicted,
    present_place,
    remaining_way,
)
from maasi_planner.settings import PlannerSettings
from maasi_planner.team import TeamView, UsableCandidates

# Above this number of pairs of a candidate and another robot, reported values of candidates that
# were not chosen neglect the other planning robots.
REPORT_LIMIT = 600


def _all(parts: Sequence[NDArray], dtype: type) -> NDArray:
    """Return arrays (W,) of several robots as one."""
    return np.concatenate([np.zeros(0, dtype), *parts])


class TeamObjective:
    """Objective of all joint candidates at one step.

    team: the team; robots that do not plan count with the rest of their trajectories; settings:
    weights; options: candidates of the planning robots that have some; names: these, in order;
    start (R + 1,): where the candidates of each begin among all; table: all candidates;
    measurements (G,): M of each candidate.
    """

    def __init__(
        self,
        team: TeamView,
        settings: PlannerSettings,
        options: Mapping[str, UsableCandidates],
    ) -> None:
        self.settings = settings
        self.weights = weights = settings.weights()
        self.names = names = [name for name in team.planning() if name in options]
        ways = [options[name].prediction for name in names]
        counts = [len(options[name].points) for name in names]
        self.start = np.array([0, *counts]).cumsum()
        lengths = _all([way.lengths for way in ways], np.int64)
        horizon = int(lengths.max(initial=0))
        views = [team.robots[name] for name in names]
        others = [team.robots[name] for name in team.names() if name not in names]
        rest = [remaining_way(view) for view in others]
        arrival, extend = weights.arrival, weights.extend
        # The first measurement that counts: the present one does not depend on the choice.
        first = 0 if weights.present else 1
        if first and weights.information:
            rest += map(present_place, views)
        planned = predicted(
            [
                Ways(view, way.positions, way.yaws, way.lengths, 0, arrival)
                for view, way in zip(views, ways)
            ],
            horizon,
            extend,
        )
        settled = predicted(rest, horizon, extend)
        self.measurements = planned.own
        centres = np.zeros((len(team.clusters), 3))
        for centre, cluster in zip(centres, team.clusters):
            centre[: team.dimension] = cluster.position[: team.dimension]
        if weights.information:
            groups = (views, planned), ([way.view for way in rest], settled)
            terms = information_terms(team, settings, *groups, first, centres)
        else:
            grid = team.exploration.kernel()
            terms = paper_terms(planned, settled, first, weights.own, centres, grid)
        norm = lengths.astype(float)
        if weights.per_distance:
            norm = _all([way.distances() for way in ways], float)
        self.table = CandidateTable(
            start=self.start,
            robot=planned.robot,
            allowed=_all([options[name].allowed for name in names], bool),
            waypoints=np.concatenate([np.zeros((0, 3)), *(options[name].points for name in names)]),
            radii=np.array([view.radius for view in views], float),
            control=_all([way.control_cost for way in ways], float),
            norm=np.maximum(norm, 1e-9),
            alpha=float(weights.alpha),
            beta=float(weights.beta),
            control_weight=float(weights.control),
            shared=weights.information,
            planned=planned,
            terms=terms,
        )
        self._alone: FloatArray | None = None

    def alone(self) -> FloatArray:
        """Return T, E and J of each candidate without the other planning robots, (G, 3)."""
        if self._alone is None:
            nobody = np.full(len(self.names), -1, np.int64)
            self._alone = values_given(self.table, 0, len(self.table.robot), nobody)
        return self._alone

    def given(self, robot: int, chosen: IntArray) -> FloatArray:
        """Return T, E and J of each candidate of one robot, given the others' choices, (W, 3).

        In teams too large for that, all but the chosen one without the other planning robots.
        """
        others, g = len(self.names) - 1, int(chosen[robot])
        first, last = int(self.start[robot]), int(self.start[robot + 1])
        if others and len(self.table.robot) * others <= REPORT_LIMIT:
            return values_given(self.table, first, last, chosen)
        rows = self.alone()[first:last].copy()
        if others and g >= 0:
            rows[g - first] = values_given(self.table, g, g + 1, chosen)[0]
        return rows

    def value(self, chosen: IntArray) -> float:
        """Return the sum of J of a joint choice (26); indices into all candidates."""
        return float(total_value(self.table, chosen))

    def search(self) -> tuple[IntArray, float, bool, int]:
        """Return the best joint choice, its value, whether it is exact, and the work done.

        The choice (R,) has indices into all candidates, -1 for a robot with none admissible.
        """
        return search(self.table, self.alone()[:, 2], self.settings)
