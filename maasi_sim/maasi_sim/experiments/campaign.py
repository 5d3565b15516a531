"""Makes and keeps the runs of experiments; seeds do not depend on the worker."""

import argparse
import contextlib
import multiprocessing
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any, TypeVar

from maasi_filter.wording import counted
from maasi_sim.arguments import count
from maasi_sim.experiments.experiment import Case, Experiment, Outcome, Results, Run, WrongInput
from maasi_sim.experiments.runs import DamagedRun, NoRoom, load_run, run_of, to_text, write_file
from maasi_sim.machine import code_digest, machine_difference, this_machine
from maasi_sim.run.progress import ProgressDisplay
from maasi_sim.scenario.layering import ScenarioError, print_warnings_plainly

Item = TypeVar('Item')

DONE, SOME_FAILED, WRONG_INPUT, STOPPED, INTERRUPTED = 0, 1, 2, 3, 130
EXIT_CODES = (
    'Exit codes: 0 all runs are done, 1 some failed, 2 wrong input, 3 stopped: disk full or '
    'workers lost, 130 interrupted.'
)
PATIENCE = 20.0  # longest wait for the scheduler of a cluster and for its first worker [s]
# One thread for each worker; the number of workers sets the load.
_ONE_THREAD = ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS', 'NUMBA_NUM_THREADS')
_MIXED = '--mixed-workers allows it'
_QUIET_PERIOD = 10.0  # wall time between two lines of progress without a terminal [s]


class WorkersLost(RuntimeError):
    """The workers are lost; their finished runs are kept."""


@dataclass
class Workers:
    """An executor of runs, or none: this process; `machines` are those of the workers by name."""

    executor: Executor | None = None
    number: int = 1
    machines: dict[str, dict[str, str]] = field(
        default_factory=lambda: {'this machine': this_machine()}
    )
    close: Callable[[], None] = lambda: None

    def make(
        self, function: Callable[[Item], Any], items: Sequence[Item]
    ) -> Iterator[tuple[Item, Any]]:
        """Yield each item with its result, in the order of completion."""
        if self.executor is None:
            yield from ((item, function(item)) for item in items)
            return
        try:
            waiting = {self.executor.submit(function, item): item for item in items}
            for future in as_completed(waiting):
                yield waiting.pop(future), future.result()
        except Exception as error:
            reason = str(error) or type(error).__name__
            raise WorkersLost(f'a worker died: {reason}') from None


def make_workers(number: int, wanted: int | None = None, cluster: str | None = None) -> Workers:
    """Return workers for `number` runs: at most the wanted processes, or a Dask cluster's."""
    if cluster is not None:
        return _of_cluster(cluster)
    processes = min(wanted or os.cpu_count() or 1, number)
    if processes <= 1:
        return Workers()
    # Spawned: a fresh interpreter on every system.
    pool = ProcessPoolExecutor(processes, multiprocessing.get_context('spawn'), _begin)
    before = dict(os.environ)
    os.environ.update(dict.fromkeys(_ONE_THREAD, '1'))

    def close() -> None:
        workers = list((pool._processes or {}).values())
        pool.shutdown(wait=False, cancel_futures=True)
        for worker in workers:
            with contextlib.suppress(OSError, ValueError):
                worker.terminate()
        os.environ.clear()
        os.environ.update(before)

    return Workers(pool, processes, close=close)


def _begin() -> None:
    # The main process handles Ctrl-C and shuts down its workers.
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _of_cluster(address: str) -> Workers:
    try:
        from distributed import Client
    except ImportError:
        raise WorkersLost("a cluster needs the package 'dask[distributed]'") from None
    try:
        client: Any = Client(address, timeout=PATIENCE, set_as_default=False)
    except (OSError, ValueError) as error:
        raise WorkersLost(f'cluster: no scheduler answers at {address}: {error}') from None
    try:
        client.wait_for_workers(1, timeout=PATIENCE)
        machines = dict(sorted(client.run(this_machine).items()))
    except TimeoutError:
        client.close()
        raise WorkersLost(f'cluster: the scheduler at {address} has no workers') from None
    except Exception as error:
        client.close()
        raise WorkersLost(f'cluster: {type(error).__name__}: {error}') from None
    # One retry if a worker is lost; not pure, so that equal tasks are not merged.
    executor = client.get_executor(pure=False, retries=1)
    return Workers(executor, sum(client.nthreads().values()), machines, client.close)


@dataclass(frozen=True)
class Task:
    """One run to be made, by a function of settings and seed; it can be sent to a worker."""

    experiment: str
    case: Case
    number: int
    seed: int
    run: Callable[[dict[str, Any], int], Outcome]
    code: str


def execute(task: Task) -> Run | str:
    """Make a run and return it, or the error."""
    try:
        if task.code != code_digest():
            return 'this worker has another version of the code'
        begin = time.process_time()
        outcome = task.run(task.case.settings, task.seed)
        outcome.timing['processor_time'] = time.process_time() - begin
        return run_of(task.experiment, task.case, task.number, task.seed, outcome)
    except Exception as error:
        return f'{type(error).__name__}: {error}'


@dataclass
class Campaign:
    """The runs of one experiment: those that are there, by case and map, and those to be made."""

    experiment: Experiment
    cases: dict[str, Case]
    folder: Path
    done: dict[tuple[str, int], Run] = field(default_factory=dict)
    tasks: list[Task] = field(default_factory=list)
    complaints: dict[Path, str] = field(default_factory=dict)  # by damaged file

    def file(self, case: str, number: int) -> Path:
        """Return the file of a run."""
        return self.folder / 'runs' / f'{self.cases[case].slug}-{number:04d}.json'

    def results(self) -> Results:
        """Return the stored runs."""
        runs: dict[str, list[Run]] = {name: [] for name in self.cases}
        for (name, _), run in sorted(self.done.items(), key=lambda item: item[0][1]):
            runs[name].append(run)
        return Results(self.experiment, list(self.cases.values()), runs)

    def carry_out(
        self,
        workers: Workers,
        advance: Callable[[Task], None] = lambda task: None,
        machine: dict[str, str] | None = None,
    ) -> list[str]:
        """Make the missing runs, store each when it is done, and return the errors.

        `advance` is called after each. With a `machine`, runs of others are not kept.
        """
        problems = []
        for task, run in workers.make(execute, self.tasks):
            problem = run if isinstance(run, str) else ''
            if not problem and machine is not None:
                difference = machine_difference(machine, run.machine)
                problem = difference and f'not kept, made by a different worker: {difference}'
            if problem:
                problems.append(
                    f'{task.experiment}, {task.case.name}, map {task.number}: {problem}'
                )
            else:
                write_file(self.file(task.case.name, task.number), to_text(run))
                self.done[task.case.name, task.number] = run
            advance(task)
        return problems


def maps_in(folder: Path) -> int:
    """Return the largest number of a map with runs in the folder of an experiment, plus one."""
    files = (folder / 'runs').glob('*-[0-9][0-9][0-9][0-9].json')
    return max((int(path.stem.rsplit('-', 1)[1]) for path in files), default=-1) + 1


def plan(
    experiment: Experiment, out: Path, runs: int, seed: int = 1, small: bool = False, first: int = 0
) -> Campaign:
    """Compare the stored runs with the wanted ones: `runs` maps from number `first`."""
    cases = {case.name: case for case in experiment.cases(small)}
    result = Campaign(experiment, cases, out / experiment.name)
    for number in range(first, first + runs):
        for case in cases.values():
            if number - first >= experiment.maps_of(case, runs):
                continue
            wanted = experiment.name, case.name, number, experiment.seed(number, seed)
            file = result.file(case.name, number)
            try:
                run = load_run(file) if file.exists() else None
            except DamagedRun as error:
                result.complaints[file] = str(error)
                run = None
            found = run and (run.experiment, run.case, run.number, run.seed, run.digest)
            if run is not None and found == (*wanted, case.digest()):
                result.done[case.name, number] = run
            else:
                task = Task(wanted[0], case, number, wanted[3], experiment.run, code_digest())
                result.tasks.append(task)
    return result


def one_machine(workers: Workers, campaigns: Sequence[Campaign]) -> dict[str, str]:
    """Return the machine that all workers and stored runs have in common; raise WrongInput."""
    first, machine = next(iter(workers.machines.items()))
    for name, other in workers.machines.items():
        difference = machine_difference(machine, other)
        if difference:
            raise WrongInput(f'worker {name} differs from worker {first}: {difference}; {_MIXED}')
    for work in campaigns:
        for (case, number), run in work.done.items() if work.tasks else ():
            difference = machine_difference(machine, run.machine)
            if difference:
                file = work.file(case, number)
                raise WrongInput(f'{file} was made on another machine: {difference}; {_MIXED}')
    return machine


# Of the commands.


def add_worker_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `carry_out_all`."""
    add = parser.add_argument
    add('--jobs', type=count, metavar='N', help='run N processes (default: one per core)')
    add('--cluster', metavar='ADDRESS', help='run on the Dask cluster with this scheduler')
    add(
        '--mixed-workers',
        action='store_true',
        help='allow workers with different processors or versions; results may differ in the last '
        'bits',
    )


def run_command(command: Callable[[], int]) -> int:
    """Run a command that can be interrupted, and return its exit code; errors are printed."""

    def interrupt(number: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    print_warnings_plainly()
    signal.signal(signal.SIGTERM, interrupt)
    signal.signal(signal.SIGINT, interrupt)
    try:
        return command()
    except (WrongInput, ScenarioError) as error:
        text, code = str(error), WRONG_INPUT
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

    `mixed` allows runs of different machines; `finished` returns a line to print after a campaign.
    """
    for work in campaigns:
        for complaint in work.complaints.values():
            print(f'warning: {complaint}; this run is repeated', file=sys.stderr)
    number = sum(len(work.tasks) for work in campaigns)
    problems: list[str] = []
    team = Workers()
    display = ProgressDisplay(period=_QUIET_PERIOD)
    tasks = (task for work in campaigns for task in work.tasks)
    cases = list(dict.fromkeys(f'{task.experiment} {task.case.name}' for task in tasks))
    made = 0
    begin = time.monotonic()

    def advance(task: Task) -> None:
        nonlocal made
        made += 1
        left = (time.monotonic() - begin) * (number - made) / made
        what = f'{task.experiment} {task.case.name}'
        what += f', case {cases.index(what) + 1} of {len(cases)}'
        display.show(f'{made} of {counted(number, "run")}, about {left:.0f} s left ({what})', 0)

    try:
        if number:
            display.update(
                f'0 of {counted(number, "run")}, of {counted(len(cases), "case")}', quiet=True
            )
            team = make_workers(number, workers, cluster)
        machine = one_machine(team, campaigns) if number and not mixed else None
        for work in campaigns:
            problems += work.carry_out(team, advance, machine)
            text = finished(work)
            if text:
                display.say(text)
    finally:
        display.close()
        team.close()
    used = (
        f' by {counted(team.number, "worker")} in {time.monotonic() - begin:.0f} s'
        if number
        else ''
    )
    kept = sum(len(work.done) for work in campaigns)
    print(f'{counted(number - len(problems), "run")} made{used}; {kept} stored in all')
    for problem in problems:
        print(f'error: {problem}', file=sys.stderr)
    return problems
