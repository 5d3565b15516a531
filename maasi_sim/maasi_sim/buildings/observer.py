"""Gathers the data of the report of a search of buildings from its messages."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from rosbags.typesys.store import Typestore

from maasi_filter.arrays import FloatArray
from maasi_planner.buildings import CoveragePlan
from maasi_sim.buildings.scenario import CuboidScenario
from maasi_sim.run.run_record import RunEnd, RunRecord, TeamLog
from maasi_sim.run.topics import STEP

SEARCHING = 0
_ACTIVITIES = ('searching', 'returning', 'recharging')


@dataclass(frozen=True)
class SnapshotRecord:
    """A snapshot as it was reported; position (3,) [m] and optical axis (3,)."""

    cuboid: int
    agent: str
    step: int
    time: float
    position: FloatArray
    direction: FloatArray
    distance: float
    detection_probability: float


@dataclass(frozen=True)
class Moment:
    """When a cuboid was visited."""

    time: float
    step: int


@dataclass
class CuboidRecord(RunRecord):
    """The record of a search of buildings.

    Attributes
    ----------
    mission : CoveragePlan
        Searched objects.
    snapshots : list of SnapshotRecord
        In the order of steps and robots; of a cuboid there can be several.
    choices : dict
        Decisions by the way they were made.
    active : (n, 2) array
        Time [s] and robots that search.
    solve_times : array
        Of decisions [s].
    most_heard : int
        Largest number of robots received at once.
    completed : Moment or None
        When the last cuboid was visited.
    """

    mission: CoveragePlan
    snapshots: list[SnapshotRecord] = field(default_factory=list)
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
        return max(self._visited_at.values(), key=lambda moment: moment.step)

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
            record.completed = max(self._visited_at.values(), key=lambda moment: moment.step)
        active: dict[float, int] = {}
        times = []
        for name, decisions in self._decisions.items():
            activity = SEARCHING
            for item in decisions:
                moment = self._team.time(item.header.stamp)
                if moment > end_time:
                    continue
                record.choices[item.how] = record.choices.get(item.how, 0) + 1
                record.most_heard = max(record.most_heard, len(item.heard))
                times.append(float(item.solve_time))
                active[moment] = active.get(moment, 0) + (item.activity == SEARCHING)
                if item.activity != activity:
                    activity = int(item.activity)
                    record.events.append(
                        {'time': moment, 'agent': name, 'event': _ACTIVITIES[activity]}
                    )
                record.snapshots += [
                    SnapshotRecord(
                        int(shot.cuboid),
                        name,
                        int(item.step),
                        moment,
                        np.array([shot.position.x, shot.position.y, shot.position.z]),
                        np.array([shot.direction.x, shot.direction.y, shot.direction.z]),
                        float(shot.distance),
                        float(shot.detection_probability),
                    )
                    for shot in item.snapshots
                ]
        record.snapshots.sort(key=lambda shot: (shot.step, shot.agent, shot.cuboid))
        record.active = np.array(sorted(active.items()), dtype=float).reshape(-1, 2)
        record.solve_times = np.array(times)
        for name, raw in self._states.items():
            states = (self._team.decode(data, 'AgentState') for data in raw)
            record.trajectories[name] = self._team.trajectory(
                state for state in states if self._team.time(state.header.stamp) <= end_time
            )
        record.add_events(self._team.events, end.events)
        return record
