"""Run the papers' experiments and compare the results with the papers'."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from maasi_filter.wording import counted
from maasi_sim.arguments import Parser, count, whole
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
from maasi_sim.experiments.experiment import Experiment, WrongInput
from maasi_sim.experiments.outputs import write_document, write_outputs
from maasi_sim.experiments.papers import experiments, find


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = Parser(
        prog='reproduce',
        description="Run the papers' experiments. Run the same command again to resume.",
        epilog=EXIT_CODES,
    )
    add = parser.add_argument
    add('names', nargs='*', metavar='NAME', help='experiments that --list prints, or "all"')
    add('--list', action='store_true', help='list the experiments and exit')
    add(
        '--runs',
        type=count,
        metavar='N',
        help="use N maps for each experiment (default: the paper's number)",
    )
    add(
        '--case',
        action='append',
        metavar='NAME',
        help='run only this case of each experiment; can be repeated',
    )
    add_worker_options(parser)
    add(
        '--out',
        type=Path,
        default=Path('runs/reproduction'),
        metavar='DIR',
        help='folder for the results (default: %(default)s)',
    )
    add(
        '--seed', type=whole, default=1, metavar='N', help='seed of the maps (default: %(default)s)'
    )
    add(
        '--small',
        action='store_true',
        help='make short test runs whose numbers have no meaning',
    )
    add(
        '--document',
        type=Path,
        metavar='FILE',
        help='write a page of all experiments in DIR to FILE, with its figures next to it',
    )
    add(
        '--rewrite',
        action='store_true',
        help='with --document: write it from the stored tables only, without runs',
    )
    return parser


def main(arguments: list[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    parser = build_parser()
    options = parser.parse_args(arguments)
    if not (options.names or options.list or options.document):
        parser.error('give names of experiments, --list, or --document FILE')
    return run_command(lambda: _reproduce(options))


def _reproduce(options: argparse.Namespace) -> int:
    if options.list:
        print('\n'.join(map(_line, experiments().values())))
        return DONE
    if options.names == ['all']:
        wanted = list(experiments().values())
    else:
        wanted = [find(name) for name in dict.fromkeys(options.names)]
    known = {case.name for item in wanted for case in item.cases(options.small)}
    for name in options.case or []:
        if name not in known:
            allowed = ', '.join(sorted(known))
            raise WrongInput(f"unknown case '{name}'; allowed are {allowed}")
    problems = _run(wanted, options) if wanted else []
    if options.document is not None:
        settings = options.seed, options.small, options.rewrite
        shown = write_document(options.document, options.out, *settings)
        print(f'wrote {options.document} with {counted(len(shown), "experiment")}')
    return SOME_FAILED if problems else DONE


def _line(item: Experiment) -> str:
    cases = item.cases(False)
    runs = sum(item.runs if case.runs is None else case.runs for case in cases)
    minutes = runs * item.seconds / 60.0
    work = f'{counted(len(cases), "case")}, {counted(runs, "run")}'
    takes = f'{work}, {max(minutes, 0.1):.1f} min on a core'
    return f'{item.name:14s} {takes:39s} {item.title}'


def _run(wanted: Sequence[Experiment], options: argparse.Namespace) -> list[str]:
    campaigns = []
    for experiment in wanted:
        runs = options.runs or experiment.runs
        work = plan(experiment, options.out, runs, options.seed, options.small)
        if options.case:
            work.tasks = [task for task in work.tasks if task.case.name in options.case]
        campaigns.append(work)

    def finished(work: Campaign) -> str:
        write_outputs(work, options.seed)
        return f'{work.experiment.name}: {work.folder}/table.md'

    return carry_out_all(campaigns, options.jobs, options.cluster, options.mixed_workers, finished)


if __name__ == '__main__':
    sys.exit(main())
