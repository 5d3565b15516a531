"""The search in one process, without ROS, with the filter, planner and library of the nodes."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maasi_drivers.agent.odometry import MapOdometry, StampedPose
from maasi_drivers.agent.sensor_reading import SensorReading
from maasi_drivers.agent.waypoint_follower import Goal, GoalStatus, WaypointFollower
from maasi_drivers.vision.marker_detector import MarkerDetector
from maasi_drivers.vision.marker_reading import read_markers
from maasi_filter.make_filter import make_filter
from maasi_filter.metrics import match_targets
from maasi_filter.models.pose import Pose
from maasi_filter.records import AgentMeasurement, FoundTarget
from maasi_planner.coordinator import Coordinator, PresentRobot
from maasi_planner.motion import RobotState, make_motion
from maasi_planner.obstacles import Obstacles
from maasi_planner.planners import Planner
from maasi_planner.settings import PlannerSettings
from maasi_planner.team import Decision
from maasi_sim.scenario.base import OriginSettings
from maasi_sim.scenario.schema import (
    Scenario,
    planner_settings,
    steps_of,
)
from maasi_sim.targets.data_frames import data_frame
from maasi_sim.targets.scoring import score, scoring_radius
from maasi_sim.view.live_view import open_view
from maasi_sim.view.search_trace import SearchTrace
from maasi_sim.world.simulation import simulated_robot, step_of_event
from maasi_sim.world.world import World

FloatArray = NDArray[np.float64]


# From the settings, and a function that returns the true targets that are not found yet.
MakePlanner = Callable[[PlannerSettings, Callable[[], FloatArray]], Planner]


@dataclass(frozen=True)
class Found:
    """State of a search after a measurement batch.

    Attributes
    ----------
    time : float
        [s].
    measurements : int
        Number so far, of all robots.
    found, true_found : int
        Targets found so far, and the number of true ones among them.
    rmse : float
        Of the true ones [m]; nan without any.
    step : int
        k.
    members : tuple of str
        Robots that measured.
    positions : dict
        Of all robots, (3,) [m].
    """

    time: float
    measurements: int
    found: int
    true_found: int
    rmse: float
    step: int
    members: tuple[str, ...]
    positions: dict[str, FloatArray]


@dataclass
class SearchResult:
    """Result of a search.

    Attributes
    ----------
    end_reason : str
        'all_found', 'planner_done' or 'time_limit'.
    found_targets : list of FoundTarget
        At the end.
    truth : (n, d) array
        True targets [m].
    missed, false_found : int
        True targets without a found one, and found ones without a true one.
    rmse : float
        Of the true ones among those found [m]; nan without any.
    measurements : dict
        Number of each robot.
    distance : dict
        Distance travelled by each robot [m].
    steps : int
        Length of the search.
    progress : list of Found
        After each measurement batch.
    decisions : list of Decision
        In their order.
    filter_times, planning_times : list of float
        Wall time of each filter step and of each decision [s].
    trace : SearchTrace or None
        For a replay.
    pairs : list of (int, int)
        Index of a found target, and of the true one that it is.
    origin : OriginSettings or None
        Of the map on the earth.
    """

    end_reason: str
    found_targets: list[FoundTarget]
    truth: FloatArray
    missed: int
    false_found: int
    rmse: float
    measurements: dict[str, int]
    distance: dict[str, float]
    steps: int
    progress: list[Found] = field(default_factory=list)
    decisions: list[Decision] = field(default_factory=list)
    filter_times: list[float] = field(default_factory=list)
    planning_times: list[float] = field(default_factory=list)
    trace: SearchTrace | None = field(default=None, repr=False, compare=False)
    pairs: list[tuple[int, int]] = field(default_factory=list)
    origin: OriginSettings | None = None

    def save_replay(self, path: str | Path) -> None:
        """Write a page that shows the search, one HTML file.

        Raises
        ------
        ResultsError
            If it cannot be written.
        """
        assert self.trace is not None, 'a result that `search` returned has a trace'
        self.trace.save_replay(Path(path))

    def to_dataframe(self, table: str = 'found_targets') -> Any:
        """Return a pandas data frame.

        Parameters
        ----------
        table : str
            'found_targets': a row for each, with the columns of `found_targets.csv`. 'progress': a
            row for each measurement batch, with the fields of `Found` and the places of robots.

        Raises
        ------
        ImportError
            If pandas is not installed.
        ValueError
            If there is no such table.
        """
        return data_frame(self, table)

    @property
    def total_measurements(self) -> int:
        """Measurements of all robots."""
        return sum(self.measurements.values())

    @property
    def complete(self) -> bool:
        """Whether all targets are found, and nothing else."""
        return self.missed == 0 and self.false_found == 0


class _Robot:
    """A simulated robot with the functions of its driver."""

    def __init__(self, name: str, scenario: Scenario, seed: int, world: World) -> None:
        settings = scenario.robots[name]
        self.name = name
        self.sensor = settings.sensor.build(name, scenario.dimension)
        self.body = simulated_robot(name, scenario, world, seed)
        obstacles = Obstacles.from_settings(scenario.environment.obstacles)
        self.follower = WaypointFollower(make_motion(settings.motion, obstacles, settings.radius))
        self.odometry = MapOdometry(Pose.from_yaw(settings.start, settings.yaw))
        self.detector = (
            None if settings.camera is None else MarkerDetector(settings.camera, scenario.dimension)
        )
        period = scenario.robots[name].sensor.period
        rate = period if settings.camera is None else 1.0 / settings.camera.rate
        self.imaging_steps = steps_of(rate, scenario.step) if rate > 0.0 else 1
        self.pose: StampedPose
        self.state: RobotState
        self.distance = 0.0

    def observe(self, stamp: int) -> None:
        """Take the odometry of a step."""
        reading = self.body.odometry
        self.pose = self.odometry.apply(
            stamp,
            reading.pose,
            reading.covariance,
            reading.velocity,
            reading.angular_velocity,
        )
        self.state = RobotState(self.pose.pose, self.pose.velocity, self.pose.angular_velocity)

    def has_ended(self, goal: int) -> bool:
        """Return whether the goal of this number has ended."""
        follower = self.follower
        return (
            follower.goal is not None
            and follower.goal.id == goal
            and follower.status != GoalStatus.MOVING
        )

    def measure(self, step: int, time: float, index: int) -> AgentMeasurement:
        """Return the measurement of the robot at a step."""
        if self.detector is None:
            sweep = self.body.sweep(step)
            reading = SensorReading.of_sweep(sweep, self.sensor, self.pose.pose)
        else:
            image = self.body.image(step, time)
            reading = read_markers(image, self.pose, self.detector, self.sensor)
        return AgentMeasurement(
            self.name,
            self.pose.pose,
            self.sensor,
            reading.values,
            reading.covariances,
            index,
            self.pose.covariance[:3, :3],
            reading.labels,
        )


class _Group:
    """Robots that share filter and planner: all, or a single one (002, section 4)."""

    def __init__(
        self, space: str, names: list[str], scenario: Scenario, trace: SearchTrace
    ) -> None:
        self.space = space
        self.names = names
        self.trace = trace
        seed = trace.seed
        common = {'step': scenario.step, 'seed': seed, 'lockstep': True}
        self.coordinator = Coordinator(planner_settings(scenario, names, common))
        self.filter = make_filter(
            scenario.filter, scenario.environment.array(), np.random.default_rng(seed)
        )
        self.last_batch: int | None = None
        # Found targets at the end of the previous step, for the other groups.
        self.shared: list[FoundTarget] = []
        self.filter_times: list[float] = []
        self.planning_times: list[float] = []

    def plan(
        self,
        step: int,
        robots: Mapping[str, _Robot],
        taken: Sequence[tuple[FloatArray, float]],
    ) -> tuple[dict[str, PresentRobot], Decision | None]:
        """Plan for the free robots, and send them to their waypoints."""
        coordinator = self.coordinator
        present = {
            name: PresentRobot(
                robots[name].state,
                coordinator.is_idle(name)
                or robots[name].has_ended(coordinator.decision_index(name) + 1),
            )
            for name in self.names
            if name in robots
        }
        begin = perf_counter()
        decision = coordinator.plan(step, present, taken)
        if decision is not None:
            self.planning_times.append(perf_counter() - begin)
            self.trace.decision(
                step * coordinator.settings.step, self.space, decision, coordinator.exploration
            )
            for name, chosen in decision.robots.items():
                if not chosen.stays:
                    number = coordinator.decision_index(name) + 1
                    robots[name].follower.take(Goal(number, step, chosen.waypoint))
        return present, decision

    def measure(
        self,
        step: int,
        time: float,
        robots: Mapping[str, _Robot],
        present: Mapping[str, PresentRobot],
        others: Sequence[_Group],
    ) -> list[str]:
        """Measure with the robots that are due, update the filter, and return their names."""
        able = {name for name in present if step % robots[name].imaging_steps == 0}
        members = self.coordinator.measuring(step, present, able)
        if not members:
            return []
        measurements = [
            robots[item.robot].measure(step, time, item.measurement) for item in members
        ]
        gone = 1 if self.last_batch is None else step - self.last_batch
        self.last_batch = step
        begin = perf_counter()
        for other in others:
            self.filter.take_over(other.names[0], other.shared)
        result = self.filter.step(measurements, gone, time)
        self.filter_times.append(perf_counter() - begin)
        known = result.found_changed or bool(others)
        found = self.filter.own_found_targets() if known else None
        self.trace.update(time, self.space, measurements, result, found)
        self.coordinator.absorb({item.robot: item.pose for item in measurements}, result.clusters)
        return [item.robot for item in members]


def leaving(scenario: Scenario) -> dict[int, list[str]]:
    """Return the robots that leave, by step."""
    steps: dict[int, list[str]] = {}
    for event in scenario.events:
        if event.do != 'leave':
            raise ValueError(
                f"events: read '{event.do}' of {event.robot}, in one process robots only leave"
            )
        steps.setdefault(step_of_event(event.at, scenario.step), []).append(event.robot)
    return steps


def search(
    scenario: Scenario,
    seed: int,
    most_measurements: int | None = None,
    planner: str | type[Planner] | MakePlanner | None = None,
    view: bool = False,
) -> SearchResult:
    """Run a scenario in this process, step by step as in lockstep.

    Parameters
    ----------
    scenario : Scenario
        To run. Of its events, only leaving robots are simulated.
    seed : int
        Of all random numbers.
    most_measurements : int, optional
        End after so many measurements of all robots.
    planner : str, class or function, optional
        Instead of the scenario's: the name of a planner, also as `module:Class`; a subclass of
        Planner; or a function that returns the planner of each group, from its settings and a
        function that returns the true targets that are not found yet, (n, 3) [m].
    view : bool
        Whether to show the running search in a browser.

    Raises
    ------
    ValueError
        If a robot is to come back, or there is no planner of that name.
    """
    if isinstance(planner, type):
        planner = f'{planner.__module__}:{planner.__qualname__}'
    if isinstance(planner, str):
        scenario = scenario.model_copy(update={'planner': scenario.planner.renamed(planner)})
        planner = None
    world = scenario.world(seed)
    robots = {name: _Robot(name, scenario, seed, world) for name in scenario.names()}
    departures = leaving(scenario)
    away: set[str] = set()
    trace = SearchTrace(scenario, seed)
    feed = open_view(trace) if view else None
    groups = [
        _Group(space, names, scenario, trace) for space, names in scenario.namespaces().items()
    ]
    destinations = {name: np.array(robot.start) for name, robot in scenario.robots.items()}
    truth = np.asarray(world.targets, dtype=float)
    trace.truth(0.0, truth)
    radius = scoring_radius(scenario, truth)
    counts = dict.fromkeys(robots, 0)
    progress: list[Found] = []
    decisions: list[Decision] = []
    end_reason = 'time_limit'
    step = -1

    def found_targets() -> list[FoundTarget]:
        return _numbered([item.filter.own_found_targets() for item in groups])

    def missing() -> FloatArray:
        positions = np.array([item.position for item in found_targets()])
        pairs = match_targets(positions, world.targets_at(step), radius).pairs
        return np.delete(world.targets_3d_at(step), [j for _, j in pairs], axis=0)

    if planner is not None:
        for group in groups:
            group.coordinator.planner = planner(scenario.planner, missing)
    for step in range(steps_of(scenario.limits.time, scenario.step)):
        time = step * scenario.step
        for name in departures.get(step, []):
            away.add(name)
            trace.leave(time, name)
            for group in groups:
                if name in group.names:
                    group.coordinator.leave(name)
        here = {name: robot for name, robot in robots.items() if name not in away}
        for robot in here.values():
            robot.observe(round(time * 1e9))
        trace.robots(time, {name: robot.state for name, robot in here.items()})
        commands = {
            name: robot.follower.update(robot.state, step)[0] for name, robot in here.items()
        }
        complete = False
        for group in groups:
            others = [other for other in groups if other is not group]
            taken = [
                (destinations[name], scenario.robots[name].radius)
                for other in others
                for name in other.names
                if name in here
            ]
            present, decision = group.plan(step, here, taken)
            for name in present:
                destinations[name] = group.coordinator.destination(name, present[name].state)
            if decision is not None:
                decisions.append(decision)
            measured = group.measure(step, time, here, present, others)
            for name in measured:
                counts[name] += 1
            if measured:
                positions = [target.position for target in found_targets()]
                truth = world.targets_at(step)
                if world.walk > 0.0:
                    trace.truth(time, truth)
                scores = score(positions, truth, radius, scenario.scoring.order)
                complete = complete or (bool(len(truth)) and scores.complete)
                progress.append(
                    Found(
                        time,
                        sum(counts.values()),
                        len(positions),
                        scores.match.true_found,
                        scores.match.rmse,
                        step,
                        tuple(measured),
                        {name: robot.body.state.pose.position for name, robot in robots.items()},
                    )
                )
        if complete and scenario.stop == 'all_found':
            end_reason = 'all_found'
            break
        searching = [group for group in groups if not away.issuperset(group.names)]
        if searching and all(group.coordinator.finished is not None for group in searching):
            end_reason = 'planner_done'
            break
        if most_measurements is not None and sum(counts.values()) >= most_measurements:
            end_reason = 'measurement_limit'
            break
        for group in groups:
            group.shared = group.filter.own_found_targets()
        for name, robot in here.items():
            before = robot.body.state.pose.position
            robot.body.command(commands[name])
            robot.body.step(step + 1, scenario.step)
            moved = robot.body.state.pose.position - before
            robot.distance += float(np.sqrt((moved * moved).sum()))
    if feed is not None:
        feed.close(f'ended: {end_reason}')
    found = found_targets()
    truth = np.asarray(world.targets_at(max(step, 0)), dtype=float)
    scores = score([item.position for item in found], truth, radius, scenario.scoring.order)
    return SearchResult(
        end_reason=end_reason,
        found_targets=found,
        truth=truth,
        missed=len(truth) - scores.match.true_found,
        false_found=len(found) - scores.match.true_found,
        rmse=scores.match.rmse,
        measurements=counts,
        distance={name: robot.distance for name, robot in robots.items()},
        steps=step + 1,
        progress=progress,
        decisions=decisions,
        trace=trace,
        filter_times=[item for group in groups for item in group.filter_times],
        planning_times=[item for group in groups for item in group.planning_times],
        pairs=scores.match.pairs,
        origin=scenario.environment.origin,
    )


def _numbered(found: list[list[FoundTarget]]) -> list[FoundTarget]:
    """Return the found targets of all filters as one list, numbered in the order of time."""
    if len(found) == 1:
        return found[0]
    every = sorted(itertools.chain(*found), key=lambda item: (item.time, item.robot, item.id))
    return [replace(item, id=number) for number, item in enumerate(every, start=1)]
