"""What a robot does about its goal: go there, hold, stop. Without ROS."""

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np

from maasi_filter.arrays import FloatArray
from maasi_filter.geometry.operating_volume import MARGIN
from maasi_planner.motion import MotionModel, RobotState


class GoalStatus(IntEnum):
    """What a robot is doing; the numbers of maasi_msgs/AgentState."""

    IDLE = 0
    MOVING = 1
    REACHED = 2
    CANCELED = 3
    ABORTED = 4
    UNAVAILABLE = 5


@dataclass(eq=False)
class Goal:
    """A waypoint of a robot."""

    id: int  # index of its decision plus one
    step: int  # it takes effect in the next one
    waypoint: FloatArray  # (3,) [m, map]
    tolerance: float = 0.0  # within this it counts as reached; 0: the robot's own [m]
    handle: Any = None  # that of its client
    status: GoalStatus = GoalStatus.MOVING
    reason: str = ''  # why it ended without success


class WaypointFollower:
    """Steers a robot to its waypoints and holds it there; `goal` is the last that took effect."""

    def __init__(self, motion: MotionModel) -> None:
        self.motion = motion
        self.on_ground = motion.settings.model == 'unicycle'
        self.goal: Goal | None = None
        self._next: Goal | None = None
        self._hold: FloatArray | None = None

    @property
    def status(self) -> GoalStatus:
        """What the robot is doing."""
        return GoalStatus.IDLE if self.goal is None else self.goal.status

    @property
    def current(self) -> Goal | None:
        """The goal that has not ended, or None."""
        if self._next is not None:
            return self._next
        if self.goal is not None and self.goal.status == GoalStatus.MOVING:
            return self.goal
        return None

    def adopt(self, goal: Goal) -> Goal | None:
        """Take a new goal, and return the one that it replaces."""
        replaced = self.end(GoalStatus.ABORTED, 'replaced')
        self._next = goal
        return replaced

    def end(self, status: GoalStatus, reason: str) -> Goal | None:
        """End the goal; return it, or None if there is none."""
        goal = self.current
        if goal is None:
            return None
        goal.status, goal.reason = status, reason
        self.goal, self._next = goal, None
        self._hold = None
        return goal

    def distance(self, position: FloatArray, goal: Goal) -> float:
        """Return the straight distance to a goal [m]."""
        offset = (goal.waypoint - position).tolist()
        return math.hypot(*offset[:2]) if self.on_ground else math.hypot(*offset)

    def update(self, state: RobotState, step: int | None = None) -> tuple[FloatArray, Goal | None]:
        """Return vx, vy, vz [m/s, body] and yaw rate of a step, and the goal reached in it."""
        position = state.pose.position
        if self._next is not None and (step is None or step > self._next.step):
            self.goal, self._next = self._next, None
        goal, reached = self.goal, None
        if goal is not None and goal.status == GoalStatus.MOVING:
            if goal.tolerance in (0.0, self.motion.settings.tolerance):
                arrived = self.motion.arrived(position, goal.waypoint)
            else:
                arrived = self.distance(position, goal) <= goal.tolerance
            if not arrived:
                return self.motion.command(state, goal.waypoint), None
            goal.status = GoalStatus.REACHED
            self._hold = goal.waypoint
            reached = goal
        # In a zone it stays as well: it leaves that when it is sent out.
        if self.on_ground or self.exit_from(position) is not None:
            return np.zeros(4), reached
        if self._hold is None:
            self._hold = self._resting(position)
        return self.motion.command(state, self._hold), reached

    def _resting(self, position: FloatArray) -> FloatArray:
        """Return where a robot holds: where it is, or inside of the border if it is far outside."""
        keep_out = self.motion.keep_out
        if keep_out.area.outside_by(position) > MARGIN + keep_out.radius:
            inside = keep_out.exit_from(position)
            if inside is not None:
                return inside
        return np.array(position)

    def exit_from(self, position: FloatArray) -> FloatArray | None:
        """Return where a robot leaves a closed zone that it is in, (3,); None outside of zones."""
        keep_out = self.motion.keep_out
        if not len(keep_out) or keep_out.area.outside_by(position):
            return None
        return keep_out.exit_from(position)

    @property
    def target(self) -> FloatArray | None:
        """The position that it goes to or holds [m, map]; None before the first update."""
        if self.goal is not None and self.goal.status == GoalStatus.MOVING:
            return self.goal.waypoint
        return self._hold

    def stay(self) -> None:
        """Hold where the robot is at the next step, even if a waypoint was reached before."""
        self._hold = None

    def let_go(self) -> None:
        """Hold, from the next step on, where the robot is then."""
        if self.status != GoalStatus.REACHED:
            self._hold = None
