"""Time and memory of decisions and filter steps by the number of robots, the area and targets."""

import ctypes
import gc
import re
import time
from pathlib import Path

import numpy as np
from timing import entry

from maasi_filter import (
    AgentMeasurement,
    FilterSettings,
    NoiseSettings,
    PmbFilter,
    Pose,
    SensorSettings,
)
from maasi_filter import warm_up as warm_up_filter
from maasi_planner import (
    make_planner,
    warm_up,
)

TOO_LONG = 15.0  # a decision that takes longer is not repeated for more robots [s]


def peak():
    """Return the largest memory of this process since the last call of `forget_peak` [MB]."""
    status = Path('/proc/self/status').read_text(encoding='ascii')
    return int(re.search(r'VmHWM:\s+(\d+)', status)[1]) / 1024.0


def forget_peak():
    """Let `peak` begin at the present memory, without what is free."""
    gc.collect()
    ctypes.CDLL('libc.so.6').malloc_trim(0)
    Path('/proc/self/clear_refs').write_text('5', encoding='ascii')


def measured(call):
    """Return the processor time of a call [s], and the memory that it needs at most [MB]."""
    forget_peak()
    before, start = peak(), time.process_time()
    call()
    return time.process_time() - start, peak() - before


def decision(*arguments):
    """Return time and memory of the first decision of `maasi` for a field."""
    from planner_helpers import field_team

    planner, team = make_planner('maasi'), field_team(*arguments)
    return measured(lambda: planner.decide(team))


def filter_steps(robots, targets, detections=3):
    """Return the median time and the largest memory of steps of `pmb` from the tenth on."""
    rng = np.random.default_rng(1)
    bounds = np.array([[0.0, 1000.0]] * 2)
    sensor = SensorSettings(noise=NoiseSettings(range=1.0, bearing=0.03)).build('bench', 2)
    places = rng.uniform(20.0, 980.0, (max(targets, 1), 2))
    search = PmbFilter(FilterSettings(method='pmb'), bounds, np.random.default_rng(2))
    rows = []
    for step in range(25):
        members = []
        for robot in range(robots):
            first = detections * (step * robots + robot)
            seen = places[(first + np.arange(min(detections, targets))) % len(places)]
            pose = Pose([*(seen.mean(axis=0) if targets else places[0]), 10.0])
            values = sensor.measurement.measure(seen, pose)
            values += rng.multivariate_normal(np.zeros(2), sensor.covariance, len(values))
            values[:, 0] = np.abs(values[:, 0])
            members.append(AgentMeasurement(f'robot{robot:03d}', pose, sensor, values))
        rows.append(measured(lambda: search.step(members, 1, float(step))))  # noqa: B023
    times, memory = np.array(rows[10:]).T
    return float(np.median(times)), float(memory.max())


def large_scan(number):
    """Return time and memory of the second scan of so many detections of different targets."""
    sensor = SensorSettings(noise=NoiseSettings(range=1.0, bearing=0.03)).build('bench', 2)
    rng = np.random.default_rng(3)
    search = PmbFilter(
        FilterSettings(method='pmb'), np.array([[0.0, 200.0]] * 2), np.random.default_rng(4)
    )
    targets, pose = rng.uniform(0.0, 200.0, (number, 2)), Pose([100.0, 100.0, 10.0])
    for step in range(2):
        values = sensor.measurement.measure(targets, pose)
        values += rng.multivariate_normal(np.zeros(2), sensor.covariance, number)
        member = AgentMeasurement('robot', pose, sensor, np.abs(values))
        out = measured(lambda: search.step([member], 1, float(step)))  # noqa: B023
    return out


def run(share=1.0):
    warm_up_filter()
    warm_up()
    small = share < 1.0
    decision(2, 200.0, 4), decision(7, 200.0, 4)
    for corner in (None, 15.0):
        last = 0.0
        for robots in (1, 3, 10) if small else (1, 3, 10, 30, 100):
            if last > TOO_LONG:
                break
            last, memory = decision(robots, 200.0, 14, corner)
            name = f'decision_{robots}_robots' + '_in_a_corner' * (corner is not None)
            yield entry(name, 1e3 * last)
            yield entry(f'{name}_memory', memory, 'MB')
    if not small:
        taken, memory = decision(30, 200.0, 20, 15.0)
        yield entry('decision_30_robots_400_candidates', 1e3 * taken)
        yield entry('decision_30_robots_400_candidates_memory', memory, 'MB')
    for side in (100.0, 1000.0) if small else (100.0, 1000.0, 10_000.0):
        taken, memory = decision(3, side, 6)
        yield entry(f'decision_3_robots_{side:.0f}_m', 1e3 * taken)
        yield entry(f'decision_3_robots_{side:.0f}_m_memory', memory, 'MB')
    cases = [(robots, 12) for robots in ((1, 10) if small else (1, 3, 10, 30, 100))]
    cases += [(1, targets) for targets in ((0, 50) if small else (0, 50, 500))]
    for robots, targets in cases:
        taken, memory = filter_steps(robots, targets)
        yield entry(f'pmb_{robots}_robots_{targets}_targets', 1e3 * taken)
        yield entry(f'pmb_{robots}_robots_{targets}_targets_memory', memory, 'MB')
    for number in (300,) if small else (300, 1000):
        taken, memory = large_scan(number)
        yield entry(f'pmb_scan_of_{number}', 1e3 * taken)
        yield entry(f'pmb_scan_of_{number}_memory', memory, 'MB')
