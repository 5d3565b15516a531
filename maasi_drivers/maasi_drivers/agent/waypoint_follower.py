"""What a robot does about its goal: go there, hold, stop. Without ROS."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any

import numpy as np

from maasi_filter.arrays import FloatArray
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
    """A waypoint of a robot.

    Attributes
    ----------
    id : int
        Decision index plus one.
    step : int
        At which it was decided; it takes effect from the next one on.
    waypoint : ndarray, shape (3,)
        [m, map].
    tolerance : float
        Distance at which it counts as reached; 0: the robot's own [m].
    handle : object
        The handle of its client.
    status : GoalStatus
        Its state.
    reason : str
        Why it ended without success.
    """

    id: int
    step: int
    waypoint: FloatArray
    tolerance: float = 0.0
    handle: Any = None
    status: GoalStatus = field(default=GoalStatus.MOVING)
    reason: str = ''


class WaypointFollower:
    """Steers a robot to its waypoints and holds it there; `goal` is the last that took effect.

    Without a goal a ground robot stands still; the controller of a flying one holds its position.
    """

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

    def take(self, goal: Goal) -> Goal | None:
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

    def distance(self, position: FloatArray) -> float:
        """Return the straight distance to the goal [m]; 0 without one."""
        return 0.0 if self.goal is None else self._distance(position, self.goal.waypoint)

    def _distance(self, position: FloatArray, waypoint: FloatArray) -> float:
        offset = (waypoint - position).tolist()
        return math.hypot(*offset[:2]) if self.on_ground else math.hypot(*offset)

    def update(self, state: RobotState, step: int | None = None) -> tuple[FloatArray, Goal | None]:
        """Return the command (4,) of a control step, and the goal that is reached in it.

        vx, vy, vz [m/s, body], yaw rate [rad/s]. With a step a goal acts from the one after its
        own, else at once.
        """
        position = state.pose.position
        if self._next is not None and (step is None or step > self._next.step):
            self.goal, self._next = self._next, None
        goal, reached = self.goal, None
        if goal is not None and goal.status == GoalStatus.MOVING:
            if not self._arrived(position, goal):
                return self.motion.command(state, goal.waypoint), None
            goal.status = GoalStatus.REACHED
            self._hold = goal.waypoint
            reached = goal
        if self.on_ground:
            return np.zeros(4), reached
        if self._hold is None:
            self._hold = np.array(position)
        return self.motion.command(state, self._hold), reached

    def _arrived(self, position: FloatArray, goal: Goal) -> bool:
        if goal.tolerance in (0.0, self.motion.settings.tolerance):
            return self.motion.arrived(position, goal.waypoint)
        return self._distance(position, goal.waypoint) <= goal.tolerance

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
