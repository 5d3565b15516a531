"""What the commands that run campaigns share: options, progress, exit codes."""

from __future__ import annotations

import argparse
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
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from maasi_sim.arguments import count
from maasi_sim.experiments.campaign import Campaign, MixedWorkers, Task, carry_out, one_machine
from maasi_sim.experiments.runs import NoRoom
from maasi_sim.experiments.workers import Workers, WorkersLost, make_workers

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


def carry_out_all(
    campaigns: list[Campaign],
    workers: int | None = None,
    cluster: str | None = None,
    mixed: bool = False,
    finished: Callable[[Campaign], str] = lambda work: '',
) -> list[str]:
    """Make the missing runs of all campaigns, print a summary, and return the errors.

    `workers` and `cluster` are those of `make_workers`; `mixed` allows runs of different
    processors or versions. `finished` is called when the runs of a campaign are done, and returns
    a line to print, '' for none.
    """
    for work in campaigns:
        for complaint in work.complaints.values():
            print(f'warning: {complaint}; this run is repeated', file=sys.stderr)
    number = sum(len(work.tasks) for work in campaigns)
    problems: list[str] = []
    team = Workers()
    begin = time.monotonic()
    try:
        if number:
            team = make_workers(number, workers, cluster)
        machine = one_machine(team, campaigns) if number and not mixed else None
        with _Display(number) as display:
            for work in campaigns:
                problems += carry_out(work, team, display.advance, machine)
                display.say(finished(work))
    finally:
        team.close()
    used = f' by {team.number} workers in {time.monotonic() - begin:.0f} s' if number else ''
    kept = sum(len(work.done) for work in campaigns)
    print(f'{number - len(problems)} runs made{used}; {kept} there in all')
    for problem in problems:
        print(f'error: {problem}', file=sys.stderr)
    return problems


class _Display:
    """Progress and remaining time: a bar, or lines without a terminal."""

    def __init__(self, total: int) -> None:
        columns = BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TextColumn('left')
        shown = sys.stderr.isatty() and total > 0
        self._bar = Progress(
            TextColumn('{task.description}'),
            *columns,
            TimeRemainingColumn(),
            console=Console(stderr=True),
            disable=not shown,
        )
        self._task = self._bar.add_task('', total=total)
        self._total = total
        self._made = 0
        self._begin = self._last = time.monotonic()

    def __enter__(self) -> _Display:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def advance(self, task: Task) -> None:
        """Count a run."""
        self._made += 1
        what = f'{task.experiment} {task.case.name}'
        self._bar.update(self._task, completed=self._made, description=what)
        now = time.monotonic()
        if self._bar.disable and now - self._last >= _QUIET_PERIOD:
            self._last = now
            left = (now - self._begin) * (self._total - self._made) / self._made
            self.say(f'{self._made} of {self._total} runs, about {left:.0f} s left ({what})')

    def say(self, text: str) -> None:
        """Print a line, if there is one."""
        if text and self._bar.disable:
            print(text, file=sys.stderr, flush=True)
        elif text:
            self._bar.console.print(text, markup=False, highlight=False)
