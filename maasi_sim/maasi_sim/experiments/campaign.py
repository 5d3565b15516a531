"""Runs the cases of experiments on their maps, and keeps the runs.

The seed of a run is that of the map and does not depend on the worker. Stored runs are not
repeated. Another processor or other versions may change the last bits of numbers, so that runs of
different machines are mixed only on request (docs/repeatability.md).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from maasi_sim.experiments.experiment import Case, Experiment, Outcome, Results, Run
from maasi_sim.experiments.runs import DamagedRun, RunFolder, run_of
from maasi_sim.experiments.workers import Workers
from maasi_sim.machine import code_digest, machine_difference


@dataclass(frozen=True)
class Task:
    """One run to be made, by a function of settings and seed; it can be sent to a worker."""

    experiment: str
    case: Case
    number: int
    seed: int
    run: Callable[[dict[str, Any], int], Outcome]
    code: str


class MixedWorkers(ValueError):
    """Processors or versions differ, and mixing was not requested."""


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
    """The runs of one experiment: those that are there, by case and map, and those to be made.

    Tasks go map by map: an interrupted campaign has all cases on the first maps. Complaints are by
    damaged file.
    """

    experiment: Experiment
    cases: dict[str, Case]
    folder: RunFolder
    done: dict[tuple[str, int], Run] = field(default_factory=dict)
    tasks: list[Task] = field(default_factory=list)
    complaints: dict[Path, str] = field(default_factory=dict)

    def file(self, case: str, number: int) -> Path:
        """Return the file of a run."""
        return self.folder.file(self.cases[case], number)

    def results(self) -> Results:
        """Return the stored runs."""
        runs: dict[str, list[Run]] = {name: [] for name in self.cases}
        for (name, _), run in sorted(self.done.items(), key=lambda item: item[0][1]):
            runs[name].append(run)
        return Results(self.experiment, list(self.cases.values()), runs)


def plan(
    experiment: Experiment,
    out: Path,
    runs: int,
    seed: int = 1,
    small: bool = False,
    first: int = 0,
) -> Campaign:
    """Compare the stored runs in the folder of all experiments with the wanted ones.

    Wanted are `runs` maps from number `first`, with the seed of the campaign.
    """
    cases = {case.name: case for case in experiment.cases(small)}
    result = Campaign(experiment, cases, RunFolder(out / experiment.name, experiment.name))
    for number in range(first, first + runs):
        for case in cases.values():
            if number - first >= experiment.maps_of(case, runs):
                continue
            map_seed = experiment.seed(number, seed)
            try:
                run = result.folder.load(case, number, map_seed)
            except DamagedRun as error:
                result.complaints[result.folder.file(case, number)] = str(error)
                run = None
            if run is not None:
                result.done[case.name, number] = run
            else:
                task = Task(experiment.name, case, number, map_seed, experiment.run, code_digest())
                result.tasks.append(task)
    return result


def one_machine(workers: Workers, campaigns: Sequence[Campaign]) -> dict[str, str]:
    """Return the machine that all workers and stored runs have in common; raise MixedWorkers."""
    first, machine = next(iter(workers.machines.items()))
    for name, other in workers.machines.items():
        difference = machine_difference(machine, other)
        if difference:
            raise MixedWorkers(f'worker {name} differs from worker {first}: {difference}')
    for work in campaigns:
        for (case, number), run in work.done.items() if work.tasks else ():
            difference = machine_difference(machine, run.machine)
            if difference:
                file = work.file(case, number)
                raise MixedWorkers(f'{file} was made on another machine: {difference}')
    return machine


def carry_out(
    work: Campaign,
    workers: Workers,
    advance: Callable[[Task], None] = lambda task: None,
    machine: Mapping[str, str] | None = None,
) -> list[str]:
    """Make the missing runs of a campaign, store each when it is done, and return the errors.

    `advance` is called after each run. With a `machine`, all must have been made on it, also by
    workers that join later.
    """
    problems = []
    for task, run in workers.make(execute, work.tasks):
        problem = run if isinstance(run, str) else ''
        if not problem and machine is not None:
            difference = machine_difference(machine, run.machine)
            problem = difference and f'not kept, made by a different worker: {difference}'
        if problem:
            problems.append(f'{task.experiment}, {task.case.name}, map {task.number}: {problem}')
        else:
            work.folder.write(task.case, run)
            work.done[task.case.name, task.number] = run
        advance(task)
    return problems
