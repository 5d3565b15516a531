"""The objective J of joint candidates: control cost, target refinement, exploration."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from maasi_filter.models.detection import BOX, PARAMETERS
from maasi_planner.motion.base import Trajectories
from maasi_planner.objective.candidate_table import CACHE_ROWS, CandidateTable
from maasi_planner.objective.candidate_value import (
    alone_on_paper,
    alone_values,
    candidate_value,
    given_values,
    total_value,
)
from maasi_planner.objective.information import add_information
from maasi_planner.objective.joint_search import (
    PAIRS_LIMIT,
    improve_in_pairs,
    search_exactly,
    search_in_turn,
)
from maasi_planner.objective.paper import apply_settled_misses, centre_sum
from maasi_planner.objective.predicted_measurements import (
    Events,
    Kernel,
    Timing,
    events,
    joined,
    path_events,
    reach_of,
    rows_of,
    stacked,
    starts_of,
)
from maasi_planner.objective.unexplored_nodes import (
    Entries,
    NodeGrid,
    block_sums,
    entries_of,
    miss_at_nodes,
)
from maasi_planner.objective.weights import resolve
from maasi_planner.settings import PlannerSettings
from maasi_planner.team import RobotView, TeamView

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


# Above this number of pairs of a candidate and another robot, reported values of candidates that
# were not chosen neglect the other planning robots.
REPORT_LIMIT = 600


class _Measuring(NamedTuple):
    """A robot, its probability of detection, and its predicted measurements."""

    view: RobotView
    kernel: Kernel
    item: Events


class TeamObjective:
    """Objective of all joint candidates at one step.

    Parameters
    ----------
    team : TeamView
        The team; robots that do not plan count with the rest of their trajectories.
    settings : PlannerSettings
        Weights.
    candidates : mapping of str to (W, 3) array
        Waypoints of each planning robot, metres.
    trajectories : mapping of str to Trajectories
        Predicted trajectories to the candidates.
    allowed : mapping of str to (W,) array of bool
        Admissible candidates.

    Attributes
    ----------
    names : list of str
        Planning robots with candidates, in order.
    table : CandidateTable
        Tables for the search.
    measurements : (G,) array
        M of each candidate.
    """

    def __init__(
        self,
        team: TeamView,
        settings: PlannerSettings,
        candidates: Mapping[str, FloatArray],
        trajectories: Mapping[str, Trajectories],
        allowed: Mapping[str, BoolArray],
    ) -> None:
        self.team = team
        self.settings = settings
        self.weights = resolve(settings)
        # The first measurement that counts: the present one does not depend on the choice.
        self.first = 0 if self.weights.present else 1
        self.names = [name for name in team.planning() if len(candidates[name])]
        counts = np.array([len(candidates[name]) for name in self.names], np.int64)
        self.start = starts_of(counts)
        self.robot = np.repeat(np.arange(len(counts)), counts)
        self._alone: FloatArray | None = None
        self._build(candidates, trajectories, allowed)

    def _build(
        self,
        candidates: Mapping[str, FloatArray],
        trajectories: Mapping[str, Trajectories],
        allowed: Mapping[str, BoolArray],
    ) -> None:
        team, weights, names = self.team, self.weights, self.names
        planned, settled = self._measuring(trajectories)
        lengths = joined([trajectories[name].lengths for name in names], np.int64)
        if weights.per_distance:
            norm = joined([trajectories[name].distances() for name in names], float)
        else:
            norm = lengths.astype(float)
        self.lengths = lengths
        self.measurements = joined([robot.item.own for robot in planned], np.int64)
        centres = np.zeros((len(team.clusters), 3))
        for index, cluster in enumerate(team.clusters):
            centres[index, : team.dimension] = cluster.position[: team.dimension]
        parameters = np.zeros((len(names), PARAMETERS))
        for index, robot in enumerate(planned):
            parameters[index] = robot.kernel[1]
        self.table = CandidateTable(
            start=self.start,
            robot=self.robot,
            allowed=joined(
                [allowed[name] & (trajectories[name].lengths > 0) for name in names], np.bool_
            ),
            waypoints=stacked([candidates[name] for name in names], 3),
            radii=np.array([robot.view.radius for robot in planned], dtype=float),
            control=joined([trajectories[name].control_cost for name in names], float),
            norm=np.maximum(norm, 1e-9),
            alpha=float(weights.alpha),
            beta=float(weights.beta),
            control_weight=float(weights.control),
            information=weights.information,
            dimension=team.dimension,
            kind=np.array([robot.kernel[0] for robot in planned], np.int64),
            parameters=parameters,
            used=np.zeros(1, np.int64),
            **self._paper_terms(planned, settled, centres),
            **self._information_terms(planned, settled, centres),
        )

    def _measuring(
        self, trajectories: Mapping[str, Trajectories]
    ) -> tuple[list[_Measuring], list[_Measuring]]:
        """Return predicted measurements of the planning robots, and of the others."""
        team, weights, names = self.team, self.weights, self.names
        horizon = max((int(trajectories[name].lengths.max(initial=0)) for name in names), default=0)
        planned = []
        settled = []
        for name in team.names():
            view = team.robots[name]
            kernel = view.sensor.detection.kernel()
            if name in names:
                way = trajectories[name]
                timing = Timing(0, view.period_steps, horizon, weights.arrival, weights.extend)
                item = events(way.positions, way.yaws, way.lengths, timing)
                planned.append(_Measuring(view, kernel, item))
            else:
                item = path_events(view, horizon, weights.extend)
                settled.append(_Measuring(view, kernel, item))
        return planned, settled

    def _paper_terms(
        self, planned: list[_Measuring], settled: list[_Measuring], centres: FloatArray
    ) -> dict[str, Any]:
        """Return the fields of the table for the objective of the papers, empty without it."""
        weights, dimension, number = self.weights, self.team.dimension, int(self.start[-1])
        several = len(planned) > 1
        refinement = np.zeros(number)
        entries = Entries(
            np.zeros(number, np.int64), np.zeros(0), np.zeros((0, 3)), np.zeros(0, np.int64)
        )
        rows = (
            np.zeros(number + 1, np.int64),
            np.zeros(0, np.int64),
            np.zeros((0, 3)),
            np.zeros((0, 2)),
        )
        if not weights.information:
            for index, robot in enumerate(planned):
                part = refinement[self.start[index] : self.start[index + 1]]
                centre_sum(robot.item, self.first, centres, dimension, robot.kernel, part)
            if weights.beta > 0.0:
                entries = self._entries(planned, settled)
                if several:
                    rows = rows_of([robot.item for robot in planned])
        pairs = number if len(entries.value) and several else 0
        longest = int(entries.counts.max(initial=0)) if pairs else 0
        return {
            'refinement': refinement,
            'event_start': rows[0],
            'event_time': rows[1],
            'event_place': rows[2],
            'event_turn': rows[3],
            'entry_start': starts_of(entries.counts),
            'entry_value': entries.value,
            'entry_node': entries.node,
            'entry_time': entries.time,
            'slot': np.full((pairs, pairs), -1, np.int32),
            'cache': np.empty((min(CACHE_ROWS, pairs * pairs), longest)),
        }

    def _information_terms(
        self, planned: list[_Measuring], settled: list[_Measuring], centres: FloatArray
    ) -> dict[str, Any]:
        """Return the fields of the table for the objective of information, empty without it."""
        d = self.team.dimension
        clusters = self.team.clusters if self.weights.information else []
        covariance = np.zeros((len(clusters), d, d))
        for index, cluster in enumerate(clusters):
            covariance[index] = cluster.covariance[:d, :d]
        base, gain = self._information(planned, settled, centres[: len(clusters)])
        unseen, miss = np.zeros(0), np.zeros((int(self.start[-1]), 0))
        if self.weights.information and self.weights.beta > 0.0:
            unseen, miss = self._new_targets(planned, settled)
        return {
            'mass': np.array([min(1.0, max(0.0, cluster.mass)) for cluster in clusters], float),
            'covariance': covariance,
            'base': base,
            'gain': gain,
            'unseen': unseen,
            'miss': miss,
        }

    def _entries(self, planned: list[_Measuring], settled: list[_Measuring]) -> Entries:
        grid = self.team.exploration.kernel()
        dimension = self.team.dimension
        corners = 4 if dimension == 2 else 8
        parts = []
        for _, kernel, item in planned:
            most = corners * int(item.own.sum())
            part = Entries(
                np.zeros(len(item.own), np.int64),
                np.empty(most),
                np.empty((most, 3)),
                np.empty(most, np.int64),
            )
            number = entries_of(item, self.first, self.weights.own, dimension, kernel, grid, part)
            part = Entries(part.counts, part.value[:number], part.node[:number], part.time[:number])
            for other in settled:
                apply_settled_misses(part, other.item.expected(), dimension, other.kernel)
            parts.append(part)
        return Entries(
            joined([part.counts for part in parts], np.int64),
            joined([part.value for part in parts], float),
            stacked([part.node for part in parts], 3),
            joined([part.time for part in parts], np.int64),
        )

    def _information(
        self, planned: list[_Measuring], settled: list[_Measuring], centres: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        d = self.team.dimension
        number = len(centres)
        base = np.zeros((number, d, d))
        gain = np.zeros((int(self.start[-1]), number, d, d))
        if number == 0:
            return base, gain
        for view, kernel, item in settled:
            out = np.zeros((1, number, d, d))
            add_information(view, kernel, item, 0, centres, d, out)
            base += out[0]
        for index, (view, kernel, item) in enumerate(planned):
            rows = slice(int(self.start[index]), int(self.start[index + 1]))
            add_information(view, kernel, item, self.first, centres, d, gain[rows])
            if self.first:
                out = np.zeros((1, number, d, d))
                add_information(view, kernel, item.present(), 0, centres, d, out)
                base += out[0]
        return base, gain

    def _new_targets(
        self, planned: list[_Measuring], settled: list[_Measuring]
    ) -> tuple[FloatArray, FloatArray]:
        exploration = self.team.exploration
        values, lower, step = exploration.kernel()
        volumes = exploration.cell_volumes().reshape(values.shape)
        # A field of view with hard edges needs every node: omitted nodes would never be seen.
        hard = any(robot.kernel[0] >= BOX for robot in planned)
        stride = 1
        if not hard:
            while np.prod([-(-size // stride) for size in values.shape]) > (
                self.settings.exploration_nodes
            ):
                stride += 1
        shape = [-(-size // stride) for size in values.shape]
        left = np.zeros(shape)
        block_sums(values, volumes, stride, left)
        left *= self.settings.expected_targets / float(volumes.sum())
        start = lower + 0.5 * (stride - 1) * step
        if self.team.dimension == 2:
            start[2] = 0.0
        every = NodeGrid(start, step * stride, np.arange(left.size, dtype=np.int64).reshape(shape))
        # What does not depend on the choice: settled robots, and the present measurements.
        given = settled + [
            robot._replace(item=robot.item.present()) for robot in planned if self.first
        ]
        for robot in given:
            miss = np.ones((1, left.size))
            self._miss(robot, 0, every, miss)
            left *= miss.reshape(left.shape)
        flat = left.ravel()
        columns = np.flatnonzero(flat > 0.0)
        column = np.full(flat.shape, -1, np.int64)
        column[columns] = np.arange(len(columns))
        unseen = every._replace(column=column.reshape(shape))
        miss = np.ones((int(self.start[-1]), len(columns)))
        for i, robot in enumerate(planned):
            self._miss(robot, self.first, unseen, miss[self.start[i] : self.start[i + 1]])
        return flat[columns], miss

    def _miss(self, robot: _Measuring, first: int, grid: NodeGrid, miss: FloatArray) -> None:
        reach = reach_of(*robot.kernel)
        dimension = self.team.dimension
        miss_at_nodes(robot.item, first, grid, dimension, robot.kernel, reach, miss)

    def alone(self) -> FloatArray:
        """Return T, E and J of each candidate without the other planning robots, (G, 3)."""
        table = self.table
        out = np.empty((int(self.start[-1]), 3))
        if table.information:
            alone_values(table, out)
        else:
            alone_on_paper(
                table.refinement,
                table.entry_start,
                table.entry_value,
                table.control,
                table.norm,
                table.allowed,
                table.alpha,
                table.beta,
                table.control_weight,
                out,
            )
        return out

    def given(self, robot: int, chosen: IntArray) -> FloatArray:
        """Return T, E and J of each candidate of one robot, given the others' choices, (W, 3).

        In teams too large for that, all but the chosen one without the other planning robots.
        """
        others = len(self.names) - 1
        if others == 0 or int(self.start[-1]) * others > REPORT_LIMIT:
            if self._alone is None:
                self._alone = self.alone()
            rows = self._alone[self.start[robot] : self.start[robot + 1]].copy()
            g = int(chosen[robot])
            if others and g >= 0:
                rows[g - self.start[robot]] = candidate_value(
                    self.table, g, chosen, np.zeros((3, 3, 3))
                )
            return rows
        out = np.zeros((int(self.start[robot + 1] - self.start[robot]), 3))
        given_values(self.table, robot, chosen, out)
        return out

    def value(self, chosen: IntArray) -> float:
        """Return the sum of J of a joint choice (26); indices into all candidates."""
        return float(total_value(self.table, chosen, np.zeros((3, 3, 3))))

    def search(self) -> tuple[IntArray, float, bool, int]:
        """Return the best joint choice, its value, whether it is exact, and the work done.

        The choice (R,) has indices into all candidates, -1 for a robot with none admissible.
        """
        self._alone = self.alone()
        alone = self._alone[:, 2]
        robots = len(self.names)
        chosen = np.full(robots, -1, np.int64)
        if robots == 0:
            return chosen, 0.0, True, 0
        if robots == 1:
            best_alone = int(alone.argmax())
            if alone[best_alone] > -np.inf:
                chosen[0] = best_alone
            return chosen, float(alone[best_alone]), True, len(alone)
        order = np.zeros(len(alone), np.int64)
        for r in range(robots):
            rows = slice(int(self.start[r]), int(self.start[r + 1]))
            order[rows] = self.start[r] + np.argsort(-alone[rows], kind='stable')
        best = np.full(robots, -1, np.int64)
        rounds = self.settings.improvement_rounds
        alone_best, work = search_in_turn(self.table, alone, order, rounds, False, best)
        best_value = alone_best
        joint_number = 1.0
        for r in range(robots):
            rows = slice(int(self.start[r]), int(self.start[r + 1]))
            joint_number *= max(1.0, float(np.isfinite(alone[rows]).sum()))
        exact = joint_number <= self.settings.enumeration_limit and bool((best >= 0).all())
        if exact:
            found = best.copy()
            value, count = search_exactly(self.table, alone, order, found, best_value)
            return found, value, True, work + count
        other = np.full(robots, -1, np.int64)
        value, count = search_in_turn(self.table, alone, order, rounds, True, other)
        work += count
        tries = [(best, best_value), (other, value)]
        if robots <= PAIRS_LIMIT:
            for index, (trial, value) in enumerate(tries):
                value, count = improve_in_pairs(
                    self.table, alone, order, value, self.settings.pair_budget, trial
                )
                tries[index] = (trial, value)
                work += count
        # Prefer more moving robots, then the larger value.
        best, best_value = max(tries, key=lambda item: (int((item[0] >= 0).sum()), item[1]))
        return best, best_value, False, work
