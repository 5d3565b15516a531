"""Active search with one measurement at each waypoint, AS and MAAS (001, 002, 003).

For a single robot (001, eq. (9) to (13)), sequences of `horizon` position changes have the value
T + alpha E. E is the sum of e at the positions; T is the sum of pi at the cluster centres or the
mutual information with the empty measurement set. Several robots (002, section 4) choose jointly
by the sum of T and the product of the robots' own e (12), (14) to (16), or independently (10),
each with its own planner and filter. e and the clusters are constant during prediction.
"""

import math
from typing import Literal

import numpy as np
from pydantic import Field

from maasi_filter.arrays import FloatArray
from maasi_filter.models.pose import Pose
from maasi_planner.objective.sight import probability_over
from maasi_planner.planners.base import Planner, explain
from maasi_planner.planners.joint_choice import search_jointly
from maasi_planner.planners.mutual_information import heading_to, intensity, mutual_information
from maasi_planner.planners.options import usable_options
from maasi_planner.planners.separation import all_apart
from maasi_planner.settings import JointSettings, NotNegative
from maasi_planner.team import (
    ASSIGNED,
    Decision,
    RobotDecision,
    RobotView,
    TeamView,
    UsableCandidates,
    single_choice,
    stay,
)


class ActiveSearchSettings(JointSettings):
    """Settings of `maas`."""

    alpha: NotNegative = Field(0.5, description='Weight of exploration [1]')
    horizon: int = Field(1, ge=1, le=3, description='Number of waypoints planned ahead [1]')
    agent_exploration: Literal['own', 'shared'] = Field(
        'own',
        description='Whether e of a robot counts only its own measurements (multi-agent '
        'exploration 2023, eq. 12, 16) or those of the whole team',
    )
    refinement: Literal['centres', 'mutual_information'] = Field(
        'centres', description='T from probabilities at cluster centres, or from mutual information'
    )


class Sequences:
    """All sequences of positions of one robot.

    first (S,): index of the first position among the candidates; refinement (S,): T; explored
    (S, horizon): e at each position.
    """

    def __init__(
        self,
        team: TeamView,
        view: RobotView,
        option: UsableCandidates,
        horizon: int,
        informed: bool,
    ) -> None:
        here = np.array(view.state.pose.position)
        steps = np.asarray(view.candidates, dtype=float) - here
        kept: list[tuple[int, list[FloatArray]]] = [
            (int(index), [option.points[index]]) for index in np.flatnonzero(option.allowed)
        ]
        for _ in range(horizon - 1):
            longer = []
            for index, visited in kept:
                following = visited[-1] + steps
                free = [
                    point
                    for point, inside in zip(following, team.area.inside(following))
                    if inside and view.motion.keep_out.is_free(point)
                ]
                # Extend a dead end by staying.
                for point in free or [visited[-1]]:
                    longer.append((index, [*visited, point]))
            kept = longer
        self.first = np.array([index for index, _ in kept], np.int64)
        positions = np.array([sequence for _, sequence in kept]).reshape(len(kept), horizon, 3)
        self.positions = positions
        flat = positions.reshape(-1, 3)
        exploration = team.exploration if view.exploration is None else view.exploration
        self.explored = exploration.at(flat).reshape(len(kept), horizon)
        before = np.concatenate(
            [np.broadcast_to(here, (len(kept), 1, 3)), positions[:, :-1]], axis=1
        )
        self.refinement = self._refinement(team, view, positions, before, informed)

    def _refinement(
        self,
        team: TeamView,
        view: RobotView,
        positions: FloatArray,
        before: FloatArray,
        informed: bool,
    ) -> FloatArray:
        number, horizon, _ = positions.shape
        if informed:
            points, weights = intensity(team)
        else:
            points = np.array([cluster.position[: team.dimension] for cluster in team.clusters])
        out = np.zeros(number)
        if not len(points):
            return out
        known: dict[bytes, FloatArray] = {}
        for row in range(number):
            missed = np.ones(len(points))
            for j in range(horizon):
                yaw = heading_to(view, before[row, j], positions[row, j])
                key = positions[row, j].tobytes() + np.float64(yaw).tobytes()
                if key not in known:
                    pose = Pose.from_yaw(positions[row, j], yaw)
                    known[key] = probability_over(team.area, view.sensor.detection, points, pose)
                if informed:
                    missed *= 1.0 - known[key]
                else:
                    out[row] += float(sum(known[key].tolist()))
            if informed:
                out[row] = mutual_information(missed, weights)
        return out


class ActiveSearch(Planner):
    """Waypoints from a ring with one measurement at each (receding horizon)."""

    measures_underway = False
    keys = ActiveSearchSettings
    settings: ActiveSearchSettings

    def decide(self, team: TeamView) -> Decision:
        """See `Planner.decide`."""
        decision = Decision(step=team.step)
        options = usable_options(team, decision)
        informed = self.settings.refinement == 'mutual_information'
        sequences = {
            name: Sequences(team, team.robots[name], option, self.settings.horizon, informed)
            for name, option in options.items()
        }
        chosen, decision.exact, decision.evaluated = self._search(team, options, sequences)
        decision.objective = self._value(sequences, chosen)
        for name, option in options.items():
            if chosen[name] < 0:
                view = team.robots[name]
                decision.robots[name] = stay(view, f'stays: {ASSIGNED}')
            else:
                decision.robots[name] = self._report(name, option, sequences, chosen)
        return explain(decision)

    def _value(self, sequences: dict[str, Sequences], chosen: dict[str, int]) -> float:
        """Return the joint objective (002, eq. (14))."""
        refinement, product = 0.0, np.ones(self.settings.horizon)
        going = [(sequences[name], row) for name, row in chosen.items() if row >= 0]
        for mine, row in going:
            refinement += float(mine.refinement[row])
            product = product * mine.explored[row]
        if not going:
            return 0.0
        return refinement + self.settings.alpha * float(sum(product.tolist()))

    def _search(
        self, team: TeamView, options: dict[str, UsableCandidates], sequences: dict[str, Sequences]
    ) -> tuple[dict[str, int], bool, int]:
        names = list(sequences)
        if len(names) == 1:
            mine = sequences[names[0]]
            values = mine.refinement + self.settings.alpha * mine.explored.sum(axis=1)
            return {names[0]: int(np.argmax(values))}, True, len(values)
        rows = {name: range(len(sequences[name].first)) for name in names}
        points = {name: options[name].points[sequences[name].first] for name in names}
        number = math.prod(map(len, rows.values()))
        if len(names) == 2 and number <= self.settings.enumeration_limit:
            # Evaluate all pairs at once, then take the best admissible one.
            one, two = sequences[names[0]], sequences[names[1]]
            values = one.refinement[:, None] + two.refinement[None, :]
            for j in range(self.settings.horizon):
                values = values + self.settings.alpha * (
                    one.explored[:, j, None] * two.explored[None, :, j]
                )
            order = np.argsort(-values, axis=None, kind='stable').tolist()
            for evaluated, flat in enumerate(order, 1):
                joint = dict(zip(names, divmod(flat, values.shape[1])))
                if all_apart(team, {name: points[name][row] for name, row in joint.items()}):
                    return joint, True, evaluated
        best, _, exact, evaluated = search_jointly(
            team, self.settings, rows, points, lambda joint: self._value(sequences, joint)
        )
        return best, exact, evaluated

    def _report(
        self,
        name: str,
        option: UsableCandidates,
        sequences: dict[str, Sequences],
        chosen: dict[str, int],
    ) -> RobotDecision:
        mine = sequences[name]
        number = len(option.points)
        refinement = np.zeros(number)
        explored = np.zeros(number)
        value = np.full(number, -np.inf)
        for row in range(len(mine.first)):
            joint = {**chosen, name: row}
            total = self._value(sequences, joint)
            w = mine.first[row]
            if total > value[w]:
                value[w] = total
                refinement[w] = mine.refinement[row]
                explored[w] = float(sum(mine.explored[row].tolist()))
        best = int(mine.first[chosen[name]])
        result = single_choice(
            option.points,
            option.prediction,
            best,
            f'target refinement T = {refinement[best]:.3g}, exploration E = {explored[best]:.3g}, '
            f'the best of {len(mine.first)} sequences of {self.settings.horizon} waypoints',
        )
        result.target_refinement = refinement
        result.exploration = explored
        result.objective = value
        result.measurements = np.ones(number, np.int64)
        return result
