"""Robots in the eyes of the coordinator: what is known of them at a step, and their plans."""

import math
from dataclasses import dataclass, field
from enum import Enum

import numpy as np

from maasi_filter.arrays import FloatArray
from maasi_filter.models.sensor import Sensor
from maasi_filter.unexplored_map import UnexploredMap
from maasi_planner.candidates import CandidateSet
from maasi_planner.endurance import Endurance
from maasi_planner.motion import MotionModel, RobotState
from maasi_planner.team import TAKEN, RobotDecision, RobotView


@dataclass
class PresentRobot:
    """A robot that takes part in a step.

    free: whether it has no goal, or its goal has ended; charge: of its battery, 0 to 1, or unknown;
    searches: whether it goes where the planner sends it; returns: whether it leaves closed zones
    and goes home by itself.
    """

    state: RobotState
    free: bool
    charge: float = math.nan
    searches: bool = True
    returns: bool = True


# Speed below which a robot that follows another client stands [m/s].
_SLOW = 0.1


class Errand(Enum):
    """What a leg is for that the planner did not decide."""

    LEAVE = 'leaves the closed zone'
    HOME = 'goes home'
    ROOM = 'makes room at its charger'


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
    # What its present leg is for, if the planner did not decide it.
    errand: Errand | None = None
    # Whether its last decision was to stay, as there is nothing to do for it.
    idle: bool = False
    # Whether it waits until a charger is free, or goes there to wait.
    queues: bool = False
    # Index on `positions` that it has reached, and at which step.
    progress: int = 0
    progress_at: int = 0

    @property
    def goal_id(self) -> int:
        """Id of the goal of its last decision; 0 before the first."""
        return self.decision + 1

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
        self.errand = None
        self.idle = self.queues = False

    def on_external_goal(self, step: int) -> None:
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
        self.decided_at = self.progress_at = step
        self.progress, self.errand = 0, None
        self.queues = TAKEN in chosen.reason
        waits = chosen.blocked or chosen.reason.startswith('waits')
        self.idle = chosen.stays and not waits
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

    def is_home(self, robot: PresentRobot) -> bool:
        """Return whether it stands at a charger of its own."""
        position = robot.state.pose.position
        return robot.free and self.endurance is not None and self.endurance.is_home(position)

    def note_progress(self, step: int, robot: PresentRobot, step_time: float) -> None:
        """Learn from how far it has come on its predicted trajectory since the last step."""
        last = len(self.positions) - 1
        if self.endurance is None or robot.free or self.staying or self.progress >= last:
            return
        gone, here = step - self.progress_at, robot.state.pose.position
        end = min(self.progress + 3 * gone + 1, last)
        ahead = self.positions[self.progress : end + 1] - here
        reached = int(np.argmin((ahead * ahead).sum(axis=1)))
        self.progress, self.progress_at = self.progress + reached, step
        # At its end it slows down, and may turn to the next waypoint.
        if self.progress < last:
            self.endurance.note_pace(gone * step_time, reached * step_time)

    def update_battery(self, step: int, robot: PresentRobot, step_time: float) -> None:
        """Take its charge, and what its present leg still takes of it."""
        if self.endurance is None:
            return
        self.note_progress(step, robot, step_time)
        slow = float(np.linalg.norm(robot.state.velocity)) < _SLOW
        stands = robot.free or (self.staying and slow)
        self.endurance.update(step, robot.state, robot.charge, stands)
        self.endurance.leg = 0.0
        if not (robot.free or self.staying) and len(self.positions):
            path = self.left(step)[0]
            metres = float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())
            self.endurance.leg = self.endurance.use(step_time * (len(path) - 1), metres)

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
