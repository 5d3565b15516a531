"""Carries out the plans of a command, with its progress on the terminal."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable

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

from maasi_sim.experiments.campaign import (
    Cluster,
    Plan,
    Processes,
    SerialExecutor,
    Workers,
    carry_out,
    one_machine,
)
from maasi_sim.experiments.results import Run

# Wall time between two lines about progress where there is no terminal [s].
_QUIET_PERIOD = 10.0


def make_workers(wanted: int | None, cluster: str | None, option: str, number: int) -> Workers:
    """Return who makes so many runs.

    Parameters
    ----------
    wanted : int or None
        Processes; None: one for each core.
    cluster : str or None
        Scheduler of a Dask cluster, instead of processes.
    option : str
        That gave it, for messages.
    number : int
        Runs to be made.

    Raises
    ------
    WorkersLost
        If the cluster cannot be reached.
    """
    if cluster is not None:
        return Cluster(cluster, option)
    processes = min(wanted or os.cpu_count() or 1, number)
    return Processes(processes) if processes > 1 else SerialExecutor()


def carry_out_all(
    plans: list[Plan],
    hire: Callable[[int], Workers],
    mixed: bool,
    finished: Callable[[Plan], str],
) -> list[str]:
    """Make the runs of all plans, say what was made, and return what went wrong.

    Parameters
    ----------
    plans : list of Plan
        One after the other.
    hire : function of a number of runs
        Returns who makes them.
    mixed : bool
        Whether runs of different processors or versions are mixed.
    finished : function of a Plan
        Called when its runs are there; returns a line to print, '' for none.

    Raises
    ------
    MixedWorkers, NoRoom, WorkersLost
        See `one_machine` and `carry_out`.
    """
    number = sum(len(work.tasks) for work in plans)
    problems: list[str] = []
    workers: Workers | None = None
    begin = time.monotonic()
    try:
        if number:
            workers = hire(number)
        machine = None
        if workers is not None and not mixed:
            machine = one_machine(workers, plans)
        with _Display(plans) as display:
            for work in plans:
                if work.tasks and workers is not None:
                    problems += carry_out(work, workers, display.advance(work), machine)
                line = finished(work)
                if line:
                    display.say(line)
    finally:
        if workers is not None:
            workers.close()
    used = f' by {workers.number} workers in {time.monotonic() - begin:.0f} s' if workers else ''
    kept = sum(len(work.done) for work in plans)
    print(f'{number - len(problems)} runs made{used}; {kept} there in all')
    for problem in problems:
        print(f'error: {problem}', file=sys.stderr)
    return problems


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
