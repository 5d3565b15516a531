"""Speed of the filter, against Stone Soup's SMC-PHD on the same particles and measurements.

Medians of repeated runs in one process. The state before each step is the same; restoring it is
not timed.
"""

from __future__ import annotations

import datetime
import statistics
import time
from functools import partial
from typing import Any

import numpy as np
from timing import entry, median_time

from maasi_filter import (
    AgentMeasurement,
    FilterSettings,
    IcPhdFilter,
    NoiseSettings,
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


# The papers' noise in its two readings.
RADIANS = NoiseSettings(range=1.5, bearing=0.175, elevation=0.295)
DEGREES = NoiseSettings(range=1.5, bearing=0.175, elevation=0.295, as_='variance', angles='degrees')


def sensor(noise: NoiseSettings = RADIANS) -> Any:
    """Return the papers' 3D sensor; the wide clouds of angles in radians cost most."""
    return SensorSettings(noise=noise).build('bench', 3)


def cloud(number: int, seed: int = 0) -> tuple[FloatArray, FloatArray]:
    """Return particles around 12 targets, and the targets."""
    generator = np.random.default_rng(seed)
    targets = 40.0 + 180.0 * generator.random((TARGETS, 3))
    group = np.sort(np.arange(number) % TARGETS)
    spread = generator.uniform(1.0, 6.0, (TARGETS, 3))
    particles = targets[group] + spread[group] * generator.standard_normal((number, 3))
    return np.clip(particles, 0.0, 260.0), targets


def phd_state(number: int, threads: int | None) -> tuple[IcPhdFilter, FloatArray]:
    """Return a PHD filter in the middle of a search, with `number` particles, and the targets."""
    settings = FilterSettings(particles=number, particles_minimum=number, threads=threads)
    search = IcPhdFilter(settings, BOUNDS, np.random.default_rng(1))
    search.particles, targets = cloud(number)
    search.weights = np.full(number, TARGETS / number)
    return search, targets


def batch(targets: FloatArray, robots: int, seed: int = 2) -> list[AgentMeasurement]:
    """Return what `robots` robots measure at one step, three detections each."""
    generator = np.random.default_rng(seed)
    device = sensor()
    members = []
    for robot in range(robots):
        seen = targets[(DETECTED * robot + np.arange(DETECTED)) % TARGETS]
        pose = Pose(seen.mean(axis=0) + generator.normal(0.0, 20.0, 3))
        values = device.measurement.measure(seen, pose)
        values += generator.standard_normal(values.shape) * [1.5, 0.05, 0.05]
        members.append(AgentMeasurement(f'robot_{robot:02d}', pose, device, values))
    return members


def phd_step_time(number: int, robots: int, repeats: int, threads: int | None) -> float:
    """Return the median time of one whole step of the PHD filter, seconds."""
    search, targets = phd_state(number, threads)
    members = batch(targets, robots)
    particles, weights = search.particles, search.weights
    values = search.exploration.values.copy()

    def prepare() -> None:
        search.particles, search.weights = particles, weights
        search.exploration.values[...] = values
        search.found_targets.clear()

    step = partial(search.step, members, 1, 0.0)
    prepare()
    step()
    return median_time(step, repeats, prepare)


def pmb_step_time(noise: NoiseSettings, number: int, robots: int, steps: int = 60) -> float:
    """Return the median time of the steps of a search of `number` targets, seconds.

    Each robot detects three targets at each step; the first ten steps are not counted.
    """
    generator = np.random.default_rng(3)
    targets = 20.0 + 220.0 * generator.random((number, 3))
    device = sensor(noise)
    search = PmbFilter(FilterSettings(method='pmb'), BOUNDS, np.random.default_rng(1))
    times = []
    for step in range(steps):
        members = []
        for robot in range(robots):
            seen = targets[(DETECTED * (step * robots + robot) + np.arange(DETECTED)) % number]
            pose = Pose(seen.mean(axis=0) + generator.normal(0.0, 20.0, 3))
            values = device.measurement.measure(seen, pose)
            values += generator.multivariate_normal(np.zeros(3), device.covariance, len(values))
            members.append(AgentMeasurement(f'robot_{robot:02d}', pose, device, values))
        start = time.perf_counter()
        search.step(members, 1, float(step))
        times.append(time.perf_counter() - start)
    return statistics.median(times[10:])


def _stone_soup(particles: FloatArray, values: FloatArray, pose: Pose) -> Any:
    """Return a call of Stone Soup's update of the same particles by the same measurements."""
    from stonesoup.models.measurement.nonlinear import CartesianToElevationBearingRange
    from stonesoup.types.angle import Bearing, Elevation
    from stonesoup.types.array import CovarianceMatrix, StateVector, StateVectors
    from stonesoup.types.detection import Detection
    from stonesoup.types.hypothesis import SingleHypothesis
    from stonesoup.types.multihypothesis import MultipleHypothesis
    from stonesoup.types.numeric import Probability
    from stonesoup.types.prediction import ParticleStatePrediction
    from stonesoup.updater.particle import SMCPHDUpdater

    now = datetime.datetime(2024, 1, 1)
    prediction = ParticleStatePrediction(
        state_vector=StateVectors(particles.T),
        weight=np.full(len(particles), TARGETS / len(particles)),
        timestamp=now,
    )
    model = CartesianToElevationBearingRange(
        3,
        np.array([0, 1, 2]),
        CovarianceMatrix(np.diag(np.array([0.295, 0.175, 1.5]) ** 2)),
        translation_offset=StateVector(pose.position),
    )
    vectors = [StateVector([Elevation(v[2]), Bearing(v[1]), v[0]]) for v in values]
    hypotheses = MultipleHypothesis(
        [
            SingleHypothesis(prediction, Detection(vector, timestamp=now, measurement_model=model))
            for vector in vectors
        ]
    )
    updater = SMCPHDUpdater(
        measurement_model=model,
        prob_detect=Probability(0.9),
        clutter_intensity=CLUTTER,
        num_samples=len(particles),
        resampler=None,
    )
    return lambda: updater.update(hypotheses)


def update_times(number: int = 10_000, repeats: int = 3) -> tuple[float, float]:
    """Return our median time of the weights' update and Stone Soup's, seconds."""
    particles, targets = cloud(number)
    member = batch(targets, 1)[0]
    update = _stone_soup(particles, member.values, member.pose)
    update()
    theirs = median_time(update, repeats)
    weights = np.full(number, TARGETS / number)
    background = np.full(len(member.values), CLUTTER)

    def ours() -> FloatArray:
        scan = make_scan(member.values, member.sensor, member.pose)
        return weights * phd_correct(particles, weights, scan, background)[0]

    ours()
    return median_time(ours, 200), theirs


def run(share: float = 1.0) -> list[dict[str, Any]]:
    """Return all figures as entries {name, value, unit, baseline, ratio}; `share` of all calls."""

    def few(number: int) -> int:
        return max(1, round(share * number))

    start = time.perf_counter()
    warm_up()
    times = {
        'filter_warm_up': time.perf_counter() - start,
        'ic_phd_step_10k': phd_step_time(10_000, 1, few(200), 1),
        'ic_phd_step_100k': phd_step_time(100_000, 1, few(30), None),
        'ic_phd_step_1m': phd_step_time(1_000_000, 1, few(9), None),
        'ic_phd_step_ten_robots': phd_step_time(10_000, 10, few(100), 1),
    }
    entries = [entry(name, 1e3 * seconds) for name, seconds in times.items()]
    ours, theirs = update_times(repeats=few(3))
    text = f'Stone Soup SMCPHDUpdater, {1e3 * theirs:.3g} ms'
    entries.append(entry('ic_phd_update', 1e3 * ours, 'ms', text, theirs / ours))
    times = {
        'pmb_step_degrees': pmb_step_time(DEGREES, TARGETS, 1, max(12, few(60))),
        'pmb_step_radians': pmb_step_time(RADIANS, TARGETS, 1, max(12, few(60))),
        'pmb_step_100_targets': pmb_step_time(DEGREES, 100, 1, few(200)),
        'pmb_step_ten_robots': pmb_step_time(DEGREES, TARGETS, 10, max(12, few(60))),
    }
    return entries + [entry(name, 1e3 * seconds) for name, seconds in times.items()]
