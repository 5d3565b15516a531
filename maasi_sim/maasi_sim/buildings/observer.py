"""Gathers the data of the report of a search of buildings from its messages."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from rosbags.typesys.store import Typestore

from maasi_filter.arrays import FloatArray
from maasi_planner.buildings.agent import Activity
from maasi_planner.buildings.preplanning import CoveragePlan
from maasi_sim.buildings.scenario import CuboidScenario
from maasi_sim.run.run_record import RunEnd, RunRecord, TeamLog, rows
from maasi_sim.run.topics import STEP


class Moment(NamedTuple):
    """When a cuboid was visited: since the first step [s], and the step."""

    time: float
    step: int


@dataclass
class CuboidRecord(RunRecord):
    """The record of a search of buildings.

    mission: searched objects; snapshots: as in the report, in the order of time and robots; of a
    cuboid there can be several; choices: decisions by the way they were made; active (n, 2): time
    [s] and robots that search; solve_times: of decisions [s]; most_heard: largest number of robots
    received at once; completed: when the last cuboid was visited.
    """

    mission: CoveragePlan
    snapshots: list[dict[str, Any]] = field(default_factory=list)
    choices: dict[str, int] = field(default_factory=dict)
    active: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))
    solve_times: FloatArray = field(default_factory=lambda: np.zeros(0))
    most_heard: int = 0
    completed: Moment | None = None


class CuboidObserver:
    """Gathers the data of a report from serialised messages, in the order of arrival."""

    #: There are no filters.
    update_topics: Sequence[str] = ()

    def __init__(self, name: str, scenario: CuboidScenario, seed: int, types: Typestore) -> None:
        self.name = name
        self.scenario = scenario
        self.seed = seed
        self.mission = scenario.mission()
        self._team = TeamLog(types)
        self._decision_topics = {f'/{name}/decision': name for name in scenario.names()}
        self._state_topics = {f'/{name}/state': name for name in scenario.names()}
        self._decisions: dict[str, list[Any]] = {name: [] for name in scenario.names()}
        self._states: dict[str, list[bytes]] = {name: [] for name in scenario.names()}
        self._visited_at: dict[int, Moment] = {}
        self._done: dict[str, int] = {}
        self.news = False
        #: Number of cuboids, and snapshots so far.
        self.total = len(self.mission.cells)
        self.measurements = 0
        #: Topics that it needs.
        self.topics = [STEP, *self._decision_topics, *self._state_topics]

    @property
    def found(self) -> int:
        """Cuboids visited so far."""
        return len(self._visited_at)

    @property
    def explored(self) -> float:
        """Share of the cuboids visited."""
        return self.found / self.total

    @property
    def completed(self) -> Moment | None:
        """When the last cuboid was visited, if `stop` asks for that."""
        if self.scenario.stop != 'all_found' or self.found < self.total:
            return None
        return max(self._visited_at.values())

    @property
    def settled(self) -> str | None:
        """The reason, once all planners report that all cuboids are visited."""
        if len(self._done) < len(self._decision_topics):
            return None
        return 'every planner knows that all cuboids are visited'

    @property
    def end_step(self) -> int | None:
        """Step at which the search ended by itself, if it has."""
        if self.completed is not None:
            return self.completed.step
        return max(self._done.values()) if self.settled is not None else None

    def add(self, topic: str, data: bytes) -> None:
        """Add a serialised message; one of another topic is ignored."""
        if topic in self._decision_topics:
            self._take(self._decision_topics[topic], self._team.decode(data, 'CuboidDecision'))
        elif topic in self._state_topics:
            self._states[self._state_topics[topic]].append(data)
        elif topic == STEP and self.completed is None:
            self._team.note(self._team.decode(data, 'LockstepStep'))

    def settle(self) -> None:
        """Do nothing: messages are evaluated in `add`."""

    def _take(self, name: str, decision: Any) -> None:
        self._decisions[name].append(decision)
        moment = Moment(self._team.time(decision.header.stamp), int(decision.step))
        for shot in decision.snapshots:
            self.measurements += 1
            known = self._visited_at.get(int(shot.cuboid))
            self.news = self.news or known is None
            if known is None or moment.step < known.step:
                self._visited_at[int(shot.cuboid)] = moment
        if decision.done:
            self._done.setdefault(name, moment.step)

    def record(self, end: RunEnd) -> CuboidRecord:
        """Return the record of the run; one that is complete ends where it became so."""
        completed = self.completed
        end_time = end.time if completed is None else completed.time
        record = CuboidRecord(
            self.name,
            self.scenario,
            self.seed,
            self.mission,
            end_reason=end.reason,
            end_time=end_time,
            wall_time=end.wall_time,
        )
        if self.found == self.total:
            record.completed = max(self._visited_at.values())
        active: dict[float, int] = {}
        times = []
        for name, decisions in self._decisions.items():
            activity = Activity.SEARCHING
            for item in decisions:
                time = self._team.time(item.header.stamp)
                if time > end_time:
                    continue
                record.choices[item.how] = record.choices.get(item.how, 0) + 1
                record.most_heard = max(record.most_heard, len(item.heard))
                times.append(float(item.solve_time))
                before, activity = activity, Activity(item.activity)
                active[time] = active.get(time, 0) + (activity is Activity.SEARCHING)
                if activity is not before:
                    word = activity.name.lower()
                    record.events.append({'time': time, 'agent': name, 'event': word})
                record.snapshots += [self._snapshot(shot, name, time) for shot in item.snapshots]
        record.snapshots.sort(key=lambda shot: (shot['time'], shot['agent'], shot['cuboid']))
        record.active = rows(sorted(active.items()), 2)
        record.solve_times = np.array(times)
        for name, raw in self._states.items():
            states = (self._team.decode(data, 'AgentState') for data in raw)
            record.trajectories[name] = self._team.trajectory(
                state for state in states if self._team.time(state.header.stamp) <= end_time
            )
        record.add_events(self._team.events, end.events)
        return record

    def _snapshot(self, shot: Any, agent: str, time: float) -> dict[str, Any]:
        cell = self.mission.cells[int(shot.cuboid)]
        return {
            'cuboid': int(shot.cuboid),
            'object': cell.target,
            'face': cell.face,
            'agent': agent,
            'time': time,
            'position': [shot.position.x, shot.position.y, shot.position.z],
            'direction': [shot.direction.x, shot.direction.y, shot.direction.z],
            'distance': float(shot.distance),
            'detection_probability': float(shot.detection_probability),
        }
