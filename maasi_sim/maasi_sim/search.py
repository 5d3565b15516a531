"""The search in one process, without ROS, with the filter, planner and library of the nodes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from time import perf_counter

import numpy as np
from pydantic import ValidationError

from maasi_drivers.agent.odometry import MapOdometry, StampedPose
from maasi_drivers.agent.sensor_reading import SensorReading
from maasi_drivers.agent.waypoint_follower import Goal, GoalStatus, WaypointFollower
from maasi_drivers.vision.marker_detector import MarkerDetector, read_markers
from maasi_filter.arrays import FloatArray
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
from maasi_sim.scenario.schema import Scenario, planner_settings, steps_of
from maasi_sim.search_result import SearchResult, SearchState
from maasi_sim.targets.scoring import Scores, score, scoring_radius
from maasi_sim.targets.tally import numbered
from maasi_sim.view.live_view import open_view
from maasi_sim.view.search_trace import SearchTrace
from maasi_sim.world.simulation import simulated_robot, step_of_event
from maasi_sim.world.world import World

# From the settings, and a function that returns the true targets that are not found yet.
MakePlanner = Callable[[PlannerSettings, Callable[[], FloatArray]], Planner]


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

    def move(self, command: FloatArray, step: int, dt: float) -> None:
        """Advance by `dt` seconds under a velocity command."""
        before = self.body.state.pose.position
        self.body.command(command)
        self.body.step(step, dt)
        moved = self.body.state.pose.position - before
        self.distance += float(np.sqrt((moved * moved).sum()))

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
        self.trace.explored(time, self.space, self.coordinator.exploration)
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
        try:
            renamed = scenario.planner.renamed(planner)
        except ValidationError as error:
            # One line, without the type of error and the address that pydantic adds.
            reasons = [item.get('ctx', {}).get('error', item['msg']) for item in error.errors()]
            raise ValueError('planner: ' + '; '.join(map(str, reasons))) from None
        scenario = scenario.model_copy(update={'planner': renamed})
        planner = None
    running = _Search(scenario, seed, planner)
    feed = open_view(running.trace) if view else None
    end_reason = running.run(most_measurements)
    if feed is not None:
        feed.close(f'ended: {end_reason}')
    return running.result(end_reason)


class _Search:
    """A search while it runs, step by step."""

    def __init__(self, scenario: Scenario, seed: int, planner: MakePlanner | None) -> None:
        self.scenario = scenario
        self.world = scenario.world(seed)
        self.trace = SearchTrace(scenario, seed)
        self.step = -1
        self._robots = {name: _Robot(name, scenario, seed, self.world) for name in scenario.names()}
        self._departures = leaving(scenario)
        self._away: set[str] = set()
        self._groups = [
            _Group(space, names, scenario, self.trace)
            for space, names in scenario.namespaces().items()
        ]
        self._destinations = {
            name: np.array(robot.start) for name, robot in scenario.robots.items()
        }
        truth = np.asarray(self.world.targets, dtype=float)
        self.trace.truth(0.0, truth)
        self._radius = scoring_radius(scenario, truth)
        self._counts = dict.fromkeys(self._robots, 0)
        self._progress: list[SearchState] = []
        self._decisions: list[Decision] = []
        # Whether the last score of a step was complete.
        self._complete = False
        if planner is not None:
            for group in self._groups:
                group.coordinator.planner = planner(scenario.planner, self._missing)

    def run(self, most_measurements: int | None) -> str:
        """Run the search and return the reason of its end."""
        for step in range(steps_of(self.scenario.limits.time, self.scenario.step)):
            self.step = step
            time = step * self.scenario.step
            self._let_leave(time)
            here = {name: r for name, r in self._robots.items() if name not in self._away}
            for robot in here.values():
                robot.observe(round(time * 1e9))
            self.trace.robots(time, {name: robot.state for name, robot in here.items()})
            commands = {
                name: robot.follower.update(robot.state, self.step)[0]
                for name, robot in here.items()
            }
            self._complete = False
            for group in self._groups:
                self._plan(group, here)
            reason = self._end_reason(most_measurements)
            if reason is not None:
                return reason
            for group in self._groups:
                group.shared = group.filter.own_found_targets()
            for name, robot in here.items():
                robot.move(commands[name], self.step + 1, self.scenario.step)
        return 'time_limit'

    def _let_leave(self, time: float) -> None:
        for name in self._departures.get(self.step, []):
            self._away.add(name)
            self.trace.leave(time, name)
            for group in self._groups:
                if name in group.names:
                    group.coordinator.leave(name)

    def _plan(self, group: _Group, here: Mapping[str, _Robot]) -> None:
        """Plan for the robots of a group, measure with those that are due, and score."""
        others = [other for other in self._groups if other is not group]
        taken = [
            (self._destinations[name], self.scenario.robots[name].radius)
            for other in others
            for name in other.names
            if name in here
        ]
        present, decision = group.plan(self.step, here, taken)
        for name in present:
            self._destinations[name] = group.coordinator.destination(name, present[name].state)
        if decision is not None:
            self._decisions.append(decision)
        time = self.step * self.scenario.step
        measured = group.measure(self.step, time, here, present, others)
        for name in measured:
            self._counts[name] += 1
        if measured:
            self._score(time, measured)

    def _score(self, time: float, measured: list[str]) -> None:
        truth = self.world.targets_at(self.step)
        if self.world.walk > 0.0:
            self.trace.truth(time, truth)
        found = self._found_targets()
        scores = self._scores(found, truth)
        self._complete = self._complete or (bool(len(truth)) and scores.complete)
        self._progress.append(
            SearchState(
                time,
                self.step,
                sum(self._counts.values()),
                len(found),
                scores.match.true_found,
                scores.match.rmse,
                tuple(measured),
                {name: r.body.state.pose.position for name, r in self._robots.items()},
            )
        )

    def _end_reason(self, most_measurements: int | None) -> str | None:
        if self._complete and self.scenario.stop == 'all_found':
            return 'all_found'
        searching = [group for group in self._groups if not self._away.issuperset(group.names)]
        if searching and all(group.coordinator.finished is not None for group in searching):
            return 'planner_done'
        if most_measurements is not None and sum(self._counts.values()) >= most_measurements:
            return 'measurement_limit'
        return None

    def _found_targets(self) -> list[FoundTarget]:
        return numbered([group.filter.own_found_targets() for group in self._groups])

    def _missing(self) -> FloatArray:
        """Return the true targets that are not found yet, (n, 3) [m]."""
        positions = np.array([item.position for item in self._found_targets()])
        pairs = match_targets(positions, self.world.targets_at(self.step), self._radius).pairs
        return np.delete(self.world.targets_3d_at(self.step), [j for _, j in pairs], axis=0)

    def _scores(self, found: list[FoundTarget], truth: FloatArray) -> Scores:
        return score(found, truth, self._radius, self.scenario.scoring.order)

    def result(self, end_reason: str) -> SearchResult:
        """Return the result after `run`."""
        found = self._found_targets()
        truth = np.asarray(self.world.targets_at(max(self.step, 0)), dtype=float)
        scores = self._scores(found, truth)
        return SearchResult(
            end_reason=end_reason,
            found_targets=found,
            truth=truth,
            missed=len(truth) - scores.match.true_found,
            false_found=len(found) - scores.match.true_found,
            rmse=scores.match.rmse,
            measurements=self._counts,
            distance={name: robot.distance for name, robot in self._robots.items()},
            steps=self.step + 1,
            progress=self._progress,
            decisions=self._decisions,
            trace=self.trace,
            filter_times=[item for group in self._groups for item in group.filter_times],
            planning_times=[item for group in self._groups for item in group.planning_times],
            pairs=scores.match.pairs,
            origin=self.scenario.environment.origin,
        )
