"""Runs the cases of an experiment on its maps: in this process, in several, or on a Dask cluster.

The seed of a run is that of the map and does not depend on the worker. Stored runs are not
repeated. Another processor or other versions may change the last bits of numbers, so that runs of
different machines are mixed only on request (docs/repeatability.md).
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from maasi_sim.experiments.cases import Case
from maasi_sim.experiments.comparison import SearchComparison
from maasi_sim.experiments.experiment import Experiment, Results
from maasi_sim.experiments.registry import find
from maasi_sim.experiments.results import DamagedRun, Run, RunFolder, from_text, run_of, to_text
from maasi_sim.machine import machine_difference, this_machine

# One thread for each worker; the number of workers sets the load.
ONE_THREAD = {
    'OMP_NUM_THREADS': '1',
    'OPENBLAS_NUM_THREADS': '1',
    'MKL_NUM_THREADS': '1',
    'NUMBA_NUM_THREADS': '1',
}
# Runs queued in advance for each worker.
_AHEAD = 2


@dataclass(frozen=True)
class Task:
    """One run to be made; plain values only, so that it can be sent to a worker.

    `settings` are those of a comparison; None: the worker finds the experiment by its name.
    """

    experiment: str
    case: str
    number: int
    seed: int
    small: bool
    digest: str
    settings: dict[str, Any] | None = None


class WorkersLost(RuntimeError):
    """The workers are lost; their finished runs are kept."""


class MixedWorkers(ValueError):
    """Processors or versions differ, and mixing was not requested."""


def execute(task: Task) -> tuple[str, str]:
    """Make a run and return the text of its file and '', or '' and the error."""
    try:
        if task.settings is None:
            experiment = find(task.experiment)
        else:
            own = [Case(task.case, task.settings)]
            experiment = SearchComparison(task.experiment, own)
        case = next((c for c in experiment.cases(task.small) if c.name == task.case), None)
        if case is None or case.digest() != task.digest:
            return '', 'this worker has other settings of this case: another version of the code'
        seed = experiment.seed(task.number, task.seed)
        begin = time.process_time()
        outcome = experiment.run(case.settings, seed)
        outcome.timing['processor_time'] = time.process_time() - begin
        run = run_of(experiment.name, case, task.number, seed, outcome)
        run.machine = this_machine()
        return to_text(run), ''
    except Exception as error:
        return '', f'{type(error).__name__}: {error}'


class Workers(Protocol):
    """Executes runs."""

    number: int

    def machines(self) -> Mapping[str, dict[str, str]]:
        """Return the machine of each of them by its name, as `this_machine` has it."""

    def make(self, tasks: Sequence[Task]) -> Iterator[tuple[Task, str, str]]:
        """Yield each task with the result of `execute`, in the order of completion."""

    def close(self) -> None:
        """Shut down; pending runs are abandoned."""


class SerialExecutor:
    """Runs in this process."""

    number = 1

    def machines(self) -> Mapping[str, dict[str, str]]:
        """See `Workers.machines`."""
        return {'this process': this_machine()}

    def make(self, tasks: Sequence[Task]) -> Iterator[tuple[Task, str, str]]:
        """See `Workers.make`."""
        for task in tasks:
            yield (task, *execute(task))

    def close(self) -> None:
        """See `Workers.close`."""


def _begin_worker() -> None:
    # The main process handles Ctrl-C and shuts down its workers.
    signal.signal(signal.SIGINT, signal.SIG_IGN)


class Processes:
    """Several processes on this machine, one thread each.

    Parameters
    ----------
    number : int
        How many.
    """

    def __init__(self, number: int) -> None:
        self.number = number
        before = {name: os.environ.get(name) for name in ONE_THREAD}
        os.environ.update(ONE_THREAD)
        try:
            # Spawned: a fresh interpreter on every system.
            self._pool = ProcessPoolExecutor(
                number, multiprocessing.get_context('spawn'), initializer=_begin_worker
            )
            # Start the processes while the environment is set.
            list(self._pool.map(_nothing, range(number)))
        finally:
            for name, value in before.items():
                if value is None:
                    os.environ.pop(name, None)
                else:
                    os.environ[name] = value

    def machines(self) -> Mapping[str, dict[str, str]]:
        """See `Workers.machines`."""
        return {'this machine': this_machine()}

    def make(self, tasks: Sequence[Task]) -> Iterator[tuple[Task, str, str]]:
        """See `Workers.make`."""
        left = list(reversed(tasks))
        waiting: dict[Future[tuple[str, str]], Task] = {}
        try:
            while left or waiting:
                while left and len(waiting) < _AHEAD * self.number:
                    task = left.pop()
                    waiting[self._pool.submit(execute, task)] = task
                for future in wait(waiting, return_when=FIRST_COMPLETED).done:
                    yield (waiting.pop(future), *future.result())
        except BrokenProcessPool:
            raise WorkersLost('a worker died; the same command resumes') from None

    def close(self) -> None:
        """See `Workers.close`."""
        workers = list((self._pool._processes or {}).values())
        self._pool.shutdown(wait=False, cancel_futures=True)
        for worker in workers:
            with contextlib.suppress(OSError, ValueError):
                worker.terminate()


def _nothing(number: int) -> None:
    time.sleep(0.01)


class Cluster:
    """A Dask cluster.

    Parameters
    ----------
    address : str
        Of its scheduler, such as 'tcp://127.0.0.1:8786'.
    patience : float
        Longest wait for the scheduler and a first worker [s].

    Raises
    ------
    WorkersLost
        If there is no scheduler, or it has no workers.
    """

    def __init__(self, address: str, patience: float = 20.0) -> None:
        try:
            from distributed import Client
        except ImportError:
            raise WorkersLost("a cluster needs the package 'dask[distributed]'") from None
        try:
            self._client: Any = Client(address, timeout=patience, set_as_default=False)
        except (OSError, ValueError) as error:
            raise WorkersLost(f'cluster: no scheduler answers at {address}: {error}') from None
        try:
            self._client.wait_for_workers(1, timeout=patience)
        except TimeoutError:
            self._client.close()
            raise WorkersLost(f'cluster: the scheduler at {address} has no workers') from None
        self.number = sum(self._client.nthreads().values())

    def machines(self) -> Mapping[str, dict[str, str]]:
        """See `Workers.machines`."""
        try:
            return dict(sorted(self._client.run(this_machine).items()))
        except Exception as error:
            self.close()
            raise WorkersLost(f'cluster: {type(error).__name__}: {error}') from None

    def make(self, tasks: Sequence[Task]) -> Iterator[tuple[Task, str, str]]:
        """See `Workers.make`."""
        from distributed import as_completed

        # One retry if a worker is lost; not pure, so that equal tasks are not merged.
        futures = {
            self._client.submit(execute, task, pure=False, retries=1): task for task in tasks
        }
        for future in as_completed(futures, loop=self._client.loop):
            try:
                result = future.result()
            except Exception as error:
                raise WorkersLost(f'cluster: {type(error).__name__}: {error}') from None
            yield (futures[future], *result)
            future.release()

    def close(self) -> None:
        """See `Workers.close`."""
        self._client.close()


@dataclass
class Plan:
    """Work plan of one experiment.

    Attributes
    ----------
    experiment : Experiment
        Which.
    cases : list of Case
        Its cases.
    done : dict
        Stored runs, by case and map.
    tasks : list of Task
        Missing runs, map by map: an interrupted campaign has all cases on the first maps.
    folder : RunFolder
        Folder of the runs.
    complaints : list of str
        Damaged files.
    """

    experiment: Experiment
    cases: list[Case]
    done: dict[tuple[str, int], Run]
    tasks: list[Task]
    folder: RunFolder
    complaints: list[str]

    def results(self) -> Results:
        """Return the stored runs."""
        runs: dict[str, list[Run]] = {case.name: [] for case in self.cases}
        for (name, _), run in sorted(self.done.items(), key=lambda item: item[0][1]):
            runs[name].append(run)
        return Results(self.experiment, self.cases, runs)


def plan(
    experiment: Experiment,
    out: Path,
    runs: int,
    seed: int = 1,
    small: bool = False,
    first: int = 0,
) -> Plan:
    """Compare the stored runs with the wanted ones, and return the work plan.

    Parameters
    ----------
    experiment : Experiment
        Which.
    out : Path
        Folder of all experiments.
    runs : int
        Maps.
    seed : int
        Of the campaign.
    small : bool
        Whether to use the small cases.
    first : int
        Number of the first map.
    """
    folder = RunFolder(out / experiment.name, experiment.name)
    result = Plan(experiment, experiment.cases(small), {}, [], folder, [])
    sent = isinstance(experiment, SearchComparison)
    for number in range(first, first + runs):
        for case in result.cases:
            if case.runs is not None and number - first >= case.runs:
                continue
            try:
                run = folder.load(case, number, experiment.seed(number, seed))
            except DamagedRun as error:
                result.complaints.append(f'{error}; this run is repeated')
                run = None
            if run is not None:
                result.done[case.name, number] = run
            else:
                settings = case.settings if sent else None
                result.tasks.append(
                    Task(experiment.name, case.name, number, seed, small, case.digest(), settings)
                )
    return result


def one_machine(workers: Workers, plans: Sequence[Plan]) -> dict[str, str]:
    """Return the machine that all workers and stored runs have in common.

    Runs of files without a machine count as made on the same.

    Raises
    ------
    MixedWorkers
        If there is none; names the difference.
    """
    machines = workers.machines()
    first, machine = next(iter(machines.items()))
    for name, other in machines.items():
        difference = machine_difference(machine, other)
        if difference:
            raise MixedWorkers(f'worker {name} differs from worker {first}: {difference}')
    for work in plans:
        cases = {case.name: case for case in work.cases}
        for (case, number), run in work.done.items() if work.tasks else ():
            difference = machine_difference(machine, run.machine) if run.machine else ''
            if difference:
                file = work.folder.file(cases[case], number)
                raise MixedWorkers(f'{file} was made on another machine: {difference}')
    return machine


def carry_out(
    work: Plan,
    workers: Workers,
    advance: Callable[[Run | None], None] = lambda run: None,
    machine: Mapping[str, str] | None = None,
) -> list[str]:
    """Make the missing runs of a plan, store each when it is done, and return the errors.

    Parameters
    ----------
    work : Plan
        Finished runs are added to `done`.
    workers : Workers
        That make the runs.
    advance : function
        Called after each run, with None if it failed.
    machine : mapping, optional
        On which all runs must have been made, also by workers that join later; None: any.

    Raises
    ------
    NoRoom
        If a run cannot be written; earlier ones are kept.
    WorkersLost
        If the workers are lost.
    """
    cases = {case.name: case for case in work.cases}
    problems = []
    for task, text, problem in workers.make(work.tasks):
        run = None if problem else from_text(text)
        if run is not None and machine is not None:
            difference = machine_difference(machine, run.machine)
            problem = difference and f'not kept, made by a different worker: {difference}'
        if run is None or problem:
            problems.append(f'{task.experiment}, {task.case}, map {task.number}: {problem}')
            advance(None)
            continue
        work.folder.write(cases[task.case], task.number, text)
        work.done[task.case, task.number] = run
        advance(run)
    return problems
