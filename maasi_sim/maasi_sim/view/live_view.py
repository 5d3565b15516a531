"""The page of a running run, of its messages, and of a search in this process."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from maasi_filter.arrays import FloatArray
from maasi_filter.records import AgentMeasurement, FilterResult, FoundTarget
from maasi_planner.coordinator import Coordinator
from maasi_planner.motion.base import RobotState
from maasi_planner.team import Decision
from maasi_sim.run.bag import load_types
from maasi_sim.run.run_options import ViewOptions
from maasi_sim.scenario.schema import Scenario
from maasi_sim.view.event_log import STATE_PERIOD, Event, EventLog, Scene
from maasi_sim.view.event_maker import EventMaker
from maasi_sim.view.messages import MARKERS, MessageEvents
from maasi_sim.view.page_file import open_browser, write_replay
from maasi_sim.view.scene import scene_of
from maasi_sim.view.server import Commander, Hub, ViewServer

# For browsers to take the last events [s].
_FAREWELL = 2.0
_STEP = 'maasi_msgs/msg/LockstepStep'
# Between exploration functions of a search [s].
_MAP_PERIOD = 1.0
# Items that wait at most, and wait for more before they are taken, so that the run has the
# processor [s].
MOST_WAITING = 50_000
_PERIOD = 0.05


class LiveFeed:
    """Hand items to a function in a thread of its own; `put` never waits."""

    def __init__(self, take: Callable[[Any], object], most: int = MOST_WAITING) -> None:
        self._take = take
        self._most = most
        self._waiting: deque[Any] = deque()
        self._ended = threading.Event()
        self.dropped = 0
        self.refused = 0
        self._thread = threading.Thread(target=self._work, name='view feed', daemon=True)
        self._thread.start()

    def put(self, item: Any) -> None:
        """Take an item; where too many wait it is dropped."""
        if len(self._waiting) < self._most:
            self._waiting.append(item)
        else:
            self.dropped += 1

    def close(self, patience: float = 5.0) -> None:
        """Take what waits, and end."""
        self._ended.set()
        self._thread.join(patience)

    def _work(self) -> None:
        while True:
            ended = self._ended.wait(_PERIOD)
            while self._waiting:
                try:
                    self._take(self._waiting.popleft())
                except (ValueError, ArithmeticError, LookupError, AttributeError, TypeError):
                    # A message that cannot be shown must not end the view.
                    self.refused += 1
            if ended:
                return


class LiveView:
    """Serve the page of a run in progress; address and commands as of `ViewServer`."""

    def __init__(
        self,
        scene: Scene,
        port: int | None = None,
        host: str = '127.0.0.1',
        commander: Commander | None = None,
    ) -> None:
        self._scene = scene if commander is None else {**scene, 'control': True}
        self.hub = Hub(self._scene)
        self.maker = EventMaker(dict(scene), self.hub.put)
        self.server = ViewServer(self.hub, port, host, commander)
        self._feed = LiveFeed(self._take)

    def announce(self, say: Callable[[str], object]) -> None:
        """Say where the page is, and open it where there is a browser."""
        server = self.server
        if server.wanted_port not in (0, server.port):
            say(f'warning: port {server.wanted_port} is in use: the page is at {server.port}')
        say(f'view: {server.address}')
        if not server.is_private:
            say('view: other machines see it, by this whole link only')
        open_browser(server.address)

    def put(self, function: Callable[..., object], *arguments: Any) -> None:
        """Have a function called with the maker of events and further arguments; never wait."""
        self._feed.put((function, arguments))

    def _take(self, call: tuple[Callable[..., object], tuple[Any, ...]]) -> None:
        function, arguments = call
        function(self.maker, *arguments)

    def restart(self) -> EventMaker:
        """Forget all events: another run begins."""
        self.hub.restart(self._scene)
        self.maker = EventMaker(dict(self._scene), self.hub.put)
        return self.maker

    def close(self, text: str = '') -> None:
        """Show what waits, say how the run ended, let browsers take the rest, and stop serving."""
        self._feed.close()
        if text:
            self.maker.message(self.maker.latest, 'run', 'team', text)
        self.hub.close()
        deadline = time.monotonic() + _FAREWELL
        while self.server.browsers and time.monotonic() < deadline:
            time.sleep(0.02)
        self.server.close()


class RunPage(LiveView):
    """Serves the page of a scene with serialised messages; OSError if it cannot be served.

    `waits`: the run begins with a `LockstepStep`; what comes before it is shown at its time, and
    the page says when the run has ended.
    """

    def __init__(
        self, scene: Scene, options: ViewOptions, domain: int, team: str, waits: bool = True
    ) -> None:
        self._control = None
        if options.control:
            # Only this part of the view needs ROS.
            from maasi_sim.view.control_node import Control

            self._control = Control(domain, team)
        super().__init__(scene, options.port, options.host, self._control)
        self._types = load_types()
        self._waits = self._early = waits
        self._known = 'bounds' in scene
        self._messages = MessageEvents(self.maker, None, None if waits else self.restart)
        self._first: list[tuple[Any, ...]] = []

    def put_message(self, topic: str, type_name: str, data: bytes) -> None:
        """Take a message of a topic that is shown; never waits."""
        if not (self._known and type_name == MARKERS):
            self.put(self._decode, topic, type_name, data)

    def _decode(self, _: EventMaker, *item: Any) -> None:
        self._first.append(item)
        if self._early and item[1] != _STEP:
            return
        begun = [item, *self._first[:-1]]
        self._early = False
        self._first.clear()
        for topic, type_name, data in begun:
            self._messages.take(topic, type_name, self._types.deserialize_cdr(data, type_name))

    def end(self) -> None:
        """Show the queued messages, and stop serving."""
        if self._waits:
            self.put(EventMaker.end)
        self.close('the run has ended' if self._waits else 'the view was closed')
        if self._control is not None:
            self._control.close()


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
        indices = {name: coordinator.plans[name].decision for name in decision.robots}
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
