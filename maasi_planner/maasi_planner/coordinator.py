"""Planning of the team step by step: which robots plan and measure, what is explored.

Used by the planner node and the in-process search (000, algorithms 1 and 2).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from maasi_filter.arrays import FloatArray
from maasi_filter.models.pose import Pose
from maasi_filter.models.sensor import Sensor
from maasi_filter.records import Cluster
from maasi_filter.unexplored_map import UnexploredMap, default_spacing
from maasi_planner.candidates import CandidateSet, half_view
from maasi_planner.measurement_trigger import MeasurementTrigger
from maasi_planner.motion import MotionModel, RobotState, make_motion
from maasi_planner.node_settings import PlannerNodeSettings
from maasi_planner.obstacles import Obstacles
from maasi_planner.planners import Planner, make_planner
from maasi_planner.planners.base import check_decision
from maasi_planner.team import Decision, RobotDecision, RobotView, TeamView


@dataclass
class PresentRobot:
    """A robot that takes part in a step.

    free: whether it has no goal, or its goal has ended.
    """

    state: RobotState
    free: bool


@dataclass(frozen=True)
class Member:
    """A robot that measures at a step: its name, decision index d and measurement index m."""

    robot: str
    decision: int
    measurement: int


@dataclass
class _Plan:
    """Present plan of a robot."""

    motion: MotionModel
    sensor: Sensor
    candidates: CandidateSet
    period: int
    radius: float
    # Distance from a waypoint at which the next one is decided [m]; 0: it stops at each.
    arrival_radius: float
    exploration: UnexploredMap | None = None
    decision: int = -1
    decided_at: int | None = None
    waypoint: FloatArray = field(default_factory=lambda: np.zeros(3))
    # The same for the present waypoint.
    turning_distance: float = 0.0
    # Waypoint that was left for the next one, until its closest point, and its distance squared.
    passed: FloatArray | None = None
    nearest: float = 0.0
    # Step from which the periods of measurements count.
    measured_from: int = 0
    positions: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    yaws: FloatArray = field(default_factory=lambda: np.zeros(0))
    staying: bool = True
    measurements: int = 0
    due: bool = False


class Coordinator:
    """Plans for a team of robots step by step.

    settings: robots, planner and environment; exploration: e after the last measurements; clusters:
    potential targets after the last measurements; finished: why no gain is left; None before.
    """

    def __init__(self, settings: PlannerNodeSettings) -> None:
        self.settings = settings
        environment = settings.environment
        self.dimension = environment.dimension
        bounds = environment.array()
        spacing = settings.exploration_spacing
        if spacing is None:
            spacing = default_spacing(bounds)
        self.exploration = UnexploredMap(bounds, spacing)
        self.obstacles = Obstacles.from_settings(environment.obstacles)
        self.clusters: list[Cluster] = []
        self.finished: str | None = None
        self.planner = make_planner(settings.planner.name, settings.planner)
        self.trigger = MeasurementTrigger(settings.planner)
        self._plans: dict[str, _Plan] = {}
        own = settings.planner.own_explorations
        for name in sorted(settings.robots):
            robot = settings.robots[name]
            motion = make_motion(robot.motion, self.obstacles, robot.radius)
            sensor = robot.sensor.build(name, self.dimension)
            self._plans[name] = _Plan(
                motion=motion,
                sensor=sensor,
                candidates=CandidateSet(robot.candidates, bounds, height=robot.start[2]),
                period=max(1, round(robot.sensor.period / settings.step)),
                radius=robot.radius,
                arrival_radius=arrival_radius(motion, sensor, self.planner),
                exploration=self.exploration.copy() if own else None,
            )

    @property
    def names(self) -> list[str]:
        """Names of all robots, in order."""
        return list(self._plans)

    def sensor(self, name: str) -> Sensor:
        """Return a robot's sensor."""
        return self._plans[name].sensor

    def decision_index(self, name: str) -> int:
        """Return the index of a robot's last decision, -1 before the first."""
        return self._plans[name].decision

    def path(self, name: str) -> FloatArray:
        """Return a robot's predicted trajectory, (K + 1, 3) [m]."""
        return self._plans[name].positions

    def destination(self, name: str, state: RobotState) -> FloatArray:
        """Return the final position of the plan of a robot at `state`, (3,) [m]."""
        plan = self._plans[name]
        if plan.staying or not len(plan.positions):
            return np.array(state.pose.position)
        return plan.positions[-1].copy()

    def is_idle(self, name: str) -> bool:
        """Return whether a robot has no goal: it never had one, or is commanded to stay."""
        return self._plans[name].staying

    def refuse(self, name: str) -> None:
        """Note that a robot refused its goal; it replans at its next measurement."""
        self._plans[name].staying = True

    def skip_measurements(self, name: str, index: int) -> None:
        """Continue the measurement indices of a robot from `index`, for example after a restart."""
        plan = self._plans[name]
        plan.measurements = max(plan.measurements, index)

    def leave(self, name: str) -> None:
        """Note that a robot does not take part; discard its plan."""
        plan = self._plans[name]
        plan.decided_at = None
        plan.positions = np.zeros((0, 3))
        plan.yaws = np.zeros(0)
        plan.staying = True
        plan.passed = None
        plan.due = False

    def destined(self, name: str) -> bool:
        """Return whether a robot has a plan, or has not measured since it had one."""
        plan = self._plans[name]
        return plan.decided_at is None or not plan.staying or len(plan.positions) > 0

    def lend(self, name: str, step: int) -> None:
        """Note that a robot follows a goal of another client: it measures without a plan."""
        plan = self._plans[name]
        began = plan.decided_at
        self.leave(name)
        if began is None:
            began = plan.measured_from = step
        plan.decided_at = began
        # Measurements need a decision index, which is not negative.
        plan.decision = max(plan.decision, 0)

    def begin_again(self) -> None:
        """Begin a new search with nothing explored; decision indices continue."""
        self.exploration.values[...] = 1.0
        self.finished = None
        self.planner = make_planner(self.settings.planner.name, self.settings.planner)
        self.trigger.reset()
        for name in self.names:
            self.leave(name)

    def next_number(self, name: str) -> int:
        """Return the number of a goal without a decision of the planner."""
        plan = self._plans[name]
        plan.decision += 1
        return plan.decision + 1

    def planning(self, step: int, robots: Mapping[str, PresentRobot]) -> list[str]:
        """Return P_k, the robots that plan at a step, in order of their names.

        A robot plans when it has arrived, or is near enough to pass its waypoint without a stop;
        one that was commanded to stay replans at its next possible measurement.
        """
        if self.finished is not None:
            return []
        chosen = []
        for name in sorted(robots):
            plan, robot = self._plans[name], robots[name]
            waited = plan.decided_at is None or step - plan.decided_at >= plan.period
            if self._nears(plan, robot) or (robot.free and (not plan.staying or waited)):
                chosen.append(name)
        return chosen

    @staticmethod
    def _nears(plan: _Plan, robot: PresentRobot) -> bool:
        """Return whether a robot on its way is near enough to its waypoint to turn to the next."""
        if robot.free or plan.staying or not plan.turning_distance:
            return False
        left = plan.motion.squared_distance(robot.state.pose.position, plan.waypoint)
        return left < plan.turning_distance**2

    def plan(
        self,
        step: int,
        robots: Mapping[str, PresentRobot],
        taken: Sequence[tuple[FloatArray, float]] = (),
    ) -> Decision | None:
        """Return the joint decision of the robots that plan at a step, None without any.

        A robot that nears its waypoint and has nowhere further to go is not in it: it goes on, and
        plans again when it has arrived.

        Parameters
        ----------
        step : int
            k.
        robots : mapping
            The robots that take part, by name.
        taken : sequence of (3,) array and float
            Final positions of robots of other planners [m], and their radii.
        """
        planning = self.planning(step, robots)
        if not planning:
            return None
        arrived = [name for name in planning if robots[name].free]
        team = self._team(step, robots, planning, taken)
        finished = self.planner.finished(team)
        if finished is not None:
            for name in planning:
                self._plans[name].turning_distance = 0.0
            if not arrived:
                return None
            self.finished = finished
            for name in arrived:
                plan = self._plans[name]
                plan.decision += 1
                plan.decided_at = plan.measured_from = step
                plan.staying = True
            return Decision(step=step, reason=finished)
        decision = self.planner.decide(team)
        check_decision(self.planner, team, decision)
        for name in planning:
            if name not in arrived and decision.robots[name].stays:
                self._plans[name].turning_distance = 0.0
                del decision.robots[name]
            else:
                self._adopt(name, step, robots[name], decision.robots[name])
        return decision if decision.robots else None

    def _adopt(self, name: str, step: int, robot: PresentRobot, chosen: RobotDecision) -> None:
        """Make what was decided for a robot its plan."""
        plan = self._plans[name]
        here = robot.state.pose.position
        # Of two waypoints passed in a row the first is measured now.
        plan.due = plan.due or plan.passed is not None
        plan.passed = None
        if robot.free:
            plan.measured_from = step
        else:
            plan.passed = plan.waypoint
            plan.nearest = plan.motion.squared_distance(here, plan.passed)
        plan.decision += 1
        plan.decided_at = step
        plan.positions, plan.yaws = chosen.positions, chosen.yaws
        plan.staying, plan.waypoint = chosen.stays, chosen.waypoint
        # A waypoint within the radius already is gone to until it is reached.
        near = plan.motion.squared_distance(here, chosen.waypoint) <= plan.arrival_radius**2
        plan.turning_distance = 0.0 if near else plan.arrival_radius
        self.trigger.begin(
            name,
            plan.sensor,
            chosen.positions,
            chosen.yaws,
            plan.period,
            self.clusters,
            self.exploration,
        )

    def _team(
        self,
        step: int,
        robots: Mapping[str, PresentRobot],
        planning: Sequence[str],
        taken: Sequence[tuple[FloatArray, float]],
    ) -> TeamView:
        views = {}
        for name in sorted(robots):
            plan = self._plans[name]
            state = robots[name].state
            view = RobotView(
                state=state,
                candidates=plan.candidates.at(state.pose.position),
                motion=plan.motion,
                sensor=plan.sensor,
                period_steps=plan.period,
                planning=name in planning,
                radius=plan.radius,
                exploration=plan.exploration,
            )
            if not view.planning and plan.decided_at is not None:
                gone = step - plan.decided_at
                view.phase = (plan.measured_from - step) % plan.period
                if len(plan.positions):
                    first = min(gone, len(plan.positions) - 1)
                    view.remaining_path = plan.positions[first:]
                    view.remaining_yaws = plan.yaws[first:]
            views[name] = view
        return TeamView(
            step=step,
            step_time=self.settings.step,
            robots=views,
            clusters=self.clusters,
            exploration=self.exploration,
            obstacles=self.obstacles,
            taken=taken,
        )

    def measuring(
        self, step: int, robots: Mapping[str, PresentRobot], able: Collection[str] | None = None
    ) -> list[Member]:
        """Return M_k, the robots that measure at a step, in order of their names."""
        members = []
        for name in sorted(robots):
            plan = self._plans[name]
            if plan.decided_at is None:
                continue
            self._pass(plan, step, robots[name])
            gone = step - plan.measured_from
            # At index 0 the robot is at its last waypoint, or at the closest point.
            if gone == 0 or (self.planner.measures_underway and gone % plan.period == 0):
                plan.due = plan.due or self.trigger.measures(
                    name,
                    gone // plan.period,
                    plan.sensor,
                    robots[name].state.pose,
                    self.clusters,
                    self.exploration,
                )
            if plan.due and (able is None or name in able):
                plan.due = False
                members.append(Member(name, plan.decision, plan.measurements))
                plan.measurements += 1
        return members

    @staticmethod
    def _pass(plan: _Plan, step: int, robot: PresentRobot) -> None:
        """Count the measurements from the closest point to a waypoint that is passed."""
        if plan.passed is None or step == plan.decided_at:
            return
        distance = plan.motion.squared_distance(robot.state.pose.position, plan.passed)
        if distance >= plan.nearest:
            plan.passed = None
            plan.measured_from = step
        else:
            plan.nearest = distance

    def absorb(self, poses: Mapping[str, Pose], clusters: list[Cluster]) -> None:
        """Update with a batch that the filter has processed."""
        for name in sorted(poses):
            plan = self._plans[name]
            self.exploration.update(plan.sensor.detection, poses[name])
            if plan.exploration is not None:
                plan.exploration.update(plan.sensor.detection, poses[name])
        self.clusters = clusters


def arrival_radius(motion: MotionModel, sensor: Sensor, planner: Planner) -> float:
    """Return the distance from its waypoint at which a robot takes its next decision [m].

    The setting `arrival_radius` where it is given. Else 0, as in 000, for the objective of the
    papers and for planners that measure at waypoints only; and for the others the distance at
    which the robot begins to brake, at most what its sensor sees to each side: what it would have
    seen from the waypoint is then still seen from its path.
    """
    given = motion.settings.arrival_radius
    if given is not None:
        return given
    if planner.settings.objective == 'paper' or not planner.measures_underway:
        return 0.0
    return min(motion.braking_distance(), half_view(sensor))
