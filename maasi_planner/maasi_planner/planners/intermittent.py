"""Active search with intermittent measurements, ASI and MAASI (000, sections 4 and 6)."""

from maasi_filter.arrays import FloatArray
from maasi_planner.objective.joint_search import search
from maasi_planner.objective.team_objective import TeamObjective
from maasi_planner.planners.base import Planner, centres_of, explain, usable_options
from maasi_planner.settings import PlannerSettings
from maasi_planner.team import Decision, TeamView, single_choice, stay


class Intermittent(Planner):
    """Joint choice of waypoints anywhere, with several measurements on the way.

    Robots that plan at the same step choose jointly (000, algorithm 2); with one robot it is ASI
    (algorithm 1). Moving robots count with the rest of their trajectories, extended by constant
    states.
    """

    def __init__(self, settings: PlannerSettings) -> None:
        super().__init__(settings)
        self._prospects: dict[str, float] = {}

    def decide(self, team: TeamView) -> Decision:
        """See `Planner.decide`."""
        decision = Decision(step=team.step)
        options = usable_options(team, decision, lambda name: self._centres(team, name))
        if not options:
            return explain(decision)
        objective, weights = TeamObjective(team, self.settings, options), self.settings.weights()
        chosen, decision.objective, decision.exact, decision.evaluated = search(
            objective.table, objective.alone[:, 2], self.settings
        )
        for index, name in enumerate(objective.names):
            option, terms = options[name], objective.given(index, chosen)
            if weights.information:
                gains = weights.alpha * terms[:, 0] + weights.beta * terms[:, 1]
                self._prospects[name] = float(gains[option.allowed].max(initial=0.0))
            if chosen[index] < 0:
                reason = 'stays: another robot is sent to every candidate'
                decision.robots[name] = stay(team.robots[name], reason)
                continue
            first, last = objective.start[index : index + 2].tolist()
            best = int(chosen[index]) - first
            refinement, exploration, value = terms[best]
            reason = (
                f'J = {value:.4g} with T = {refinement:.4g}, E = {exploration:.4g} over '
                f'{option.prediction.lengths[best]} steps, the best of {len(option.points)}'
            )
            result = single_choice(option.points, option.prediction, best, reason)
            result.target_refinement, result.exploration, result.objective = terms.T
            result.measurements = objective.table.planned.own[first:last]
            decision.robots[name] = result
        return explain(decision)

    def _centres(self, team: TeamView, name: str) -> FloatArray | None:
        """Return the cluster centres as further candidates of a robot, if enabled."""
        wanted = self.settings.cluster_candidates
        if wanted is None:
            wanted = self.settings.objective == 'information'
        heavy = self.heavy(team) if wanted else []
        return centres_of(team, team.robots[name], heavy) if heavy else None

    def finished(self, team: TeamView) -> str | None:
        """See `Planner.finished`; also when no candidate of any robot has an expected gain."""
        reason = super().finished(team)
        if reason is not None or self.settings.objective == 'paper':
            return reason
        known = [name for name in team.names() if name in self._prospects]
        if len(known) < len(team.robots) or not known:
            return None
        largest = max(self._prospects[name] for name in known)
        if largest > self.settings.gain_threshold:
            return None
        explored = 100.0 * team.exploration.explored_fraction()
        return self._settled(
            team,
            f'no candidate of any robot promises to show more ({explored:.1f} % of the '
            'environment is explored)',
        )
