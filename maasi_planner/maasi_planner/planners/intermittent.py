"""Active search with intermittent measurements, ASI and MAASI (000, sections 4 and 6)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from maasi_planner.motion.base import Trajectories
from maasi_planner.objective.team_objective import TeamObjective
from maasi_planner.planners.base import (
    Planner,
    check_team,
    explain,
    options_of,
    waiting_places,
)
from maasi_planner.settings import PlannerSettings
from maasi_planner.team import Decision, RobotDecision, TeamView, stay

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


class Intermittent(Planner):
    """Joint choice of waypoints anywhere, with several measurements on the way.

    Robots that plan at the same step choose jointly (000, algorithm 2); with one robot it is ASI
    (algorithm 1). Moving robots count with the rest of their trajectories, extended by constant
    states.
    """

    def __init__(self, settings: PlannerSettings) -> None:
        super().__init__(settings)
        self._prospects: dict[str, float] = {}

    def reset(self) -> None:
        """See `Planner.reset`."""
        self._prospects.clear()

    def decide(self, team: TeamView) -> Decision:
        """See `Planner.decide`."""
        check_team(team)
        places = waiting_places(team)
        candidates: dict[str, FloatArray] = {}
        trajectories: dict[str, Trajectories] = {}
        allowed: dict[str, BoolArray] = {}
        decision = Decision(step=team.step)
        for name in team.planning():
            options = options_of(team, name, places, self._centres(team, name))
            if isinstance(options, str):
                candidates[name] = np.zeros((0, 3))
                decision.robots[name] = stay(team.robots[name], f'stays: {options}')
            else:
                candidates[name] = options.points
                trajectories[name] = options.prediction
                allowed[name] = options.allowed
        objective = TeamObjective(team, self.settings, candidates, trajectories, allowed)
        chosen, value, exact, work = objective.search()
        decision.objective = value if len(chosen) else 0.0
        decision.exact = exact
        decision.evaluated = work
        for index, name in enumerate(objective.names):
            decision.robots[name] = self._robot_decision(
                team, name, objective, index, chosen, candidates[name], trajectories[name]
            )
        return explain(decision)

    def _robot_decision(
        self,
        team: TeamView,
        name: str,
        objective: TeamObjective,
        index: int,
        chosen: NDArray[np.int64],
        points: FloatArray,
        prediction: Trajectories,
    ) -> RobotDecision:
        rows = slice(int(objective.start[index]), int(objective.start[index + 1]))
        terms = objective.given(index, chosen)
        weights = objective.weights
        if weights.information:
            gains = weights.alpha * terms[:, 0] + weights.beta * terms[:, 1]
            possible = objective.table.allowed[rows]
            self._prospects[name] = float(gains[possible].max(initial=0.0))
        if chosen[index] < 0:
            result = stay(team.robots[name], 'stays: another robot is sent to every candidate')
            best = -1
        else:
            best = int(chosen[index] - objective.start[index])
            length = int(prediction.lengths[best])
            result = RobotDecision(
                chosen=best,
                waypoint=points[best].copy(),
                positions=prediction.positions[best, : length + 1].copy(),
                yaws=prediction.yaws[best, : length + 1].copy(),
                candidates=points,
                control_cost=prediction.control_cost,
                target_refinement=terms[:, 0],
                exploration=terms[:, 1],
                objective=terms[:, 2],
                lengths=prediction.lengths,
                measurements=objective.measurements[rows],
                reason=_reason(terms[best], int(prediction.lengths[best]), len(points)),
            )
        return result

    def _centres(self, team: TeamView, name: str) -> FloatArray | None:
        """Return the cluster centres as further candidates of a robot, if enabled."""
        wanted = self.settings.cluster_candidates
        if wanted is None:
            wanted = self.settings.objective == 'information'
        if not wanted:
            return None
        heavy = [
            cluster for cluster in team.clusters if cluster.mass >= self.settings.mass_threshold
        ]
        if not heavy:
            return None
        view = team.robots[name]
        centres = np.zeros((len(heavy), 3))
        # In 2D a robot keeps the height of its waypoints.
        centres[:, 2] = view.candidates[0, 2] if len(view.candidates) else 0.0
        for row, cluster in zip(centres, heavy):
            row[: team.dimension] = cluster.position[: team.dimension]
        return centres

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


def _reason(terms: FloatArray, length: int, number: int) -> str:
    return (
        f'J = {terms[2]:.4g} with T = {terms[0]:.4g}, E = {terms[1]:.4g} over {length} steps, '
        f'the best of {number}'
    )
