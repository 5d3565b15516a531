"""The objective J of joint candidates: control cost, target refinement, exploration."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from maasi_filter.models.detection import (
    BOX,
    PARAMETERS,
)
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
    events,
    first_row,
    joined,
    reach_of,
    rows_of,
    stacked,
    starts_of,
    tail_events,
)
from maasi_planner.objective.unexplored_nodes import block_sums, entries_of, miss_at_nodes
from maasi_planner.objective.weights import resolve
from maasi_planner.settings import PlannerSettings
from maasi_planner.team import RobotView, TeamView

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


# Above this number of pairs of a candidate and another robot, reported values of candidates that
# were not chosen neglect the other planning robots.
REPORT_LIMIT = 600


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
        robots = [team.robots[name] for name in names]
        horizon = max((int(trajectories[name].lengths.max(initial=0)) for name in names), default=0)
        kernels = [view.sensor.detection.kernel() for view in robots]
        planned = [
            events(
                trajectories[name].positions,
                trajectories[name].yaws,
                trajectories[name].lengths,
                0,
                view.period_steps,
                horizon,
                weights.arrival,
                weights.extend,
            )
            for name, view in zip(names, robots)
        ]
        self.events = dict(zip(names, planned))
        settled = []
        for name in team.names():
            if name not in names:
                view = team.robots[name]
                kernel = view.sensor.detection.kernel()
                settled.append((view, kernel, tail_events(view, horizon, weights.extend)))
        first = 0 if weights.present else 1
        lengths = joined([trajectories[name].lengths for name in names], np.int64)
        if weights.per_distance:
            norm = joined([trajectories[name].distances() for name in names], float)
        else:
            norm = lengths.astype(float)
        self.lengths = lengths
        self.measurements = joined([item.own for item in planned], np.int64)
        number = int(self.start[-1])
        clusters = team.clusters
        dimension = team.dimension
        centres = np.zeros((len(clusters), 3))
        for index, cluster in enumerate(clusters):
            centres[index, :dimension] = cluster.position[:dimension]
        refinement = np.zeros(number)
        empty_entries = (
            np.zeros(number + 1, np.int64),
            np.zeros(0),
            np.zeros((0, 3)),
            np.zeros(0, np.int64),
        )
        entries = empty_entries
        rows = (
            np.zeros(number + 1, np.int64),
            np.zeros(0, np.int64),
            np.zeros((0, 3)),
            np.zeros((0, 2)),
        )
        d = dimension
        mass = np.zeros(0)
        covariance = np.zeros((0, d, d))
        base = np.zeros((0, d, d))
        gain = np.zeros((number, 0, d, d))
        unseen = np.zeros(0)
        miss = np.zeros((number, 0))
        if weights.information:
            mass = np.array([min(1.0, max(0.0, cluster.mass)) for cluster in clusters])
            covariance = np.zeros((len(clusters), d, d))
            for index, cluster in enumerate(clusters):
                covariance[index] = cluster.covariance[:d, :d]
            base, gain = self._information(robots, kernels, planned, settled, centres, first)
            if weights.beta > 0.0:
                unseen, miss = self._new_targets(kernels, planned, settled, first)
        else:
            for index, (kernel, item) in enumerate(zip(kernels, planned)):
                centre_sum(
                    item.places,
                    item.turns,
                    first,
                    item.own,
                    centres,
                    dimension,
                    *kernel,
                    refinement[self.start[index] : self.start[index + 1]],
                )
            if weights.beta > 0.0:
                entries = self._entries(kernels, planned, settled, first)
                if len(names) > 1:
                    rows = rows_of(planned)
        pairs = number if len(entries[1]) and len(names) > 1 else 0
        longest = int(np.diff(entries[0]).max(initial=0)) if pairs else 0
        parameters = np.zeros((len(names), PARAMETERS))
        for index, kernel in enumerate(kernels):
            parameters[index] = kernel[1]
        self.table = CandidateTable(
            start=self.start,
            robot=self.robot,
            allowed=joined(
                [allowed[name] & (trajectories[name].lengths > 0) for name in names], np.bool_
            ),
            waypoints=stacked([candidates[name] for name in names], 3),
            radii=np.array([view.radius for view in robots], dtype=float),
            control=joined([trajectories[name].control_cost for name in names], float),
            norm=np.maximum(norm, 1e-9),
            alpha=float(weights.alpha),
            beta=float(weights.beta),
            control_weight=float(weights.control),
            information=weights.information,
            dimension=dimension,
            refinement=refinement,
            event_start=rows[0],
            event_time=rows[1],
            event_place=rows[2],
            event_turn=rows[3],
            kind=np.array([kernel[0] for kernel in kernels], np.int64),
            parameters=parameters,
            entry_start=entries[0],
            entry_value=entries[1],
            entry_node=entries[2],
            entry_time=entries[3],
            slot=np.full((pairs, pairs), -1, np.int32),
            cache=np.empty((min(CACHE_ROWS, pairs * pairs), longest)),
            used=np.zeros(1, np.int64),
            mass=mass,
            covariance=covariance,
            base=base,
            gain=gain,
            unseen=unseen,
            miss=miss,
        )

    def _entries(
        self,
        kernels: list[tuple[int, FloatArray]],
        planned: list[Events],
        settled: list[tuple[RobotView, tuple[int, FloatArray], Events]],
        first: int,
    ) -> tuple[IntArray, FloatArray, FloatArray, IntArray]:
        values, lower, step = self.team.exploration.kernel()
        corners = 4 if self.team.dimension == 2 else 8
        counts, value_parts, node_parts, time_parts = [], [], [], []
        for kernel, item in zip(kernels, planned):
            most = corners * int(item.own.sum())
            count = np.zeros(len(item.own), np.int64)
            entry_value = np.empty(most)
            entry_node = np.empty((most, 3))
            entry_time = np.empty(most, np.int64)
            number = entries_of(
                item.times,
                item.places,
                item.turns,
                first,
                item.own,
                self.weights.own,
                self.team.dimension,
                *kernel,
                values,
                lower,
                step,
                count,
                entry_value,
                entry_node,
                entry_time,
            )
            entry_value = entry_value[:number]
            entry_node = entry_node[:number]
            entry_time = entry_time[:number]
            for _, other, tail in settled:
                total = int(tail.total[0])
                apply_settled_misses(
                    count,
                    entry_value,
                    entry_node,
                    entry_time,
                    tail.times[0, :total],
                    tail.places[0, :total],
                    tail.turns[0, :total],
                    self.team.dimension,
                    *other,
                )
            counts.append(count)
            value_parts.append(entry_value)
            node_parts.append(entry_node)
            time_parts.append(entry_time)
        return (
            starts_of(joined(counts, np.int64)),
            joined(value_parts, float),
            stacked(node_parts, 3),
            joined(time_parts, np.int64),
        )

    def _information(
        self,
        robots: list[RobotView],
        kernels: list[tuple[int, FloatArray]],
        planned: list[Events],
        settled: list[tuple[RobotView, tuple[int, FloatArray], Events]],
        centres: FloatArray,
        first: int,
    ) -> tuple[FloatArray, FloatArray]:
        d = self.team.dimension
        number = len(centres)
        base = np.zeros((number, d, d))
        gain = np.zeros((int(self.start[-1]), number, d, d))
        if number == 0:
            return base, gain
        for view, kernel, tail in settled:
            out = np.zeros((1, number, d, d))
            add_information(view, kernel, tail, tail.own, 0, centres, d, out)
            base += out[0]
        for index, (view, kernel, item) in enumerate(zip(robots, kernels, planned)):
            rows = slice(int(self.start[index]), int(self.start[index + 1]))
            add_information(view, kernel, item, item.own, first, centres, d, gain[rows])
            if first:
                # The present measurement does not depend on the choice.
                here = first_row(item)
                out = np.zeros((1, number, d, d))
                add_information(view, kernel, here, np.minimum(here.own, 1), 0, centres, d, out)
                base += out[0]
        return base, gain

    def _new_targets(
        self,
        kernels: list[tuple[int, FloatArray]],
        planned: list[Events],
        settled: list[tuple[RobotView, tuple[int, FloatArray], Events]],
        first: int,
    ) -> tuple[FloatArray, FloatArray]:
        exploration = self.team.exploration
        values, lower, step = exploration.kernel()
        volumes = exploration.cell_volumes().reshape(values.shape)
        # A field of view with hard edges needs every node: omitted nodes would never be seen.
        hard = any(kernel[0] >= BOX for kernel in kernels)
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
        for _, kernel, tail in settled:
            self._see(kernel, tail, 0, tail.own, start, step * stride, left)
        if first:
            for kernel, item in zip(kernels, planned):
                here = first_row(item)
                self._see(kernel, here, 0, np.minimum(here.own, 1), start, step * stride, left)
        flat = left.ravel()
        columns = np.flatnonzero(flat > 0.0)
        index = np.full(flat.shape, -1, np.int64)
        index[columns] = np.arange(len(columns))
        index = index.reshape(shape)
        miss = np.ones((int(self.start[-1]), len(columns)))
        for i, (kernel, item) in enumerate(zip(kernels, planned)):
            miss_at_nodes(
                item.places,
                item.turns,
                first,
                item.own,
                start,
                step * stride,
                index,
                self.team.dimension,
                *kernel,
                reach_of(*kernel),
                miss[self.start[i] : self.start[i + 1]],
            )
        return flat[columns], miss

    def _see(
        self,
        kernel: tuple[int, FloatArray],
        item: Events,
        first: int,
        own: IntArray,
        start: FloatArray,
        step: FloatArray,
        left: FloatArray,
    ) -> None:
        index = np.arange(left.size, dtype=np.int64).reshape(left.shape)
        miss = np.ones((1, left.size))
        miss_at_nodes(
            item.places,
            item.turns,
            first,
            own,
            start,
            step,
            index,
            self.team.dimension,
            *kernel,
            reach_of(*kernel),
            miss,
        )
        left *= miss.reshape(left.shape)

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
