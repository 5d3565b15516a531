"""Active search with intermittent measurements, ASI and MAASI (000, sections 4 and 6)."""

from numba import njit

from maasi_filter.arrays import BoolArray, FloatArray
from maasi_filter.geometry.area import Area
from maasi_filter.wording import counted
from maasi_planner.motion.base import Trajectories
from maasi_planner.objective.joint_search import PAIRS_LIMIT, search
from maasi_planner.objective.predicted_measurements import CoarseTrajectories
from maasi_planner.objective.settings import InformationSettings
from maasi_planner.objective.sight import SightTables
from maasi_planner.objective.team_objective import TeamObjective
from maasi_planner.objective.terms import Terms
from maasi_planner.planners.base import Planner, explain
from maasi_planner.planners.options import centres_of, usable_options
from maasi_planner.team import ASSIGNED, Decision, TeamView, single_choice, stay


class Intermittent(Planner):
    """Joint choice of waypoints, with several measurements on the path.

    Robots that plan at the same step choose jointly (000, algorithm 2); a single one is ASI
    (algorithm 1). Moving robots count with their remaining trajectories, extended by constant
    states.
    """

    keys = InformationSettings
    settings: InformationSettings

    def __init__(self, settings: InformationSettings) -> None:
        super().__init__(settings)
        # Expected unseen targets that the candidates of each robot show together, at its last
        # decision and at most so far.
        self._prospects: dict[str, float] = {}
        self._most: dict[str, float] = {}
        self._area: Area | None = None
        self._sight = SightTables()

    def decide(self, team: TeamView) -> Decision:
        """See `Planner.decide`."""
        self._adopt_area(team)
        decision = Decision(step=team.step)
        # Complete trajectories of large teams need much memory.
        coarse = len(team.planning()) > PAIRS_LIMIT

        def kept(name: str, exact: Trajectories) -> Trajectories:
            period = team.robots[name].period_steps
            return CoarseTrajectories.of(exact, period) if coarse else exact

        options = usable_options(team, decision, lambda name: self._centres(team, name), kept)
        if not options:
            return explain(decision)
        sight = self._sight.of(team.exploration, team.robots.values())
        objective = TeamObjective(team, self.settings, options, sight)
        chosen, decision.objective, decision.exact, decision.evaluated = search(
            objective.table, objective.bounds, self.settings
        )
        for index, name in enumerate(objective.names):
            option, terms = options[name], objective.given(index, chosen)
            first, last = objective.start[index : index + 2].tolist()
            if self.settings.objective == 'information':
                shown = _shown_by(objective.table.terms, first, last, option.allowed)
                self._prospects[name] = shown
                self._most[name] = max(shown, self._most.get(name, 0.0))
            if chosen[index] < 0:
                decision.robots[name] = stay(team.robots[name], f'stays: {ASSIGNED}')
                continue
            best = int(chosen[index]) - first
            refinement, exploration, value = terms[best]
            seconds = option.prediction.lengths[best] * team.step_time
            reason = (
                f'arrives in {seconds:.3g} s; J = {value:.3g} is the best of '
                f'{counted(len(option.points), "candidate")}, with target refinement '
                f'T = {refinement:.3g} and '
                f'exploration E = {exploration:.3g}'
            )
            result = single_choice(option.points, option.prediction, best, reason)
            if coarse:
                view, point = team.robots[name], option.points[best : best + 1]
                exact = view.motion.predict(view.state, point, team.step_time)
                end = int(exact.lengths[0]) + 1
                result.positions, result.yaws = exact.positions[0, :end], exact.yaws[0, :end]
            result.target_refinement, result.exploration, result.objective = terms.T
            result.measurements = objective.table.planned.own[first:last]
            decision.robots[name] = result
        return explain(decision)

    def _adopt_area(self, team: TeamView) -> None:
        if team.area is not self._area:
            self._prospects.clear()
            self._area = team.area

    def _centres(self, team: TeamView, name: str) -> FloatArray | None:
        heavy = self.heavy(team) if self.settings.cluster_candidates else []
        return centres_of(team, team.robots[name], heavy) if heavy else None

    def finished(self, team: TeamView) -> str | None:
        """See `Planner.finished`; also if the candidates of all robots show too few unseen targets.

        Too few are at most `gain_threshold` of the most that they ever showed.
        """
        reason = super().finished(team)
        if reason is not None or self.settings.objective == 'paper':
            return reason
        names = self.searching(team)
        self._adopt_area(team)
        if not names or not all(name in self._prospects for name in names):
            return None
        least = self.settings.gain_threshold
        if any(self._prospects[name] > least * self._most[name] for name in names):
            return None
        explored = team.exploration.describe()
        return self._settled(team, f'no candidate of any robot would reveal more ({explored})')


@njit(cache=True)
def _shown_by(terms: Terms, first: int, last: int, allowed: BoolArray) -> float:
    """Return the expected number of unseen targets that the allowed candidates show together."""
    left = terms.unseen.copy()
    for g in range(first, last):
        if allowed[g - first]:
            for i in range(terms.first[g], terms.first[g + 1]):
                left[terms.node[i]] *= terms.miss[i]
    return float((terms.unseen - left).sum())
