"""A search in one process, without ROS, with the filter, planner and libraries of the nodes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from time import perf_counter

import numpy as np
from pydantic import ValidationError

from maasi_drivers.agent.odometry import MapOdometry, StampedPose
from maasi_drivers.agent.sensor_reading import SensorReading
from maasi_drivers.agent.waypoint_follower import Goal, GoalStatus, WaypointFollower
from maasi_drivers.vision.marker_detector import MarkerDetector, read_markers
from maasi_filter import SearchFilter
from maasi_filter.arrays import FloatArray
from maasi_filter.make_filter import make_filter
from maasi_filter.models.pose import Pose
from maasi_filter.records import AgentMeasurement, FoundTarget
from maasi_filter.wording import reason
from maasi_planner.coordinator import Coordinator
from maasi_planner.motion import RobotState, make_motion
from maasi_planner.planners import Planner
from maasi_planner.robot_plan import PresentRobot
from maasi_planner.settings import PlannerSettings
from maasi_planner.terrain_frame import above_ground, decision_on_map
from maasi_sim.compiling import compiling_said
from maasi_sim.run.facts import Decided, Left, Measured, Truth, Updated
from maasi_sim.scenario.schema import Scenario, planner_settings, steps_of
from maasi_sim.search_result import SearchResult
from maasi_sim.simulation.robots import SimulatedRobot, Simulation

# From the settings and a function that returns the undetected true targets.
MakePlanner = Callable[[PlannerSettings, Callable[[], FloatArray]], Planner]


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
        Scenario to run. Robots may leave but not return.
    seed : int
        Seed of all random numbers.
    most_measurements : int, optional
        End after this many measurements of all robots.
    planner : str, class or function, optional
        Instead of the scenario's: the name of a planner, also as `module:Class`; a subclass of
        Planner; or a function that returns the planner of each group, from its settings and a
        function that returns the true targets that are not found yet, (n, 3) [m].
    view : bool
        Whether to show the running search in a browser.

    Raises
    ------
    ValueError
        If a robot is to return, or the planner is unknown.
    """
    if isinstance(planner, type):
        planner = f'{planner.__module__}:{planner.__qualname__}'
    if isinstance(planner, str):
        try:
            renamed = scenario.planner.renamed(planner)
        except ValidationError as error:
            # One line, without error type and address that pydantic adds.
            reasons = '; '.join(map(reason, error.errors()))
            raise ValueError(f'planner: {reasons}') from None
        scenario = scenario.model_copy(update={'planner': renamed})
        planner = None
    with compiling_said():
        running = _Search(scenario, seed, planner)
        page = None
        if view:
            # Deferred: only a page needs a web server.
            from maasi_sim.run.view.live_view import SearchPage

            page = SearchPage(running.log)
        result = running.run(most_measurements)
    if page is not None:
        page.end()
    return result


class _Search:
    def __init__(self, scenario: Scenario, seed: int, make_planner: MakePlanner | None) -> None:
        check_events(scenario)
        self.scenario = scenario
        self.simulation = Simulation(scenario, seed)
        self.world = self.simulation.world
        self.log = SearchResult(scenario, seed, self.world)
        self.log.add(Truth(0.0, self.log.truth))
        self.step, self.time = 0, 0.0
        self._robots = {
            name: _Robot(body, scenario) for name, body in self.simulation.robots.items()
        }
        self._here = dict(self._robots)
        common = {'step': scenario.step, 'seed': seed, 'lockstep': True}
        self._groups = [
            _Group(
                space,
                names,
                Coordinator(planner_settings(scenario, names, common)),
                make_filter(scenario.filter, self.world.area, np.random.default_rng(seed)),
            )
            for space, names in scenario.namespaces().items()
        ]
        if make_planner is not None:
            for group in self._groups:
                group.coordinator.planner = make_planner(scenario.planner, self._missing)
        self._destinations = {
            name: np.array(robot.start) for name, robot in scenario.robots.items()
        }

    def run(self, most_measurements: int | None) -> SearchResult:
        reason = None
        for step in range(steps_of(self.scenario.limits.time, self.scenario.step)):
            self.step, self.time = step, self.simulation.time
            for name in sorted(self._here.keys() & self.simulation.away):
                del self._here[name]
                self.log.add(Left(self.time, name))
                (group,) = (group for group in self._groups if name in group.names)
                group.coordinator.robots[name].clear_plan()
            for robot in self._here.values():
                robot.observe(round(self.time * 1e9))
            commands = {
                name: robot.follower.update(robot.state, self.step)[0]
                for name, robot in self._here.items()
            }
            states = {name: robot.shown() for name, robot in self._here.items()}
            self.log.add_states(self.time, states)
            for group in self._groups:
                present = self._plan(group)
                self._measure(group, present)
            reason = self._end_reason(most_measurements)
            if reason is not None:
                break
            for group in self._groups:
                group.shared = group.filter.own_found_targets()
            self._move(commands)
        self.log.end(self.step, reason or 'time_limit')
        return self.log

    def _plan(self, group: _Group) -> dict[str, PresentRobot]:
        """Plan for the free robots of a group and send them to their waypoints."""
        coordinator, robots, here = group.coordinator, group.coordinator.robots, self._here
        present = {}
        for name in [name for name in group.names if name in here]:
            follower, plan = here[name].follower, robots[name].plan
            ended = follower.goal is not None and follower.goal.id == plan.goal_id
            ended = ended and follower.status != GoalStatus.MOVING
            free, charge = plan.staying or ended, here[name].body.battery.charge
            state = above_ground(here[name].state, self.world.area.terrain)
            present[name] = PresentRobot(state, free, charge)
        taken = [
            (self._destinations[name], self.scenario.robots[name].radius)
            for other in self._groups
            for name in other.names
            if other is not group and name in here
        ]
        begin = perf_counter()
        decision = coordinator.plan(self.step, present, taken)
        if decision is not None:
            duration = perf_counter() - begin
            indices = {name: robots[name].plan.decision for name in decision.robots}
            explored = coordinator.exploration.explored_fraction()
            shown = decision_on_map(decision, self.world.area.terrain)
            made = Decided(self.time, group.space, shown, indices, explored, duration=duration)
            self.log.add(made)
            self.log.add_map(self.time, group.space, coordinator.exploration, now=True)
            for name, chosen in decision.robots.items():
                if not chosen.stays:
                    number = robots[name].plan.goal_id
                    waypoint = self.world.area.above_ground(chosen.waypoint)
                    here[name].follower.adopt(Goal(number, self.step, waypoint))
        for name, robot in present.items():
            self._destinations[name] = robots[name].plan.destination(robot.state)
        return present

    def _measure(self, group: _Group, present: Mapping[str, PresentRobot]) -> None:
        """Measure with the due robots of a group, update its filter, and score."""
        able = {name for name in present if self.simulation.images_due(name)}
        members = group.coordinator.measure(self.step, present, able)
        if not members:
            return
        measurements = [
            self._here[item.robot].measure(self.step, self.time, item.measurement)
            for item in members
        ]
        gone = 1 if group.last_batch is None else self.step - group.last_batch
        group.last_batch = self.step
        others = [other for other in self._groups if other is not group]
        begin = perf_counter()
        group.filter.merge({other.names[0]: other.shared for other in others})
        result = group.filter.step(measurements, gone, self.time)
        duration = perf_counter() - begin
        group.coordinator.absorb({item.robot: item.pose for item in measurements}, result.clusters)
        known = result.found_changed or bool(others)
        found = group.filter.own_found_targets() if known else None
        for item in measurements:
            self.log.add(Measured.of(self.time, item))
        update = Updated(
            self.time,
            self.step,
            group.space,
            [(item.robot, item.index) for item in measurements],
            found,
            result.expected_number,
            result.clusters,
            duration,
            {name: robot.body.state.pose.position for name, robot in self._robots.items()},
        )
        self.log.add(update)
        self.log.add_map(self.time, group.space, group.coordinator.exploration, now=False)

    def _move(self, commands: Mapping[str, FloatArray]) -> None:
        """Advance by a step with the commands of the present robots."""
        robots = self.simulation.robots
        places = {name: robots[name].state.pose.position for name in commands}
        for name, command in commands.items():
            robots[name].command(command)
        self.simulation.advance()
        for name, place in places.items():
            moved = robots[name].state.pose.position - place
            self.log.distance[name] += float(np.sqrt((moved * moved).sum()))

    def _end_reason(self, most_measurements: int | None) -> str | None:
        if self.log.completed is not None:
            return 'all_found'
        searching = [group for group in self._groups if self._here.keys() & set(group.names)]
        if searching and all(group.coordinator.ended is not None for group in searching):
            return 'planner_done'
        if most_measurements is not None and self.log.total_measurements >= most_measurements:
            return 'measurement_limit'
        return None

    def _missing(self) -> FloatArray:
        """Return the undetected true targets, (n, 3) [m]."""
        truth = np.asarray(self.world.targets_at(self.step), dtype=float)
        matched = [j for _, j in self.log.scores_against(truth).match.pairs]
        return np.delete(self.world.targets_3d_at(self.step), matched, axis=0)


@dataclass
class _Group:
    """Robots that share filter and planner: all, or a single one (paper 002, section 4)."""

    space: str
    names: list[str]
    coordinator: Coordinator
    filter: SearchFilter
    # Step of the last batch, and earlier found targets for other groups.
    last_batch: int | None = None
    shared: list[FoundTarget] = field(default_factory=list)


class _Robot:
    def __init__(self, body: SimulatedRobot, scenario: Scenario) -> None:
        settings = body.settings
        self.name = body.name
        self.sensor = settings.sensor.build(self.name, scenario.dimension)
        self.body = body
        area = body.world.area
        self.follower = WaypointFollower(make_motion(settings.motion, area, settings.radius))
        start = area.above_ground(settings.start)
        self.odometry = MapOdometry(Pose.from_yaw(start, settings.yaw))
        self.detector = (
            None
            if settings.camera is None
            else MarkerDetector(settings.camera, scenario.dimension, area.terrain)
        )
        self.pose: StampedPose
        self.state: RobotState

    def observe(self, stamp: int) -> None:
        """Handle the odometry of a step."""
        reading = self.body.odometry
        motion = reading.velocity, reading.angular_velocity
        self.pose = self.odometry.apply(stamp, reading.pose, reading.covariance, *motion)
        self.state = RobotState(self.pose.pose, self.pose.velocity, self.pose.angular_velocity)

    def shown(self) -> tuple[RobotState, float, int]:
        """Return its state, the charge of its battery, and the status of its goal."""
        return self.state, float(self.body.battery.charge), int(self.follower.status)

    def measure(self, step: int, time: float, index: int) -> AgentMeasurement:
        if self.detector is None:
            reading = SensorReading.of_sweep(self.body.sweep(step), self.sensor, self.pose.pose)
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


def check_events(scenario: Scenario) -> None:
    """Raise ValueError if a robot is to return."""
    for event in scenario.events:
        if event.do != 'leave':
            raise ValueError(
                f"events: read '{event.do}' of {event.robot}, allowed in one process is 'leave'"
            )
