"""The page: what browsers cost a run in lockstep, when it is usable, and how fast it seeks."""

import contextlib
import tempfile
import threading
import time
import urllib.request
from pathlib import Path

import numpy as np
from timing import entry, real_time_factor

from maasi_sim.run.missions import load_mission
from maasi_sim.run.view.event_log import EventLog
from maasi_sim.run.view.page_file import write_replay
from maasi_sim.run.view.scene import scene_of

# Of a run [s], and runs of each kind, of which the fastest counts: others share the machine.
SECONDS, RUNS = 60.0, 3
EVENTS, SEEKS = 100_000, 60
DEMO = 'mambo_turtlebot'
# From the request to the end of the frame in which it is drawn.
SEEK = """async (share) => {
  const begin = performance.now();
  maasi.seek(share * maasi.log.duration);
  await new Promise((done) => requestAnimationFrame(() => setTimeout(done)));
  return performance.now() - begin;
}"""


def streams(number):
    """Return a watcher: readers of the events of a run to their end, which show nothing."""

    def read(address):
        with contextlib.suppress(OSError), urllib.request.urlopen(f'{address}events') as stream:
            for _ in stream:
                pass

    def watch(address):
        for _ in range(number):
            threading.Thread(target=read, args=(address,), daemon=True).start()

    return watch


def browser(shown, usable):
    """Return a watcher: a Chromium that runs already; it notes when each page was usable."""

    def watch(address):
        begin = time.monotonic()
        shown.page.goto(address)
        shown.until('maasi.drawn > 0')
        usable.append(time.monotonic() - begin)
        # Asked rarely: questions to a page cost time as well.
        while shown.page.evaluate('document.body.dataset.connection') != 'ended':
            shown.page.wait_for_timeout(1000)
        shown.page.goto('about:blank')

    return watch


def long_log():
    """Return a run with many events of all kinds that grow with time."""
    rng = np.random.default_rng(1)
    events, found = [], []
    places = rng.normal(scale=0.02, size=(EVENTS, 2)).cumsum(axis=0) % 2.4
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
    return EventLog(scene_of('long', load_mission(DEMO).scenario), events)


def seeks(shown, file):
    # Not thinned: all of it is to be sought in.
    write_replay(long_log(), file, 10**9)
    begin = time.monotonic()
    shown.open(file.as_uri())
    yield entry('open_100000_events', time.monotonic() - begin, 's')
    shares = np.random.default_rng(2).random(SEEKS)
    times = [float(shown.page.evaluate(SEEK, float(share))) for share in shares]
    yield entry('replay_of_100000_events', file.stat().st_size / 1e6, 'MB')
    yield entry('seek_p50', float(np.median(times)))
    yield entry('seek_largest', float(np.max(times)))


def run(share=1.0):
    from browsers import CHROMIUM, chromium

    kinds, usable = {'none': None, 'one': streams(1), 'ten': streams(10)}, []
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        if CHROMIUM is not None:
            shown = stack.enter_context(chromium())
            kinds['chromium'] = browser(shown, usable)
        real_time_factor(DEMO, folder / 'cold', share * SECONDS)
        best = dict.fromkeys(kinds, 0.0)
        # Kinds take turns.
        for turn in range(RUNS):
            for kind, watch in kinds.items():
                view = ('--view', '--port', 0) if watch else ()
                out = folder / f'{kind}_{turn}'
                factor = real_time_factor(DEMO, out, share * SECONDS, *view, watch=watch)
                best[kind] = max(best[kind], factor)
        yield entry('demo_factor_without_view', best['none'], 'x')
        for kind in list(kinds)[1:]:
            yield entry(f'demo_slower_with_{kind}', 100.0 * (best['none'] / best[kind] - 1.0), '%')
        if usable:
            yield entry('page_usable_after', max(usable), 's')
            # The server of a run that has ended answers no page.
            shown.errors.clear()
            yield from seeks(shown, folder / 'long.html')
