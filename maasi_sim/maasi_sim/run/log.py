"""The record of a search for targets: facts in their order, counted and scored once.

Two adapters write it: `maasi_sim.search`, and `TargetObserver` from the messages of nodes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from typing import Any

import numpy as np

from maasi_filter.arrays import FloatArray
from maasi_filter.records import AgentMeasurement, Cluster, FoundTarget
from maasi_filter.unexplored_map import UnexploredMap
from maasi_planner.motion import RobotState
from maasi_planner.team import Decision
from maasi_sim.run.scores import Scores, score, scoring_radius
from maasi_sim.run.view.event_log import STATE_PERIOD, shades
from maasi_sim.scenario.schema import Scenario
from maasi_sim.simulation.world import World

_MAP_PERIOD = 1.0  # between two exploration functions without a decision [s]


@dataclass(frozen=True)
class Fact:
    """Something that happened, at a time [s]."""

    time: float


@dataclass(frozen=True)
class RobotAt(Fact):
    """Where a robot is, by its odometry: x, y, z [m] and yaw [rad]."""

    robot: str
    pose: tuple[float, ...]


@dataclass(frozen=True)
class Left(Fact):
    """A robot left the team."""

    robot: str


@dataclass(frozen=True)
class Decided(Fact):
    """A joint decision; `indices` number the decisions of each robot."""

    team: str
    decision: Decision
    indices: Mapping[str, int]
    explored: float
    duration: float = 0.0  # computation [s]


@dataclass(frozen=True)
class Measured(Fact):
    """A measurement of a robot."""

    measurement: AgentMeasurement


@dataclass(frozen=True)
class Updated(Fact):
    """An update of a filter by measurements: robots and their index."""

    step: int
    team: str
    members: Sequence[tuple[str, int]]
    found: Sequence[FoundTarget] | None  # by this filter, all of them; None: as before
    expected: float = 0.0
    clusters: Sequence[Cluster] = ()
    duration: float = 0.0  # computation [s]
    #: Where all robots are, (3,) [m]: the truth, in a search in one process.
    positions: Mapping[str, FloatArray] = field(default_factory=dict)


@dataclass(frozen=True)
class Explored(Fact):
    """The exploration function of a planner, in letters of `shades`, and the explored share."""

    team: str
    lower: FloatArray
    step: FloatArray
    letters: Any
    share: float


@dataclass(frozen=True)
class Truth(Fact):
    """The true targets, (n, d) [m]."""

    targets: FloatArray


@dataclass(frozen=True)
class Count:
    """Measurements and found targets of all robots after a filter update.

    rmse: of the true targets among those found [m], nan without any; members: that measured.
    """

    time: float
    step: int
    measurements: int
    found: int
    true_found: int
    rmse: float
    members: tuple[str, ...]
    positions: Mapping[str, FloatArray]


def numbered(found: Sequence[Sequence[FoundTarget]]) -> list[FoundTarget]:
    """Return the found targets of several filters as one list, numbered in the order of time."""
    if len(found) == 1:
        return list(found[0])
    every = sorted(chain(*found), key=lambda item: (item.time, item.robot, item.id))
    return [replace(item, id=number) for number, item in enumerate(every, start=1)]


class RunLog:
    """What happened in a search for targets, its counts and scores.

    Parameters
    ----------
    scenario : Scenario
        Of the search.
    seed : int
        Of its random numbers.
    world : World, optional
        With the true targets; none: there are none.
    keeps : bool
        Whether facts are kept, which a replay needs.

    Attributes
    ----------
    facts : list of Fact
        In their order, if they are kept.
    listeners : list of callables
        Each is called with each fact.
    measurements, distance : dict
        Number of measurements, and distance travelled, of each robot [m].
    truth : (n, d) array
        True targets [m], now.
    scores : Scores
        Of the found targets against the truth, after the last update.
    progress : list of Count
        After each update.
    completed : Count or None
        When all was found, in a search that ends then.
    end_reason : str
        'all_found', 'planner_done', 'time_limit' or 'measurement_limit'.
    steps : int
        Length of the search.
    """

    def __init__(
        self, scenario: Scenario, seed: int, world: World | None = None, keeps: bool = True
    ) -> None:
        self.scenario, self.seed = scenario, seed
        self.facts: list[Fact] = []
        self.listeners: list[Callable[[Fact], None]] = []
        self.measurements = dict.fromkeys(scenario.names(), 0)
        self.distance = dict.fromkeys(scenario.names(), 0.0)
        self.progress: list[Count] = []
        self.completed: Count | None = None
        self.end_reason, self.steps = '', 0
        self._world, self._keeps = world, keeps
        # Also of a world without targets.
        shape = (0, scenario.dimension)
        self.truth = np.asarray(np.zeros(shape) if world is None else world.targets, dtype=float)
        self._radius = scoring_radius(scenario, self.truth)
        self._found: dict[str, Sequence[FoundTarget]] = dict.fromkeys(scenario.namespaces(), ())
        self._counted: set[tuple[str, str, int]] = set()
        self._last_states = -np.inf
        self._last_maps: dict[str, float] = {}
        self.scores = self.scores_against(self.truth)

    def add(self, fact: Fact) -> None:
        """Add a fact."""
        if self._keeps:
            self.facts.append(fact)
        for listener in self.listeners:
            listener(fact)
        if isinstance(fact, Updated):
            self._count(fact)

    def add_states(self, time: float, states: Mapping[str, RobotState]) -> None:
        """Add where robots are, no more often than is shown."""
        if time - self._last_states >= STATE_PERIOD - 1e-9:
            self._last_states = time
            for name, state in states.items():
                pose = (*state.pose.position.tolist(), float(state.pose.yaw))
                self.add(RobotAt(time, name, pose))

    def add_map(self, time: float, team: str, exploration: UnexploredMap, now: bool) -> None:
        """Add an exploration function as a planner node does: once a second, and if `now`."""
        if now or time - self._last_maps.get(team, -np.inf) >= _MAP_PERIOD - 1e-9:
            self._last_maps[team] = time
            # As coarse as it is shown: a byte for each cell.
            lower, step, shown = exploration.shown()
            letters = np.frombuffer(shades(shown).encode(), 'S1').reshape(shown.shape)
            share = exploration.explored_fraction()
            self.add(Explored(time, team, lower, step, letters, share))

    def _count(self, update: Updated) -> None:
        team = update.team
        for robot, index in update.members:
            # A restarted filter republishes its last update.
            if (team, robot, index) not in self._counted:
                self._counted.add((team, robot, index))
                self.measurements[robot] = self.measurements.get(robot, 0) + 1
        if update.found is not None:
            self._found[team] = update.found
        if self._world is not None and self._world.walk > 0.0:
            self.truth = np.asarray(self._world.targets_at(update.step), dtype=float)
            if self._keeps:
                self.add(Truth(update.time, self.truth))
            self.scores = self.scores_against(self.truth)
        elif update.found is not None:
            self.scores = self.scores_against(self.truth)
        now = Count(
            update.time,
            update.step,
            sum(self.measurements.values()),
            sum(map(len, self._found.values())),
            self.scores.match.true_found,
            self.scores.match.rmse,
            tuple(robot for robot, _ in update.members),
            update.positions,
        )
        self.progress.append(now)
        complete = len(self.truth) and self.scores.complete and self.scenario.stop == 'all_found'
        if complete and self.completed is None:
            self.completed = now

    def found_by(self, team: str) -> Sequence[FoundTarget]:
        """Return the targets that a filter has found."""
        return self._found[team]

    @property
    def found_targets(self) -> list[FoundTarget]:
        """Targets found so far, of all filters."""
        return numbered(list(self._found.values()))

    def scores_against(self, truth: FloatArray) -> Scores:
        """Return the scores of what is found against true targets (n, d) [m]."""
        return score(self.found_targets, truth, self._radius, self.scenario.scoring.order)

    def end(self, step: int, reason: str) -> None:
        """Note the last step of a search, and why it ended."""
        self.steps, self.end_reason = step + 1, reason
        if self._world is not None:
            self.truth = np.asarray(self._world.targets_at(step), dtype=float)
        self.scores = self.scores_against(self.truth)

    # ---- what is asked of it -----------------------------------------------------------------

    @property
    def missed(self) -> int:
        """True targets without a found one."""
        return self.scores.match.missed

    @property
    def false_found(self) -> int:
        """Found targets without a true one."""
        return self.scores.match.false_found

    @property
    def rmse(self) -> float:
        """Of the true ones among those found [m]; nan without any."""
        return self.scores.match.rmse

    @property
    def pairs(self) -> list[tuple[int, int]]:
        """Index of a found target, and of the true one that it is."""
        return self.scores.match.pairs

    @property
    def total_measurements(self) -> int:
        """Measurements of all robots."""
        return sum(self.measurements.values())

    @property
    def complete(self) -> bool:
        """Whether all targets are found, and nothing else."""
        return self.missed == 0 and self.false_found == 0

    @property
    def decisions(self) -> list[Decision]:
        """Joint decisions."""
        return [item.decision for item in self.facts if isinstance(item, Decided)]

    @property
    def planning_times(self) -> list[float]:
        """Wall time of each decision [s]."""
        return [item.duration for item in self.facts if isinstance(item, Decided)]

    @property
    def filter_times(self) -> list[float]:
        """Wall time of each filter step [s]."""
        return [item.duration for item in self.facts if isinstance(item, Updated)]

    def paths(self) -> dict[str, FloatArray]:
        """Return where each robot was by its odometry, (n, 3) [m], ten times a second at most."""
        paths: dict[str, list[tuple[float, ...]]] = {}
        for item in self.facts:
            if isinstance(item, RobotAt):
                paths.setdefault(item.robot, []).append(item.pose[:3])
        return {name: np.array(path) for name, path in paths.items()}

    def columns(self) -> dict[str, Any]:
        """Return the progress by columns, with places of robots and whether they measured."""
        progress = self.progress
        kinds = ('step', 'time', 'measurements', 'found', 'true_found', 'rmse')
        columns: dict[str, Any] = {
            kind: [getattr(item, kind) for item in progress] for kind in kinds
        }
        for name in sorted(self.measurements):
            places = np.array([item.positions[name] for item in progress]).reshape(-1, 3)
            columns |= {f'{name}_{axis}': values for axis, values in zip('xyz', places.T)}
            columns[f'{name}_measures'] = [name in item.members for item in progress]
        return columns
