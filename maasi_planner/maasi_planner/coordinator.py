"""Planning of the team step by step: which robots plan and measure, what is explored.

Used by the planner node and the in-process search (000, algorithms 1 and 2).
"""

from collections.abc import Collection, Mapping, Sequence

from maasi_filter.arrays import FloatArray
from maasi_filter.geometry.area import Area
from maasi_filter.models.pose import Pose
from maasi_filter.models.sensor import Sensor
from maasi_filter.records import Cluster
from maasi_filter.unexplored_map import UnexploredMap
from maasi_planner.candidates import CandidateSet, half_view, map_spacing
from maasi_planner.endurance import NOTHING_AFFORDABLE, Endurance
from maasi_planner.homing import CUT_OFF, Homing, waits_cut_off
from maasi_planner.measurement_trigger import MeasurementTrigger
from maasi_planner.motion import MotionModel, make_motion
from maasi_planner.node_settings import PlannerNodeSettings
from maasi_planner.planners import Planner, make_planner
from maasi_planner.planners.base import check_decision, explain
from maasi_planner.planners.separation import keep_apart
from maasi_planner.robot_plan import Errand, Member, PresentRobot, RobotPlan
from maasi_planner.settings import PlannerSettings
from maasi_planner.team import Decision, RobotDecision, TeamView, stay

_ROUNDING = 1e-9  # of shares


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
        sensors = {
            name: robot.sensor.build(name, self.dimension)
            for name, robot in sorted(settings.robots.items())
        }
        spacing, _ = map_spacing(self.area.bounds, sensors.values())
        spacing = settings.exploration_spacing or spacing
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
            sensor = sensors[name]
            self.plans[name] = RobotPlan(
                motion=motion,
                sensor=sensor,
                candidates=CandidateSet(robot.candidates, self.area, height=robot.start[2]),
                period=max(1, round(robot.sensor.period / settings.step)),
                radius=robot.radius,
                arrival_radius=arrival_radius(motion, sensor, self.planner),
                endurance=None
                if robot.endurance is None
                else Endurance(robot.endurance, motion, robot.start, settings.step),
                exploration=self.exploration.copy() if own else None,
            )
        self.homing = Homing(self.plans)
        self._ended = False
        # Robots that have not been planned since ground was opened.
        self._unasked: set[str] = set()
        self._live = _live(settings.planner)

    @property
    def names(self) -> list[str]:
        """Names of all robots, in order."""
        return list(self.plans)

    def take_area(self, area: Area) -> None:
        """Take another area within the same bounds, as with other keep-outs.

        A search that was finished continues where that opens something.
        """
        self.area = area
        before = self._open_share()
        self.exploration.take_area(area)
        if self._open_share() > before + _ROUNDING:
            self.finished, self._ended = None, False
            # What the planner knew of each before says nothing about ground that is opened.
            self._unasked = set(self.plans)
        lasting = Area(area.settings.without_keep_outs())
        for name, plan in self.plans.items():
            plan.motion.take_area(area, plan.radius)
            plan.candidates = CandidateSet(
                plan.candidates.settings, lasting, self.settings.robots[name].start[2]
            )
            plan.candidates.restrict(area)
            if plan.exploration is not None:
                plan.exploration.take_area(area)
        self.homing.take_area()

    def begin_again(self) -> None:
        """Begin a new search with nothing explored; decision indices continue."""
        self.exploration.values[...] = 1.0
        self.clusters = []
        self.finished, self._ended, self._unasked = None, False, set()
        self.homing.begin_again()
        self.planner = make_planner(self.settings.planner.name, self.settings.planner)
        self.trigger = MeasurementTrigger(self.settings.planner)
        for plan in self.plans.values():
            plan.leave()
            if plan.exploration is not None:
                plan.exploration.values[...] = 1.0

    @property
    def ended(self) -> str | None:
        """Why no gain is left, once the robots with batteries are home; None before."""
        return self.finished if self._ended else None

    def planning(self, step: int, robots: Mapping[str, PresentRobot]) -> list[str]:
        """Return P_k, the robots that plan at a step, in order of their names.

        A robot plans when it has arrived, or is near enough to pass its waypoint without a stop;
        one that was commanded to stay replans at its next possible measurement.
        """
        if self.finished is not None:
            return []
        return [
            name
            for name in sorted(robots)
            if self.homing.is_available(name, robots[name]) and self._is_due(name, step, robots)
        ]

    def _is_due(self, name: str, step: int, robots: Mapping[str, PresentRobot]) -> bool:
        plan, robot = self.plans[name], robots[name]
        waited = plan.decided_at is None or step - plan.decided_at >= plan.period
        return plan.nears(robot) or (robot.free and (not plan.staying or waited))

    def plan(
        self,
        step: int,
        robots: Mapping[str, PresentRobot],
        taken: Sequence[tuple[FloatArray, float]] = (),
    ) -> Decision | None:
        """Return the joint decision of the robots that plan at a step, None without any.

        A robot that nears its waypoint and has nowhere further to go is not in it: it goes on, and
        plans again when it has arrived. Robots that leave a closed zone or go home are in it,
        whatever the planner thinks. At the end of the search a decision without robots has its
        reason.

        robots: those that take part, by name; taken: final positions (3,) of robots of other
        planners [m], and their radii.
        """
        self._take_settings()
        self.homing.update(step, robots, self.settings.step)
        if self.finished is None and not self._closed() and self.homing.exhausted(step, robots):
            explored = 100.0 * self.exploration.explored_fraction()
            self.finished = (
                f'{NOTHING_AFFORDABLE} ({explored:.1f} % of the environment is explored)'
            )
        errands = self.homing.errands(step, robots, self.finished is not None)
        asked = [name for name in self.planning(step, robots) if name not in errands]
        cut_off = [
            name
            for name, alarm in sorted(self.homing.alarms.items())
            if alarm == CUT_OFF
            if robots[name].searches and robots[name].free and self._is_due(name, step, robots)
            if name not in errands
        ]
        landed = [name for name in self.homing.landed if name not in errands]
        decision = Decision(step)
        if asked or errands or landed or cut_off:
            views = {
                name: self.plans[name].view(step, robots[name], name in asked)
                for name in sorted(robots)
            }
            knowledge = self.clusters, self.exploration
            team = TeamView(step, self.settings.step, views, *knowledge, taken)
            if asked and self._concludes(team, robots, asked, decision):
                errands = self.homing.errands(step, robots, self.finished is not None)
            elif asked:
                decision = self._ask(team, robots)
            before = dict(decision.robots)
            for name in cut_off:
                decision.robots[name] = waits_cut_off(views[name])
            for name in landed:
                decision.robots[name] = self.homing.at_home(views[name], name)
            self.homing.decide(team, errands, decision, self.finished is not None)
            self._carry_out(team, robots, decision, errands, before)
        if decision.robots or self.finished is None or self._ended:
            return decision if decision.robots else None
        self._ended = self.homing.settled(robots)
        return Decision(step=step, reason=self.finished) if self._ended else None

    def _take_settings(self) -> None:
        """Hand settings that were changed while the search runs to the planner."""
        settings = self.settings.planner
        if (live := _live(settings)) != self._live:
            self._live = live
            self.planner.take_settings(settings)

    def _open_share(self) -> float:
        """Return the share of the expected targets that is unseen on ground that is open."""
        exploration = self.exploration
        return 1.0 - exploration.explored_fraction() - exploration.closed_share()

    def _closed(self) -> float:
        """Return how many targets are expected where zones are closed now; 0 if hardly any."""
        share = self.exploration.closed_share()
        least = 1.0 - self.settings.planner.explored_threshold
        return share * self.area.expected_targets if share > least else 0.0

    def _concludes(
        self,
        team: TeamView,
        robots: Mapping[str, PresentRobot],
        asked: Sequence[str],
        decision: Decision,
    ) -> bool:
        """Return whether nothing is left to gain now; then the robots wait, or are finished."""
        unasked = self._unasked.intersection(asked)
        self._unasked -= unasked
        conclusion = None if unasked else self.planner.finished(team)
        if conclusion is None:
            return False
        arrived = [name for name in asked if robots[name].free]
        for name in asked:
            self.plans[name].turning_distance = 0.0
        closed = self._closed()
        for name in arrived if closed else ():
            reason = f'waits: closed zones hold {closed:.2g} expected targets'
            decision.robots[name] = stay(team.robots[name], reason)
        if arrived and not closed:
            self.finished = conclusion
            for name in arrived:
                plan = self.plans[name]
                plan.decision += 1
                plan.decided_at = plan.measured_from = team.step
                plan.staying = True
        return True

    def _ask(self, team: TeamView, robots: Mapping[str, PresentRobot]) -> Decision:
        """Return what the planner decides, with the paths home of robots that afford nothing."""
        decision = self.planner.decide(team)
        check_decision(self.planner, team, decision)
        decided = dict(decision.robots)
        self.homing.check(team, decision, [name for name in decided if robots[name].free])
        if any(decision.robots[name] is not chosen for name, chosen in decided.items()):
            explain(decision)
        return decision

    def _carry_out(
        self,
        team: TeamView,
        robots: Mapping[str, PresentRobot],
        decision: Decision,
        errands: Mapping[str, Errand],
        before: Mapping[str, RobotDecision],
    ) -> None:
        """Keep robots apart, and adopt the plans of those that get one.

        before: what was decided before errands were added.
        """
        # A robot that has not arrived, and gets no other path, is still on its present one.
        left = {
            name: self.plans[name].left(team.step)[0]
            for name in decision.robots
            if not robots[name].free and len(self.plans[name].positions)
        }
        keep_apart(team, decision, left)
        for name, chosen in list(decision.robots.items()):
            plan = self.plans[name]
            if chosen.stays and not robots[name].free:
                plan.turning_distance = 0.0
                self.homing.drop(name)
                del decision.robots[name]
                continue
            plan.adopt(team.step, robots[name], chosen)
            self.homing.adopt(name, chosen, errands.get(name))
            way, knowledge = (chosen.positions, chosen.yaws), (self.clusters, self.exploration)
            self.trigger.begin(name, plan.sensor, *way, plan.period, *knowledge)
        changed = any(before.get(name) is not item for name, item in decision.robots.items())
        if changed or not decision.reason:
            explain(decision)

    def measuring(
        self, step: int, robots: Mapping[str, PresentRobot], able: Collection[str] | None = None
    ) -> list[Member]:
        """Return M_k, the robots that measure at a step, in order of their names."""
        members = []
        for name in sorted(robots):
            plan = self.plans[name]
            if plan.decided_at is None or not robots[name].searches:
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


def _live(settings: PlannerSettings) -> tuple[object, ...]:
    """Return the values that may change while a search runs."""
    names = sorted(PlannerNodeSettings.live)
    parts = [name.removeprefix('planner.') for name in names if name.startswith('planner.')]
    return tuple(getattr(settings, part) for part in parts)


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
