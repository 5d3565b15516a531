"""Moves of robots that the planner does not decide: out of closed zones, home, and to charge."""

import math
from collections.abc import Collection, Mapping

import numpy as np

from maasi_filter.arrays import FloatArray
from maasi_planner.endurance import NOTHING_AFFORDABLE, SEARCH_ENDED, Endurance, Phase
from maasi_planner.motion import RobotState
from maasi_planner.planners.way_home import go_home, make_room
from maasi_planner.robot_plan import Errand, PresentRobot, RobotPlan
from maasi_planner.team import Decision, RobotDecision, RobotView, TeamView, single_choice, stay

# A robot at a charger makes room for one that waits for it with less than this share of its
# reserve, and with so much less charge than its own.
_URGENT, _MORE = 0.5, 0.2
# Charge of a battery that cannot be charged any further.
_FULL = 0.999
TOP = 'charges beyond full'  # in place of the reason of a phase
TOO_FAR = 'its battery does not last for the path to any charger'
CUT_OFF = 'closed zones cut it off from every charger'


class Homing:
    """Decides which robots leave a closed zone, go home or charge, whatever the planner thinks.

    plans: of all robots, by name; alarms: what is wrong with robots now, by name; news: what has
    been decided about batteries since the caller last cleared it.
    """

    def __init__(self, plans: Mapping[str, RobotPlan]) -> None:
        self._plans = plans
        self.alarms: dict[str, str] = {}
        #: Robots that have come home at this step.
        self.landed: list[str] = []
        self.news: list[str] = []
        # Phases that begin when their decisions are carried out, with the reason of a last one.
        self._phases: dict[str, tuple[Phase, str]] = {}
        # Since which step no robot has had anything to do.
        self._idle_since: int | None = None

    def begin_again(self) -> None:
        """Begin a new search."""
        self.alarms.clear()
        self._idle_since = None
        for plan in self._plans.values():
            if plan.endurance is not None:
                plan.endurance.begin_again()

    def take_area(self) -> None:
        """Take another area: what was out of reach may be in reach again."""
        self._idle_since = None
        for plan in self._plans.values():
            if (endurance := plan.endurance) is not None:
                endurance.take_area()
                if endurance.done_reason in (NOTHING_AFFORDABLE, SEARCH_ENDED):
                    endurance.begin(Phase.AVAILABLE)

    def update(self, step: int, robots: Mapping[str, PresentRobot], step_time: float) -> None:
        """Take states and charges of a step."""
        self.landed = []
        for name in sorted(robots):
            plan, robot = self._plans[name], robots[name]
            if robot.free and plan.errand is not None and not plan.staying:
                if plan.errand is Errand.HOME and plan.is_home(robot):
                    self.landed.append(name)
                plan.errand = None
            before = '' if plan.endurance is None else plan.endurance.done_reason
            plan.update_battery(step, robot, step_time)
            endurance = plan.endurance
            if endurance is not None and endurance.done_reason not in ('', before):
                self.news.append(f'{name}: {endurance.done_reason}')
        self.alarms = {}
        for name in sorted(robots):
            if (endurance := self._plans[name].endurance) is not None:
                if endurance.cut_off:
                    self.alarms[name] = CUT_OFF
                elif endurance.short:
                    self.alarms[name] = TOO_FAR

    def estimates(self) -> list[str]:
        """Return the robots whose charge is not reported any more, with what is assumed."""
        return [
            f'{name}: no charge is reported, {plan.endurance.describe()}'
            for name, plan in self._plans.items()
            if plan.endurance is not None and plan.endurance.estimated
        ]

    def at_home(self, view: RobotView, name: str) -> RobotDecision:
        """Return the decision of a robot that has come home."""
        endurance = self._endurance(name)
        if endurance.charging:
            return stay(view, f'charges: {endurance.describe()}')
        return stay(view, f'stays at home: {endurance.done_reason or endurance.describe()}')

    def is_available(self, name: str, robot: PresentRobot) -> bool:
        """Return whether the planner may send a robot."""
        plan = self._plans[name]
        if not robot.searches or plan.errand in (Errand.LEAVE, Errand.ROOM):
            return False
        endurance = plan.endurance
        return endurance is None or (endurance.phase is Phase.AVAILABLE and not endurance.cut_off)

    def release(self, name: str) -> None:
        """Let a robot go that was on its way to a charger, or charged."""
        endurance = self._plans[name].endurance
        if endurance is not None and endurance.phase is not Phase.AVAILABLE:
            endurance.begin(Phase.AVAILABLE)

    def occupies(self, name: str) -> bool:
        """Return whether a robot leaves a zone, is on its way to a charger, charges, or is done."""
        plan = self._plans[name]
        home = plan.endurance is not None and plan.endurance.phase is not Phase.AVAILABLE
        return home or (plan.errand is not None and not plan.staying)

    def may_go(self, name: str, state: RobotState, goal: FloatArray, step_time: float) -> bool:
        """Return whether the battery of a robot allows it to go to a goal (3,) and then home."""
        endurance = self._plans[name].endurance
        if endurance is None or math.isnan(endurance.charge):
            return True
        if endurance.is_home(goal):
            return True  # it goes to a charger
        path = self._plans[name].motion.predict(state, goal[None, :], step_time)
        return bool(endurance.affords(path, step_time)[0])

    def errands(
        self, step: int, robots: Mapping[str, PresentRobot], finished: bool
    ) -> dict[str, Errand]:
        """Return the robots that have to leave a zone, or to go home, now."""
        found = {}
        for name in sorted(robots):
            plan, robot = self._plans[name], robots[name]
            errand = self._errand(plan, robot, finished, step) if robot.returns else None
            # Where it could not go it tries again after a while.
            if errand is not None and not _waits(plan, robot, step):
                found[name] = errand
        # Those with the least charge choose their chargers first.
        found = dict(sorted(found.items(), key=lambda item: (self._charge(item[0]), item[0])))
        for name in robots:
            if self._is_wanted(name, robots):
                found.setdefault(name, Errand.ROOM)
        return found

    def _charge(self, name: str) -> float:
        endurance = self._plans[name].endurance
        return 0.0 if endurance is None or math.isnan(endurance.charge) else endurance.charge

    def _is_wanted(self, name: str, robots: Mapping[str, PresentRobot]) -> bool:
        """Return whether a robot occupies a charger for which another one waits urgently."""
        plan, robot = self._plans[name], robots[name]
        endurance = plan.endurance
        if endurance is None or not robot.returns or not plan.is_home(robot):
            return False
        if endurance.phase is not Phase.CHARGING:
            return False
        for other in robots:
            waiting = self._plans[other]
            if other == name or not waiting.queues or waiting.endurance is None:
                continue
            charge = waiting.endurance.charge
            urgent = charge < _URGENT * waiting.endurance.settings.reserve
            near = waiting.endurance.is_home(robot.state.pose.position)
            if urgent and near and endurance.charge > charge + _MORE:
                return True
        return False

    def _errand(
        self, plan: RobotPlan, robot: PresentRobot, finished: bool, step: int
    ) -> Errand | None:
        leaving = plan.errand is Errand.LEAVE and not robot.free
        # It does not follow a line exactly, and zones change: its exit is chosen again as it goes.
        recent = step - (plan.decided_at or 0) < plan.period
        if not (leaving and recent) and exit_of(plan, robot) is not None:
            return Errand.LEAVE
        if leaving:
            return None
        endurance = plan.endurance
        if endurance is None or endurance.cut_off:
            return None
        if plan.errand is not None and not robot.free and not plan.staying:
            return None
        if robot.free and endurance.is_home(robot.state.pose.position):
            return None
        if endurance.must_return:
            return Errand.HOME
        if not robot.searches:
            return None
        # A robot without a plan that is not free follows another client.
        at_once = finished and (robot.free or not plan.staying)
        waiting = robot.free and endurance.phase in (Phase.RETURNING, Phase.DONE)
        return Errand.HOME if at_once or waiting else None

    def decide(
        self, team: TeamView, errands: Mapping[str, Errand], decision: Decision, finished: bool
    ) -> None:
        """Add the decisions of robots with errands."""
        for name, errand in errands.items():
            view = team.robots[name]
            if errand is Errand.LEAVE:
                goal = view.motion.keep_out.exit_from(view.state.pose.position)
                assert goal is not None
                path = view.motion.predict(view.state, goal[None, :], team.step_time)
                chosen = single_choice(goal[None, :], path, 0, Errand.LEAVE.value)
            elif errand is Errand.ROOM:
                self._phases[name] = Phase.RETURNING, ''
                chosen = make_room(team, name, decision, Errand.ROOM.value)
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
        """Send robots home in place of legs that they cannot afford."""
        for name in list(decision.robots):
            plan, view, chosen = self._plans[name], team.robots[name], decision.robots[name]
            endurance = plan.endurance
            if endurance is None or math.isnan(endurance.charge):
                continue
            unaffordable = chosen.unaffordable
            if not chosen.stays:
                # Not every planner asks for the battery.
                path = view.motion.predict(view.state, chosen.waypoint[None], team.step_time)
                unaffordable = not endurance.affords(path, team.step_time)[0]
            if unaffordable:
                changed = self._unaffordable(team, name, decision, name in arrived)
                decision.robots[name] = changed

    def _unaffordable(
        self, team: TeamView, name: str, decision: Decision, arrived: bool
    ) -> RobotDecision:
        """Return what a robot does that cannot afford anything else."""
        endurance, view, chosen = self._endurance(name), team.robots[name], decision.robots[name]
        home = arrived and endurance.is_home(view.state.pose.position)
        if not endurance.full:
            if home:
                self._phases[name] = Phase.CHARGING, ''
                return stay(view, f'charges: {endurance.describe()}')
            return self._home(team, name, decision, False)
        if chosen.stays and not chosen.saves_battery:
            return chosen  # others have all that is left
        if not home:
            return self._home(team, name, decision, False)
        if endurance.charge < _FULL and not endurance.topped:
            self._phases[name] = Phase.CHARGING, TOP
            return stay(view, f'charges: {endurance.describe()}')
        self._phases[name] = Phase.DONE, NOTHING_AFFORDABLE
        return stay(view, f'stays: {NOTHING_AFFORDABLE}')

    def adopt(self, name: str, chosen: RobotDecision, errand: Errand | None) -> None:
        """Carry out a decision: enter the phase that belongs to it."""
        plan = self._plans[name]
        phase, reason = self._phases.pop(name, (None, ''))
        if errand is not None or phase is Phase.RETURNING:
            plan.errand = errand or Errand.HOME
        if phase is not None and plan.endurance is not None:
            if phase is Phase.DONE and plan.endurance.done_reason != reason:
                self.news.append(f'{name}: {reason}')
            if reason == TOP:
                plan.endurance.top()
            elif plan.endurance.phase is not phase or plan.endurance.done_reason != reason:
                plan.endurance.begin(phase, reason)

    def drop(self, name: str) -> None:
        """Forget what was decided for a robot that keeps its present path."""
        self._phases.pop(name, None)

    def settled(self, robots: Mapping[str, PresentRobot]) -> bool:
        """Return whether every robot that goes home after the search is there, or cannot go."""
        return not any(
            plan.endurance is not None
            and robot.searches
            and not plan.endurance.cut_off
            and not (robot.free and plan.endurance.is_home(robot.state.pose.position))
            and not (plan.staying and plan.errand is not None)
            and (robot.free or not plan.staying)
            for plan, robot in ((self._plans[name], robot) for name, robot in robots.items())
        )

    def exhausted(self, step: int, robots: Mapping[str, PresentRobot]) -> bool:
        """Return whether batteries leave no robot anything to do, and each was asked again."""
        searching = {name: self._plans[name] for name, robot in robots.items() if robot.searches}
        done = [name for name, plan in searching.items() if _is_done(plan)]
        idle = [name for name in searching if name not in done and _is_idle(searching[name])]
        limited = done or any(searching[name].endurance is not None for name in idle)
        if not limited or len(done) + len(idle) < len(searching):
            self._idle_since = None
            return False
        if self._idle_since is None:
            self._idle_since = step
        since = self._idle_since
        return all((searching[name].decided_at or 0) > since for name in idle)

    def _endurance(self, name: str) -> Endurance:
        endurance = self._plans[name].endurance
        assert endurance is not None
        return endurance


def exit_of(plan: RobotPlan, robot: PresentRobot) -> np.ndarray | None:
    """Return where a robot leaves the closed zone that it is in, (3,) [m]; None: it is in none."""
    keep_out = plan.motion.keep_out
    if keep_out.area is None or not keep_out.area.settings.keep_outs:
        return None
    return keep_out.exit_from(robot.state.pose.position)


def waits_cut_off(view: RobotView) -> RobotDecision:
    """Return the decision of a robot from which no path leads to a charger."""
    return stay(view, f'waits: {CUT_OFF}')


def _waits(plan: RobotPlan, robot: PresentRobot, step: int) -> bool:
    """Return whether a robot that could not go waits before it is asked again."""
    refused = plan.staying and plan.errand is not None and plan.decided_at is not None
    return refused and robot.free and step - (plan.decided_at or 0) < plan.period


def _is_done(plan: RobotPlan) -> bool:
    return plan.endurance is not None and plan.endurance.phase is Phase.DONE


def _is_idle(plan: RobotPlan) -> bool:
    if plan.endurance is not None and plan.endurance.phase is not Phase.AVAILABLE:
        return False
    return plan.staying and plan.idle
