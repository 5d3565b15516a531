"""The page of a running run, of its messages."""

import contextlib
import os
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any

from maasi_sim.run.bag import load_types
from maasi_sim.run.facts import Said
from maasi_sim.run.message_facts import MARKERS
from maasi_sim.run.run_options import ViewOptions
from maasi_sim.run.topics import time_at
from maasi_sim.run.view.event_log import Scene
from maasi_sim.run.view.event_maker import EventMaker
from maasi_sim.run.view.page_file import open_browser
from maasi_sim.run.view.pictures import IMAGES
from maasi_sim.run.view.recording import facts_for
from maasi_sim.run.view.server import Commander, Hub, ViewServer

_FAREWELL = 2.0  # for browsers to take the last events [s]
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

    def restart(self) -> None:
        """Forget all events: another run begins."""
        self.hub.restart(self._scene)
        self.maker = EventMaker(dict(self._scene), self.hub.put)

    def finish(self, text: str) -> None:
        """Show what waits, and say how the run ended; browsers that come now get all of it."""
        if self._ended.is_set():
            return
        self._ended.set()
        self._feed.join(_PATIENCE)
        self.maker.add(Said(self.maker.latest, 'run', 'team', text))
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
        self._facts = facts_for(scene, waits, None if waits else self.restart)

    def put_message(self, topic: str, type_name: str, data: bytes) -> None:
        """Take a message of a topic that is shown; never waits."""
        decode = self._types.deserialize_cdr
        if type_name in IMAGES:
            # Not in the queue: most are never decoded.
            stamp = time_at(data, 4) / 1e9
            self._facts.pictures.keep(topic, stamp, lambda: decode(data, type_name))
        elif not (self._known and type_name == MARKERS):
            self.put(lambda _: self._add(topic, type_name, decode(data, type_name)))

    def _add(self, topic: str, type_name: str, message: Any) -> None:
        for fact in self._facts.of(topic, type_name, message):
            self.maker.add(fact)

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
