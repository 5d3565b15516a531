"""Quality of the filters next to an exact one on small scenes: `./scripts/quality reference`.

All filters get the same scans of a lawnmower over a square of 100 m, with targets drawn from their
prior. The sensors tell detection, noise and clutter as they are.
"""

import contextlib
import math
import sys
import time
from itertools import pairwise

import numpy as np
from exact_reference import Reference
from quality_conditions import NOISES
from scipy.optimize import linear_sum_assignment

from maasi_filter import AgentMeasurement, FilterSettings, Pose, make_filter
from maasi_filter.geometry.area import Area
from maasi_filter.geometry.environment import EnvironmentSettings
from maasi_filter.metrics import gospa, match_targets
from maasi_filter.models.detection import ExponentialDetection
from maasi_filter.models.sensor import Sensor
from maasi_sim.experiments.campaign import make_workers
from maasi_sim.experiments.statistics import mean_interval, paired_difference
from maasi_sim.simulation.sensors import RangingSensor

SIDE, TARGETS, CUTOFF, RADIUS = 100.0, 3, 10.0, 5.0
BOUNDS = np.array([[0.0, SIDE]] * 2)
# A lawnmower with lanes 25 m apart, and a scan each 10 m.
POSES = [Pose(np.array([x, y, 0.0])) for y in np.arange(12.5, 100, 25) for x in range(5, 100, 10)]
# False detections per scan, pi of that of 000, noise, and whether targets are pairs.
CONDITIONS = {
    'no clutter': (0.0, 1.0, 'degrees', False),
    '1 false per scan': (1.0, 1.0, 'degrees', False),
    '3 false per scan': (3.0, 1.0, 'degrees', False),
    'half of pi': (0.0, 0.5, 'degrees', False),
    'pairs 5 m apart': (0.0, 1.0, 'degrees', True),
    'radians': (0.0, 1.0, 'radians', False),
}
METHODS = ('reference', 'pmb', 'ic_phd')
EDGES = np.array([0.1, 0.3, 0.5, 0.7, 0.9, 0.99, 1.0 + 1e-9])
HEAD = (
    *('condition', 'method', 'GOSPA [m]', 'difference [%]', 'GOSPA at the end [m]'),
    *('scans until found', 'found', 'false'),
    *(f'r {low:g} to {high:g} [points]' for low, high in pairwise(EDGES)),
    'step [ms]',
)
LEAST_DEVIATION = 0.1  # of an estimate that may be of a target [m]
# Weight of hypotheses without which the reference still counts as exact.
LARGEST_LOSS = 1e-3


def scene(condition, seed):
    """Return the sensor, the false detections per unit, true targets and what each scan saw."""
    per_scan, factor, noise, paired = CONDITIONS[condition]
    generator = np.random.default_rng([seed, 79])
    truth = generator.uniform(0.0, SIDE, (generator.poisson(TARGETS), 2))
    if paired:
        centres, angles = generator.uniform(5.0, SIDE - 5.0, (2, 2)), generator.uniform(0, 6.3, 2)
        half = 2.5 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        truth = np.concatenate([centres - half, centres + half])
    model = ExponentialDetection(0.98 * factor, [30.0, 30.0])
    # Detections of two targets stay two, however close.
    sensor = Sensor('robot', model, NOISES[noise].covariance(2), resolution=0.0)
    sensor.clutter = per_scan / sensor.measurement_space(BOUNDS)
    device = RangingSensor(sensor, truth, seed, 'robot', BOUNDS)
    return sensor, truth, [device.measure(pose, step) for step, pose in enumerate(POSES)]


def estimates(search, method):
    """Return r, mean, covariance and whether it is found of each target of a filter."""
    if method == 'reference':
        least = 2.0 * math.sqrt(search.sensor.covariance[0, 0])
        return [
            (r, mean, spread, r > 0.99 and hits > 1 and math.sqrt(np.trace(spread)) <= least)
            for r, mean, spread, hits in search.targets()
        ]
    if method == 'pmb':
        items = [(item.existence, item.density, item.target) for item in search.components]
        return [(r, d.mean, d.covariance, target is not None) for r, d, target in items]
    found = [(1.0, item.position, item.covariance, True) for item in search.found_targets]
    others = search.clusters
    return found + [(min(c.mass, 1.0), c.position, c.covariance, False) for c in others]


def true_of(items, truth):
    """Return which estimates are targets: the likeliest one-to-one, within four deviations."""
    cost = np.zeros((len(items), len(truth)))
    for row, (r, mean, spread, _) in zip(cost, items):
        errors, spread = truth - mean, spread + np.eye(2) * LEAST_DEVIATION**2
        squares = (errors * np.linalg.solve(spread, errors.T).T).sum(axis=1)
        log = math.log(np.linalg.det(spread)) - 2.0 * math.log(r)
        row[squares < 16.0] = squares[squares < 16.0] + log - 100.0
    rows, columns = linear_sum_assignment(cost)
    return np.isin(np.arange(len(items)), rows[cost[rows, columns] < 0.0])


def run_one(key):
    """Run a filter in a scene; return its scores, and sums of r, truths and counts by bin."""
    condition, method, seed = key
    sensor, truth, scans = scene(condition, seed)
    if method == 'reference':
        search = Reference(sensor, SIDE, TARGETS, sensor.clutter)
    else:
        area = Area(EnvironmentSettings(bounds=BOUNDS.tolist(), expected_targets=TARGETS))
        search = make_filter(FilterSettings(method=method), area, np.random.default_rng(seed))
    scores, times, bins = [], [], np.zeros((3, len(EDGES) - 1))
    first, found = np.full((2, len(truth)), len(scans))
    for step, (pose, (values, causes)) in enumerate(zip(POSES, scans)):
        begin = time.perf_counter()
        if method == 'reference':
            search.update(pose, values)
        else:
            search.step([AgentMeasurement('robot', pose, sensor, values, None, step)], 1, step)
        times.append(time.perf_counter() - begin)
        first[causes[causes >= 0]] = np.minimum(first[causes[causes >= 0]], step)
        items = estimates(search, method)
        best = np.array([mean for r, mean, _, _ in items if r > 0.5]).reshape(-1, 2)
        scores.append(gospa(best, truth, CUTOFF).total)
        items = [item for item in items if item[0] >= EDGES[0]]
        existence = np.array([r for r, _, _, _ in items])
        right = true_of(items, truth[first <= step])
        for b, (low, high) in enumerate(pairwise(EDGES)):
            inside = (existence >= low) & (existence < high)
            bins[:, b] += existence[inside].sum(), right[inside].sum(), inside.sum()
        kept = np.array([mean for _, mean, _, sure in items if sure]).reshape(-1, 2)
        match = match_targets(kept, truth, RADIUS)
        for _, target in match.pairs:
            found[target] = min(found[target], step)
    seen = first < len(scans)
    return {
        'gospa': float(np.mean(scores)),
        'end': scores[-1],
        'until': float((found - first)[seen].mean()) if seen.any() else math.nan,
        'found': match.true_found,
        'targets': len(truth),
        'false': match.false_found,
        'bins': bins.tolist(),
        'step': float(np.median(times)),
        'lost': getattr(search, 'lost', 0.0),
    }


def difference(ours, theirs):
    """Return the mean of paired relative differences in percent, with its interval, as text."""
    gap = paired_difference(ours, theirs)
    return f'{100 * gap.mean / theirs.mean():+.1f} ± {100 * gap.half_width / theirs.mean():.1f}'


def calibration(bins):
    """Return by how many points more (less) than r are true, by bin of r, with intervals."""
    cells, generator = [], np.random.default_rng(0)
    draws = generator.integers(len(bins), size=(1000, len(bins)))
    for expected, true, number in bins.transpose(2, 1, 0):
        sums = np.maximum(number[draws].sum(axis=1), 1.0)
        low, high = np.percentile(100 * (true - expected)[draws].sum(axis=1) / sums, [2.5, 97.5])
        gap = 100 * (true - expected).sum() / max(number.sum(), 1.0)
        cells.append(f'{gap:+.1f} ({low:+.1f} to {high:+.1f})' if number.sum() >= 30 else '-')
    return cells


def row(runs, reference):
    """Return the cells of a method; `reference` are the GOSPA of the exact filter."""
    values = {name: np.array([run[name] for run in runs]) for name in runs[0]}
    mean, end, until = (
        f'{span.mean:.2f} ± {span.half_width:.2f}'
        for span in (mean_interval(values[name]) for name in ('gospa', 'end', 'until'))
    )
    return [
        mean,
        '-' if reference is None else difference(values['gospa'], reference),
        end,
        until,
        f'{values["found"].sum()} of {values["targets"].sum()}',
        f'{values["false"].sum()}',
        *calibration(values['bins']),
        f'{1e3 * np.median(values["step"]):.1f}',
    ]


def rows(conditions, seeds, jobs):
    """Yield the rows of the table."""
    for condition in conditions:
        keys = [(condition, method, seed) for method in METHODS for seed in seeds]
        with contextlib.closing(make_workers(len(keys), jobs)) as workers:
            runs = dict(workers.make(run_one, keys))
        reference = None
        for method in METHODS:
            found = [runs[condition, method, seed] for seed in seeds]
            yield condition, method, *row(found, reference)
            if method == 'reference':
                reference = np.array([run['gospa'] for run in found])
                lost = max(run['lost'] for run in found)
                if lost > LARGEST_LOSS:
                    print(
                        f'{condition}: up to {lost:.2g} of the weight was left out', file=sys.stderr
                    )
