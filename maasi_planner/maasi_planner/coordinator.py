"""Planning of the team step by step: which robots plan and measure, what is explored.

Used by the planner node and the in-process search (000, algorithms 1 and 2).
"""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from maasi_filter.area import Area
from maasi_filter.arrays import FloatArray
from maasi_filter.models.pose import Pose
from maasi_filter.models.sensor import Sensor
from maasi_filter.records import Cluster
from maasi_filter.unexplored_map import UnexploredMap, default_spacing
from maasi_planner.candidates import CandidateSet, half_view
from maasi_planner.endurance import Endurance
from maasi_planner.measurement_trigger import MeasurementTrigger
from maasi_planner.motion import MotionModel, RobotState, make_motion
from maasi_planner.node_settings import PlannerNodeSettings
from maasi_planner.planners import Planner, make_planner
from maasi_planner.planners.base import check_decision, explain, go_home, keep_apart
from maasi_planner.team import Decision, RobotDecision, RobotView, TeamView, stay


@dataclass
class PresentRobot:
    """A robot that takes part in a step.

    free: whether it has no goal, or its goal has ended; charge: of its battery, 0 to 1, or unknown.
    """

    state: RobotState
    free: bool
    charge: float = math.nan


@dataclass(frozen=True)
class Member:
    """A robot that measures at a step: its name, decision index d and measurement index m."""

    robot: str
    decision: int
    measurement: int


@dataclass
class RobotPlan:
    """A robot, and its present plan.

    decision: index of its last decision, -1 before the first; positions (K + 1, 3): predicted
    trajectory [m]; staying: whether it has no goal: it never had one, refused it, or is commanded
    to stay.
    """

    motion: MotionModel
    sensor: Sensor
    candidates: CandidateSet
    period: int
    radius: float
    # Distance from a waypoint at which the next one is decided [m]; 0: it stops at each.
    arrival_radius: float
    endurance: Endurance | None = None
    exploration: UnexploredMap | None = None
    decision: int = -1
    decided_at: int | None = None
    waypoint: FloatArray = field(default_factory=lambda: np.zeros(3))
    turning_distance: float = 0.0  # the same for the present waypoint
    # Waypoint that was left for the next one, until its closest point, and its distance squared.
    passed: FloatArray | None = None
    nearest: float = 0.0
    # Step from which the periods of measurements count.
    measured_from: int = 0
    positions: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    yaws: FloatArray = field(default_factory=lambda: np.zeros(0))
    tour: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    staying: bool = True
    measurements: int = 0
    due: bool = False

    def destination(self, state: RobotState) -> FloatArray:
        """Return the final position of its plan at a state, (3,) [m]."""
        if self.staying or not len(self.positions):
            return np.array(state.pose.position)
        return self.positions[-1].copy()

    def leave(self) -> None:
        """Discard its plan: it does not take part."""
        self.decided_at = None
        self.positions, self.yaws = np.zeros((0, 3)), np.zeros(0)
        self.tour = np.zeros((0, 3))
        self.staying = True
        self.passed = None
        self.due = False

    def lend(self, step: int) -> None:
        """Note that it follows a goal of another client: it measures without a plan."""
        began = self.decided_at
        if began is not None and self.staying and not len(self.positions):
            return  # it does so already
        self.leave()
        if began is None:
            began = self.measured_from = step
        self.decided_at = began
        # Measurements need a decision index, which is not negative.
        self.decision = max(self.decision, 0)

    def nears(self, robot: PresentRobot) -> bool:
        """Return whether it is on its way, near enough to turn to the next waypoint."""
        if robot.free or self.staying or not self.turning_distance:
            return False
        left = self.motion.squared_distance(robot.state.pose.position, self.waypoint)
        return left < self.turning_distance**2

    def adopt(self, step: int, robot: PresentRobot, chosen: RobotDecision) -> None:
        """Take over what was decided for it."""
        here = robot.state.pose.position
        # Of two waypoints passed in a row the first is measured now.
        self.due = self.due or self.passed is not None
        self.passed = None
        if robot.free:
            self.measured_from = step
        else:
            self.passed = self.waypoint
            self.nearest = self.motion.squared_distance(here, self.passed)
        self.decision += 1
        self.decided_at = step
        self.positions, self.yaws, self.tour = chosen.positions, chosen.yaws, chosen.tour
        self.staying, self.waypoint = chosen.stays, chosen.waypoint
        # A waypoint within the radius already is gone to until it is reached.
        near = self.motion.squared_distance(here, chosen.waypoint) <= self.arrival_radius**2
        self.turning_distance = 0.0 if near else self.arrival_radius

    def pass_waypoint(self, step: int, robot: PresentRobot) -> None:
        """Count the measurements from the closest point to a waypoint that is passed."""
        if self.passed is None or step == self.decided_at:
            return
        distance = self.motion.squared_distance(robot.state.pose.position, self.passed)
        if distance >= self.nearest:
            self.passed = None
            self.measured_from = step
        else:
            self.nearest = distance

    def view(self, step: int, robot: PresentRobot, planning: bool) -> RobotView:
        """Return what a planner sees of it."""
        view = RobotView(
            state=robot.state,
            candidates=self.candidates.at(robot.state.pose.position),
            motion=self.motion,
            sensor=self.sensor,
            period_steps=self.period,
            planning=planning,
            radius=self.radius,
            endurance=self.endurance,
            arrival_radius=self.arrival_radius,
            exploration=self.exploration,
        )
        if not planning and self.decided_at is not None:
            view.phase = (self.measured_from - step) % self.period
            if len(self.positions):
                view.remaining_path, view.remaining_yaws = self.left(step)
        return view

    def left(self, step: int) -> tuple[FloatArray, FloatArray]:
        """Return the rest of its predicted trajectory: positions (n, 3) and headings (n,)."""
        first = min(step - (self.decided_at or 0), len(self.positions) - 1)
        return self.positions[first:], self.yaws[first:]


class Coordinator:
    """Plans for a team of robots step by step.

    settings: robots, planner and environment; plans: of the robots, in order of their names;
    exploration: e after the last measurements; clusters: potential targets after the last
    measurements; finished: why no gain is left; None before.
    """

    def __init__(self, settings: PlannerNodeSettings, area: Area | None = None) -> None:
        self.settings = settings
        self.dimension = settings.environment.dimension
        self.area = area or Area(settings.environment)
        spacing = settings.exploration_spacing or default_spacing(self.area.bounds)
        self.exploration = UnexploredMap(self.area, spacing)
        self.clusters: list[Cluster] = []
        self.finished: str | None = None
        self.planner = make_planner(settings.planner.name, settings.planner)
        self.trigger = MeasurementTrigger(settings.planner)
        self.plans: dict[str, RobotPlan] = {}
        planner = settings.planner
        own = planner.name in ('maas', 'as') and planner.agent_exploration == 'own'
        for name in sorted(settings.robots):
            robot = settings.robots[name]
            motion = make_motion(robot.motion, self.area, robot.radius)
            sensor = robot.sensor.build(name, self.dimension)
            self.plans[name] = RobotPlan(
                motion=motion,
                sensor=sensor,
                candidates=CandidateSet(robot.candidates, self.area, height=robot.start[2]),
                period=max(1, round(robot.sensor.period / settings.step)),
                radius=robot.radius,
                arrival_radius=arrival_radius(motion, sensor, self.planner),
                endurance=None
                if robot.endurance is None
                else Endurance(robot.endurance, motion, robot.start),
                exploration=self.exploration.copy() if own else None,
            )

    @property
    def names(self) -> list[str]:
        """Names of all robots, in order."""
        return list(self.plans)

    def take_area(self, area: Area) -> None:
        """Take another area within the same bounds, as with other keep-outs."""
        self.area = area
        self.exploration.take_area(area)
        for name, plan in self.plans.items():
            plan.motion.take_area(area, plan.radius)
            plan.candidates = CandidateSet(
                plan.candidates.settings, area, self.settings.robots[name].start[2]
            )
            if plan.exploration is not None:
                plan.exploration.take_area(area)

    def begin_again(self) -> None:
        """Begin a new search with nothing explored; decision indices continue."""
        self.exploration.values[...] = 1.0
        self.finished = None
        self.planner = make_planner(self.settings.planner.name, self.settings.planner)
        self.trigger = MeasurementTrigger(self.settings.planner)
        for plan in self.plans.values():
            plan.leave()

    def planning(self, step: int, robots: Mapping[str, PresentRobot]) -> list[str]:
        """Return P_k, the robots that plan at a step, in order of their names.

        A robot plans when it has arrived, or is near enough to pass its waypoint without a stop;
        one that was commanded to stay replans at its next possible measurement.
        """
        if self.finished is not None:
            return []
        chosen = []
        for name in sorted(robots):
            plan, robot = self.plans[name], robots[name]
            if plan.endurance is not None:
                plan.endurance.hear(robot.charge)
                here = robot.state.pose.position
                if plan.endurance.charging:
                    # Its way home has ended elsewhere.
                    if robot.free and not plan.endurance.is_home(here):
                        chosen.append(name)
                    continue
                if not robot.free and plan.endurance.must_return(here):
                    chosen.append(name)
                    continue
            waited = plan.decided_at is None or step - plan.decided_at >= plan.period
            if plan.nears(robot) or (robot.free and (not plan.staying or waited)):
                chosen.append(name)
        return chosen

    def plan(
        self,
        step: int,
        robots: Mapping[str, PresentRobot],
        taken: Sequence[tuple[FloatArray, float]] = (),
    ) -> Decision | None:
        """Return the joint decision of the robots that plan at a step, None without any.

        A robot that nears its waypoint and has nowhere further to go is not in it: it goes on, and
        plans again when it has arrived.

        robots: those that take part, by name; taken: final positions (3,) of robots of other
        planners [m], and their radii.
        """
        planning = self.planning(step, robots)
        if not planning:
            return None
        arrived = [name for name in planning if robots[name].free]
        views = {
            name: self.plans[name].view(step, robots[name], name in planning)
            for name in sorted(robots)
        }
        knowledge = self.clusters, self.exploration
        team = TeamView(step, self.settings.step, views, *knowledge, taken)
        finished = self.planner.finished(team)
        if finished is not None:
            for name in planning:
                self.plans[name].turning_distance = 0.0
            if not arrived:
                return None
            self.finished = finished
            for name in arrived:
                plan = self.plans[name]
                plan.decision += 1
                plan.decided_at = plan.measured_from = step
                plan.staying = True
            return Decision(step=step, reason=finished)
        for name in planning:
            if (endurance := self.plans[name].endurance) is not None:
                endurance.spent = False
        decision = self.planner.decide(team)
        check_decision(self.planner, team, decision)
        decided = dict(decision.robots)
        for name in planning:
            home = self._way_home(team, name, decision, name in arrived)
            if home is not None:
                decision.robots[name] = home
        # Who has not arrived, and gets no other way, is still on its present one.
        under_way = [n for n in planning if n not in arrived and len(self.plans[n].positions)]
        keep_apart(team, decision, {name: self.plans[name].left(step)[0] for name in under_way})
        if any(decision.robots[name] is not chosen for name, chosen in decided.items()):
            explain(decision)
        for name in planning:
            plan, chosen = self.plans[name], decision.robots[name]
            if name not in arrived and chosen.stays:
                plan.turning_distance = 0.0
                if plan.endurance is not None:
                    plan.endurance.charging = False  # asked again at the next step
                del decision.robots[name]
                continue
            plan.adopt(step, robots[name], chosen)
            way = chosen.positions, chosen.yaws
            self.trigger.begin(name, plan.sensor, *way, plan.period, *knowledge)
        return decision if decision.robots else None

    def _way_home(
        self, team: TeamView, name: str, decision: Decision, arrived: bool
    ) -> RobotDecision | None:
        """Return the way to a charger of a robot that can afford nothing else, or None."""
        view, endurance = team.robots[name], self.plans[name].endurance
        if endurance is None or math.isnan(endurance.charge):
            return None
        here, chosen = view.state.pose.position, decision.robots[name]
        spent = endurance.spent
        if not chosen.stays:
            # Not every planner asks for the battery.
            way = view.motion.predict(view.state, chosen.waypoint[None], team.step_time)
            spent = not endurance.affords(way, team.step_time)[0]
        if not (spent or endurance.charging or endurance.must_return(here)):
            return None
        endurance.spent, endurance.charging = False, True
        battery = f'its battery is at {100.0 * endurance.charge:.0f} %'
        if arrived and endurance.is_home(here):
            return stay(view, f'charges: {battery}')
        return go_home(team, name, decision, f'goes home to charge: {battery}')

    def measuring(
        self, step: int, robots: Mapping[str, PresentRobot], able: Collection[str] | None = None
    ) -> list[Member]:
        """Return M_k, the robots that measure at a step, in order of their names."""
        members = []
        for name in sorted(robots):
            plan = self.plans[name]
            if plan.decided_at is None:
                continue
            plan.pass_waypoint(step, robots[name])
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

    def absorb(self, poses: Mapping[str, Pose], clusters: list[Cluster]) -> None:
        """Update with a batch that the filter has processed."""
        for name in sorted(poses):
            plan = self.plans[name]
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
