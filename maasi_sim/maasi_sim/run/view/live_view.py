"""The page of a running run, of its messages, and of a search in this process."""

import contextlib
import os
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from maasi_filter.arrays import FloatArray
from maasi_filter.records import AgentMeasurement, FilterResult, FoundTarget
from maasi_planner.coordinator import Coordinator
from maasi_planner.motion.base import RobotState
from maasi_planner.team import Decision
from maasi_sim.run.bag import load_types
from maasi_sim.run.run_options import ViewOptions
from maasi_sim.run.topics import time_at
from maasi_sim.run.view.event_log import STATE_PERIOD, Event, EventLog, Scene, shades
from maasi_sim.run.view.event_maker import EventMaker
from maasi_sim.run.view.messages import MARKERS, MessageEvents
from maasi_sim.run.view.page_file import open_browser
from maasi_sim.run.view.pictures import IMAGES
from maasi_sim.run.view.scene import scene_of
from maasi_sim.run.view.server import Commander, Hub, ViewServer
from maasi_sim.scenario.schema import Scenario

_FAREWELL = 2.0  # for browsers to take the last events [s]
_MAP_PERIOD = 1.0  # between exploration functions of a search [s]
# Calls that wait at most, and wait for more before they are made, so that the run has the
# processor [s].
MOST_WAITING = 50_000
_PERIOD = 0.05
_PATIENCE = 5.0  # patience at the end for calls that wait [s]


class LiveView:
    """Serve the page of a run in progress, its events made in a thread for which nothing waits."""

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
        self._waiting: deque[tuple[Callable[..., object], tuple[Any, ...]]] = deque()
        self._ended = threading.Event()
        self._feed = threading.Thread(target=self._work, name='view feed', daemon=True)
        self._feed.start()

    def announce(self, say: Callable[[str], object], browser: bool = True) -> None:
        """Say where the page is, and open it where there is a browser."""
        server = self.server
        if server.wanted_port not in (0, server.port):
            say(f'warning: port {server.wanted_port} is in use: the page is at {server.port}')
        say(f'view: {server.address}')
        if not server.is_private:
            say('view: other machines see it, by this whole link only')
        if browser:
            open_browser(server.address)

    def put(self, function: Callable[..., object], *arguments: Any) -> None:
        """Have a function called with the event maker and arguments; drop it if too many wait."""
        if len(self._waiting) < MOST_WAITING:
            self._waiting.append((function, arguments))

    def _work(self) -> None:
        ended = False
        while not ended:
            ended = self._ended.wait(_PERIOD)
            while self._waiting:
                function, arguments = self._waiting.popleft()
                # A message that cannot be shown must not end the view.
                with contextlib.suppress(
                    ValueError, ArithmeticError, LookupError, AttributeError, TypeError
                ):
                    function(self.maker, *arguments)

    def restart(self) -> EventMaker:
        """Forget all events: another run begins."""
        self.hub.restart(self._scene)
        self.maker = EventMaker(dict(self._scene), self.hub.put)
        return self.maker

    def finish(self, text: str) -> None:
        """Show what waits, and say how the run ended; browsers that come now get all of it."""
        if self._ended.is_set():
            return
        self._ended.set()
        self._feed.join(_PATIENCE)
        self.maker.message(self.maker.latest, 'run', 'team', text)
        self.hub.close()

    def wait_for_reader(self, say: Callable[[str], object]) -> None:
        """Keep the page, in a terminal, until Enter is pressed; it is finished."""
        with contextlib.suppress(OSError, ValueError):
            if os.tcgetpgrp(sys.stdin.fileno()) == os.getpgrp():
                say(f'the page stays at {self.server.address} (Enter or Ctrl-C ends it)')
                sys.stdin.readline()

    def close(self) -> None:
        """Finish, let browsers take the rest, and stop serving."""
        self.finish('closed')
        deadline = time.monotonic() + _FAREWELL
        while self.server.browsers and time.monotonic() < deadline:
            time.sleep(0.02)
        self.server.close()


class RunPage(LiveView):
    """Serves the page of a scene with serialised messages; OSError if it cannot be served.

    `waits`: the run begins with a `LockstepStep`, and what comes before is shown at its time.
    """

    def __init__(
        self, scene: Scene, options: ViewOptions, domain: int, team: str, waits: bool = True
    ) -> None:
        self._control = None
        if options.control:
            # Only this part of the view needs ROS.
            from maasi_sim.run.view.control_node import Control

            self._control = Control(domain, team)
        super().__init__(scene, options.port, options.host, self._control)
        self._types = load_types()
        self._waits = waits
        self._ready = -1
        self._known = 'bounds' in scene
        self._messages = MessageEvents(self.maker, waits, None if waits else self.restart)

    def put_message(self, topic: str, type_name: str, data: bytes) -> None:
        """Take a message of a topic that is shown; never waits."""
        decode, take = self._types.deserialize_cdr, self._messages.take
        if type_name in IMAGES:
            # Not in the queue: most are never decoded.
            stamp = time_at(data, 4) / 1e9
            self._messages.pictures.keep(topic, stamp, lambda: decode(data, type_name))
        elif not (self._known and type_name == MARKERS):
            self.put(lambda _: take(topic, type_name, decode(data, type_name)))

    def starting(self, ready: int, total: int) -> None:
        """Show how many nodes are ready."""
        if self._ready != ready:
            self._ready = ready
            self.put(EventMaker.starting, ready, total)

    def end(self) -> None:
        """Show the queued messages; no command is carried out any more."""
        if self._waits:
            self.put(EventMaker.end)
        self.finish('the run has ended' if self._waits else 'the view was closed')
        if self._control is not None:
            self._control.close()


class SearchTrace:
    """Gathers calls that make the events of a search, cheaply: they are made when it is shown."""

    def __init__(self, scenario: Scenario, seed: int) -> None:
        self.scenario, self.seed = scenario, seed
        self._live: LiveView | None = None
        self._calls: list[tuple[Callable[..., None], tuple[Any, ...]]] = []
        self._last_states = -np.inf
        self._last_maps: dict[str, float] = {}

    def add(self, function: Callable[..., None], *arguments: Any) -> None:
        """Have a method of `EventMaker` called with these arguments, which do not change."""
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
        self.add(EventMaker.end, reason)
        if self._live is not None:
            self._live.finish(f'ended: {reason}')
            self._live.close()

    def robots(self, time: float, states: Mapping[str, RobotState]) -> None:
        """Add where robots are; no more often than is shown."""
        if time - self._last_states >= STATE_PERIOD - 1e-9:
            self._last_states = time
            for name, state in states.items():
                pose = (*state.pose.position.tolist(), float(state.pose.yaw))
                self.add(EventMaker.robot, time, name, pose)

    def positions(self) -> dict[str, FloatArray]:
        """Return where each robot was, (n, 3) [m], as often as is shown."""
        ways: dict[str, list[tuple[float, ...]]] = {}
        for function, arguments in self._calls:
            if function is EventMaker.robot:
                _, name, pose = arguments
                ways.setdefault(name, []).append(pose[:3])
        return {name: np.array(way) for name, way in ways.items()}

    def decision(
        self, time: float, space: str, decision: Decision, coordinator: Coordinator
    ) -> None:
        """Add a joint decision."""
        indices = {name: coordinator.plans[name].decision for name in decision.robots}
        explored = coordinator.exploration.explored_fraction()
        planner = self.scenario.planner.name
        self.add(EventMaker.plan, time, space, planner, decision, indices, explored)
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
            self.add(EventMaker.seen, time, item.robot, *seen)
        if found is not None:
            self.add(EventMaker.found, time, space, found)
        members = [(item.robot, item.index) for item in measurements]
        numbers = result.expected_number, result.clusters, members
        self.add(EventMaker.filter, time, space, *numbers)
        self._explored(time, space, coordinator)

    def _explored(self, time: float, space: str, coordinator: Coordinator) -> None:
        """Add the exploration function; as the planner node, once a second and at decisions."""
        if time - self._last_maps.get(space, -np.inf) >= _MAP_PERIOD - 1e-9:
            self._last_maps[space] = time
            explored = coordinator.exploration
            # As coarse as it is shown: a byte for each cell.
            lower, step, shown = explored.shown()
            letters = np.frombuffer(shades(shown).encode(), 'S1').reshape(shown.shape)
            share = explored.explored_fraction()
            self.add(EventMaker.map, time, space, lower, step, letters, share)

    def log(self, name: str = 'search') -> EventLog:
        """Return the event log of the search."""
        events: list[Event] = []
        maker = EventMaker(scene_of(name, self.scenario, self.seed), events.append)
        for function, arguments in self._calls:
            function(maker, *arguments)
        maker.end()
        return EventLog(maker.scene, events)
