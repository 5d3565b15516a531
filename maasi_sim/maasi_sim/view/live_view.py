"""The page of a run that goes on: server, events, and what feeds them."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from rosbags.typesys.store import Typestore

from maasi_sim.run.bag import load_types
from maasi_sim.run.run_options import ViewOptions
from maasi_sim.view.event_log import Scene
from maasi_sim.view.event_maker import EventMaker
from maasi_sim.view.hub import Hub, LiveFeed
from maasi_sim.view.messages import MessageEvents
from maasi_sim.view.page_file import open_browser
from maasi_sim.view.scene import scene_of
from maasi_sim.view.search_trace import Call, SearchTrace
from maasi_sim.view.server import Commander, ViewServer

# For browsers to take the last events [s].
_FAREWELL = 2.0
_STEP = 'maasi_msgs/msg/LockstepStep'
_MARKERS = 'visualization_msgs/msg/MarkerArray'


class LiveView:
    """Serve the page of a run in progress; address and commands as of `ViewServer`."""

    def __init__(
        self,
        scene: Scene,
        port: int | None = None,
        host: str = '127.0.0.1',
        commander: Commander | None = None,
    ) -> None:
        self._scene = scene
        self.hub = Hub(scene)
        self.maker = EventMaker(dict(scene), self.hub.put)
        self.server = ViewServer(self.hub, port, host, commander)

    def announce(self, say: Callable[[str], object]) -> None:
        """Say where the page is, and open it where there is a browser."""
        server = self.server
        if server.wanted_port not in (0, server.port):
            say(f'warning: port {server.wanted_port} is in use: the page is at {server.port}')
        say(f'view: {server.address}')
        if not server.is_private:
            say('view: other machines see it, by this whole link only')
        open_browser(self.server.address)

    def restart(self) -> EventMaker:
        """Forget all events: another run begins."""
        self.hub.restart(self._scene)
        self.maker = EventMaker(dict(self._scene), self.hub.put)
        return self.maker

    def end(self, text: str = '') -> None:
        """Say how the run ended, let browsers take what is left, and stop serving."""
        if text:
            self.maker.message(self.maker.latest, 'run', 'team', text)
        self.hub.close()
        deadline = time.monotonic() + _FAREWELL
        while self.server.browsers and time.monotonic() < deadline:
            time.sleep(0.02)
        self.server.close()


class MessageFeed:
    """Feeds a page with serialised messages.

    `waits`: the run begins with a `LockstepStep`; what comes before it is shown at its time.
    """

    def __init__(self, view: LiveView, types: Typestore, waits: bool = True) -> None:
        self._types = types
        self._waits = waits
        self._early: list[tuple[str, str, bytes]] = []
        self._known = 'bounds' in view.maker.scene
        self._events = MessageEvents(view.maker, None, None if waits else view.restart)
        self._feed = LiveFeed(self._take)

    def put(self, topic: str, type_name: str, data: bytes) -> None:
        """Take a message of a topic that is shown; never waits."""
        if not (self._known and type_name == _MARKERS):
            self._feed.put((topic, type_name, data))

    def close(self) -> None:
        """Take what waits, and end."""
        self._feed.close()

    def _take(self, item: Any) -> None:
        if self._waits:
            self._early.append(item)
            if item[1] != _STEP:
                return
            self._waits = False
            begun, self._early = [item, *self._early[:-1]], []
            for one in begun:
                self._decode(*one)
        else:
            self._decode(*item)

    def _decode(self, topic: str, type_name: str, data: bytes) -> None:
        self._events.take(topic, type_name, self._types.deserialize_cdr(data, type_name))


class RunPage:
    """Serves the page of a scene with serialised messages; OSError if it cannot be served.

    `waits`: as of `MessageFeed`; the page of a run says when that has ended.
    """

    def __init__(
        self, scene: Scene, options: ViewOptions, domain: int, team: str, waits: bool = True
    ) -> None:
        self._control = None
        if options.control:
            # Only this part of the view needs ROS.
            from maasi_sim.view.control_node import Control

            self._control = Control(domain, team)
        self._waits = waits
        self.view = LiveView(scene, options.port, options.host, self._control)
        self._feed = MessageFeed(self.view, load_types(), waits)
        self.put = self._feed.put

    def close(self) -> None:
        """Show the queued messages, and stop serving."""
        self._feed.close()
        if self._waits:
            self.view.maker.end()
        self.view.end('the run has ended' if self._waits else 'the view was closed')
        if self._control is not None:
            self._control.close()


class TraceFeed:
    """Feeds a page with the calls of a search in this process."""

    def __init__(self, view: LiveView) -> None:
        self._view = view
        self._feed = LiveFeed(self._take)
        self.put = self._feed.put

    def _take(self, call: Call) -> None:
        function, arguments = call
        function(self._view.maker, *arguments)

    def close(self, text: str) -> None:
        """Take what waits, say how the search ended, and stop serving."""
        self._feed.close()
        self._view.maker.end()
        self._view.end(text)


def open_view(trace: SearchTrace) -> TraceFeed:
    """Serve the page of a search in this process, and say where."""
    view = LiveView(scene_of('search', trace.scenario, trace.seed))
    view.announce(print)
    feed = TraceFeed(view)
    for call in trace.calls:
        feed.put(call)
    trace.live = feed.put
    return feed
