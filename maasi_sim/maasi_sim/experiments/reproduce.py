"""Run the papers' experiments and lay what comes out beside what the papers report."""

from __future__ import annotations

import argparse
import os
import signal
import sys
import time
from pathlib import Path
from types import FrameType

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from maasi_sim.arguments import count, whole
from maasi_sim.experiments.campaign import (
    Cluster,
    MixedWorkers,
    Plan,
    Processes,
    SerialExecutor,
    Workers,
    WorkersLost,
    carry_out,
    one_machine,
    plan,
)
from maasi_sim.experiments.document import write_document
from maasi_sim.experiments.experiment import Experiment
from maasi_sim.experiments.outputs import write_outputs
from maasi_sim.experiments.registry import UnknownExperiment, experiments, find
from maasi_sim.experiments.results import NoRoom, Run

DONE, SOME_FAILED, WRONG_INPUT, STOPPED, INTERRUPTED = 0, 1, 2, 3, 130

# Wall time between two lines about progress where there is no terminal [s].
_QUIET_PERIOD = 10.0


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
    number = sum(len(work.tasks) for work in plans)
    problems: list[str] = []
    workers: Workers | None = None
    begin = time.monotonic()
    try:
        if number:
            workers = make_workers(options, number)
        machine = None
        if workers is not None and not options.mixed_workers:
            machine = one_machine(workers, plans)
        with _Display(plans) as display:
            for work in plans:
                if work.tasks and workers is not None:
                    problems += carry_out(work, workers, display.advance(work), machine)
                write_outputs(work.folder, work.results(), options.seed)
                display.say(f'{work.experiment.name}: {work.folder.path}/table.md')
    finally:
        if workers is not None:
            workers.close()
    used = f' by {workers.number} workers in {time.monotonic() - begin:.0f} s' if workers else ''
    kept = sum(len(work.done) for work in plans)
    print(f'{number - len(problems)} runs made{used}; {kept} there in all')
    for problem in problems:
        print(f'error: {problem}', file=sys.stderr)
    return SOME_FAILED if problems else DONE


def make_workers(options: argparse.Namespace, number: int) -> Workers:
    """Return who makes so many runs."""
    if options.cluster is not None:
        return Cluster(options.cluster)
    wanted = min(options.workers or os.cpu_count() or 1, number)
    return Processes(wanted) if wanted > 1 else SerialExecutor()


class _Display:
    """Progress and an estimate of what is left: a bar, or lines where there is no terminal."""

    def __init__(self, plans: list[Plan]) -> None:
        self._plans = plans
        self._total = sum(len(work.tasks) for work in plans)
        self._made = 0
        self._begin = self._last = time.monotonic()
        self._bar: Progress | None = None
        self._task: TaskID | None = None

    def __enter__(self) -> _Display:
        if sys.stderr.isatty() and self._total:
            self._bar = Progress(
                TextColumn('{task.description}'),
                BarColumn(),
                MofNCompleteColumn(),
                TimeElapsedColumn(),
                TextColumn('left'),
                TimeRemainingColumn(),
                console=Console(stderr=True),
            )
            self._bar.start()
            self._task = self._bar.add_task('', total=self._total)
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.stop()

    def advance(self, work: Plan):  # type: ignore[no-untyped-def]
        """Return what is to be called after each run of an experiment."""

        def note(run: Run | None) -> None:
            self._made += 1
            what = work.experiment.name if run is None else f'{run.experiment} {run.case}'
            if self._bar is not None and self._task is not None:
                self._bar.update(self._task, completed=self._made, description=what)
                return
            now = time.monotonic()
            if now - self._last >= _QUIET_PERIOD:
                self._last = now
                left = (now - self._begin) * (self._total - self._made) / self._made
                print(
                    f'{self._made} of {self._total} runs, about {left:.0f} s left ({what})',
                    file=sys.stderr,
                    flush=True,
                )

        return note

    def say(self, text: str) -> None:
        """Write a line that stays."""
        if self._bar is not None:
            self._bar.console.print(text, markup=False, highlight=False)
        else:
            print(text, file=sys.stderr, flush=True)


if __name__ == '__main__':
    sys.exit(main())
