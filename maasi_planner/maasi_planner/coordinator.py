"""Step-by-step planning of a team: robots that plan and measure, explored area.

The planner node and the in-process search use it (000, algorithms 1 and 2).
"""

import copy
from collections.abc import Collection, Mapping, Sequence

from maasi_filter.arrays import FloatArray
from maasi_filter.geometry.area import Area
from maasi_filter.models.pose import Pose
from maasi_filter.models.sensor import Sensor
from maasi_filter.records import Cluster
from maasi_filter.reports import SEARCHED, SIGHTING, Report, sighting_of
from maasi_filter.unexplored_map import UnexploredMap
from maasi_planner.candidates import CandidateSet, half_view, map_spacing
from maasi_planner.endurance import NOTHING_AFFORDABLE, Endurance
from maasi_planner.homing import Homing
from maasi_planner.measurement_schedule import MeasurementSchedule
from maasi_planner.motion import MotionModel, make_motion
from maasi_planner.node_settings import PlannerNodeSettings
from maasi_planner.planners import Planner, make_planner
from maasi_planner.planners.base import check_decision, explain
from maasi_planner.planners.separation import keep_apart
from maasi_planner.robot_plan import (
    Errand,
    Member,
    PlannedRobot,
    PresentRobot,
    RobotFacts,
)
from maasi_planner.settings import PLANNERS, PlannerSettings
from maasi_planner.team import Decision, TeamView, stay

_ROUNDING = 1e-9  # of shares


class Coordinator:
    """Plans for a team step by step; `finished` is why the search ends, or None."""

    def __init__(self, settings: PlannerNodeSettings, area: Area | None = None) -> None:
        self.settings = settings
        self.area = area or Area(settings.environment)
        dimension = settings.environment.dimension
        sensors = {
            name: robot.sensor.build(name, dimension)
            for name, robot in sorted(settings.robots.items())
        }
        spacing, _ = map_spacing(self.area.bounds, sensors.values())
        self.exploration = UnexploredMap(self.area, settings.exploration_spacing or spacing)
        # e after the searches of others alone, with which a search begins again.
        self._by_others: UnexploredMap | None = None
        self.clusters: list[Cluster] = []
        self.finished: str | None = None
        self.planner = self._planner()
        self.robots = {name: self._robot(name, sensor) for name, sensor in sensors.items()}
        self.homing = Homing(self.robots)
        self._ended = False
        # Robots that were not planned after ground was opened.
        self._unasked: set[str] = set()

    def _planner(self) -> Planner | None:
        """Return the planner, or None if the first planning robots determine it."""
        settings = self.settings.planner
        return None if settings.name == 'auto' else make_planner(settings.name, settings)

    def _robot(self, name: str, sensor: Sensor) -> PlannedRobot:
        planner, robot, step = self.settings.planner, self.settings.robots[name], self.settings.step
        motion = make_motion(robot.motion, self.area, robot.radius)
        period = max(1, round(robot.sensor.period / step))
        radius = arrival_radius(motion, sensor, planner)
        separate = getattr(planner, 'agent_exploration', 'shared') == 'own'
        battery = robot.endurance
        return PlannedRobot(
            RobotFacts(motion, sensor, period, robot.radius, radius),
            CandidateSet(robot.candidates, self.area, height=robot.start[2]),
            MeasurementSchedule(motion, sensor, period, planner),
            None if battery is None else Endurance(battery, motion, robot.start, step),
            self.exploration.copy() if separate else None,
        )

    # ---- queries -----------------------------------------------------------------------------

    @property
    def names(self) -> list[str]:
        """Names of all robots, in order."""
        return list(self.robots)

    @property
    def ended(self) -> str | None:
        """Why the search has ended, once robots with batteries are home, or None."""
        return self.finished if self._ended else None

    def planning(self, step: int, present: Mapping[str, PresentRobot]) -> list[str]:
        """Return P_k, the robots that plan at a step, in order of their names."""
        if self.finished is not None:
            return []
        return [
            name
            for name in sorted(present)
            if self.homing.is_available(name, present[name])
            and self.robots[name].is_due(step, present[name])
        ]

    def _open_share(self) -> float:
        exploration = self.exploration
        return 1.0 - exploration.explored_fraction() - exploration.closed_share()

    def _closed(self) -> float:
        """Return the expected number of targets in closed zones; 0 if negligible."""
        share = self.exploration.closed_share()
        least = 1.0 - self.settings.planner.explored_threshold
        return share * self.area.expected_targets if share > least else 0.0

    # ---- changes -----------------------------------------------------------------------------

    def adopt_area(self, area: Area) -> None:
        """Change keep-outs within the same bounds; opened ground resumes a finished search."""
        before = self._open_share()
        self.exploration.adopt_area(area)
        self.area = self.exploration.area
        if self._open_share() > before + _ROUNDING:
            self._resume()
        if self._by_others is not None:
            self._by_others.adopt_area(area)
        for robot in self.robots.values():
            robot.adopt_area(area)
        self.homing.adopt_area()

    def _resume(self) -> None:
        self.finished, self._ended = None, False
        # Earlier decisions do not account for the ground that is opened, or more likely.
        self._unasked = set(self.robots)

    def use(self, report: Report) -> None:
        """Use a statement of a person as the filter did; a sighting resumes a finished search."""
        if report.kind == SEARCHED and self._by_others is None:
            self._by_others = self.exploration.copy()
            self._by_others.values[...] = 1.0
        maps = [self.exploration, self._by_others]
        maps += [robot.exploration for robot in self.robots.values()]
        if report.kind == SIGHTING:
            self.area = self.area.with_sightings((*self.area.sightings, sighting_of(report)))
            self._resume()
        elif report.kind == SEARCHED:
            # Another object, as plans hold as long as the area is the same one.
            self.area = copy.copy(self.area)
        for exploration in (item for item in maps if item is not None):
            if report.kind == SIGHTING:
                exploration.adopt_sightings(self.area)
            elif report.kind == SEARCHED:
                exploration.search(report.shape, report.weight)
                exploration.area = self.area

    def begin_again(self) -> None:
        """Begin a new search: only what others searched is explored; decision indices continue."""
        before = 1.0 if self._by_others is None else self._by_others.values
        self.exploration.values[...] = before
        self.clusters = []
        self.finished, self._ended, self._unasked = None, False, set()
        self.planner = self._planner()
        for robot in self.robots.values():
            robot.begin_again(before)
        self.homing.begin_again()

    def plan(
        self,
        step: int,
        present: Mapping[str, PresentRobot],
        taken: Sequence[tuple[FloatArray, float]] = (),
    ) -> Decision | None:
        """Return the joint decision for a step; None without any.

        It contains robots that leave a closed zone or go home, but none that nears its waypoint
        without a next one. At the end of the search, a decision without robots has the reason.
        taken: final positions (3,) [m] and radii of robots of other planners.
        """
        # Update batteries.
        self.homing.update(step, present)
        self._check_batteries(step, present)
        # Robots with errands, waiting robots, and robots that the planner decides for.
        errands = self.homing.errands(step, present, self.finished is not None)
        waiting = self.homing.waiting(step, present, errands)
        asked = [name for name in self.planning(step, present) if name not in errands]
        if not (errands or waiting or asked):
            return self._end(step, present)
        # The planner decides, or ends the search.
        team = self._view(step, present, asked, taken)
        decision = self._decide(team, present, asked)
        decided = dict(decision.robots)
        # The end of the search may add errands.
        if asked and self.finished is not None:
            errands = self.homing.errands(step, present, True)
        self.homing.decide(team, waiting, errands, decision, self.finished is not None)
        # Keep robots apart, and set their plans.
        keep_apart(team, decision, self._remaining(step, present, decision))
        self._adopt(step, present, decision, errands)
        changed = any(decided.get(name) is not item for name, item in decision.robots.items())
        if changed or not decision.reason:
            explain(decision)
        return decision if decision.robots else self._end(step, present)

    def _check_batteries(self, step: int, present: Mapping[str, PresentRobot]) -> None:
        if self.finished is not None or self._closed():
            return
        self.homing.note_idle(step, present)
        if self.homing.exhausted:
            self.finished = f'{NOTHING_AFFORDABLE} ({self.exploration.describe()})'

    def _view(
        self,
        step: int,
        present: Mapping[str, PresentRobot],
        asked: Sequence[str],
        taken: Sequence[tuple[FloatArray, float]],
    ) -> TeamView:
        views = {
            name: self.robots[name].view(step, present[name], name in asked)
            for name in sorted(present)
        }
        return TeamView(step, self.settings.step, views, self.clusters, self.exploration, taken)

    def _decide(
        self, team: TeamView, present: Mapping[str, PresentRobot], asked: Sequence[str]
    ) -> Decision:
        if not asked:
            return Decision(team.step)
        unasked = self._unasked.intersection(asked)
        self._unasked -= unasked
        settings = self.settings.planner
        planner = self.planner = self.planner or make_planner(settings.name, settings, team)
        conclusion = None if unasked else planner.finished(team)
        if conclusion is not None:
            return self._conclude(team, present, asked, conclusion)
        decision = planner.decide(team)
        check_decision(planner, team, decision)
        decision.reason = planner.prefix + decision.reason
        decided = dict(decision.robots)
        self.homing.check(team, decision, [name for name in decided if present[name].free])
        if any(decision.robots[name] is not chosen for name, chosen in decided.items()):
            explain(decision)
        return decision

    def _conclude(
        self,
        team: TeamView,
        present: Mapping[str, PresentRobot],
        asked: Sequence[str],
        conclusion: str,
    ) -> Decision:
        """Finish the search, or let robots wait for closed zones."""
        decision, closed = Decision(team.step), self._closed()
        for name in asked:
            self.robots[name].plan.turning_distance = 0.0
        for name in [name for name in asked if present[name].free]:
            if closed:
                reason = f'waits: closed zones hold {closed:.2g} expected targets'
                decision.robots[name] = stay(team.robots[name], reason)
            else:
                self.finished = conclusion
                self.robots[name].stay(team.step)
        return decision

    def _remaining(
        self, step: int, present: Mapping[str, PresentRobot], decision: Decision
    ) -> dict[str, FloatArray]:
        """Return the paths that robots continue without another one, as they have not arrived."""
        return {
            name: self.robots[name].plan.remaining(step)[0]
            for name in decision.robots
            if not present[name].free and len(self.robots[name].plan.positions)
        }

    def _adopt(
        self,
        step: int,
        present: Mapping[str, PresentRobot],
        decision: Decision,
        errands: Mapping[str, Errand],
    ) -> None:
        """Set the robots' plans; a moving robot that would stay continues its path."""
        for name, chosen in list(decision.robots.items()):
            robot = self.robots[name]
            if chosen.stays and not present[name].free:
                robot.plan.turning_distance = 0.0
                self.homing.drop(name)
                del decision.robots[name]
                continue
            robot.adopt(step, present[name], chosen)
            robot.schedule.predict(chosen.positions, chosen.yaws, self.clusters, self.exploration)
            self.homing.adopt(name, errands.get(name))

    def _end(self, step: int, present: Mapping[str, PresentRobot]) -> Decision | None:
        """Return the decision without robots of a search that ends now, or None."""
        if self.finished is None or self._ended or not self.homing.settled(present):
            return None
        self._ended = True
        return Decision(step=step, reason=self.finished)

    def measure(
        self, step: int, present: Mapping[str, PresentRobot], able: Collection[str] | None = None
    ) -> list[Member]:
        """Begin the measurements of a step; return M_k, the robots that measure, in order."""
        members = []
        for name in sorted(present):
            plan, schedule = self.robots[name].plan, self.robots[name].schedule
            if plan.decided_at is None or not present[name].searches:
                continue
            pose = present[name].state.pose
            underway = self.planner is None or self.planner.measures_underway
            schedule.update(step, pose, underway, self.clusters, self.exploration)
            if schedule.due and (able is None or name in able):
                members.append(Member(name, plan.decision, schedule.begin()))
        return members

    def absorb(self, poses: Mapping[str, Pose], clusters: list[Cluster]) -> None:
        """Update with a batch processed by the filter."""
        for name in sorted(poses):
            robot = self.robots[name]
            for exploration in (self.exploration, robot.exploration):
                if exploration is not None:
                    exploration.update(robot.facts.sensor.detection, poses[name])
        self.clusters = clusters


def arrival_radius(motion: MotionModel, sensor: Sensor, settings: PlannerSettings) -> float:
    """Return the distance from its waypoint at which a robot takes its next decision [m].

    It is the setting `arrival_radius`, or 0, as in 000, for the papers' objective and planners that
    measure only at waypoints. For others it is the braking distance, at most the reach of the
    sensor to each side, so that the robot sees from its path what it would have seen at the
    waypoint.
    """
    given = motion.settings.arrival_radius
    if given is not None:
        return given
    planner: type[Planner] = PLANNERS.load(settings.name)
    if settings.stops or not planner.measures_underway:
        return 0.0
    return min(motion.braking_distance(), half_view(sensor))
