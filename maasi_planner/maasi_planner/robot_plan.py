"""A robot as the coordinator sees it: facts, plan, measurements and battery."""

import math
from dataclasses import dataclass, field
from enum import Enum

import numpy as np

from maasi_filter.arrays import FloatArray
from maasi_filter.geometry.area import Area
from maasi_filter.models.sensor import Sensor
from maasi_filter.unexplored_map import UnexploredMap
from maasi_planner.candidates import CandidateSet
from maasi_planner.endurance import Endurance
from maasi_planner.measurement_schedule import MeasurementSchedule
from maasi_planner.motion import MotionModel, RobotState
from maasi_planner.team import TAKEN, RobotDecision, RobotView

# Speed below which a robot with a goal of another client stands [m/s].
_SLOW = 0.1


@dataclass
class PresentRobot:
    """An available robot at a step.

    free: no goal, or an ended one; charge: of the battery, 0 to 1, or unknown; searches: follows
    the planner; returns: leaves closed zones and goes home by itself.
    """

    state: RobotState
    free: bool
    charge: float = math.nan
    searches: bool = True
    returns: bool = True


class Errand(Enum):
    """Purpose of a leg that the planner did not decide."""

    LEAVE = 'leaves the closed zone'
    HOME = 'goes home'
    FREE = 'frees its charger for another robot'


@dataclass(frozen=True)
class Member:
    """A robot that measures at a step, with decision index d and measurement index m."""

    robot: str
    decision: int
    measurement: int


@dataclass(frozen=True)
class RobotFacts:
    """Constant properties of a robot; period in steps, radii in metres."""

    motion: MotionModel
    sensor: Sensor
    period: int
    radius: float
    arrival_radius: float


@dataclass
class RobotPlan:
    """The last decision for a robot.

    decision: its index, -1 before the first; chosen: None without a path; staying: no goal, a
    refused one, or the command to stay; turning_distance: `RobotFacts.arrival_radius` of the
    present waypoint; errand: purpose of a leg that the planner did not decide.
    """

    decision: int = -1
    decided_at: int | None = None
    chosen: RobotDecision | None = None
    waypoint: FloatArray = field(default_factory=lambda: np.zeros(3))
    turning_distance: float = 0.0
    staying: bool = True
    errand: Errand | None = None

    @property
    def goal_id(self) -> int:
        """Id of the last goal; 0 before the first."""
        return self.decision + 1

    @property
    def positions(self) -> FloatArray:
        """Predicted trajectory, (K + 1, 3) [m]; empty without a path."""
        return np.zeros((0, 3)) if self.chosen is None else self.chosen.positions

    @property
    def tour(self) -> FloatArray:
        """Positions to visit after the waypoint, (n, 3) [m]."""
        return np.zeros((0, 3)) if self.chosen is None else self.chosen.tour

    @property
    def idle(self) -> bool:
        """Whether the robot stays as it has nothing to do."""
        chosen = self.chosen
        waits = chosen is not None and (chosen.blocked or chosen.reason.startswith('waits'))
        return chosen is not None and chosen.stays and not waits

    @property
    def queues(self) -> bool:
        """Whether the robot waits for a free charger, or goes there to wait."""
        return self.chosen is not None and TAKEN in self.chosen.reason

    def remaining(self, step: int) -> tuple[FloatArray, FloatArray]:
        """Return the remaining predicted trajectory: positions (n, 3) and headings (n,)."""
        if self.chosen is None:
            return np.zeros((0, 3)), np.zeros(0)
        first = min(step - (self.decided_at or 0), len(self.positions) - 1)
        return self.chosen.positions[first:], self.chosen.yaws[first:]

    def destination(self, state: RobotState) -> FloatArray:
        """Return the final position of the plan, (3,) [m]."""
        if self.staying or not len(self.positions):
            return np.array(state.pose.position)
        return self.positions[-1].copy()


@dataclass
class PlannedRobot:
    """One robot of a team; `exploration` is e of only its measurements, or None."""

    facts: RobotFacts
    candidates: CandidateSet
    schedule: MeasurementSchedule
    endurance: Endurance | None
    exploration: UnexploredMap | None
    plan: RobotPlan = field(default_factory=RobotPlan)

    # ---- queries -----------------------------------------------------------------------------

    def is_due(self, step: int, present: PresentRobot) -> bool:
        """Return whether the robot has arrived, passes its waypoint, or stayed for a period."""
        plan = self.plan
        if present.free:
            waited = plan.decided_at is None or step - plan.decided_at >= self.facts.period
            return not plan.staying or waited
        if plan.staying or not plan.turning_distance:
            return False
        here = present.state.pose.position
        return self.facts.motion.squared_distance(here, plan.waypoint) < plan.turning_distance**2

    def is_home(self, present: PresentRobot) -> bool:
        """Return whether the robot stands at one of its chargers."""
        position = present.state.pose.position
        return present.free and self.endurance is not None and self.endurance.is_home(position)

    def view(self, step: int, present: PresentRobot, planning: bool) -> RobotView:
        """Return the robot's view for a planner."""
        view = RobotView(
            state=present.state,
            candidates=self.candidates.at(present.state.pose.position),
            motion=self.facts.motion,
            sensor=self.facts.sensor,
            period_steps=self.facts.period,
            planning=planning,
            radius=self.facts.radius,
            endurance=self.endurance,
            arrival_radius=self.facts.arrival_radius,
            exploration=self.exploration,
        )
        if not planning and self.plan.decided_at is not None:
            view.phase = self.schedule.phase(step)
            if len(self.plan.positions):
                view.remaining_path, view.remaining_yaws = self.plan.remaining(step)
        return view

    # ---- changes -----------------------------------------------------------------------------

    def adopt_area(self, area: Area) -> None:
        """Change keep-outs: `area` has the same bounds."""
        self.facts.motion.adopt_area(area, self.facts.radius)
        lasting, before = Area(area.settings.without_keep_outs()), self.candidates
        self.candidates = CandidateSet(before.settings, lasting, before.height)
        self.candidates.restrict(area)
        if self.exploration is not None:
            self.exploration.adopt_area(area)

    def begin_again(self, exploration: FloatArray | float) -> None:
        """Begin a new search with an exploration function; decision indices continue."""
        self.clear_plan()
        self.schedule.begin_again()
        if self.exploration is not None:
            self.exploration.values[...] = exploration
        if self.endurance is not None:
            self.endurance.begin_again()

    def adopt(self, step: int, present: PresentRobot, chosen: RobotDecision) -> None:
        """Adopt a decision."""
        plan, facts = self.plan, self.facts
        here = present.state.pose.position
        self.schedule.turn(step, here, None if present.free else plan.waypoint)
        if self.endurance is not None:
            self.endurance.begin_path(step)
        # A waypoint within the radius is approached until it is reached.
        near = facts.motion.squared_distance(here, chosen.waypoint) <= facts.arrival_radius**2
        self.plan = RobotPlan(
            plan.decision + 1,
            step,
            chosen,
            chosen.waypoint,
            turning_distance=0.0 if near else facts.arrival_radius,
            staying=chosen.stays,
        )

    def clear_plan(self) -> None:
        """Discard the plan, as the robot is unavailable."""
        self.plan = RobotPlan(self.plan.decision, waypoint=self.plan.waypoint)
        self.schedule.cancel()

    def stay(self, step: int) -> None:
        """Note the decision to stay at the end of the search."""
        self.plan.decision += 1
        self.plan.decided_at, self.plan.staying = step, True
        self.schedule.restart(step)

    def on_external_goal(self, step: int) -> None:
        """Note a goal of another client, on the path to which the robot measures without a plan."""
        began = self.plan.decided_at
        if began is not None and self.plan.staying and not len(self.plan.positions):
            return  # already noted
        self.clear_plan()
        if began is None:
            began = step
            self.schedule.restart(step)
        self.plan.decided_at = began
        # Measurements need a decision index, which is not negative.
        self.plan.decision = max(self.plan.decision, 0)

    def update_battery(self, step: int, present: PresentRobot) -> None:
        """Update the charge, and the use of the remaining leg."""
        if self.endurance is None:
            return
        plan, state = self.plan, present.state
        moves = not (present.free or plan.staying)
        if moves:
            self.endurance.note_progress(step, state.pose.position, plan.positions)
        slow = float(np.linalg.norm(state.velocity)) < _SLOW
        stands = present.free or (plan.staying and slow)
        self.endurance.update(step, state, present.charge, stands)
        self.endurance.plan_leg(plan.remaining(step)[0] if moves else np.zeros((0, 3)))
