"""The objective J of joint candidates: control cost, target refinement, exploration."""

from collections.abc import Mapping

import numpy as np

from maasi_filter.arrays import FloatArray, IntArray
from maasi_planner.objective.joint_search import CandidateTable, values_given
from maasi_planner.objective.predicted_measurements import Ways, predicted, remaining_way
from maasi_planner.objective.terms import information_terms, paper_terms
from maasi_planner.settings import PlannerSettings
from maasi_planner.team import TeamView, UsableCandidates

# Above this number of pairs of a candidate and another robot, reported values of candidates that
# were not chosen neglect the other planning robots.
REPORT_LIMIT = 600


class TeamObjective:
    """Objective of all joint candidates at one step.

    team: the team; robots that do not plan count with the rest of their trajectories; settings:
    weights; options: candidates of the planning robots that have some; names: these, in order;
    start (R + 1,): where the candidates of each begin among all; table: all candidates; alone
    (G, 3): T, E and J of each candidate without the other planning robots.
    """

    def __init__(
        self, team: TeamView, settings: PlannerSettings, options: Mapping[str, UsableCandidates]
    ) -> None:
        weights = settings.weights()
        self.names = [name for name in team.planning() if name in options]
        choices = [options[name] for name in self.names]
        self.start = np.array([0, *(len(option.points) for option in choices)]).cumsum()
        views = [team.robots[name] for name in self.names]
        ways = [
            Ways(view, way.positions, way.yaws, way.lengths, 0, weights.arrival)
            for view, way in zip(views, (option.prediction for option in choices))
        ]
        rest = [remaining_way(team.robots[name]) for name in team.names() if name not in self.names]
        # The first measurement that counts: the present one does not depend on the choice.
        first = 0 if weights.present else 1
        if first and weights.information:
            rest += map(remaining_way, views)
        lengths = np.concatenate([way.lengths for way in ways])
        cost = np.concatenate([option.prediction.control_cost for option in choices])
        planned = predicted(ways, int(lengths.max()), weights.extend)
        settled = predicted(rest, int(lengths.max()), weights.extend)
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
            norm = np.concatenate([option.prediction.distances() for option in choices])
        self.table = CandidateTable(
            allowed=np.concatenate([option.allowed for option in choices]),
            waypoints=np.concatenate([option.points for option in choices]),
            radii=np.array([view.radius for view in views], float),
            cost=weights.control * cost,
            norm=np.maximum(norm, 1e-9),
            alpha=float(weights.alpha),
            beta=float(weights.beta),
            shared=weights.information,
            planned=planned,
            terms=terms,
        )
        nobody = np.full(len(self.names), -1, np.int64)
        self.alone = values_given(self.table, 0, len(norm), nobody)

    def given(self, robot: int, chosen: IntArray) -> FloatArray:
        """Return T, E and J of each candidate of one robot, given the others' choices, (W, 3).

        In teams too large for that, all but the chosen one without the other planning robots.
        """
        others, g = len(self.names) - 1, int(chosen[robot])
        first, last = self.start[robot : robot + 2].tolist()
        if 0 < len(self.alone) * others <= REPORT_LIMIT:
            return values_given(self.table, first, last, chosen)
        rows = self.alone[first:last].copy()
        if others and g >= 0:
            rows[g - first] = values_given(self.table, g, g + 1, chosen)[0]
        return rows
