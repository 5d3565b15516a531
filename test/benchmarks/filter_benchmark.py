"""Speed of the filter.

Medians of repeated runs in one process. The state before each step is the same; restoring it is
not timed.
"""

from __future__ import annotations

import statistics
import time
from functools import partial
from typing import Any

import numpy as np
from quality_conditions import NOISES
from timing import entry, median_time

from maasi_filter import (
    AgentMeasurement,
    FilterSettings,
    IcPhdFilter,
    PmbFilter,
    Pose,
    SensorSettings,
    warm_up,
)
from maasi_filter.arrays import FloatArray
from maasi_filter.ic_phd.corrector import make_scan, phd_correct

BOUNDS = np.array([[0.0, 260.0]] * 3)
TARGETS = 12
DETECTED = 3
CLUTTER = 1e-6


def sensor(noise: str = 'radians') -> Any:
    """Return the papers' 3D sensor; the wide clouds of angles in radians cost most."""
    return SensorSettings(noise=NOISES[noise]).build('bench', 3)


def cloud(number: int) -> tuple[FloatArray, FloatArray]:
    """Return particles around 12 targets, and the targets."""
    generator = np.random.default_rng(0)
    targets = 40.0 + 180.0 * generator.random((TARGETS, 3))
    group = np.sort(np.arange(number) % TARGETS)
    spread = generator.uniform(1.0, 6.0, (TARGETS, 3))
    particles = targets[group] + spread[group] * generator.standard_normal((number, 3))
    return np.clip(particles, 0.0, 260.0), targets


def batch(
    generator: np.random.Generator,
    device: Any,
    targets: FloatArray,
    robots: int,
    covariance: FloatArray,
    first: int = 0,
) -> list[AgentMeasurement]:
    """Return what `robots` robots measure at one step, three detections each."""
    members = []
    for robot in range(robots):
        seen = targets[(DETECTED * (first + robot) + np.arange(DETECTED)) % len(targets)]
        pose = Pose(seen.mean(axis=0) + generator.normal(0.0, 20.0, 3))
        values = device.measurement.measure(seen, pose)
        values += generator.multivariate_normal(np.zeros(3), covariance, DETECTED)
        members.append(AgentMeasurement(f'robot_{robot:02d}', pose, device, values))
    return members


def precise_batch(targets: FloatArray, robots: int) -> list[AgentMeasurement]:
    covariance = np.diag(np.square([1.5, 0.05, 0.05]))
    return batch(np.random.default_rng(2), sensor(), targets, robots, covariance)


def phd_step_time(number: int, robots: int, repeats: int, threads: int | None) -> float:
    """Return the median time of a step in the middle of a search with `number` particles [s]."""
    settings = FilterSettings(particles=number, particles_minimum=number, threads=threads)
    search = IcPhdFilter(settings, BOUNDS, np.random.default_rng(1))
    particles, targets = cloud(number)
    weights = np.full(number, TARGETS / number)
    values = search.exploration.values.copy()

    def prepare() -> None:
        search.particles, search.weights = particles, weights
        search.exploration.values[...] = values
        search.found_targets.clear()

    step = partial(search.step, precise_batch(targets, robots), 1, 0.0)
    prepare()
    step()
    return median_time(step, repeats, prepare)


def pmb_step_time(noise: str, number: int, robots: int, steps: int) -> float:
    """Return the median time of a search's steps [s]; the first ten are not counted."""
    generator = np.random.default_rng(3)
    targets = 20.0 + 220.0 * generator.random((number, 3))
    device = sensor(noise)
    search = PmbFilter(FilterSettings(method='pmb'), BOUNDS, np.random.default_rng(1))
    times = []
    for step in range(steps):
        members = batch(generator, device, targets, robots, device.covariance, step * robots)
        start = time.perf_counter()
        search.step(members, 1, float(step))
        times.append(time.perf_counter() - start)
    return statistics.median(times[10:])


def phd_update_time() -> float:
    """Return the median time of the update of 10,000 weights [s]."""
    particles, targets = cloud(10_000)
    (member,) = precise_batch(targets, 1)
    weights = np.full(len(particles), TARGETS / len(particles))
    background = np.full(len(member.values), CLUTTER)

    def update() -> FloatArray:
        scan = make_scan(member.values, member.sensor, member.pose)
        return weights * phd_correct(particles, weights, scan, background)[0]

    update()
    return median_time(update, 200)


def run(share: float = 1.0) -> list[dict[str, Any]]:
    def few(number: int) -> int:
        return max(1, round(share * number))

    start = time.perf_counter()
    warm_up()
    steps = max(12, few(60))
    times = {
        'filter_warm_up': time.perf_counter() - start,
        'ic_phd_step_10k': phd_step_time(10_000, 1, few(200), 1),
        'ic_phd_step_100k': phd_step_time(100_000, 1, few(30), None),
        'ic_phd_step_1m': phd_step_time(1_000_000, 1, few(9), None),
        'ic_phd_step_ten_robots': phd_step_time(10_000, 10, few(100), 1),
        'ic_phd_update': phd_update_time(),
        'pmb_step_degrees': pmb_step_time('degrees', TARGETS, 1, steps),
        'pmb_step_radians': pmb_step_time('radians', TARGETS, 1, steps),
        'pmb_step_100_targets': pmb_step_time('degrees', 100, 1, few(200)),
        'pmb_step_ten_robots': pmb_step_time('degrees', TARGETS, 10, steps),
    }
    return [entry(name, 1e3 * seconds) for name, seconds in times.items()]
