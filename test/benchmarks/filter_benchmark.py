"""Speed of the filters next to Stone Soup: medians of steps, those of `ic_phd` from one state."""

import time
from functools import partial

import numpy as np
from quality_conditions import NOISES
from timing import against, entry, few, median_time, times_of

from maasi_filter import (
    AgentMeasurement,
    FilterSettings,
    IcPhdFilter,
    PmbFilter,
    Pose,
    SensorSettings,
    warm_up,
)
from maasi_filter.ic_phd.corrector import phd_correct, phd_scan

BOUNDS = np.array([[0.0, 260.0]] * 3)
TARGETS, DETECTED, CLUTTER = 12, 3, 1e-6
# The papers' 3D sensor; the wide clouds of angles in radians cost most.
RADIANS, DEGREES = (
    SensorSettings(noise=NOISES[name]).build('bench', 3) for name in ('radians', 'degrees')
)


def batch(generator, device, targets, robots, covariance, first=0):
    """Return what `robots` robots measure at one step, three detections each."""
    members = []
    for robot in range(robots):
        seen = targets[(DETECTED * (first + robot) + np.arange(DETECTED)) % len(targets)]
        pose = Pose(seen.mean(axis=0) + generator.normal(0.0, 20.0, 3))
        values = device.measurement.measure(seen, pose)
        values += generator.multivariate_normal(np.zeros(3), covariance, DETECTED)
        members.append(AgentMeasurement(f'robot_{robot:02d}', pose, device, values))
    return members


def middle_of_search(number, robots):
    """Return particles around 12 targets, their weights, and precise measurements of robots."""
    generator = np.random.default_rng(0)
    targets = 40.0 + 180.0 * generator.random((TARGETS, 3))
    group = np.sort(np.arange(number) % TARGETS)
    spread = generator.uniform(1.0, 6.0, (TARGETS, 3))
    particles = targets[group] + spread[group] * generator.standard_normal((number, 3))
    covariance = np.diag(np.square([1.5, 0.05, 0.05]))
    members = batch(np.random.default_rng(2), RADIANS, targets, robots, covariance)
    return np.clip(particles, 0.0, 260.0), np.full(number, TARGETS / number), members


def phd_step_time(number, robots, repeats, threads):
    """Return the time of a step in the middle of a search with `number` particles [s]."""
    settings = FilterSettings(particles=number, particles_minimum=number, threads=threads)
    search = IcPhdFilter(settings, BOUNDS, np.random.default_rng(1))
    particles, weights, members = middle_of_search(number, robots)
    values = search.exploration.values.copy()

    def prepare():
        search.particles, search.weights = particles, weights
        search.exploration.values[...] = values
        search.found_targets.clear()

    return median_time(lambda: search.step(members, 1, 0.0), repeats, prepare)


def phd_update_time():
    """Return the time of the update of 10,000 weights [s]."""
    particles, weights, (member,) = middle_of_search(10_000, 1)

    def update():
        scan = phd_scan(member.values, member.sensor, member.pose)
        return weights * phd_correct(particles, weights, scan, np.full(DETECTED, CLUTTER))[0]

    return median_time(update, 200)


def smc_phd_update_time(repeats):
    """Return the time of Stone Soup's update of the same particles by the same detections [s]."""
    from stone_soup_quality import START, detections_of
    from stonesoup.types.array import StateVectors
    from stonesoup.types.hypothesis import SingleHypothesis
    from stonesoup.types.multihypothesis import MultipleHypothesis
    from stonesoup.types.numeric import Probability
    from stonesoup.types.prediction import ParticleStatePrediction
    from stonesoup.updater.particle import SMCPHDUpdater

    particles, weights, (member,) = middle_of_search(10_000, 1)
    state = ParticleStatePrediction(StateVectors(particles.T), weight=weights, timestamp=START)
    seen = detections_of(member, START)
    hypotheses = MultipleHypothesis([SingleHypothesis(state, detection) for detection in seen])
    updater = SMCPHDUpdater(
        seen[0].measurement_model,
        # Constant, as it only takes one; ours is pi at each particle.
        prob_detect=Probability(0.9),
        clutter_intensity=CLUTTER,
        num_samples=len(particles),
        resampler=None,
    )
    return median_time(lambda: updater.update(hypotheses), repeats)


def step_time(search, device, number, robots, steps):
    """Return the time of a search's steps [s]; the first ten are not counted."""
    generator = np.random.default_rng(3)
    targets = 20.0 + 220.0 * generator.random((number, 3))
    times = []
    for step in range(steps):
        members = batch(generator, device, targets, robots, device.covariance, step * robots)
        times += times_of(lambda: search(members, float(step)), 1)  # noqa: B023
    return float(np.median(times[10:]))


def pmb_step_time(*case):
    search = PmbFilter(FilterSettings(method='pmb'), BOUNDS, np.random.default_rng(1))
    return step_time(lambda members, now: search.step(members, 1, now), *case)


def jpda_step_time(*case):
    """Return the time of steps of Stone Soup's JPDA tracker with the same detections [s]."""
    from stone_soup_quality import StoneSoup

    trackers = []

    def step(members, now):
        if not trackers:
            trackers.append(StoneSoup(members[0], BOUNDS, 0.0))
        for member in members:
            trackers[0].step(member, now)

    return step_time(step, *case)


def run(share=1.0):
    start = time.perf_counter()
    warm_up()
    yield entry('filter_warm_up', 1e3 * (time.perf_counter() - start))
    steps = max(12, few(share, 60))
    for name, function, *arguments in (
        ('ic_phd_step_10k', phd_step_time, 10_000, 1, few(share, 200), 1),
        ('ic_phd_step_100k', phd_step_time, 100_000, 1, few(share, 30), None),
        ('ic_phd_step_1m', phd_step_time, 1_000_000, 1, few(share, 9), None),
        ('ic_phd_step_ten_robots', phd_step_time, 10_000, 10, few(share, 100), 1),
        ('pmb_step_ten_robots', pmb_step_time, DEGREES, TARGETS, 10, steps),
    ):
        yield entry(name, 1e3 * function(*arguments))
    yield against(
        'ic_phd_update',
        1e3 * phd_update_time(),
        'Stone Soup, SMCPHDUpdater',
        lambda: 1e3 * smc_phd_update_time(few(share, 3)),
    )
    for name, *case in (
        ('pmb_step_degrees', DEGREES, TARGETS, 1, steps),
        ('pmb_step_radians', RADIANS, TARGETS, 1, steps),
        ('pmb_step_100_targets', DEGREES, 100, 1, max(12, few(share, 200))),
    ):
        ours, theirs = 1e3 * pmb_step_time(*case), partial(jpda_step_time, *case)
        yield against(name, ours, 'Stone Soup, JPDA', lambda: 1e3 * theirs())  # noqa: B023
