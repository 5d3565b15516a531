"""Quality of the two filters in whole searches, side by side: `./scripts/quality`.

Runs the scenario in this process, once for each seed, condition and method, and prints a table.
Seeds and conditions are in `quality_conditions.py`; numbers for documents are from the block
`report`, which nothing is tuned on.
"""

from __future__ import annotations

import argparse
import json
import math
import signal
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from quality_conditions import CONDITIONS, RETURNS, SCENARIOS, SEEDS
from scipy.stats import binomtest, chi2

from maasi_filter import warm_up
from maasi_filter.metrics import match_targets
from maasi_filter.vector_math import squared_distance
from maasi_sim.experiments.campaign import run_command
from maasi_sim.experiments.searches import merged
from maasi_sim.experiments.statistics import paired_difference
from maasi_sim.scenario.loading import load_scenario
from maasi_sim.scenario.schema import Scenario
from maasi_sim.search import search
from maasi_sim.targets.scoring import scoring_radius
from maasi_sim.world.sensors import RangingSensor

METHODS = ('ic_phd', 'pmb')
CUBE = 'ranging_drone_3d'
# Measurements after which a search in the cube ends; of other scenarios, whose images are many.
CAP = 400
CAP_OF_SCENARIOS = 6000
# A planner that never ends a search.
PERSISTENT = {'explored_threshold': 1.0, 'gain_threshold': 0.0}
# A found target in the cube is true within this distance of a true one, one to one, metres.
RADIUS = 5.0
HEAD = (
    '| condition | method | complete | false found per run | RMSE [m] | NEES | measurements '
    '| difference to ic_phd | filter step [ms] |\n|---|---|---|---|---|---|---|---|---|'
)


@dataclass(frozen=True)
class Run:
    """What one search came to.

    `found` are true targets that were found, of `targets`; `squares` and `normalised` are sums of
    their squared errors [m^2], and of the same normalised with their covariances; `step` is the
    mean wall time of a filter step [s].
    """

    seed: int
    found: int
    targets: int
    false_found: int
    squares: float
    normalised: float
    measurements: int
    step: float

    @property
    def finished(self) -> bool:
        """Whether all were found."""
        return self.found == self.targets

    def counted(self, cap: int) -> int:
        """Return its measurements; `cap` if it did not finish."""
        return self.measurements if self.finished else cap


@cache
def _content(scenario: str) -> dict[str, Any]:
    return load_scenario(scenario).model_dump(by_alias=True, exclude_unset=True)


def _cap(condition: str) -> int:
    return CAP_OF_SCENARIOS if condition in SCENARIOS else CAP


def prepared(
    condition: str, method: str, seed: int, settings: dict[str, Any] | None = None
) -> Scenario:
    """Return the scenario of one run, with no limit but the number of measurements."""
    ours = {'planner': PERSISTENT, 'filter': {'method': method}, 'limits': {'time': 1e4}}
    scoring = {'scoring': {'radius': RADIUS}} if condition not in SCENARIOS else {}
    content = merged(_content(SCENARIOS.get(condition, CUBE)), ours, scoring)
    for change in CONDITIONS[condition]:
        content = change(content, seed) if callable(change) else merged(content, change)
        common = content.pop('every_robot', {})
        content['robots'] = {
            name: merged(robot, common) for name, robot in content['robots'].items()
        }
    content = merged(content, {'filter': settings or {}})
    return Scenario.model_validate(content)


def run_one(condition: str, method: str, seed: int, settings: dict[str, Any] | None = None) -> Run:
    """Run one search up to its number of measurements."""
    scenario = prepared(condition, method, seed, settings)
    measure = RangingSensor.measure
    returned = RETURNS[condition](measure) if condition in RETURNS else measure
    with patch.object(RangingSensor, 'measure', returned):
        result = search(scenario, seed, _cap(condition))
    d = scenario.dimension
    found = np.array([target.position for target in result.found_targets]).reshape(-1, d)
    match = match_targets(found, result.truth, scoring_radius(scenario, result.truth))
    normalised = sum(
        squared_distance(found[i] - result.truth[j], result.found_targets[i].covariance)
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
        step=float(np.mean(result.filter_times)),
    )


def restricted_mean(times: np.ndarray, ended: np.ndarray, cap: float) -> tuple[float, float]:
    """Return the restricted mean of times (n,) and its standard error (Greenwood's plug-in).

    It is the area under the Kaplan-Meier curve up to `cap`; where `ended` is false the run was cut
    short at its time.
    """
    ended, times = ended & (times <= cap), np.minimum(times, cap)
    survival, previous, area, steps = 1.0, 0.0, 0.0, []
    for moment in np.unique(times[ended]):
        area += survival * (moment - previous)
        risk, here = (times >= moment).sum(), ((times == moment) & ended).sum()
        steps.append((risk, here, area))
        survival *= 1.0 - here / risk
        previous = moment
    area += survival * (cap - previous)
    variance = sum((area - a) ** 2 * n / (m * (m - n)) for m, n, a in steps if m > n)
    return float(area), math.sqrt(variance * len(times) / max(len(times) - 1, 1))


def row(runs: Sequence[Run], others: Sequence[Run] | None, cap: int) -> list[str]:
    """Return the cells of a row, with 95 % intervals; `others` are those of the reference.

    Complete runs: Clopper and Pearson. False found targets: Poisson. Measurements: restricted
    mean, Kaplan and Meier, for runs that did not finish; their difference is paired by seed.
    """
    number = len(runs)
    complete = sum(run.finished for run in runs)
    low, high = binomtest(complete, number).proportion_ci()
    false = sum(run.false_found for run in runs)
    least = chi2.ppf(0.025, 2 * false) / 2 / number if false else 0.0
    most = chi2.ppf(0.975, 2 * false + 2) / 2 / number
    found = max(sum(run.found for run in runs), 1)
    mean, error = restricted_mean(
        np.array([float(run.measurements) for run in runs]),
        np.array([run.finished for run in runs], np.bool_),
        cap,
    )
    difference = '-'
    if others is not None:
        theirs = {run.seed: run.counted(cap) for run in others}
        both = [run for run in runs if run.seed in theirs]
        ours = [run.counted(cap) for run in both]
        gap = paired_difference(ours, [theirs[run.seed] for run in both])
        difference = f'{gap.mean:+.0f} +- {gap.half_width:.0f}'
    return [
        f'{complete}/{number} ({low:.2f} to {high:.2f})',
        f'{false / number:.2f} ({least:.2f} to {most:.2f})',
        f'{math.sqrt(sum(run.squares for run in runs) / found):.2f}',
        f'{sum(run.normalised for run in runs) / found:.2f}',
        f'{mean:.0f} +- {1.96 * error:.0f}',
        difference,
        f'{1e3 * float(np.median([run.step for run in runs])):.1f}',
    ]


def runs_in(path: Path | None) -> dict[tuple[str, str], dict[int, Run]]:
    """Return the runs of a file by condition and method, and by seed."""
    kept: dict[tuple[str, str], dict[int, Run]] = {}
    if path is not None and path.exists():
        for line in path.read_text(encoding='utf-8').splitlines():
            values = json.loads(line)
            key = values.pop('condition'), values.pop('method')
            kept.setdefault(key, {})[values['seed']] = Run(**values)
    return kept


def keep(path: Path | None, condition: str, method: str, run: Run) -> None:
    """Add a run to a file, as a line of JSON."""
    if path is not None:
        with path.open('a', encoding='utf-8') as file:
            file.write(json.dumps({'condition': condition, 'method': method, **asdict(run)}) + '\n')


def main(arguments: list[str] | None = None) -> int:
    """Run the searches and print the table."""
    parser = argparse.ArgumentParser(prog='quality', description=__doc__)
    parser.add_argument('conditions', nargs='*', help='names, or parts of names; none: all')
    parser.add_argument('--method', nargs='*', choices=METHODS, default=METHODS)
    parser.add_argument('--seeds', choices=sorted(SEEDS), default='development')
    parser.add_argument('--runs', type=int, default=20, metavar='N', help='first N of the block')
    parser.add_argument('--jobs', type=int, default=1, metavar='N', help='processes')
    parser.add_argument(
        '--json',
        type=Path,
        metavar='FILE',
        help='add each run there as a line; those that are there are not run again',
    )
    parser.add_argument(
        '--filter', type=json.loads, metavar='JSON', help='settings of the filter, in all runs'
    )
    parser.add_argument(
        '--stone-soup', action='store_true', help="GOSPA beside Stone Soup's JPDA tracker instead"
    )
    options = parser.parse_args(arguments)
    wanted = [
        name
        for name in CONDITIONS
        if not options.conditions
        or name in options.conditions
        or any(part in name for part in options.conditions if part not in CONDITIONS)
    ]
    if not wanted:
        parser.error(f'conditions: read {options.conditions}, known are {", ".join(CONDITIONS)}')
    if not 1 <= options.runs <= len(SEEDS[options.seeds]):
        parser.error(f'--runs: read {options.runs}, allowed is 1 to {len(SEEDS[options.seeds])}')
    seeds = SEEDS[options.seeds][: options.runs]
    warm_up()
    if options.stone_soup:
        # Stone Soup takes seconds to import.
        from stone_soup_quality import print_table

        print_table(wanted, seeds, prepared)
        return 0
    kept = runs_in(options.json)
    print(HEAD, flush=True)
    begin = time.perf_counter()
    # An interrupt is for the parent: it ends the pool.
    ignore = partial(signal.signal, signal.SIGINT, signal.SIG_IGN)
    with ProcessPoolExecutor(max(options.jobs, 1), initializer=ignore) as pool:
        for condition in wanted:
            done: dict[str, list[Run]] = {}
            for method in options.method:
                there = kept.setdefault((condition, method), {})
                missing = [seed for seed in seeds if seed not in there]
                one = partial(run_one, condition, method, settings=options.filter)
                for run in pool.map(one, missing):
                    there[run.seed] = run
                    keep(options.json, condition, method, run)
                done[method] = [there[seed] for seed in seeds]
                others = done.get('ic_phd') if method != 'ic_phd' else None
                cells = [condition, method, *row(done[method], others, _cap(condition))]
                print(f'| {" | ".join(cells)} |', flush=True)
    print(f'{time.perf_counter() - begin:.0f} s', file=sys.stderr)
    return 0


if __name__ == '__main__':
    raise SystemExit(run_command(main))
