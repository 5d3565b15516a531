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
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from quality_conditions import CONDITIONS, RETURNS, SCENARIOS, wanted
from scipy.stats import binomtest, chi2

from maasi_filter import warm_up
from maasi_filter.metrics import match_targets
from maasi_filter.vector_math import squared_distance
from maasi_sim.experiments.campaign import run_command
from maasi_sim.experiments.searches import merged
from maasi_sim.experiments.statistics import mean_interval, paired_difference
from maasi_sim.run.targets.scoring import scoring_radius
from maasi_sim.scenario.loading import load_scenario
from maasi_sim.scenario.schema import Scenario
from maasi_sim.search import search
from maasi_sim.simulation.sensors import RangingSensor

METHODS = ('ic_phd', 'pmb')
CUBE = 'ranging_drone_3d'
# A found target in the cube is true within this distance of a true one, one to one [m].
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

    def counted(self, cap: int) -> int:
        """Return its measurements; `cap` if it did not find all."""
        return self.measurements if self.found == self.targets else cap


def cap_of(condition: str) -> int:
    """Return the measurements after which a search ends; other scenarios have many images."""
    return 6000 if condition in SCENARIOS else 400


def prepared(
    condition: str, method: str, seed: int, settings: dict[str, Any] | None = None
) -> Scenario:
    """Return the scenario of one run, with no limit but the number of measurements."""
    scenario = load_scenario(SCENARIOS.get(condition, CUBE))
    ours = {
        'planner': {'explored_threshold': 1.0, 'gain_threshold': 0.0},
        'filter': {'method': method},
        'limits': {'time': 1e4},
        'scoring': {} if condition in SCENARIOS else {'radius': RADIUS},
    }
    content = merged(scenario.model_dump(by_alias=True, exclude_unset=True), ours)
    for change in CONDITIONS[condition]:
        content = change(content, seed) if callable(change) else merged(content, change)
        common = content.pop('every_robot', {})
        content['robots'] = {
            name: merged(robot, common) for name, robot in content['robots'].items()
        }
    return Scenario.model_validate(merged(content, {'filter': settings or {}}))


def run_one(condition: str, method: str, seed: int, settings: dict[str, Any] | None = None) -> Run:
    scenario = prepared(condition, method, seed, settings)
    measure, besides = RangingSensor.measure, RETURNS.get(condition)

    def returned(sensor: Any, pose: Any, step: int, *rest: Any) -> tuple[Any, Any]:
        seen = measure(sensor, pose, step, *rest)
        return besides(sensor, pose, step, *seen) if besides else seen

    with patch.object(RangingSensor, 'measure', returned):
        result = search(scenario, seed, cap_of(condition))
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


def row(runs: Sequence[Run], others: Sequence[Run] | None, cap: int) -> list[str]:
    """Return the cells of a row, with 95 % intervals; `others` are those of the reference.

    Complete runs: Clopper and Pearson. False found targets: Poisson. Measurements: Student, as all
    runs that did not find all reached the cap; their difference is paired by seed.
    """
    number = len(runs)
    complete = sum(run.found == run.targets for run in runs)
    low, high = binomtest(complete, number).proportion_ci()
    false = sum(run.false_found for run in runs)
    least = chi2.ppf(0.025, 2 * false) / 2 / number if false else 0.0
    most = chi2.ppf(0.975, 2 * false + 2) / 2 / number
    found = max(sum(run.found for run in runs), 1)
    ours = [run.counted(cap) for run in runs]
    mean, difference = mean_interval(ours), '-'
    if others is not None:
        gap = paired_difference(ours, [run.counted(cap) for run in others])
        difference = f'{gap.mean:+.0f} +- {gap.half_width:.0f}'
    return [
        f'{complete}/{number} ({low:.2f} to {high:.2f})',
        f'{false / number:.2f} ({least:.2f} to {most:.2f})',
        f'{math.sqrt(sum(run.squares for run in runs) / found):.2f}',
        f'{sum(run.normalised for run in runs) / found:.2f}',
        f'{mean.mean:.0f} +- {mean.half_width:.0f}',
        difference,
        f'{1e3 * float(np.median([run.step for run in runs])):.1f}',
    ]


def runs_in(path: Path | None) -> dict[tuple[str, str, int], Run]:
    kept = {}
    if path is not None and path.exists():
        for line in path.read_text(encoding='utf-8').splitlines():
            values = json.loads(line)
            key = values.pop('condition'), values.pop('method'), values['seed']
            kept[key] = Run(**values)
    return kept


def main() -> int:
    parser = argparse.ArgumentParser(prog='quality', description=__doc__)
    parser.add_argument('--method', nargs='*', choices=METHODS, default=METHODS)
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
    options, conditions, seeds = wanted(parser, CONDITIONS, runs=20, jobs=1)
    warm_up()
    if options.stone_soup:
        # Stone Soup takes seconds to import.
        from stone_soup_quality import print_table

        print_table(conditions, seeds, prepared)
        return 0
    kept = runs_in(options.json)
    print(HEAD, flush=True)
    begin = time.perf_counter()
    # An interrupt is for the parent: it ends the pool.
    ignore = partial(signal.signal, signal.SIGINT, signal.SIG_IGN)
    with ProcessPoolExecutor(max(options.jobs, 1), initializer=ignore) as pool:
        for condition in conditions:
            done: dict[str, list[Run]] = {}
            for method in options.method:
                missing = [seed for seed in seeds if (condition, method, seed) not in kept]
                one = partial(run_one, condition, method, settings=options.filter)
                for run in pool.map(one, missing):
                    kept[condition, method, run.seed] = run
                    if options.json is not None:
                        named = {'condition': condition, 'method': method, **asdict(run)}
                        with options.json.open('a', encoding='utf-8') as file:
                            file.write(json.dumps(named) + '\n')
                done[method] = [kept[condition, method, seed] for seed in seeds]
                others = done.get('ic_phd') if method != 'ic_phd' else None
                cells = [condition, method, *row(done[method], others, cap_of(condition))]
                print(f'| {" | ".join(cells)} |', flush=True)
    print(f'{time.perf_counter() - begin:.0f} s', file=sys.stderr)
    return 0


if __name__ == '__main__':
    raise SystemExit(run_command(main))
