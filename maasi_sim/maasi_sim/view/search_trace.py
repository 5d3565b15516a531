"""What a search in one process leaves for its replay, and how that becomes events."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maasi_filter.records import AgentMeasurement, FilterResult, FoundTarget
from maasi_filter.unexplored_map import UnexploredMap
from maasi_planner.motion.base import RobotState
from maasi_planner.team import Decision
from maasi_sim.scenario.schema import Scenario
from maasi_sim.view.event_log import STATE_PERIOD, Event, EventLog
from maasi_sim.view.event_maker import EventMaker, RobotChoice
from maasi_sim.view.page_file import write_replay
from maasi_sim.view.scene import scene_of

FloatArray = NDArray[np.float64]

# Between exploration functions [s].
_MAP_PERIOD = 1.0


@dataclass(frozen=True)
class _Choice:
    """A joint decision, and the explored share that it was made with."""

    decision: Decision
    indices: Mapping[str, int]
    planner: str
    explored: float


@dataclass(frozen=True)
class _Map:
    """The exploration function, e in ninths."""

    corner: FloatArray
    spacing: FloatArray
    ninths: NDArray[np.uint8]
    explored: float


@dataclass(frozen=True)
class _Update:
    """Measurements and the filter's update; found targets where they have changed."""

    measurements: Sequence[AgentMeasurement]
    result: FilterResult
    found: Sequence[FoundTarget] | None


@dataclass
class SearchTrace:
    """Gathers the records of a search; only references are kept, so that it costs little.

    Parameters
    ----------
    scenario : Scenario
        What is searched.
    seed : int
        Of the run.
    live : callable, optional
        Called with each record as it comes.
    """

    scenario: Scenario
    seed: int
    live: Callable[[float, str, Any], None] | None = None
    records: list[tuple[float, str, Any]] = field(default_factory=list)
    _last_states: float = -np.inf
    _last_maps: dict[str, float] = field(default_factory=dict)
    _indices: dict[str, int] = field(default_factory=dict)

    def _add(self, time: float, space: str, record: Any) -> None:
        self.records.append((time, space, record))
        if self.live is not None:
            self.live(time, space, record)

    def robots(self, time: float, states: Mapping[str, RobotState]) -> None:
        """Add where robots are; no more often than is shown."""
        if time - self._last_states < STATE_PERIOD - 1e-9:
            return
        self._last_states = time
        self._add(time, '', dict(states))

    def decision(
        self, time: float, space: str, decision: Decision, exploration: UnexploredMap
    ) -> None:
        """Add a joint decision."""
        for name in decision.robots:
            self._indices[name] = self._indices.get(name, -1) + 1
        self._add(
            time,
            space,
            _Choice(
                decision,
                {name: self._indices[name] for name in decision.robots},
                self.scenario.planner.name,
                exploration.explored_fraction(),
            ),
        )
        self._last_maps.pop(space, None)
        self.explored(time, space, exploration)

    def explored(self, time: float, space: str, exploration: UnexploredMap) -> None:
        """Add the exploration function; as the planner node, once a second and at decisions."""
        if time - self._last_maps.get(space, -np.inf) < _MAP_PERIOD - 1e-9:
            return
        self._last_maps[space] = time
        self._add(
            time,
            space,
            _Map(
                exploration.bounds[:, 0],
                exploration.step,
                np.rint(9.0 * exploration.values).astype(np.uint8),
                exploration.explored_fraction(),
            ),
        )

    def update(
        self,
        time: float,
        space: str,
        measurements: Sequence[AgentMeasurement],
        result: FilterResult,
        found: Sequence[FoundTarget] | None,
    ) -> None:
        """Add measurements and the filter's update; found targets only where they have changed."""
        self._add(time, space, _Update(measurements, result, found))

    def truth(self, time: float, targets: FloatArray) -> None:
        """Add where the true targets are, (n, d) [m]."""
        self._add(time, '', np.array(targets, dtype=float))

    def leave(self, time: float, name: str) -> None:
        """Add that a robot leaves."""
        self._add(time, name, 'left')

    def log(self, name: str = 'search') -> EventLog:
        """Return the event log of the search."""
        events: list[Event] = []
        maker = EventMaker(scene_of(name, self.scenario, self.seed), events.append)
        for record in self.records:
            hand_over(maker, *record)
        maker.end()
        return EventLog(maker.scene, events)

    def save_replay(self, path: Path) -> None:
        """Write the page with the search inside.

        Raises
        ------
        ResultsError
            If it cannot be written.
        """
        write_replay(self.log(Path(path).stem), Path(path))


def hand_over(maker: EventMaker, time: float, space: str, record: Any) -> None:
    """Hand a record of a trace to what makes events."""
    if isinstance(record, _Update):
        _hand_over_update(maker, time, space, record)
    elif isinstance(record, _Choice):
        _hand_over_choice(maker, time, space, record)
    elif isinstance(record, _Map):
        values = record.ninths / 9.0
        maker.map(time, space, record.corner, record.spacing, values, record.explored)
    elif isinstance(record, np.ndarray):
        maker.truth(time, record)
    elif isinstance(record, str):
        maker.leave(time, space)
    else:
        for name, state in record.items():
            pose = state.pose
            maker.robot(time, name, (*pose.position.tolist(), float(pose.yaw)))


def _hand_over_update(maker: EventMaker, time: float, space: str, record: _Update) -> None:
    for item in record.measurements:
        covariances: Sequence[FloatArray | None] = [None] * len(item.values)
        if item.covariances is not None:
            covariances = list(item.covariances)
        maker.seen(time, item.robot, item.pose.position, list(zip(item.values, covariances)))
    if record.found is not None:
        maker.found(
            time,
            space,
            [
                (target.id, target.position, target.covariance, target.robot, target.time)
                for target in record.found
            ],
        )
    maker.filter(
        time,
        space,
        record.result.expected_number,
        [(item.position, item.mass, item.covariance) for item in record.result.clusters],
        [(item.robot, item.index) for item in record.measurements],
    )


def _hand_over_choice(maker: EventMaker, time: float, space: str, record: _Choice) -> None:
    decision = record.decision
    reason = '' if decision.robots else decision.reason
    maker.plan(
        time,
        space,
        _choices(decision, record.indices),
        record.planner,
        record.explored,
        decision.objective,
        reason,
    )
    for name, robot in sorted(decision.robots.items()):
        maker.way(time, name, robot.positions)


def _choices(decision: Decision, indices: Mapping[str, int]) -> Iterator[RobotChoice]:
    for name, robot in sorted(decision.robots.items()):
        rows = np.column_stack(
            [
                robot.candidates.reshape(-1, 3),
                robot.control_cost,
                robot.target_refinement,
                robot.exploration,
                robot.objective,
                robot.lengths,
                robot.measurements,
            ]
        )
        yield RobotChoice(
            name, indices[name], robot.chosen, robot.waypoint, rows.tolist(), robot.reason
        )
