"""The objective J of joint candidates: control cost, target refinement, exploration."""

from collections.abc import Mapping, Sequence

import numpy as np

from maasi_filter.arrays import BoolArray, FloatArray, IntArray
from maasi_planner.objective.candidate_table import CandidateTable, part_of_table, values_given
from maasi_planner.objective.information_terms import InformationTerms, joined, reduced
from maasi_planner.objective.joint_search import PAIRS_LIMIT
from maasi_planner.objective.paper_terms import paper_terms
from maasi_planner.objective.predicted_measurements import path_ahead, planned_paths, predicted
from maasi_planner.objective.settings import InformationSettings
from maasi_planner.objective.sight import CLEAR, Sight
from maasi_planner.objective.terms import Terms
from maasi_planner.team import RobotView, TeamView, UsableCandidates

# Above this number of pairs of a candidate and another robot, reported values of candidates that
# were not chosen neglect the other planning robots.
REPORT_LIMIT = 600
# Most nodes seen by the candidates of all robots together; above, the joint choice has only the
# best candidates of each robot without the others. 12 bytes each.
MOST_ENTRIES = 8_000_000
LEAST_KEPT = 8  # fewest candidates of a robot in the joint choice


class TeamObjective:
    """Objective of all joint candidates at one step.

    Robots that do not plan count with their remaining trajectories. names: planning robots with
    candidates, in order; start (R + 1,): begin of the candidates of each; table: all candidates;
    alone (G, 3): T, E and J without the other planning robots; kept (G,): candidates of the joint
    choice.
    """

    def __init__(
        self,
        team: TeamView,
        settings: InformationSettings,
        options: Mapping[str, UsableCandidates],
        sight: Sight = CLEAR,
    ) -> None:
        informed = settings.objective == 'information'
        self.names = [name for name in team.planning() if name in options]
        choices = [options[name] for name in self.names]
        self.start = np.array([0, *(len(option.points) for option in choices)]).cumsum()
        views = [team.robots[name] for name in self.names]
        paths = [
            planned_paths(view, option.prediction, settings.measure_at_arrival)
            for view, option in zip(views, choices)
        ]
        rest = [path_ahead(team.robots[name]) for name in team.names() if name not in self.names]
        # First counted measurement: the present one does not depend on the choice.
        first = 0 if settings.count_present else 1
        if first and informed:
            rest += map(path_ahead, views)
        lengths = np.concatenate([path.lengths for path in paths])
        cost = np.concatenate([option.prediction.control_cost for option in choices])
        # By information, later measurements at a robot's end do not count.
        extend = settings.extension == 'measuring' and not informed
        planned = predicted(paths, int(lengths.max()), extend, sight)
        settled = predicted(rest, int(lengths.max()), extend, sight)
        norm = lengths.astype(float)
        if settings.normalisation == 'distance':
            norm = np.concatenate([option.prediction.distances() for option in choices])
        self.kept: BoolArray = np.ones(len(norm), np.bool_)
        table = CandidateTable(
            allowed=np.concatenate([option.allowed for option in choices]),
            waypoints=np.concatenate([option.points for option in choices]),
            radii=np.array([view.radius for view in views], float),
            cost=settings.control_weight * cost,
            norm=np.maximum(norm, 1e-9),
            alpha=float(settings.alpha),
            beta=float(settings.beta),
            planned=planned,
            terms=Terms(informed, np.zeros(0), np.zeros(1, np.int64)),
        )
        if informed:
            others = [path.view for path in rest], settled
            build = InformationTerms(team, settings, others, planned.kind)
            self.table, self.alone = self._by_robot(table, build, views, first)
            return
        centres = np.zeros((len(team.clusters), 3))
        for centre, cluster in zip(centres, team.clusters):
            centre[: team.dimension] = cluster.position[: team.dimension]
        grid = team.exploration.kernel()
        terms = paper_terms(planned, settled, first, settings.own_measurement, centres, grid)
        self.table = table._replace(terms=terms)
        nobody = np.full(len(self.names), -1, np.int64)
        self.alone = values_given(self.table, 0, len(norm), nobody)

    def _by_robot(
        self,
        table: CandidateTable,
        build: InformationTerms,
        views: Sequence[RobotView],
        first: int,
    ) -> tuple[CandidateTable, FloatArray]:
        """Return the table with its terms, and T, E and J of each candidate by itself."""
        robots = len(views)
        whole = robots <= PAIRS_LIMIT and build.are_few(len(self.kept))
        nobody = np.full(robots, -1, np.int64)
        parts, alone = [], []
        for view, begin, end in zip(views, self.start[:-1].tolist(), self.start[1:].tolist()):
            part = part_of_table(table, begin, end)
            terms = build.of(view, part.planned, first, whole)
            values = values_given(part._replace(terms=terms), 0, end - begin, nobody)
            if robots > 1:
                kept = best_of(values[:, 2], np.diff(terms.first), MOST_ENTRIES // robots)
                self.kept[begin:end] = kept
                terms = reduced(terms, kept)
            parts.append(terms)
            alone.append(values)
        return table._replace(terms=joined(parts)), np.concatenate(alone)

    @property
    def bounds(self) -> FloatArray:
        """Upper bound of J (G,) of candidates of the joint choice; -inf for others."""
        return np.where(self.kept, self.alone[:, 2], -np.inf)

    def given(self, robot: int, chosen: IntArray) -> FloatArray:
        """Return T, E and J of each candidate of one robot, given the others' choices, (W, 3).

        In very large teams only the chosen one accounts for the other planning robots.
        """
        others, g = len(self.names) - 1, int(chosen[robot])
        first, last = self.start[robot : robot + 2].tolist()
        if 0 < len(self.alone) * others <= REPORT_LIMIT and self.kept.all():
            return values_given(self.table, first, last, chosen)
        rows = self.alone[first:last].copy()
        if others and g >= 0:
            rows[g - first] = values_given(self.table, g, g + 1, chosen)[0]
        return rows


def best_of(values: FloatArray, counts: IntArray, most: int) -> BoolArray:
    """Return the best candidates (W,) that see at most `most` nodes together."""
    order = np.argsort(-values, kind='stable')
    fits = counts[order].cumsum() <= most
    fits[:LEAST_KEPT] = True
    kept = np.zeros(len(values), np.bool_)
    kept[order[fits]] = True
    return kept
