"""Active search with intermittent measurements, ASI and MAASI (000, sections 4 and 6)."""

from numba import njit

from maasi_filter.arrays import BoolArray, FloatArray
from maasi_filter.geometry.area import Area
from maasi_planner.motion.base import Trajectories
from maasi_planner.objective.joint_search import PAIRS_LIMIT, search
from maasi_planner.objective.predicted_measurements import CoarseTrajectories
from maasi_planner.objective.settings import InformationSettings
from maasi_planner.objective.team_objective import TeamObjective
from maasi_planner.objective.terms import Terms
from maasi_planner.planners.base import Planner, explain
from maasi_planner.planners.options import centres_of, usable_options
from maasi_planner.team import Decision, TeamView, single_choice, stay


class Intermittent(Planner):
    """Joint choice of waypoints anywhere, with several measurements on the way.

    Robots that plan at the same step choose jointly (000, algorithm 2); with one robot it is ASI
    (algorithm 1). Moving robots count with the rest of their trajectories, extended by constant
    states.
    """

    keys = InformationSettings
    settings: InformationSettings

    def __init__(self, settings: InformationSettings) -> None:
        super().__init__(settings)
        # Of each robot, how many unseen targets its candidates show together: at its last decision,
        # and at most until now.
        self._prospects: dict[str, float] = {}
        self._most: dict[str, float] = {}
        self._area: Area | None = None

    def decide(self, team: TeamView) -> Decision:
        """See `Planner.decide`."""
        self._adopt_area(team)
        decision = Decision(step=team.step)
        # Whole trajectories to all candidates of all robots of a large team need much memory.
        coarse = len(team.planning()) > PAIRS_LIMIT

        def kept(name: str, exact: Trajectories) -> Trajectories:
            period = team.robots[name].period_steps
            return CoarseTrajectories.of(exact, period) if coarse else exact

        options = usable_options(team, decision, lambda name: self._centres(team, name), kept)
        if not options:
            return explain(decision)
        objective = TeamObjective(team, self.settings, options)
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
                reason = 'stays: another robot is sent to every candidate'
                decision.robots[name] = stay(team.robots[name], reason)
                continue
            best = int(chosen[index]) - first
            refinement, exploration, value = terms[best]
            reason = (
                f'J = {value:.4g} with T = {refinement:.4g}, E = {exploration:.4g} over '
                f'{option.prediction.lengths[best]} steps, the best of {len(option.points)}'
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
        """Forget what candidates showed before zones were opened or closed."""
        if team.area is not self._area:
            self._prospects.clear()
            self._area = team.area

    def _centres(self, team: TeamView, name: str) -> FloatArray | None:
        """Return the cluster centres as further candidates of a robot, if enabled."""
        heavy = self.heavy(team) if self.settings.cluster_candidates else []
        return centres_of(team, team.robots[name], heavy) if heavy else None

    def finished(self, team: TeamView) -> str | None:
        """See `Planner.finished`; also when the candidates of no robot show much any more.

        That is judged by the share that they show together of what they showed at most.
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
        explored = 100.0 * team.exploration.explored_fraction()
        return self._settled(
            team,
            f'no candidate of any robot promises to show more ({explored:.1f} % of the '
            'environment is explored)',
        )


@njit(cache=True)
def _shown_by(terms: Terms, first: int, last: int, allowed: BoolArray) -> float:
    """Return how many unseen targets the allowed candidates from `first` on show together."""
    left = terms.unseen.copy()
    for g in range(first, last):
        if allowed[g - first]:
            for i in range(terms.first[g], terms.first[g + 1]):
                left[terms.node[i]] *= terms.miss[i]
    return float((terms.unseen - left).sum())
