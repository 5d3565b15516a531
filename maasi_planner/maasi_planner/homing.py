"""Moves that the planner does not decide: out of closed zones, home, and to chargers."""

import math
from collections.abc import Collection, Mapping, Sequence

from maasi_filter.arrays import FloatArray
from maasi_planner.endurance import NOTHING_AFFORDABLE, SEARCH_ENDED, Endurance, Phase
from maasi_planner.motion import RobotState
from maasi_planner.planners.home_path import free_charger, go_home
from maasi_planner.robot_plan import Errand, PlannedRobot, PresentRobot
from maasi_planner.team import Decision, RobotDecision, TeamView, single_choice, stay

# A robot frees its charger for one that waits with less than this share of its reserve, and
# with so much less charge.
_URGENT, _MORE = 0.5, 0.2
# Charge of a full battery.
_FULL = 0.999
TOP = 'charges beyond full'  # reason of a phase
TOO_FAR = 'its charge is too low to reach any charger'
CUT_OFF = 'closed zones cut it off from every charger'


class Homing:
    """Decides which robots leave a closed zone, go home or charge.

    alarms: present problems by robot; news: decisions that the caller has not cleared; exhausted:
    batteries leave no robot anything to do.
    """

    def __init__(self, robots: Mapping[str, PlannedRobot]) -> None:
        self._robots = robots
        self.alarms: dict[str, str] = {}
        self.news: list[str] = []
        self.exhausted = False
        # Robots that come home at this step.
        self._landed: list[str] = []
        # Phases that begin with their decisions, and reasons of `DONE`.
        self._phases: dict[str, tuple[Phase, str]] = {}
        # Step from which no robot has anything to do.
        self._idle_since: int | None = None

    def begin_again(self) -> None:
        """Begin a new search."""
        self.alarms.clear()
        self._idle_since = None

    def adopt_area(self) -> None:
        """Reconsider positions that were out of reach after a change of the area."""
        self._idle_since = None
        for robot in self._robots.values():
            if (endurance := robot.endurance) is not None:
                endurance.adopt_area()
                if endurance.done_reason in (NOTHING_AFFORDABLE, SEARCH_ENDED):
                    endurance.begin(Phase.AVAILABLE)

    def update(self, step: int, present: Mapping[str, PresentRobot]) -> None:
        """Update with states and charges of a step."""
        self._landed, self.alarms = [], {}
        for name in sorted(present):
            robot, here = self._robots[name], present[name]
            if here.free and robot.plan.errand is not None and not robot.plan.staying:
                if robot.plan.errand is Errand.HOME and robot.is_home(here):
                    self._landed.append(name)
                robot.plan.errand = None
            if (endurance := robot.endurance) is None:
                continue
            before = endurance.done_reason
            robot.update_battery(step, here)
            if endurance.done_reason not in ('', before):
                self.news.append(f'{name}: {endurance.done_reason}')
            if endurance.cut_off:
                self.alarms[name] = CUT_OFF
            elif endurance.short:
                self.alarms[name] = TOO_FAR

    def note_idle(self, step: int, present: Mapping[str, PresentRobot]) -> None:
        """Note whether batteries leave no robot anything to do."""
        searching = {name: self._robots[name] for name, here in present.items() if here.searches}
        done = [name for name, robot in searching.items() if _is_done(robot)]
        idle = [name for name in searching if name not in done and _is_idle(searching[name])]
        limited = done or any(searching[name].endurance is not None for name in idle)
        self.exhausted = False
        if not limited or len(done) + len(idle) < len(searching):
            self._idle_since = None
            return
        if self._idle_since is None:
            self._idle_since = step
        since = self._idle_since
        self.exhausted = all((searching[name].plan.decided_at or 0) > since for name in idle)

    def estimates(self) -> list[str]:
        """Return robots that no longer report a charge, with their estimates."""
        return [
            f'{name}: the robot reports no charge; {robot.endurance.describe()}'
            for name, robot in self._robots.items()
            if robot.endurance is not None and robot.endurance.estimated
        ]

    def _at_home(self, name: str) -> str:
        endurance = self._endurance(name)
        if endurance.charging:
            return f'charges: {endurance.describe()}'
        return f'stays at home: {endurance.done_reason or endurance.describe()}'

    def is_available(self, name: str, here: PresentRobot) -> bool:
        """Return whether the planner decides for a robot."""
        robot = self._robots[name]
        if not here.searches or robot.plan.errand in (Errand.LEAVE, Errand.FREE):
            return False
        endurance = robot.endurance
        return endurance is None or (endurance.phase is Phase.AVAILABLE and not endurance.cut_off)

    def release(self, name: str) -> None:
        """Release a robot that charges, or is on its path to a charger."""
        endurance = self._robots[name].endurance
        if endurance is not None and endurance.phase is not Phase.AVAILABLE:
            endurance.begin(Phase.AVAILABLE)

    def occupies(self, name: str) -> bool:
        """Return whether a robot leaves a zone, goes to a charger, charges, or is done."""
        endurance, plan = self._robots[name].endurance, self._robots[name].plan
        home = endurance is not None and endurance.phase is not Phase.AVAILABLE
        return home or (plan.errand is not None and not plan.staying)

    def may_go(self, name: str, state: RobotState, goal: FloatArray, step_time: float) -> bool:
        """Return whether the battery suffices to go to a goal (3,) and then home."""
        endurance = self._robots[name].endurance
        if endurance is None or math.isnan(endurance.charge):
            return True
        if endurance.is_home(goal):
            return True  # to a charger
        path = self._robots[name].facts.motion.predict(state, goal[None, :], step_time)
        return bool(endurance.affords(path, step_time)[0])

    def errands(
        self, step: int, present: Mapping[str, PresentRobot], finished: bool
    ) -> dict[str, Errand]:
        """Return the robots that have to leave a zone or go home now."""
        found = {}
        for name in sorted(present):
            robot, here = self._robots[name], present[name]
            errand = _errand(robot, here, finished, step) if here.returns else None
            # A robot that could not go tries again later.
            if errand is not None and not _waits(robot, here, step):
                found[name] = errand
        # Robots with the least charge choose their chargers first.
        found = dict(sorted(found.items(), key=lambda item: (self._charge(item[0]), item[0])))
        for name in present:
            if self._is_wanted(name, present):
                found.setdefault(name, Errand.FREE)
        return found

    def waiting(
        self, step: int, present: Mapping[str, PresentRobot], errands: Collection[str]
    ) -> list[str]:
        """Return the robots that have just come home, or are cut off from every charger."""
        cut_off = [
            name
            for name, alarm in sorted(self.alarms.items())
            if alarm == CUT_OFF and present[name].searches and present[name].free
            if self._robots[name].is_due(step, present[name])
        ]
        return [name for name in (*cut_off, *self._landed) if name not in errands]

    def _charge(self, name: str) -> float:
        endurance = self._robots[name].endurance
        return 0.0 if endurance is None or math.isnan(endurance.charge) else endurance.charge

    def _is_wanted(self, name: str, present: Mapping[str, PresentRobot]) -> bool:
        """Return whether another robot urgently waits for a robot's charger."""
        robot, here = self._robots[name], present[name]
        endurance = robot.endurance
        if endurance is None or not here.returns or not robot.is_home(here):
            return False
        if endurance.phase is not Phase.CHARGING:
            return False
        for other in present:
            waiting = self._robots[other]
            if other == name or not waiting.plan.queues or waiting.endurance is None:
                continue
            charge = waiting.endurance.charge
            urgent = charge < _URGENT * waiting.endurance.settings.reserve
            near = waiting.endurance.is_home(here.state.pose.position)
            if urgent and near and endurance.charge > charge + _MORE:
                return True
        return False

    def decide(
        self,
        team: TeamView,
        waiting: Sequence[str],
        errands: Mapping[str, Errand],
        decision: Decision,
        finished: bool,
    ) -> None:
        """Add the decisions for waiting robots and errands."""
        for name in waiting:
            view = team.robots[name]
            landed = name in self._landed
            decision.robots[name] = stay(
                view, self._at_home(name) if landed else f'waits: {CUT_OFF}'
            )
        for name, errand in errands.items():
            view = team.robots[name]
            if errand is Errand.LEAVE:
                goal = view.motion.keep_out.exit_from(view.state.pose.position)
                assert goal is not None
                path = view.motion.predict(view.state, goal[None, :], team.step_time)
                chosen = single_choice(goal[None, :], path, 0, Errand.LEAVE.value)
            elif errand is Errand.FREE:
                self._phases[name] = Phase.RETURNING, ''
                chosen = free_charger(team, name, decision, Errand.FREE.value)
            else:
                chosen = self._home(team, name, decision, finished)
            decision.robots[name] = chosen

    def _home(self, team: TeamView, name: str, decision: Decision, finished: bool) -> RobotDecision:
        endurance = self._endurance(name)
        done = finished or endurance.phase is Phase.DONE
        why = endurance.done_reason or SEARCH_ENDED
        self._phases[name] = (Phase.DONE, why) if done else (Phase.RETURNING, '')
        reason = f'goes home: {why}' if done else f'goes home to charge: {endurance.describe()}'
        if done and endurance.must_return:
            reason += f', {endurance.describe()}'
        return go_home(team, name, decision, reason)

    def check(self, team: TeamView, decision: Decision, arrived: Collection[str]) -> None:
        """Send robots home that cannot afford their legs."""
        for name in list(decision.robots):
            view, chosen = team.robots[name], decision.robots[name]
            endurance = self._robots[name].endurance
            if endurance is None or math.isnan(endurance.charge):
                continue
            unaffordable = chosen.unaffordable
            if not chosen.stays:
                # Not every planner checks the battery.
                path = view.motion.predict(view.state, chosen.waypoint[None], team.step_time)
                unaffordable = not endurance.affords(path, team.step_time)[0]
            if unaffordable:
                changed = self._unaffordable(team, name, decision, name in arrived)
                decision.robots[name] = changed

    def _unaffordable(
        self, team: TeamView, name: str, decision: Decision, arrived: bool
    ) -> RobotDecision:
        endurance, view, chosen = self._endurance(name), team.robots[name], decision.robots[name]
        home = arrived and endurance.is_home(view.state.pose.position)
        if not endurance.full:
            if home:
                self._phases[name] = Phase.CHARGING, ''
                return stay(view, f'charges: {endurance.describe()}')
            return self._home(team, name, decision, False)
        if chosen.stays and not chosen.saves_battery:
            return chosen  # other robots visit what remains
        if not home:
            return self._home(team, name, decision, False)
        if endurance.charge < _FULL and not endurance.topped:
            self._phases[name] = Phase.CHARGING, TOP
            return stay(view, f'charges: {endurance.describe()}')
        self._phases[name] = Phase.DONE, NOTHING_AFFORDABLE
        return stay(view, f'stays: {NOTHING_AFFORDABLE}')

    def adopt(self, name: str, errand: Errand | None) -> None:
        """Enter the phase of an executed decision."""
        robot, endurance = self._robots[name], self._robots[name].endurance
        phase, reason = self._phases.pop(name, (None, ''))
        if errand is not None or phase is Phase.RETURNING:
            robot.plan.errand = errand or Errand.HOME
        if phase is not None and endurance is not None:
            if phase is Phase.DONE and endurance.done_reason != reason:
                self.news.append(f'{name}: {reason}')
            if reason == TOP:
                endurance.top()
            elif endurance.phase is not phase or endurance.done_reason != reason:
                endurance.begin(phase, reason)

    def drop(self, name: str) -> None:
        """Forget the decision for a robot that continues its path."""
        self._phases.pop(name, None)

    def settled(self, present: Mapping[str, PresentRobot]) -> bool:
        """Return whether every robot that goes home after the search is there, or cannot go."""
        return not any(
            robot.endurance is not None
            and here.searches
            and not robot.endurance.cut_off
            and not robot.is_home(here)
            and not (robot.plan.staying and robot.plan.errand is not None)
            and (here.free or not robot.plan.staying)
            for robot, here in ((self._robots[name], here) for name, here in present.items())
        )

    def _endurance(self, name: str) -> Endurance:
        endurance = self._robots[name].endurance
        assert endurance is not None
        return endurance


def _errand(robot: PlannedRobot, here: PresentRobot, finished: bool, step: int) -> Errand | None:
    plan, endurance = robot.plan, robot.endurance
    leaving = plan.errand is Errand.LEAVE and not here.free
    # The exit is chosen again on the path, as zones change and lines are not followed exactly.
    recent = step - (plan.decided_at or 0) < robot.facts.period
    if not (leaving and recent) and _is_in_zone(robot, here):
        return Errand.LEAVE
    if leaving or endurance is None or endurance.cut_off:
        return None
    if plan.errand is not None and not here.free and not plan.staying:
        return None
    if here.free and endurance.is_home(here.state.pose.position):
        return None
    if endurance.must_return:
        return Errand.HOME
    if not here.searches:
        return None
    # A robot without a plan that is not free follows another client.
    at_once = finished and (here.free or not plan.staying)
    waiting = here.free and endurance.phase in (Phase.RETURNING, Phase.DONE)
    return Errand.HOME if at_once or waiting else None


def _is_in_zone(robot: PlannedRobot, here: PresentRobot) -> bool:
    keep_out = robot.facts.motion.keep_out
    if keep_out.area is None or not keep_out.area.settings.keep_outs:
        return False
    return keep_out.exit_from(here.state.pose.position) is not None


def _waits(robot: PlannedRobot, here: PresentRobot, step: int) -> bool:
    """Return whether a robot that could not go still waits for its next attempt."""
    plan = robot.plan
    refused = plan.staying and plan.errand is not None and plan.decided_at is not None
    return refused and here.free and step - (plan.decided_at or 0) < robot.facts.period


def _is_done(robot: PlannedRobot) -> bool:
    return robot.endurance is not None and robot.endurance.phase is Phase.DONE


def _is_idle(robot: PlannedRobot) -> bool:
    if robot.endurance is not None and robot.endurance.phase is not Phase.AVAILABLE:
        return False
    return robot.plan.staying and robot.plan.idle
