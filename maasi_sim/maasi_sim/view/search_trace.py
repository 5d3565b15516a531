"""What a search in one process leaves for its replay, as calls of what makes events."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from maasi_filter.arrays import FloatArray
from maasi_filter.records import AgentMeasurement, FilterResult, FoundTarget
from maasi_filter.unexplored_map import UnexploredMap
from maasi_planner.motion.base import RobotState
from maasi_planner.team import Decision
from maasi_sim.scenario.schema import Scenario
from maasi_sim.view.event_log import STATE_PERIOD, Event, EventLog
from maasi_sim.view.event_maker import EventMaker, RobotChoice
from maasi_sim.view.page_file import write_replay
from maasi_sim.view.scene import scene_of

# Between exploration functions [s].
_MAP_PERIOD = 1.0
# A function of an `EventMaker`, and what it takes besides.
Call = tuple[Callable[..., None], tuple[Any, ...]]


class SearchTrace:
    """Gathers calls that make the events of a search; they are carried out when it is shown.

    Only references are kept, so that it costs a search little. `live` is called with each call.
    """

    def __init__(self, scenario: Scenario, seed: int) -> None:
        self.scenario = scenario
        self.seed = seed
        self.live: Callable[[Call], None] | None = None
        self.calls: list[Call] = []
        self._last_states = -np.inf
        self._last_maps: dict[str, float] = {}
        self._indices: dict[str, int] = {}

    def _add(self, function: Callable[..., None], *arguments: Any) -> None:
        self.calls.append((function, arguments))
        if self.live is not None:
            self.live((function, arguments))

    def robots(self, time: float, states: Mapping[str, RobotState]) -> None:
        """Add where robots are; no more often than is shown."""
        if time - self._last_states >= STATE_PERIOD - 1e-9:
            self._last_states = time
            for name, state in states.items():
                pose = (*state.pose.position.tolist(), float(state.pose.yaw))
                self._add(EventMaker.robot, time, name, pose)

    def decision(
        self, time: float, space: str, decision: Decision, exploration: UnexploredMap
    ) -> None:
        """Add a joint decision."""
        for name in decision.robots:
            self._indices[name] = self._indices.get(name, -1) + 1
        indices = {name: self._indices[name] for name in decision.robots}
        explored = exploration.explored_fraction()
        self._add(_plan, time, space, decision, indices, self.scenario.planner.name, explored)
        self._last_maps.pop(space, None)
        self.explored(time, space, exploration)

    def explored(self, time: float, space: str, exploration: UnexploredMap) -> None:
        """Add the exploration function; as the planner node, once a second and at decisions."""
        if time - self._last_maps.get(space, -np.inf) >= _MAP_PERIOD - 1e-9:
            self._last_maps[space] = time
            # As coarse as it is shown.
            ninths = np.rint(9.0 * exploration.values).astype(np.uint8)
            grid = exploration.bounds[:, 0], exploration.step, ninths
            self._add(EventMaker.map, time, space, *grid, exploration.explored_fraction())

    def update(
        self,
        time: float,
        space: str,
        measurements: Sequence[AgentMeasurement],
        result: FilterResult,
        found: Sequence[FoundTarget] | None,
    ) -> None:
        """Add measurements and the filter's update; found targets only where they have changed."""
        self._add(_update, time, space, measurements, result, found)

    def truth(self, time: float, targets: FloatArray) -> None:
        """Add where the true targets are, (n, d) [m]."""
        self._add(EventMaker.truth, time, np.array(targets, dtype=float))

    def leave(self, time: float, name: str) -> None:
        """Add that a robot leaves."""
        self._add(EventMaker.leave, time, name)

    def log(self, name: str = 'search') -> EventLog:
        """Return the event log of the search."""
        events: list[Event] = []
        maker = EventMaker(scene_of(name, self.scenario, self.seed), events.append)
        for function, arguments in self.calls:
            function(maker, *arguments)
        maker.end()
        return EventLog(maker.scene, events)

    def save_replay(self, path: Path) -> None:
        """Write the page with the search inside; ResultsError if it cannot be written."""
        write_replay(self.log(Path(path).stem), Path(path))


def _update(
    maker: EventMaker,
    time: float,
    space: str,
    measurements: Sequence[AgentMeasurement],
    result: FilterResult,
    found: Sequence[FoundTarget] | None,
) -> None:
    for item in measurements:
        own = [None] * len(item.values) if item.covariances is None else item.covariances
        maker.seen(time, item.robot, item.pose.position, zip(item.values, own))
    if found is not None:
        targets = [(one.id, one.position, one.covariance, one.robot, one.time) for one in found]
        maker.found(time, space, targets)
    clusters = [(item.position, item.mass, item.covariance) for item in result.clusters]
    members = [(item.robot, item.index) for item in measurements]
    maker.filter(time, space, result.expected_number, clusters, members)


def _plan(
    maker: EventMaker,
    time: float,
    space: str,
    decision: Decision,
    indices: Mapping[str, int],
    planner: str,
    explored: float,
) -> None:
    choices = []
    for name, robot in sorted(decision.robots.items()):
        terms = robot.control_cost, robot.target_refinement, robot.exploration, robot.objective
        places = robot.candidates.reshape(-1, 3)
        rows = np.column_stack([places, *terms, robot.lengths, robot.measurements]).tolist()
        chosen = robot.chosen, robot.waypoint
        choices.append(RobotChoice(name, indices[name], *chosen, rows, robot.reason))
    reason = '' if decision.robots else decision.reason
    maker.plan(time, space, choices, planner, explored, decision.objective, reason)
    for name, robot in sorted(decision.robots.items()):
        maker.way(time, name, robot.positions)
