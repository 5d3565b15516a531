"""The page of a run in progress: of nodes, from their messages, or of a search in one process."""

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
from maasi_sim.run.log import RunLog
from maasi_sim.run.message_facts import MARKERS
from maasi_sim.run.run_options import ViewOptions
from maasi_sim.run.topics import time_at
from maasi_sim.run.view.event_log import Scene
from maasi_sim.run.view.event_maker import EventMaker
from maasi_sim.run.view.page_file import open_browser
from maasi_sim.run.view.pictures import IMAGES
from maasi_sim.run.view.recording import facts_for
from maasi_sim.run.view.scene import scene_of
from maasi_sim.run.view.server import Commander, Hub, ViewServer

_FAREWELL = 2.0  # time for browsers to receive the last events [s]
# Most waiting calls, and the time that calls are collected, which leaves the processor to the run
# [s].
MOST_WAITING = 50_000
_PERIOD = 0.05
_PATIENCE = 5.0  # longest wait at the end for waiting calls [s]


class LiveView:
    """Serves the page of a run in progress; a thread makes its events without blocking the run."""

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
        """Print the address of the page and open it in a browser."""
        server = self.server
        if server.wanted_port not in (0, server.port):
            say(f'warning: port {server.wanted_port} is in use: using port {server.port}')
        say(f'view: {server.address}')
        if not server.is_private:
            say('view: other machines need this full link including its token')
        if browser:
            open_browser(server.address)

    def put(self, function: Callable[..., object], *arguments: Any) -> None:
        """Queue a function of the event maker with arguments; drop it if too many wait."""
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
        """Drop all events: another run begins."""
        self.hub.restart(self._scene)
        self.maker = EventMaker(dict(self._scene), self.hub.put)

    def finish(self, text: str) -> None:
        """Show the queued events and how the run ended."""
        if self._ended.is_set():
            return
        self._ended.set()
        self._feed.join(_PATIENCE)
        self.maker.add(Said(self.maker.latest, 'run', 'team', text))
        self.hub.close()

    def wait_for_reader(self, say: Callable[[str], object]) -> None:
        """Keep serving in a terminal until Enter is pressed."""
        with contextlib.suppress(OSError, ValueError):
            if os.tcgetpgrp(sys.stdin.fileno()) == os.getpgrp():
                say(f'the page stays at {self.server.address} until Enter or Ctrl-C is pressed')
                sys.stdin.readline()

    def close(self) -> None:
        """Finish, let browsers receive the rest, and stop serving."""
        self.finish('closed')
        deadline = time.monotonic() + _FAREWELL
        while self.server.browsers and time.monotonic() < deadline:
            time.sleep(0.02)
        self.server.close()


class RunPage(LiveView):
    """Serves the page of a scene from serialised messages; raises OSError if it cannot.

    `waits`: the run begins with a `LockstepStep`; earlier messages are shown at its time.
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
        """Queue a message of a shown topic without waiting."""
        decode = self._types.deserialize_cdr
        if type_name in IMAGES:
            # Not in the queue: most images are never decoded.
            stamp = time_at(data, 4) / 1e9
            self._facts.pictures.keep(topic, stamp, lambda: decode(data, type_name))
        elif not (self._known and type_name == MARKERS):
            self.put(lambda _: self._add(topic, type_name, decode(data, type_name)))

    def _add(self, topic: str, type_name: str, message: Any) -> None:
        for fact in self._facts.of(topic, type_name, message):
            self.maker.add(fact)

    def starting(self, ready: int, total: int) -> None:
        """Show the number of ready nodes."""
        if self._ready != ready:
            self._ready = ready
            self.put(EventMaker.starting, ready, total)

    def end(self) -> None:
        """Show the queued messages and refuse further commands."""
        if self._waits:
            self.put(EventMaker.end)
        self.finish('the run has ended' if self._waits else 'the view was closed')
        if self._control is not None:
            self._control.close()


class SearchPage(LiveView):
    """Serves the page of a running search in this process."""

    def __init__(self, log: RunLog) -> None:
        super().__init__(scene_of('search', log.scenario, log.seed))
        self._log = log
        self.announce(print)
        for fact in log.facts:
            self.put(EventMaker.add, fact)
        log.listeners.append(lambda fact: self.put(EventMaker.add, fact))

    def end(self) -> None:
        """Show how the search ended and stop serving."""
        reason = self._log.end_reason
        self.put(EventMaker.end, reason)
        self.finish(f'ended: {reason}')
        self.close()
