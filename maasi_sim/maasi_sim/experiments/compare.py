"""Compare planners and filters: searches of scenarios in one process each, on the same seeds."""

import argparse
import json
import sys
from collections.abc import Sequence
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any

from maasi_sim.arguments import Parser, count, positive, whole
from maasi_sim.experiments.campaign import (
    DONE,
    EXIT_CODES,
    SOME_FAILED,
    Campaign,
    add_worker_options,
    carry_out_all,
    plan,
    run_command,
)
from maasi_sim.experiments.experiment import WrongInput
from maasi_sim.experiments.figures import as_png, draw_comparison
from maasi_sim.experiments.runs import runs_text, write_file
from maasi_sim.experiments.searches import compared
from maasi_sim.experiments.tables import SearchTable, compared_facts, compared_page, compared_text

_RUNS = Path('runs')


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = Parser(
        prog='compare',
        description='Compare planners and filters in complete searches on the same seeds. Run '
        'the same command again to resume an interrupted comparison.',
        epilog=EXIT_CODES,
    )
    add = parser.add_argument
    add(
        'scenarios',
        nargs='+',
        metavar='SCENARIO',
        help='scenario file, or its name in config/scenarios',
    )
    add(
        '--planner',
        type=_names,
        default=(),
        metavar='NAME,...',
        help="planners; the first is the baseline of differences (default: the scenario's)",
    )
    add(
        '--filter',
        type=_names,
        default=(),
        metavar='NAME,...',
        help="filters, each combined with each planner (default: the scenario's)",
    )
    add(
        '--runs',
        type=count,
        default=30,
        metavar='N',
        help='searches of each combination (default: %(default)s)',
    )
    add(
        '--seed',
        type=partial(whole, most=2**32),
        default=1,
        metavar='N',
        help='seed of the first search; the next ones count up (default: %(default)s)',
    )
    add(
        '--time-limit',
        type=positive,
        metavar='S',
        help="end each search after this simulated time [s] (default: the scenario's limits.time)",
    )
    add_worker_options(parser)
    add(
        '--again',
        action='store_true',
        help='repeat searches in DIR that were run with other settings or another code version',
    )
    add(
        '--out',
        type=Path,
        metavar='DIR',
        help='folder for the results (default: the interrupted comparison, or runs/compare_<time>)',
    )
    return parser


def _names(text: str) -> tuple[str, ...]:
    names = tuple(name.strip() for name in text.split(','))
    if not all(names) or len(set(names)) < len(names):
        raise argparse.ArgumentTypeError(
            f"read '{text}', allowed are different names with commas between them"
        )
    return names


def main(arguments: list[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    options = build_parser().parse_args(arguments)
    return run_command(lambda: compare(options))


def compare(options: argparse.Namespace) -> int:
    """Make the missing searches, write the results, and return the exit code."""
    comparisons = [
        compared(scenario, options.planner, options.filter, options.time_limit)
        for scenario in options.scenarios
    ]
    names = [item.name for item in comparisons]
    if len(set(names)) < len(names):
        raise WrongInput(f'SCENARIO: read {", ".join(names)}, allowed are different names')
    wanted = {
        'first_seed': options.seed,
        'seeds': options.runs,
        'scenarios': {
            item.name: {case.name: case.digest() for case in item.cases(False)}
            for item in comparisons
        },
    }
    out = options.out or _unfinished(wanted) or _new_folder()
    campaigns = [plan(item, out, options.runs, first=options.seed) for item in comparisons]
    if not options.again:
        _refuse_others(campaigns, out)
    print(f'results: {out}', file=sys.stderr)
    write_file(out / 'request.json', json.dumps(wanted, indent=2) + '\n')
    problems = carry_out_all(campaigns, options.jobs, options.cluster, options.mixed_workers)
    tables = [SearchTable(work.results()) for work in campaigns if work.done]
    if tables:
        seeds = range(options.seed, options.seed + options.runs)
        _write(out, tables, seeds)
        for table in tables:
            print(f'\n{table.name}', *table.verdicts(), sep='\n  ')
        print(f'\n{out}/comparison.md')
    return SOME_FAILED if problems else DONE


def _unfinished(wanted: dict[str, Any]) -> Path | None:
    for folder in sorted(_RUNS.glob('compare_*'), reverse=True):
        try:
            read = json.loads((folder / 'request.json').read_text(encoding='utf-8'))
        except (OSError, ValueError):
            continue
        if read == wanted and not (folder / 'comparison.json').exists():
            return folder
    return None


def _new_folder() -> Path:
    stamp = datetime.now().strftime('%Y%m%d_%H%M%S')
    folder, number = _RUNS / f'compare_{stamp}', 1
    while folder.exists():
        number += 1
        folder = _RUNS / f'compare_{stamp}_{number}'
    return folder


def _refuse_others(campaigns: Sequence[Campaign], out: Path) -> None:
    other = sum(
        file.exists() and file not in work.complaints
        for work in campaigns
        for file in (work.file(task.case.name, task.number) for task in work.tasks)
    )
    if other:
        raise WrongInput(
            f'--out: {out}: {other} searches there are of other settings, or of another version '
            'of the code; allowed is another folder, or --again to repeat them'
        )


def _write(out: Path, tables: Sequence[SearchTable], seeds: Sequence[int]) -> None:
    for table in tables:
        write_file(out / table.name / 'runs.csv', runs_text(table.results.every()))
    write_file(out / 'comparison.csv', compared_text(tables))
    write_file(out / 'comparison.png', as_png(lambda figure: draw_comparison(figure, tables)))
    write_file(out / 'comparison.md', compared_page(tables, seeds))
    text = json.dumps(compared_facts(tables, seeds), indent=2, allow_nan=False)
    write_file(out / 'comparison.json', text + '\n')


if __name__ == '__main__':
    sys.exit(main())
