"""What the benchmarks share: times of a call, whole runs, an entry of their results."""

import sys
from pathlib import Path
from time import perf_counter

import numpy as np

TESTS = Path(__file__).resolve().parents[1]
# Harnesses of the tests.
sys.path += [str(TESTS), *(str(TESTS / room) for room in ('chaos', 'planner', 'system'))]


def few(share, number):
    """Return the share of a number of calls, at least one."""
    return max(1, round(share * number))


def times_of(function, repeats, prepare=lambda: None):
    """Return the wall times of calls [s]; `prepare` comes before each and is not timed."""
    times = []
    for _ in range(repeats):
        prepare()
        start = perf_counter()
        function()
        times.append(perf_counter() - start)
    return times


def median_time(function, repeats, prepare=lambda: None):
    """Return the median wall time of calls after a first one [s]."""
    return float(np.median(times_of(function, repeats + 1, prepare)[1:]))


def real_time_factor(name, folder, seconds, *options, watch=None):
    """Run a scenario in lockstep, recorded; `watch` gets the address of its page."""
    from scenario_runs import start

    options = ('--lockstep', '--seed', 1, '--time-limit', seconds, *options)
    with start(name, folder, *options) as run:
        if watch is not None:
            watch(run.wait_for('^view: ').split()[1])
        run.finish()
    assert run.code in (0, 1), run.output
    return run.report['real_time_factor']


def entry(name, value, unit='ms', baseline=None, ratio=None):
    """Return a result; baseline is what it was compared with, and ratio its time over ours."""
    return {'name': name, 'value': value, 'unit': unit, 'baseline': baseline, 'ratio': ratio}


def against(name, value, peer, measure):
    """Return the entry of a time [ms] with its ratio to a peer's, which `measure` returns [ms].

    A peer that is not installed is named as not measured.
    """
    try:
        theirs = measure()
    except ImportError as error:
        return entry(name, value, 'ms', f'{peer}: not measured, {error}')
    return entry(name, value, 'ms', f'{peer}, {theirs:.3g} ms', theirs / value)
