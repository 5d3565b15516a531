"""What a search in one process leaves for its page: calls of an `EventMaker`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from maasi_filter.arrays import FloatArray
from maasi_filter.records import AgentMeasurement, FilterResult, FoundTarget
from maasi_planner.coordinator import Coordinator
from maasi_planner.motion.base import RobotState
from maasi_planner.team import Decision
from maasi_sim.scenario.schema import Scenario
from maasi_sim.view.event_log import STATE_PERIOD, Event, EventLog
from maasi_sim.view.event_maker import EventMaker
from maasi_sim.view.live_view import LiveView
from maasi_sim.view.page_file import write_replay
from maasi_sim.view.scene import scene_of

# Between exploration functions [s].
_MAP_PERIOD = 1.0


class SearchTrace:
    """Gathers calls that make the events of a search; they are carried out when it is shown.

    Only references are kept, so that it costs a search little.
    """

    def __init__(self, scenario: Scenario, seed: int) -> None:
        self.scenario = scenario
        self.seed = seed
        self._live: LiveView | None = None
        self._calls: list[tuple[Callable[..., None], tuple[Any, ...]]] = []
        self._last_states = -np.inf
        self._last_maps: dict[str, float] = {}

    def _add(self, function: Callable[..., None], *arguments: Any) -> None:
        self._calls.append((function, arguments))
        if self._live is not None:
            self._live.put(function, *arguments)

    def show(self) -> None:
        """Serve the page of the search from now on, and say where."""
        self._live = LiveView(scene_of('search', self.scenario, self.seed))
        self._live.announce(print)
        for function, arguments in self._calls:
            self._live.put(function, *arguments)

    def end(self, reason: str) -> None:
        """Stop serving the page; what was gathered stays."""
        if self._live is not None:
            self._live.put(EventMaker.end)
            self._live.close(f'ended: {reason}')

    def robots(self, time: float, states: Mapping[str, RobotState]) -> None:
        """Add where robots are; no more often than is shown."""
        if time - self._last_states >= STATE_PERIOD - 1e-9:
            self._last_states = time
            for name, state in states.items():
                pose = (*state.pose.position.tolist(), float(state.pose.yaw))
                self._add(EventMaker.robot, time, name, pose)

    def decision(
        self, time: float, space: str, decision: Decision, coordinator: Coordinator
    ) -> None:
        """Add a joint decision."""
        indices = {name: coordinator.decision_index(name) for name in decision.robots}
        explored = coordinator.exploration.explored_fraction()
        planner = self.scenario.planner.name
        self._add(EventMaker.plan, time, space, planner, decision, indices, explored)
        self._last_maps.pop(space, None)
        self._explored(time, space, coordinator)

    def update(
        self,
        time: float,
        space: str,
        measurements: Sequence[AgentMeasurement],
        result: FilterResult,
        found: Sequence[FoundTarget] | None,
        coordinator: Coordinator,
    ) -> None:
        """Add measurements and the filter's update; found targets only where they have changed."""
        for item in measurements:
            seen = item.pose.position, item.values, item.covariances
            self._add(EventMaker.seen, time, item.robot, *seen)
        if found is not None:
            self._add(EventMaker.found, time, space, found)
        members = [(item.robot, item.index) for item in measurements]
        numbers = result.expected_number, result.clusters, members
        self._add(EventMaker.filter, time, space, *numbers)
        self._explored(time, space, coordinator)

    def _explored(self, time: float, space: str, coordinator: Coordinator) -> None:
        """Add the exploration function; as the planner node, once a second and at decisions."""
        if time - self._last_maps.get(space, -np.inf) >= _MAP_PERIOD - 1e-9:
            self._last_maps[space] = time
            explored = coordinator.exploration
            # As coarse as it is shown.
            ninths = np.rint(9.0 * explored.values).astype(np.uint8)
            grid = explored.bounds[:, 0], explored.step, ninths
            self._add(EventMaker.map, time, space, *grid, explored.explored_fraction())

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
        for function, arguments in self._calls:
            function(maker, *arguments)
        maker.end()
        return EventLog(maker.scene, events)

    def save_replay(self, path: Path) -> None:
        """Write the page with the search inside; ResultsError if it cannot be written."""
        write_replay(self.log(path.stem), path)
