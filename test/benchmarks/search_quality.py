"""Quality of whole searches with each planner, side by side: `./scripts/search_quality`.

Runs the regimes of `search_regimes.py` in this process and prints a table in Markdown. Seeds are
those of `quality_conditions.py`: numbers for documents are from the block `report`, which nothing
is tuned on.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import math
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path

import numpy as np
from quality_conditions import SEEDS
from search_regimes import KINDS, REGIMES, prepared

from maasi_filter import warm_up
from maasi_sim.experiments.clairvoyant import Clairvoyant
from maasi_sim.experiments.statistics import Interval, mean_interval, paired_difference
from maasi_sim.search import SearchResult, search

# What differences are to.
REFERENCE = 'before'
BEGIN, END = '<!-- table: begin -->', '<!-- table: end -->'
HEAD = (
    '| planner | runs | complete | false found | time [s] | difference [s] | mean time to find [s] '
    '| difference [s] | measurements | way [m] | decision [ms] |\n'
    '|---|---|---|---|---|---|---|---|---|---|---|'
)


@dataclass(frozen=True)
class Run:
    """What one search came to.

    Attributes
    ----------
    regime, kind, seed, digest
        Which one; a hash of its settings.
    complete : bool
        Whether all targets were found, and nothing else.
    false_found : int
        Found targets that are none.
    time : float
        Until all were found, else the limit of the regime [s].
    mean_time : float
        The same, averaged over the targets [s].
    measurements : int
        Of all robots, in the run.
    distance : float
        Way of all robots, in the run [m].
    decision : float
        Mean wall time of a decision [s].
    slowest : float
        The longest one [s].
    took : float
        Wall time of the run [s].
    """

    regime: str
    kind: str
    seed: int
    digest: str
    complete: bool
    false_found: int
    time: float
    mean_time: float
    measurements: int
    distance: float
    decision: float
    slowest: float
    took: float

    @property
    def key(self) -> tuple[str, str, int, str]:
        """What identifies it."""
        return self.regime, self.kind, self.seed, self.digest


@cache
def digest(regime: str, kind: str) -> str:
    """Return a short hash of all settings of a regime with a planner."""
    text = json.dumps(prepared(regime, kind).content(), sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def find_times(result: SearchResult, limit: float) -> np.ndarray:
    """Return when the first, second and so on of the true targets was found, (n,) [s].

    A target that was not found has the limit.
    """
    times = np.full(len(result.truth), limit)
    for item in reversed(result.progress):
        times[: item.true_found] = np.minimum(times[: item.true_found], item.time)
    return times


def run_one(regime: str, kind: str, seed: int) -> Run:
    """Run one search."""
    scenario = prepared(regime, kind)
    begin = time.perf_counter()
    result = search(scenario, seed, planner=Clairvoyant if KINDS[kind].clairvoyant else None)
    times = find_times(result, scenario.limits.time)
    return Run(
        regime=regime,
        kind=kind,
        seed=seed,
        digest=digest(regime, kind),
        complete=result.complete,
        false_found=result.false_found,
        time=float(times.max()),
        mean_time=float(times.mean()),
        measurements=result.total_measurements,
        distance=sum(result.distance.values()),
        decision=float(np.mean(result.planning_times)),
        slowest=max(result.planning_times),
        took=time.perf_counter() - begin,
    )


def stored(path: Path | None) -> dict[tuple[str, str, int, str], Run]:
    """Return the runs of a file of JSON lines; a last line that is cut off is left out."""
    runs = {}
    if path is not None and path.exists():
        for line in path.read_text(encoding='utf-8').splitlines():
            try:
                run = Run(**json.loads(line))
            except (json.JSONDecodeError, TypeError):
                continue
            runs[run.key] = run
    return runs


def difference(runs: Sequence[Run], others: Sequence[Run], field: str) -> Interval:
    """Return the mean difference of a field on the seeds of both, with Student's interval."""
    theirs = {run.seed: run for run in others}
    both = [run for run in runs if run.seed in theirs]
    return paired_difference(
        [getattr(run, field) for run in both], [getattr(theirs[run.seed], field) for run in both]
    )


def _text(interval: Interval, sign: str = '') -> str:
    digits = 1 if abs(interval.mean) < 1000 else 0
    half = '-' if math.isnan(interval.half_width) else f'{interval.half_width:.{digits}f}'
    return f'{interval.mean:{sign}.{digits}f} ± {half}'


def row(kind: str, runs: Sequence[Run], others: Sequence[Run]) -> str:
    """Return a row of the table."""
    cells = [
        kind,
        str(len(runs)),
        f'{sum(run.complete for run in runs)}/{len(runs)}',
        f'{np.mean([run.false_found for run in runs]):.2f}',
    ]
    for field in ('time', 'mean_time'):
        cells.append(_text(mean_interval([getattr(run, field) for run in runs])))
        same = kind == REFERENCE or not others
        cells.append('' if same else _text(difference(runs, others, field), '+'))
    cells += [f'{np.mean([getattr(run, f) for run in runs]):.0f}' for f in ('measurements',)]
    way = float(np.mean([run.distance for run in runs]))
    cells.append(f'{way:.0f}' if way >= 100.0 else f'{way:.1f}')
    decision = 1e3 * float(np.median([run.decision for run in runs]))
    cells.append(f'{decision:.1f} (at most {1e3 * max(run.slowest for run in runs):.0f})')
    return '| ' + ' | '.join(cells) + ' |'


def table(runs: Sequence[Run]) -> str:
    """Return the table of all regimes in Markdown."""
    lines = []
    for regime, what in REGIMES.items():
        here = {
            kind: [run for run in runs if (run.regime, run.kind) == (regime, kind)]
            for kind in KINDS
        }
        if any(here.values()):
            lines += ['', f'**{regime}** (limit {what.limit:g} s)', '', HEAD]
            lines += [row(kind, own, here[REFERENCE]) for kind, own in here.items() if own]
    return '\n'.join(lines[1:])


def write(path: Path, text: str) -> None:
    """Put the table between its marks in a document."""
    before, rest = path.read_text(encoding='utf-8').split(BEGIN)
    after = rest.split(END)[1]
    path.write_text(f'{before}{BEGIN}\n{text}\n{END}{after}', encoding='utf-8')


def main(arguments: list[str] | None = None) -> int:
    """Run the searches and print the table."""
    parser = argparse.ArgumentParser(prog='search_quality', description=__doc__)
    parser.add_argument('regimes', nargs='*', help='parts of their names; none: all of them')
    parser.add_argument('--planner', nargs='*', choices=tuple(KINDS), default=list(KINDS))
    parser.add_argument('--seeds', choices=sorted(SEEDS), default='development')
    parser.add_argument('--runs', type=int, default=16, metavar='N', help='first N of the block')
    parser.add_argument('--jobs', type=int, default=1, metavar='N', help='processes')
    parser.add_argument(
        '--json', type=Path, metavar='FILE', help='JSON lines of runs; those there are kept'
    )
    parser.add_argument('--document', type=Path, metavar='FILE', help='write the table into it')
    options = parser.parse_args(arguments)
    wanted = [
        name
        for name in REGIMES
        if not options.regimes or any(part in name for part in options.regimes)
    ]
    if not wanted:
        parser.error(f'regimes: read {options.regimes}, known are {", ".join(REGIMES)}')
    if not 1 <= options.runs <= len(SEEDS[options.seeds]):
        parser.error(f'--runs: read {options.runs}, allowed is 1 to {len(SEEDS[options.seeds])}')
    # Seed by seed: a campaign that is interrupted has all planners on the first seeds.
    tasks = [
        (regime, kind, seed)
        for number, seed in enumerate(SEEDS[options.seeds][: options.runs])
        for regime in wanted
        for kind in options.planner
        if number < KINDS[kind].runs
    ]
    there = stored(options.json)
    runs = {}
    missing = []
    for regime, kind, seed in tasks:
        key = (regime, kind, seed, digest(regime, kind))
        if key in there:
            runs[key] = there[key]
        else:
            missing.append((regime, kind, seed))
    warm_up()
    begin = time.perf_counter()
    with ProcessPoolExecutor(max(options.jobs, 1)) as pool:
        for future in as_completed([pool.submit(run_one, *task) for task in missing]):
            run = future.result()
            runs[run.key] = run
            if options.json is not None:
                with options.json.open('a', encoding='utf-8') as file:
                    file.write(json.dumps(asdict(run)) + '\n')
    ordered = sorted(runs.values(), key=lambda run: run.seed)
    block = f'Block `{options.seeds}`, the first {options.runs} seeds (fewer for slow planners).'
    text = f'{block}\n\n{table(ordered)}'
    print(text)
    if options.document is not None:
        write(options.document, text)
    print(
        f'{len(missing)} runs in {time.perf_counter() - begin:.0f} s, wall time of all '
        f'{sum(run.took for run in ordered):.0f} s',
        file=sys.stderr,
    )
    return 0


if __name__ == '__main__':
    raise SystemExit(main())
