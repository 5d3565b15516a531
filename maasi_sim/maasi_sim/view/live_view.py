"""The page of a run that goes on: server, events, and what feeds them."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from maasi_sim.run.bag import load_types
from maasi_sim.run.run_options import ViewOptions
from maasi_sim.view.event_log import Scene
from maasi_sim.view.event_maker import EventMaker
from maasi_sim.view.hub import Hub, LiveFeed
from maasi_sim.view.messages import MARKERS, MessageEvents
from maasi_sim.view.page_file import open_browser
from maasi_sim.view.server import Commander, ViewServer

# For browsers to take the last events [s].
_FAREWELL = 2.0
_STEP = 'maasi_msgs/msg/LockstepStep'


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
