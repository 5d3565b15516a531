"""What the commands that run campaigns share: options, workers, progress, exit codes."""

from __future__ import annotations

import argparse
import os
import signal
import sys
import time
from collections.abc import Callable
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

from maasi_sim.arguments import count
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
)
from maasi_sim.experiments.results import NoRoom, Run

DONE, SOME_FAILED, WRONG_INPUT, STOPPED, INTERRUPTED = 0, 1, 2, 3, 130
EXIT_CODES = (
    'Exit codes: 0 all runs are there, 1 some failed, 2 wrong input, 3 stopped: no room on the '
    'disk, or the workers are gone, 130 interrupted.'
)

# Wall time between two lines of progress without a terminal [s].
_QUIET_PERIOD = 10.0


def add_worker_options(parser: argparse.ArgumentParser, cluster: str) -> None:
    """Add the options of `carry_out_all`; `cluster` is the name of that of a Dask cluster."""
    parser.add_argument(
        '--workers', type=count, metavar='N', help='processes (default: one for each core)'
    )
    parser.add_argument(
        cluster, dest='cluster', metavar='ADDRESS', help='scheduler of a Dask cluster'
    )
    parser.add_argument(
        '--mixed-workers',
        action='store_true',
        help='mix runs of different processors or versions, which may differ in the last bits',
    )


def run_command(command: Callable[[], int], *wrong_input: type[Exception]) -> int:
    """Run a command that can be interrupted, and return its exit code; errors are printed."""

    def interrupt(number: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    signal.signal(signal.SIGTERM, interrupt)
    signal.signal(signal.SIGINT, interrupt)
    try:
        return command()
    except wrong_input as error:
        text, code = str(error), WRONG_INPUT
    except MixedWorkers as error:
        text, code = f'{error}; --mixed-workers allows it', WRONG_INPUT
    except (NoRoom, WorkersLost) as error:
        text, code = f'{error}; the runs until now are kept', STOPPED
    except KeyboardInterrupt:
        text, code = 'interrupted; the same command resumes', INTERRUPTED
    for line in text.splitlines():
        print(f'error: {line}', file=sys.stderr)
    return code


def make_workers(number: int, wanted: int | None, cluster: str | None) -> Workers:
    """Return workers for `number` runs; the other parameters are those of `carry_out_all`."""
    if cluster is not None:
        return Cluster(cluster)
    processes = min(wanted or os.cpu_count() or 1, number)
    return Processes(processes) if processes > 1 else SerialExecutor()


def carry_out_all(
    plans: list[Plan],
    workers: int | None = None,
    cluster: str | None = None,
    mixed: bool = False,
    finished: Callable[[Plan], str] = lambda work: '',
) -> list[str]:
    """Make the missing runs of all plans, print a summary, and return the errors.

    Parameters
    ----------
    plans : list of Plan
        One after the other.
    workers : int, optional
        Processes; none: one for each core.
    cluster : str, optional
        Scheduler of a Dask cluster, instead of processes.
    mixed : bool
        Whether runs of different processors or versions are mixed.
    finished : function of a Plan
        Called when its runs are done; returns a line to print, '' for none.

    Raises
    ------
    MixedWorkers, NoRoom, WorkersLost
        See `one_machine` and `carry_out`; also if the cluster cannot be reached.
    """
    number = sum(len(work.tasks) for work in plans)
    problems: list[str] = []
    team: Workers | None = None
    begin = time.monotonic()
    try:
        if number:
            team = make_workers(number, workers, cluster)
        machine = one_machine(team, plans) if team is not None and not mixed else None
        with _Display(plans) as display:
            for work in plans:
                if work.tasks and team is not None:
                    problems += carry_out(work, team, display.advance(work), machine)
                line = finished(work)
                if line:
                    display.say(line)
    finally:
        if team is not None:
            team.close()
    used = f' by {team.number} workers in {time.monotonic() - begin:.0f} s' if team else ''
    kept = sum(len(work.done) for work in plans)
    print(f'{number - len(problems)} runs made{used}; {kept} there in all')
    for problem in problems:
        print(f'error: {problem}', file=sys.stderr)
    return problems


class _Display:
    """Progress and remaining time: a bar, or lines without a terminal."""

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
        """Return the function to call after each run of an experiment."""

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
        """Print a line."""
        if self._bar is not None:
            self._bar.console.print(text, markup=False, highlight=False)
        else:
            print(text, file=sys.stderr, flush=True)
