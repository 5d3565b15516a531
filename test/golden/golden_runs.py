"""Runs whose decisions, filter updates and found targets are stored, and what is noted of each."""

import hashlib
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

from maasi_filter import IcPhdFilter, PmbFilter, SearchFilter
from maasi_planner.coordinator import Coordinator
from maasi_sim.experiments.experiment import Experiment
from maasi_sim.experiments.papers import experiments
from maasi_sim.run.buildings.mission import CuboidMission
from maasi_sim.run.buildings.scenario import CuboidScenario, mission_of
from maasi_sim.run.missions import load_mission
from maasi_sim.scenario.layering import ScenarioError
from maasi_sim.search import search

SCENARIOS = Path(__file__).resolve().parents[2] / 'config' / 'scenarios'
SEEDS = (1, 2, 3)
# Simulated time of a search at most [s], and steps of a search of buildings.
TIME_LIMIT = 120.0
STEP_LIMIT = 300

# Of one run: 'size' is the longest side of the environment [m], 'end' what the run came to, and
# every other entry a table of events, columns by name.
Recording = dict[str, Any]


class Log:
    """Notes what a run does: rows by kind of event; 'bits' is a hash of all numbers of the row."""

    def __init__(self) -> None:
        self.size = 0.0
        self.tables: dict[str, list[dict[str, Any]]] = {}
        self._step = 0

    def add(self, kind: str, **row: Any) -> None:
        """Add an event."""
        self.tables.setdefault(kind, []).append(row)

    def planned(self, _: Coordinator, decision: Any, step: int, *rest: Any) -> None:
        """Note what a planner decided at a step, if anything."""
        self._step = step
        for name, robot in [] if decision is None else decision.robots.items():
            self.add(
                'decisions',
                step=step,
                robot=name,
                chosen=int(robot.chosen),
                waypoint=robot.waypoint.tolist(),
                objective=0.0 if robot.stays else float(robot.objective[robot.chosen]),
                bits=bits(robot.waypoint, robot.positions, robot.yaws, robot.objective),
            )

    def updated(self, search_filter: SearchFilter, result: Any, measured: Any, *rest: Any) -> None:
        """Note a filter update of the step at which was planned last."""
        self.size = float(np.ptp(search_filter.bounds, axis=1).max())
        found = search_filter.own_found_targets()
        self.add(
            'updates',
            step=self._step,
            members=[item.robot for item in measured],
            clusters=len(result.clusters),
            found=len(found),
            expected=float(result.expected_number),
            explored=search_filter.exploration.explored_fraction(),
            # In an order of their own: that of equal masses is the processor's.
            mean=sorted(cluster.position.tolist() for cluster in result.clusters),
            bits=bits(
                *(item for c in result.clusters for item in (c.position, c.covariance, c.mass)),
                *(item for target in found for item in (target.position, target.covariance)),
                search_filter.exploration.values,
            ),
        )
        for target in result.newly_found:
            position = target.position.tolist()
            self.add('found', step=self._step, robot=target.robot, position=position)

    def flown(self, _: CuboidMission, record: Any, *rest: Any) -> None:
        """Note a whole search of buildings."""
        self.size = float(np.ptp(record.mission.area, axis=1).max())
        for step in range(record.steps + 1):
            places = {name: path[step] for name, path in sorted(record.paths.items())}
            self.add(
                'flights',
                step=step,
                visited=int(record.visited[step]),
                searching=int(record.active[step]),
                position=[place.tolist() for place in places.values()],
                bits=bits(*places.values()),
            )
        for shot in record.snapshots:
            self.add('snapshots', step=shot.step, robot=shot.robot, cuboid=int(shot.cuboid))

    def recording(self, end: dict[str, Any]) -> Recording:
        """Return what was noted, and what the run came to."""
        tables = {
            kind: {column: [row[column] for row in rows] for column in rows[0]}
            for kind, rows in self.tables.items()
        }
        return {'size': self.size, **tables, 'end': end}


def bits(*values: Any) -> str:
    """Return a short hash of numbers, which is another one if a bit of them is."""
    digest = hashlib.sha256()
    for value in values:
        digest.update(np.ascontiguousarray(value).tobytes())
    return digest.hexdigest()[:12]


@contextmanager
def noted() -> Iterator[Log]:
    """Note what the filters, planners and searches of buildings in this process do meanwhile."""
    log = Log()

    def noting(method: Callable[..., Any], note: Callable[..., None]) -> Callable[..., Any]:
        def noted_method(self: Any, *arguments: Any) -> Any:
            result = method(self, *arguments)
            note(self, result, *arguments)
            return result

        return noted_method

    with ExitStack() as stack:
        for kind, name, note in (
            (IcPhdFilter, 'step', log.updated),
            (PmbFilter, 'step', log.updated),
            (Coordinator, 'plan', log.planned),
            (CuboidMission, 'run', log.flown),
        ):
            stack.enter_context(patch.object(kind, name, noting(getattr(kind, name), note)))
        yield log


def run_scenario(path: Path, seed: int) -> Recording:
    """Run a scenario in this process and return what it did."""
    layers: dict[str, Any] = {'seed': (('seed',), seed)}
    scenario = load_mission(path, layers).scenario
    if isinstance(scenario, CuboidScenario):
        # A limit on wall time would make a decision depend on the machine.
        layers['time'] = ('planner', 'time_limit'), 1e9
        scenario = load_mission(path, layers).scenario
        with noted() as log:
            record = mission_of(scenario).run(STEP_LIMIT)  # type: ignore[arg-type]
        return log.recording({'steps': record.steps, 'complete': record.complete, **record.how})
    layers['limit'] = ('limits', 'time'), min(TIME_LIMIT, scenario.limits.time)
    scenario = load_mission(path, layers).scenario
    with noted() as log:
        result = search(scenario, seed)  # type: ignore[arg-type]
    end = {
        'reason': result.end_reason,
        'steps': result.steps,
        'measurements': result.measurements,
        'position': [target.position.tolist() for target in result.found_targets],
    }
    return log.recording(end)


def run_case(experiment: Experiment, index: int) -> Recording:
    """Run a small case of an experiment on its first map and return what it did."""
    with noted() as log:
        outcome = experiment.run(experiment.cases(True)[index].settings, experiment.seed(0))
    end = {
        name: value.item() if isinstance(value, np.generic) else value
        for name, value in outcome.summary.items()
    }
    return log.recording(end)


def runs() -> dict[str, dict[str, Callable[[], Recording]]]:
    """Return all golden runs: name of scenario or experiment, then what tells its runs apart."""
    known: dict[str, dict[str, Callable[[], Recording]]] = {}
    for path in sorted(SCENARIOS.glob('*.yaml')):
        try:
            load_mission(path).scenario.check_pace(True, None)
        except ScenarioError:
            continue
        known[path.stem] = {
            f'seed {seed}': lambda path=path, seed=seed: run_scenario(path, seed) for seed in SEEDS
        }
    for name, experiment in experiments().items():
        cases = experiment.cases(True)
        # Often a fixed path, and the paper's own method.
        known[name] = {
            cases[index].name: lambda e=experiment, index=index: run_case(e, index)
            for index in (0, len(cases) - 1)
        }
    return known
