"""Run the papers' experiments and lay what comes out beside what the papers report."""

from __future__ import annotations

import argparse
import signal
import sys
from functools import partial
from pathlib import Path
from types import FrameType

from maasi_sim.arguments import count, whole
from maasi_sim.experiments.campaign import MixedWorkers, Plan, WorkersLost, plan
from maasi_sim.experiments.document import write_document
from maasi_sim.experiments.execution import carry_out_all, make_workers
from maasi_sim.experiments.experiment import Experiment
from maasi_sim.experiments.outputs import write_outputs
from maasi_sim.experiments.registry import UnknownExperiment, experiments, find
from maasi_sim.experiments.results import NoRoom

DONE, SOME_FAILED, WRONG_INPUT, STOPPED, INTERRUPTED = 0, 1, 2, 3, 130


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(
        prog='reproduce',
        description="Run the papers' experiments; the same command goes on where it stopped.",
        epilog='Exit codes: 0 all runs are there, 1 some failed, 2 wrong input, 3 stopped: no '
        'room on the disk, or the workers are gone, 130 interrupted.',
    )
    parser.add_argument('names', nargs='*', metavar='NAME', help='experiments, or "all"')
    parser.add_argument('--list', action='store_true', help='name every experiment')
    parser.add_argument(
        '--runs', type=count, metavar='N', help="maps of each (default: the paper's number)"
    )
    parser.add_argument(
        '--case',
        action='append',
        metavar='NAME',
        help='only this case of each experiment; may be given several times',
    )
    parser.add_argument(
        '--workers', type=count, metavar='N', help='processes (default: one for each core)'
    )
    parser.add_argument('--cluster', metavar='ADDRESS', help='scheduler of a Dask cluster')
    parser.add_argument(
        '--mixed-workers',
        action='store_true',
        help='mix runs of different processors or versions, which may differ in the last bits',
    )
    parser.add_argument(
        '--out',
        type=Path,
        default=Path('runs/reproduction'),
        metavar='DIR',
        help='folder of the results (default: %(default)s)',
    )
    parser.add_argument(
        '--seed', type=whole, default=1, metavar='N', help='other maps (default: %(default)s)'
    )
    parser.add_argument(
        '--small',
        action='store_true',
        help='a look at how it works, in seconds: short runs, whose numbers mean nothing',
    )
    parser.add_argument(
        '--document',
        type=Path,
        metavar='FILE',
        help='write the page of all experiments that are in DIR, with their figures beside it',
    )
    return parser


def main(arguments: list[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    parser = build_parser()
    options = parser.parse_args(arguments)
    if not (options.names or options.list or options.document):
        parser.error('give names of experiments, --list, or --document FILE')
    signal.signal(signal.SIGTERM, _interrupt)
    if options.list:
        print('\n'.join(listing(list(experiments().values()))))
        return DONE
    try:
        wanted = (
            list(experiments().values())
            if options.names == ['all']
            else [find(name) for name in dict.fromkeys(options.names)]
        )
    except UnknownExperiment as error:
        return _refuse(str(error), WRONG_INPUT)
    unknown = _unknown_case(wanted, options)
    if unknown:
        return _refuse(unknown, WRONG_INPUT)
    try:
        code = run_all(wanted, options) if wanted else DONE
        if options.document is not None:
            shown = write_document(options.document, options.out, options.seed, options.small)
            print(f'wrote {options.document} with {len(shown)} experiments')
        return code
    except MixedWorkers as error:
        return _refuse(f'{error}; --mixed-workers allows it', WRONG_INPUT)
    except (NoRoom, WorkersLost) as error:
        return _refuse(f'{error}; the runs until now are kept', STOPPED)
    except KeyboardInterrupt:
        return _refuse('interrupted; the same command goes on from here', INTERRUPTED)


def _unknown_case(wanted: list[Experiment], options: argparse.Namespace) -> str:
    """Return what is wrong with the names of cases, '' if nothing is."""
    known = {case.name for item in wanted for case in item.cases(options.small)}
    for name in options.case or []:
        if name not in known:
            return f"unknown case '{name}'; allowed are {', '.join(sorted(known))}"
    return ''


def _interrupt(number: int, frame: FrameType | None) -> None:
    raise KeyboardInterrupt


def _refuse(text: str, code: int) -> int:
    print(f'error: {text}', file=sys.stderr)
    return code


def listing(known: list[Experiment]) -> list[str]:
    """Return a line for each experiment: name, what it takes, and what it shows."""
    lines = []
    for item in known:
        cases = item.cases(False)
        runs = sum(item.runs if case.runs is None else case.runs for case in cases)
        minutes = runs * item.seconds / 60.0
        takes = f'{len(cases)} cases, {runs} runs, {max(minutes, 0.1):.1f} min on a core'
        lines.append(f'{item.name:12s} {takes:38s} {item.title}')
    return lines


def run_all(wanted: list[Experiment], options: argparse.Namespace) -> int:
    """Run experiments one after the other and return the exit code."""
    plans = []
    for experiment in wanted:
        runs = options.runs or experiment.runs
        work = plan(experiment, options.out, runs, options.seed, options.small)
        if options.case:
            work.tasks = [task for task in work.tasks if task.case in options.case]
        for complaint in work.complaints:
            print(f'warning: {complaint}', file=sys.stderr)
        plans.append(work)

    def finished(work: Plan) -> str:
        write_outputs(work.folder, work.results(), options.seed)
        return f'{work.experiment.name}: {work.folder.path}/table.md'

    hire = partial(make_workers, options.workers, options.cluster, '--cluster')
    problems = carry_out_all(plans, hire, options.mixed_workers, finished)
    return SOME_FAILED if problems else DONE


if __name__ == '__main__':
    sys.exit(main())
