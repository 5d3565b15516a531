"""The record of a run: its facts, counts and scores.

`maasi_sim.search` writes it, and an `Observer` from the messages of nodes.
"""

from __future__ import annotations

import math
from array import array
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from maasi_filter.arrays import FloatArray
from maasi_filter.models.pose import Pose
from maasi_filter.records import FoundTarget
from maasi_filter.reports import Report
from maasi_filter.unexplored_map import UnexploredMap
from maasi_planner.motion import RobotState
from maasi_planner.team import Decision
from maasi_sim.run import facts
from maasi_sim.run.scores import Scoreboard, Scores, numbered, scoring_radius
from maasi_sim.run.view.event_log import STATE_PERIOD, shades
from maasi_sim.scenario.base import BaseScenario
from maasi_sim.scenario.schema import Scenario
from maasi_sim.simulation.world import World

UNAVAILABLE = 5  # goal status of `AgentState`
_MAP_PERIOD = 1.0  # between two exploration functions without a decision [s]


@dataclass(frozen=True)
class RunEnd:
    """How a run ended."""

    reason: str  # a key of `END_REASONS`
    time: float  # simulated [s]
    wall_time: float  # from the first step [s]
    events: Sequence[dict[str, Any]] = ()
    began: float | None = None  # Unix time of the first step [s]; None: no time of the day


@dataclass(frozen=True)
class Count:
    """Measurements and found targets of all robots after a filter update.

    Attributes
    ----------
    time : float
        Since the first step [s].
    step : int
        Step of the update.
    measurements, found, true_found : int
        Numbers until then.
    rmse : float
        Of the true finds [m]; nan without any.
    members : tuple of str
        Robots that measured.
    positions : dict of (3,) arrays
        Positions of the robots [m, map].
    """

    time: float
    step: int
    measurements: int
    found: int
    true_found: int
    rmse: float
    members: tuple[str, ...]
    positions: Mapping[str, FloatArray]


class RunRecord:
    """Record of a run of any mission.

    events: lost and joined robots and notes of the run ('time' [s], 'agent', 'event').
    distance: path length of each robot [m], in runs of nodes set at the end. end_reason: a key
    of `END_REASONS`. end_time, wall_time: simulated and wall time [s]. began: Unix time of the
    first step [s], None if the times of the run are no times of the day.
    """

    def __init__(self, scenario: BaseScenario, seed: int, name: str = '') -> None:
        self.name, self.scenario, self.seed = name, scenario, seed
        self.events: list[dict[str, Any]] = []
        self.last_steps: dict[str, int] = {}
        self.distance = dict.fromkeys(scenario.names(), 0.0)
        self.end_reason, self.end_time, self.wall_time = '', 0.0, 0.0
        self.began: float | None = None
        # Time and position of the states of each robot; an hour needs 2 MB.
        self._path = {name: array('d') for name in scenario.names()}
        # Statements of persons by filter.
        self._reports: dict[str, list[Report]] = defaultdict(list)
        # Time and charge of its battery, after each change.
        self._charges: dict[str, list[tuple[float, float]]] = {
            name: [] for name in scenario.names()
        }
        self.team = set(scenario.names())  #: robots of the team
        self._lost: set[str] = set()

    def add(self, fact: facts.Fact) -> None:
        """Add a fact."""
        match fact:
            case facts.RobotAt(time, robot, pose, charge, status, reason, step) if (
                robot in self._path
            ):
                if math.isfinite(sum(pose)):
                    self._path[robot].extend((time, *pose[:3]))
                charges = self._charges[robot]
                if charge >= 0.0 and not (charges and charges[-1][1] == charge):
                    charges.append((time, charge))
                self.last_steps[robot] = step
                if status == UNAVAILABLE or robot in self._lost:
                    self._note_lost(time, robot, status == UNAVAILABLE, reason)
            case facts.Present(_, robots):
                self.team = set(robots)
            case facts.Joined(time, robot) if robot in self._path:
                self.team.add(robot)
                self._note_lost(time, robot, False)
            case facts.Left(time, robot) if robot in self._path:
                self.team.discard(robot)
                self._note_lost(time, robot, True)
            case facts.Reported(time, team, report):
                if report is None:
                    self._reports[team].clear()
                else:
                    self._reports[team].append(report)
                    self._note(time, report.source or 'a person', str(report))

    def _note_lost(self, time: float, robot: str, lost: bool, reason: str = '') -> None:
        # A robot that left stays lost, even if its driver still publishes.
        lost = lost or robot not in self.team
        if lost != (robot in self._lost):
            self._lost ^= {robot}
            # Before the first step robots become ready.
            if time >= 0.0:
                because = {'reason': reason} if lost and reason else {}
                self._note(time, robot, 'lost' if lost else 'joined', **because)

    def _note(self, time: float, robot: str, event: str, **more: str) -> None:
        self.events.append({'time': time, 'agent': robot, 'event': event, **more})

    def takes_part(self, robot: str) -> bool:
        """Return whether a robot is in the team and can continue."""
        return robot not in self._lost

    @property
    def trajectories(self) -> dict[str, FloatArray]:
        """Odometry positions of each robot: time [s], x, y, z [m], (n, 4)."""
        return {name: np.array(path).reshape(-1, 4) for name, path in self._path.items()}

    def reports(self) -> list[Report]:
        """Return the statements of persons until the end, in order; what several filters got once.

        Their times are those of the run.
        """
        found: dict[tuple[object, ...], Report] = {}
        for report in (item for reports in self._reports.values() for item in reports):
            what = report.kind, report.target, report.zone, *report.position, report.radius
            found.setdefault((*what, report.weight, report.source), report)
        return sorted(
            (item for item in found.values() if item.time <= self.end_time),
            key=lambda item: item.time,
        )

    def charges(self, robot: str) -> list[float]:
        """Return the charges of a robot's battery until the end, 0 to 1; empty: unknown."""
        return [charge for time, charge in self._charges[robot] if time <= self.end_time]

    def close(self, end: RunEnd, until: float) -> None:
        """Note the end of a run of nodes and drop later data; `until` in s."""
        self.end_reason, self.end_time, self.wall_time = end.reason, until, end.wall_time
        self.began = end.began
        for name, path in self.trajectories.items():
            path = path[path[:, 0] <= until]
            self._path[name] = array('d', path.ravel())
            self.distance[name] = float(np.linalg.norm(np.diff(path[:, 1:], axis=0), axis=1).sum())
        events = [event for event in self.events if event['time'] <= until]
        self.events = sorted([*events, *end.events], key=lambda event: float(event['time']))


class RunLog(RunRecord):
    """Log of a search for targets, with its counts and scores.

    Parameters
    ----------
    scenario : Scenario
        Of the search.
    seed : int
        Of its random numbers.
    world : World, optional
        With the true targets; none: there are none.
    name : str
        Of the run.
    keeps : bool
        Whether facts are kept, which a replay needs.

    Attributes
    ----------
    facts : list of facts.Fact
        In their order, if they are kept.
    listeners : list of callables
        Each is called with each fact.
    measurements : dict
        Number of measurements of each robot.
    waypoints : dict
        Step and position (3,) [m] of the chosen waypoints of each robot.
    measured_from : dict
        Time [s] and pose of the measurements of each robot.
    explored : float
        Share that is explored, by the planner that reports most of it.
    truth : (n, d) array
        True targets [m], now.
    scores : Scores
        Of the found targets against the truth, after the last update.
    progress : list of Count
        After each update.
    completed : Count or None
        When all was found, in a search that ends then.
    steps : int
        Length of a search in one process.
    """

    scenario: Scenario
    scores: Scores

    def __init__(
        self,
        scenario: Scenario,
        seed: int,
        world: World | None = None,
        name: str = '',
        keeps: bool = True,
    ) -> None:
        super().__init__(scenario, seed, name)
        self.facts: list[facts.Fact] = []
        self.listeners: list[Callable[[facts.Fact], None]] = []
        self.waypoints: dict[str, list[tuple[int, FloatArray]]] = defaultdict(list)
        self.measured_from: dict[str, list[tuple[float, Pose]]] = defaultdict(list)
        self._shares: dict[str, float] = {}
        self.steps = 0
        self._world, self._keeps = world, keeps
        self._last_states = -np.inf
        self._last_maps: dict[str, float] = {}
        self._begin_counts()

    def _begin_counts(self) -> None:
        # Also for a world without targets.
        none = np.zeros((0, self.scenario.dimension))
        self.truth = np.asarray(none if self._world is None else self._world.targets, dtype=float)
        radius = scoring_radius(self.scenario, self.truth)
        self._board = Scoreboard(radius, self.scenario.scoring.order, self.truth)
        self._board.found = dict.fromkeys(self.scenario.namespaces(), ())
        self.measurements = dict.fromkeys(self.scenario.names(), 0)
        self.progress: list[Count] = []
        self.completed: Count | None = None
        self._counted: set[tuple[str, str, int]] = set()
        self.scores = self.scores_against(self.truth)

    def add(self, fact: facts.Fact) -> None:
        """Add a fact."""
        if self._keeps:
            self.facts.append(fact)
        for listener in self.listeners:
            listener(fact)
        super().add(fact)
        match fact:
            case facts.Decided(team=team, decision=decision, explored=share):
                self._shares[team] = share
                for robot, choice in decision.robots.items():
                    if choice.chosen >= 0 and robot in self._path:
                        self.waypoints[robot].append((decision.step, choice.waypoint))
            case facts.Measured(time=time, robot=robot, pose=Pose() as pose, batch=batch):
                if batch and robot in self._path:
                    self.measured_from[robot].append((time, pose))
            case facts.Updated():
                self._count(fact)

    def add_states(self, time: float, states: Mapping[str, tuple[RobotState, float, int]]) -> None:
        """Add states of robots, with charges and goal statuses, at the rate of the page."""
        if time - self._last_states >= STATE_PERIOD - 1e-9:
            self._last_states = time
            for name, (state, charge, status) in states.items():
                pose = (*state.pose.position.tolist(), float(state.pose.yaw))
                self.add(facts.RobotAt(time, name, pose, charge, status))

    def add_map(self, time: float, team: str, exploration: UnexploredMap, now: bool) -> None:
        """Add an exploration function as a planner node does: once per second, and if `now`."""
        if now or time - self._last_maps.get(team, -np.inf) >= _MAP_PERIOD - 1e-9:
            self._last_maps[team] = time
            # At the resolution of the page: one byte per cell.
            lower, step, shown = exploration.shown()
            letters = np.frombuffer(shades(shown).encode(), 'S1').reshape(shown.shape)
            share = exploration.explored_fraction()
            self.add(facts.Explored(time, team, lower, step, letters, share))

    def _count(self, update: facts.Updated) -> None:
        team = update.team
        for robot, index in update.members:
            # A restarted filter repeats its last update.
            if robot in self._path and (team, robot, index) not in self._counted:
                self._counted.add((team, robot, index))
                self.measurements[robot] += 1
        if update.found is not None:
            self._board.found[team] = update.found
        if self._world is not None and self._world.walk > 0.0:
            self.truth = np.asarray(self._world.targets_at(update.step), dtype=float)
            if self._keeps:
                self.add(facts.Truth(update.time, self.truth))
            self.scores = self.scores_against(self.truth)
        elif update.found is not None:
            self.scores = self.scores_against(self.truth)
        now = Count(
            update.time,
            update.step,
            sum(self.measurements.values()),
            sum(map(len, self._board.found.values())),
            self.scores.match.true_found,
            self.scores.match.rmse,
            tuple(robot for robot, _ in update.members),
            update.positions,
        )
        self.progress.append(now)
        complete = len(self.truth) and self.scores.complete and self.scenario.stop == 'all_found'
        if complete and self.completed is None:
            self.completed = now

    def recount(self, updates: Sequence[facts.Updated]) -> None:
        """Count again, by step and team instead of arrival."""
        self._begin_counts()
        for update in sorted(updates, key=lambda item: (item.step, item.team, item.batch)):
            if self.completed is not None and update.step > self.completed.step:
                break
            self._count(update)

    def found_by(self, team: str) -> Sequence[FoundTarget]:
        """Return the targets that a filter has found."""
        return self._board.found[team]

    @property
    def found_targets(self) -> list[FoundTarget]:
        """Targets found so far by all filters."""
        return numbered(list(self._board.found.values()))

    def scores_against(self, truth: FloatArray) -> Scores:
        """Return the scores of the found targets against true targets (n, d) [m]."""
        scores = self._board.scores_against(truth)
        assert scores is not None
        return scores

    def end(self, step: int, reason: str) -> None:
        """Note the last step of a search in one process, and its reason."""
        self.steps, self.end_reason = step + 1, reason
        if self._world is not None:
            self.truth = np.asarray(self._world.targets_at(step), dtype=float)
        self.scores = self.scores_against(self.truth)

    def close(self, end: RunEnd, until: float) -> None:
        """See `RunRecord.close`; a completed search ends with the completing update."""
        last: float = np.inf
        if self.completed is not None:
            until, last = self.completed.time, self.completed.step
        for robot, chosen in self.waypoints.items():
            self.waypoints[robot] = [item for item in chosen if item[0] <= last]
        for robot, poses in self.measured_from.items():
            self.measured_from[robot] = [item for item in poses if item[0] <= until]
        super().close(end, until)

    def planned_paths(self) -> dict[str, FloatArray]:
        """Return the start and the chosen waypoints of each robot, (n, 3) [m]."""
        starts = {robot: path[:1, 1:] for robot, path in self.trajectories.items()}
        chosen = {robot: [place for _, place in self.waypoints.get(robot, ())] for robot in starts}
        return {robot: np.vstack([start, *chosen[robot]]) for robot, start in starts.items()}

    @property
    def explored(self) -> float:
        """Explored share, from the planner that reports the largest."""
        return max(self._shares.values(), default=0.0)

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
        """Error of the true finds [m]; nan without any."""
        return self.scores.match.rmse

    @property
    def pairs(self) -> list[tuple[int, int]]:
        """Pairs of indices: found target, true target."""
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
        return [item.decision for item in self.facts if isinstance(item, facts.Decided)]

    @property
    def planning_times(self) -> list[float]:
        """Wall time of each decision [s]."""
        return [item.duration for item in self.facts if isinstance(item, facts.Decided)]

    @property
    def filter_times(self) -> list[float]:
        """Wall time of each filter step [s]."""
        return [item.duration for item in self.facts if isinstance(item, facts.Updated)]

    def columns(self) -> dict[str, Any]:
        """Return the progress by column, with positions of robots and whether they measured."""
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
