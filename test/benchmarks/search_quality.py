"""Quality of whole searches with the filter: `python test/benchmarks/search_quality.py`.

Runs a scenario in this process, once for each seed and each reading of the papers' noise, and
prints a table: complete runs, false found targets, RMSE, and measurements to find all (restricted
mean, Kaplan-Meier, for runs that did not finish). Intervals are 95 % ones.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import beta, chi2, t

from maasi_filter import NoiseSettings, warm_up
from maasi_filter.metrics import match_targets, normalised_error, restricted_mean
from maasi_sim.scenario.loading import load_scenario
from maasi_sim.scenario.schema import Scenario
from maasi_sim.search import search

# R = diag[1.5, 0.175, 0.295] of 000 does not say what it holds: two readings.
NOISES = {
    'degrees': NoiseSettings(
        range=1.5, bearing=0.175, elevation=0.295, as_='variance', angles='degrees'
    ),
    'radians': NoiseSettings(range=1.5, bearing=0.175, elevation=0.295),
}
CAP = 400
# A planner that never ends a search.
PERSISTENT = {'explored_threshold': 1.0, 'gain_threshold': 0.0}
# A found target is true within this distance of a true one, one to one, metres.
RADIUS = 5.0


@dataclass(frozen=True)
class Run:
    """What one search came to.

    Attributes
    ----------
    seed : int
        Of all random numbers.
    found, targets, false_found : int
        True targets that were found, true targets, and found targets that are none.
    squares : float
        Sum of the squared errors of the found ones, square metres.
    normalised : float
        Sum of their squared errors, normalised with their covariances (NEES).
    measurements : int
        Taken in all.
    finished : bool
        Whether all were found before the cap.
    seconds : float
        Wall time.
    """

    seed: int
    found: int
    targets: int
    false_found: int
    squares: float
    normalised: float
    measurements: int
    finished: bool
    seconds: float


def prepared(
    scenario: Scenario, noise: NoiseSettings, planner: dict[str, Any], options: dict[str, Any]
) -> Scenario:
    """Return the scenario with other noise, and no limit but the number of measurements."""
    content = scenario.model_dump(by_alias=True, exclude_unset=True)
    for robot in content['robots'].values():
        robot['sensor']['noise'] = noise.model_dump(by_alias=True)
    content['planner'] = {**content['planner'], **planner}
    content['filter'] = {**content['filter'], **options}
    content['limits'] = {**content.get('limits', {}), 'time': 1e4}
    content['scoring'] = {**content.get('scoring', {}), 'radius': RADIUS}
    return Scenario.model_validate(content)


def run_one(scenario: Scenario, seed: int, cap: int = CAP) -> Run:
    """Run one search up to `cap` measurements."""
    start = time.perf_counter()
    result = search(scenario, seed, cap)
    found = np.array([target.position for target in result.found_targets]).reshape(-1, 3)
    found = found[:, : result.truth.shape[1]]
    match = match_targets(found, result.truth, RADIUS)
    normalised = sum(
        normalised_error(found[i] - result.truth[j], result.found_targets[i].covariance)
        for i, j in match.pairs
    )
    return Run(
        seed=seed,
        found=match.true_found,
        targets=len(result.truth),
        false_found=match.false_found,
        squares=match.true_found * match.rmse**2 if match.true_found else 0.0,
        normalised=normalised,
        measurements=result.total_measurements,
        finished=match.missed == 0,
        seconds=time.perf_counter() - start,
    )


def summary(runs: Sequence[Run], cap: int = CAP) -> dict[str, Any]:
    """Return the figures of a table's row, with 95 % intervals.

    Complete runs: Clopper and Pearson. False found targets: Poisson. RMSE: over all found
    targets, with a t interval on the mean square of a run. Measurements: restricted mean.
    """
    number = len(runs)
    complete = sum(run.finished for run in runs)
    false = sum(run.false_found for run in runs)
    found = np.array([run.found for run in runs], float)
    squares = np.array([run.squares for run in runs])
    mean_square = squares.sum() / found.sum()
    # Error of a ratio of sums over runs.
    deviation = math.sqrt(((squares - mean_square * found) ** 2).sum() / max(number - 1, 1))
    half = t.ppf(0.975, max(number - 1, 1)) * deviation / math.sqrt(number) / found.mean()
    times = restricted_mean(
        [run.measurements if run.finished else None for run in runs],
        cap,
        [float(run.measurements) for run in runs],
    )
    return {
        'runs': number,
        'complete': complete,
        'complete_interval': [
            float(beta.ppf(0.025, complete, number - complete + 1)) if complete else 0.0,
            float(beta.ppf(0.975, complete + 1, number - complete)) if complete < number else 1.0,
        ],
        'false_per_run': false / number,
        'false_interval': [
            float(chi2.ppf(0.025, 2 * false)) / 2 / number if false else 0.0,
            float(chi2.ppf(0.975, 2 * false + 2)) / 2 / number,
        ],
        'rmse': math.sqrt(mean_square),
        'rmse_interval': [
            math.sqrt(max(mean_square - half, 0.0)),
            math.sqrt(mean_square + half),
        ],
        'nees': sum(run.normalised for run in runs) / found.sum(),
        'measurements': times.mean,
        'measurements_half_width': 1.96 * times.standard_error,
        'seconds_per_run': float(np.mean([run.seconds for run in runs])),
    }


def show(name: str, row: dict[str, Any]) -> str:
    """Return a row of the table in Markdown."""
    low, high = row['complete_interval']
    text = f'| {name} | {row["complete"]} of {row["runs"]} ({low:.2f} to {high:.2f})'
    low, high = row['false_interval']
    text += f' | {row["false_per_run"]:.2f} ({low:.2f} to {high:.2f})'
    low, high = row['rmse_interval']
    text += f' | {row["rmse"]:.2f} m ({low:.2f} to {high:.2f})'
    text += f' | {row["nees"]:.2f}'
    text += f' | {row["measurements"]:.0f} +- {row["measurements_half_width"]:.0f}'
    return text + f' | {row["seconds_per_run"]:.1f} s |'


def report(options: argparse.Namespace, lines: Sequence[str]) -> str:
    """Return a page in Markdown: how the table was made, and the table."""
    last = options.first_seed + options.runs - 1
    words = ['python test/benchmarks/search_quality.py', f'--scenario {options.scenario}']
    words += [f'--runs {options.runs} --first-seed {options.first_seed} --cap {options.cap}']
    for name in ('planner', 'filter'):
        if getattr(options, name):
            words.append(f"--{name} '{json.dumps(getattr(options, name))}'")
    command = ' '.join(words)
    return f"""# Quality of searches with the filter

Whole searches of the scenario `{options.scenario}` in one process, for seeds
{options.first_seed} to {last}, each ended when all targets are found, after {options.cap}
measurements, or when its planner sees nothing left to gain; `to the cap` are the same searches
with a planner that goes on. (A PHD holds a target that is missed again and again for gone, by
1 - pi each time; the filter goes on to show where it may be, from the detections that no found
target explains. A planner can still end early: an environment explored to 99.9 % hides one of
twelve targets about once in a hundred searches, and a target may be found too far from its true
place.) Written by

    {command}

`degrees` and `radians` are the two readings of R = diag[1.5, 0.175, 0.295] of 000
(`docs/filter_presets.md`): variances with angles in degrees, or deviations with angles in
radians. A found target is true when it is matched, one to one, to a true one within {RADIUS:g} m;
a run is complete when all true ones are found. NEES is the mean normalised squared error of the
true ones at the end: 3 where covariances are right, below 3 where they are cautious.
Measurements to find all are a restricted mean. Brackets hold 95 % intervals: Clopper and
Pearson's, Poisson's, and Student's.

{chr(10).join(lines)}
"""


def main(arguments: list[str] | None = None) -> int:
    """Run the searches and print the table."""
    parser = argparse.ArgumentParser(prog='search_quality', description=__doc__)
    parser.add_argument('--scenario', default='ranging_drone_3d', help='name or file')
    parser.add_argument('--noise', nargs='*', choices=sorted(NOISES), default=sorted(NOISES))
    parser.add_argument('--runs', type=int, default=30, metavar='N')
    parser.add_argument('--first-seed', type=int, default=1000, metavar='SEED')
    parser.add_argument('--cap', type=int, default=CAP, help='measurements at most in a run')
    parser.add_argument('--planner', type=json.loads, default={}, help='settings, as JSON')
    parser.add_argument('--filter', type=json.loads, default={}, help='settings, as JSON')
    parser.add_argument(
        '--json',
        type=Path,
        metavar='FILE',
        help='keep runs and table there; go on with those that are',
    )
    parser.add_argument('--report', type=Path, metavar='FILE', help='write a page with the table')
    options = parser.parse_args(arguments)
    scenario = load_scenario(options.scenario)
    warm_up()
    lines = [
        '| noise | complete | false found per run | RMSE | NEES | measurements | a run |',
        '|---|---|---|---|---|---|---|',
    ]
    print('\n'.join(lines), flush=True)
    output: dict[str, Any] = {}
    if options.json is not None and options.json.exists():
        output = json.loads(options.json.read_text(encoding='utf-8'))
    for name in options.noise:
        ended: dict[int, Run] = {}
        for row, planner in ((name, {}), (f'{name}, to the cap', PERSISTENT)):
            settings = {**options.planner, **planner}
            wanted = prepared(scenario, NOISES[name], settings, options.filter)
            there = {run['seed']: Run(**run) for run in output.get(row, {}).get('runs', [])}
            # A search that found all before its planner ended it is the same one.
            there.update({seed: run for seed, run in ended.items() if run.finished})
            runs = []
            for seed in range(options.first_seed, options.first_seed + options.runs):
                runs.append(there.get(seed) or run_one(wanted, seed, options.cap))
                ended[seed] = runs[-1]
                print(asdict(runs[-1]), file=sys.stderr, flush=True)
                table = summary(runs, options.cap)
                output[row] = {'runs': [asdict(run) for run in runs], 'table': table}
                if options.json is not None:
                    options.json.write_text(json.dumps(output, indent=2) + '\n', encoding='utf-8')
            lines.append(show(row, output[row]['table']))
            print(lines[-1], flush=True)
    if options.report is not None:
        options.report.write_text(report(options, lines), encoding='utf-8')
    return 0


if __name__ == '__main__':
    raise SystemExit(main())
