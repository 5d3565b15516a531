"""The page: what browsers cost a run in lockstep, when it is usable, and how fast it seeks."""

from __future__ import annotations

import contextlib
import queue
import sys
import tempfile
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from timing import entry, run_scenario

from maasi_sim.run.missions import load_mission
from maasi_sim.run.view.event_log import Event, EventLog
from maasi_sim.run.view.page_file import write_replay
from maasi_sim.run.view.scene import scene_of

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from browsers import CHROMIUM, chromium

# Of a run [s], and runs of each kind, of which the fastest counts: others share the machine.
SECONDS, RUNS = 60.0, 3
EVENTS, SEEKS = 100_000, 60


def demo(folder: Path, watch: Callable[[str], Any] | None, seconds: float) -> float:
    """Run the demo, watched from its address; return its real-time factor."""

    def hear(line: str) -> None:
        if watch and line.startswith('view: '):
            watch(line.split()[1])

    options = ('--view', '--port', '0') if watch else ()
    return run_scenario('mambo_turtlebot', folder, seconds, *options, hear=hear)


def read(address: str) -> None:
    """Read the events of a run to their end, and show nothing."""
    with contextlib.suppress(OSError), urllib.request.urlopen(f'{address}events') as stream:
        for _ in stream:
            pass


def streams(number: int) -> Callable[[str], None]:
    def watch(address: str) -> None:
        for _ in range(number):
            threading.Thread(target=read, args=(address,), daemon=True).start()

    return watch


def browse(addresses: queue.Queue[str], usable: list[float], started: threading.Event) -> None:
    """Watch runs with a Chromium that runs already, and note when each page was usable."""
    with chromium() as shown:
        started.set()
        while True:
            address = addresses.get()
            with contextlib.suppress(Exception):
                begin = time.monotonic()
                shown.page.goto(address)
                shown.until('maasi.drawn > 0')
                usable.append(time.monotonic() - begin)
                # Asked rarely: questions to a page cost time as well.
                while shown.page.evaluate('document.body.dataset.connection') != 'ended':
                    shown.page.wait_for_timeout(1000)
                shown.page.goto('about:blank')


def long_log() -> EventLog:
    """Return a run with many events of all kinds that grow with time."""
    rng = np.random.default_rng(1)
    events: list[Event] = []
    places = rng.normal(scale=0.02, size=(EVENTS, 2)).cumsum(axis=0) % 2.4
    found: list[Any] = []
    for index, (x, y) in enumerate(places.round(4).tolist()):
        now, name, kind = index / 40.0, ('mambo', 'turtlebot')[index % 2], index % 10
        if kind < 6:
            events.append([now, 'robot', name, [x, y, 0.5, 0.1], 0.9, 1, ''])
        elif kind < 8:
            events.append([now, 'seen', name, [x, y, 0.5], [[0.1, 0.2, 0.0, 0.01, 0.05, 0.0]]])
        elif kind == 8:
            clusters = [[x, y, 0.0, 0.5, 1e-3, 0.0, 0.0, 1e-3, 0.0, 0.0]] * 8
            events.append([now, 'filter', '', 3.0, clusters, index])
        else:
            events.append([now, 'log', '', 'team', name, f'line {index}'])
        if index % 2000 == 0:
            found.append([len(found) + 1, x, y, 0.0, [1e-4, 0, 0, 1e-4, 0, 0], name, now])
            events.append([now, 'found', '', list(found)])
    return EventLog(scene_of('long', load_mission('mambo_turtlebot').scenario), events)


def seeks(folder: Path) -> Iterator[dict[str, Any]]:
    log = long_log()
    file = folder / 'long.html'
    # Not thinned: all of it is to be sought in.
    write_replay(log, file, 10**9)
    rng = np.random.default_rng(2)
    times = []
    with chromium() as shown:
        begin = time.monotonic()
        shown.open(file.as_uri())
        yield entry('open_100000_events', time.monotonic() - begin, 's')
        for share in rng.random(SEEKS):
            # From the request to the end of the frame in which it is drawn.
            took = shown.page.evaluate(
                """async (share) => {
                  const begin = performance.now();
                  maasi.seek(share * maasi.log.duration);
                  await new Promise((done) => requestAnimationFrame(() => setTimeout(done)));
                  return performance.now() - begin;
                }""",
                float(share),
            )
            times.append(float(took))
    yield entry('replay_of_100000_events', file.stat().st_size / 1e6, 'MB')
    yield entry('seek_p50', float(np.median(times)), 'ms')
    yield entry('seek_largest', float(np.max(times)), 'ms')


def run(share: float = 1.0) -> Iterator[dict[str, Any]]:
    kinds: dict[str, Callable[[str], Any] | None] = {
        'none': None,
        'one': streams(1),
        'ten': streams(10),
    }
    usable: list[float] = []
    if CHROMIUM is not None:
        addresses: queue.Queue[str] = queue.Queue()
        started = threading.Event()
        threading.Thread(target=browse, args=(addresses, usable, started), daemon=True).start()
        started.wait(60.0)
        kinds['chromium'] = addresses.put
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        demo(folder / 'cold', None, share * SECONDS)
        best = dict.fromkeys(kinds, 0.0)
        # Kinds take turns.
        for turn in range(RUNS):
            for kind, watch in kinds.items():
                factor = demo(folder / f'{kind}_{turn}', watch, share * SECONDS)
                best[kind] = max(best[kind], factor)
        yield entry('demo_factor_without_view', best['none'], 'x')
        for kind in list(kinds)[1:]:
            yield entry(f'demo_slower_with_{kind}', 100.0 * (best['none'] / best[kind] - 1.0), '%')
        if usable:
            yield entry('page_usable_after', max(usable), 's')
        if CHROMIUM is not None:
            yield from seeks(folder)
