"""Compare the two filters in complete searches, and print a table.

Runs one search for each seed, condition and filter. Seeds and conditions are in
`test/benchmarks/quality_conditions.py`. Documents show the seeds of `report`, on which nothing is
tuned.
"""

import argparse
import contextlib
import json
import math
import os
import sys
from functools import partial
from pathlib import Path

import numpy as np
import reference_quality
import reflection_quality
from quality_conditions import (
    CONDITIONS,
    DEGREES,
    RETURNS,
    SCENARIOS,
    changed,
    wanted,
    with_returns,
)
from scipy.stats import binomtest, chi2

from maasi_filter import warm_up
from maasi_filter.geometry.vector_math import squared_distance
from maasi_sim.experiments.campaign import make_workers, run_command
from maasi_sim.experiments.statistics import mean_interval, paired_difference
from maasi_sim.experiments.tables import markdown_table
from maasi_sim.search import search

METHODS = ('ic_phd', 'pmb')
OTHERS = {'reference': reference_quality, 'reflections': reflection_quality}
KEYS = ('condition', 'method', 'seed')
# Measurements after which a search ends: in the cube; other scenarios have many images.
CAP, CAP_OF_IMAGES = 400, 6000
# A found target in the cube is true within this distance of a true one, one to one [m].
RADIUS = 5.0
HEAD = (
    *('condition', 'method', 'complete', 'false found per run', 'RMSE [m]', 'NEES'),
    *('measurements', 'difference to ic_phd', 'filter step [ms]'),
)


def prepared(condition, method, seed, settings=None):
    """Return the scenario of one run, with no limit but the number of measurements."""
    common = {'filter': {'method': method}, 'limits': {'time': 1e4}}
    cube = [{'scoring': {'radius': RADIUS}}, DEGREES] if condition not in SCENARIOS else []
    changes = [common, *cube, *CONDITIONS[condition], {'filter': settings or {}}]
    return changed(SCENARIOS.get(condition, 'ranging_drone_3d'), changes, seed)


def run_one(key, settings=None):
    """Run a search of a condition, method and seed; return counts, sums of errors and times."""
    condition, method, seed = key
    scenario = prepared(condition, method, seed, settings)
    with with_returns(RETURNS.get(condition, lambda sensor, pose, step, *seen: seen)):
        result = search(scenario, seed, CAP_OF_IMAGES if condition in SCENARIOS else CAP)
    match = result.scores.match
    normalised = sum(
        squared_distance(target.position - result.truth[j], target.covariance)
        for target, j in ((result.found_targets[i], j) for i, j in match.pairs)
    )
    return dict(zip(KEYS, key)) | {
        'found': match.true_found,
        'targets': len(result.truth),
        'false_found': match.false_found,
        'squares': match.true_found * match.rmse**2 if match.true_found else 0.0,
        'normalised': normalised,
        'measurements': result.total_measurements,
        'step': float(np.mean(result.filter_times)),
    }


def row(runs, others):
    """Return the cells of a row, with 95 % intervals; `others` are those of the reference."""
    number = len(runs)
    values = {name: np.array([run[name] for run in runs]) for name in runs[0]}
    complete = int((values['found'] == values['targets']).sum())
    low, high = binomtest(complete, number).proportion_ci()
    false, found = values['false_found'].sum(), max(values['found'].sum(), 1)
    least = chi2.ppf(0.025, 2 * false) / 2 / number if false else 0.0
    most = chi2.ppf(0.975, 2 * false + 2) / 2 / number
    mean, difference = mean_interval(values['measurements']), '-'
    if others is not None:
        gap = paired_difference(values['measurements'], [run['measurements'] for run in others])
        difference = f'{gap.mean:+.0f} +- {gap.half_width:.0f}'
    return [
        f'{complete}/{number} ({low:.2f} to {high:.2f})',
        f'{false / number:.2f} ({least:.2f} to {most:.2f})',
        f'{math.sqrt(values["squares"].sum() / found):.2f}',
        f'{values["normalised"].sum() / found:.2f}',
        f'{mean.mean:.0f} +- {mean.half_width:.0f}',
        difference,
        f'{1e3 * float(np.median(values["step"])):.1f}',
    ]


def rows(options, conditions, seeds):
    """Make the runs that are missing; yield the rows of the table."""
    with contextlib.ExitStack() as stack:
        file = stack.enter_context((options.json or Path(os.devnull)).open('a+', encoding='utf-8'))
        file.seek(0)
        kept = {tuple(run[name] for name in KEYS): run for run in map(json.loads, file)}
        workers = stack.enter_context(contextlib.closing(make_workers(len(seeds), options.jobs)))
        for condition in conditions:
            reference = None
            for method in options.filter:
                keys = [(condition, method, seed) for seed in seeds]
                missing = [key for key in keys if key not in kept]
                for key, run in workers.make(partial(run_one, settings=options.settings), missing):
                    kept[key] = run
                    print(json.dumps(run), file=file, flush=True)
                runs = [kept[key] for key in keys]
                yield condition, method, *row(runs, reference)
                reference = runs if method == 'ic_phd' else None


def main():
    parser = argparse.ArgumentParser(
        prog='quality',
        description=__doc__,
        epilog='`quality reference [NAME ...]` compares both filters with an exact one on small '
        'scenes; `quality reflections [NAME ...]` counts missed targets, and reflections that were '
        'taken for targets.',
    )
    parser.add_argument(
        '--filter',
        nargs='*',
        choices=METHODS,
        default=METHODS,
        help='filters to compare (default: both)',
    )
    parser.add_argument(
        '--json',
        type=Path,
        metavar='FILE',
        help='add each run to FILE as a line, and skip the runs that FILE has',
    )
    parser.add_argument(
        '--settings', type=json.loads, metavar='JSON', help='use these settings of the filter'
    )
    parser.add_argument(
        '--stone-soup', action='store_true', help="compare pmb with Stone Soup's JPDA tracker"
    )
    other = OTHERS.get(sys.argv[1]) if len(sys.argv) > 1 else None
    if other is not None:
        del sys.argv[1]
    known = CONDITIONS if other is None else other.CONDITIONS
    options, conditions, seeds = wanted(parser, known, runs=20, jobs=1)
    warm_up()
    head, table = HEAD, rows(options, conditions, seeds)
    if other is not None:
        head, table = other.HEAD, other.rows(conditions, seeds, options.jobs)
    elif options.stone_soup:
        # Stone Soup takes seconds to import.
        import stone_soup_quality

        head, table = stone_soup_quality.HEAD, stone_soup_quality.rows(conditions, seeds, prepared)
    print(markdown_table([head]), end='', flush=True)
    for cells in table:
        print(f'| {" | ".join(cells)} |', flush=True)
    return 0


if __name__ == '__main__':
    raise SystemExit(run_command(main))
