"""Nearest and widest cluster in turn: Sung and Tokekar (2022) as adapted by 000, section 5.1.

Without clusters a robot goes to the candidate with the largest e (ties: the nearest).
"""

import numpy as np

from maasi_filter.arrays import FloatArray
from maasi_planner.planners.base import Planner, explain
from maasi_planner.planners.options import affordable, centres_of, options_of, waiting_places
from maasi_planner.planners.separation import apart
from maasi_planner.settings import PlannerSettings
from maasi_planner.team import Decision, RobotDecision, TeamView, single_choice, stay


class NearestWidest(Planner):
    """Each robot plans alone and alternates between the nearest and the widest cluster."""

    def __init__(self, settings: PlannerSettings) -> None:
        super().__init__(settings)
        self._turns: dict[str, int] = {}

    def decide(self, team: TeamView) -> Decision:
        """See `Planner.decide`."""
        decision = Decision(step=team.step)
        taken = waiting_places(team)
        for name in team.planning():
            robot = self._decide_one(team, name, taken)
            decision.robots[name] = robot
            taken.append((robot.waypoint, team.robots[name].radius))
        return explain(decision)

    def _decide_one(
        self, team: TeamView, name: str, taken: list[tuple[FloatArray, float]]
    ) -> RobotDecision:
        view = team.robots[name]
        clusters = self.heavy(team)
        centres = centres_of(team, view, clusters)
        found = options_of(team, name, taken, centres)
        if isinstance(found, str):
            return stay(view, f'stays: {found}')
        here = np.array(view.state.pose.position)
        turn = self._turns.get(name, 0)
        for kind in (turn, turn + 1) if clusters else ():
            if kind % 2 == 0:
                keys = [float(((centre - here) ** 2).sum()) for centre in centres]
            else:
                keys = [-float(cluster.radius) for cluster in clusters]
            for position in sorted(range(len(clusters)), key=keys.__getitem__):
                point = view.motion.keep_out.moved_out(here, centres[position])
                if point is None or not apart(point, view.radius, taken):
                    continue
                prediction = view.motion.predict(view.state, point[None, :], team.step_time)
                allowed = prediction.reached & (prediction.lengths > 0)
                if not affordable(team, name, prediction, allowed)[0]:
                    continue
                self._turns[name] = (kind + 1) % 2
                word = ('nearest', 'widest')[kind % 2]
                return single_choice(point[None, :], prediction, 0, f'goes to the {word} cluster')
        explored = team.exploration.at(found.points)
        gaps = ((found.points - here) ** 2).sum(axis=1)
        order = sorted(
            np.flatnonzero(found.allowed).tolist(),
            key=lambda w: (-float(explored[w]), float(gaps[w]), w),
        )
        best = order[0]
        result = single_choice(
            found.points,
            found.prediction,
            best,
            f'no cluster: goes to the least explored candidate, e = {explored[best]:.3g}',
        )
        result.exploration = explored
        result.objective = np.where(found.allowed, explored, -np.inf)
        return result
