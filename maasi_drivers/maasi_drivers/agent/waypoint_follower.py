"""Waypoint following, holding and stopping. Without ROS."""

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np

from maasi_filter.arrays import FloatArray
from maasi_filter.geometry.operating_volume import MARGIN
from maasi_planner.motion import MotionModel, RobotState
from maasi_planner.terrain_frame import follow_terrain


class GoalStatus(IntEnum):
    """Activity of a robot; numbers as in maasi_msgs/AgentState."""

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
    step: int  # takes effect in the next step
    waypoint: FloatArray  # (3,) [m, map]
    tolerance: float = 0.0  # counts as reached within this; 0: the robot's tolerance [m]
    handle: Any = None  # handle of its client
    status: GoalStatus = GoalStatus.MOVING
    reason: str = ''  # why it ended without success


class WaypointFollower:
    """Steers a robot to waypoints and holds it there; `goal` is the last active one."""

    def __init__(self, motion: MotionModel) -> None:
        self.motion = motion
        self.on_ground = motion.settings.model == 'unicycle'
        self.goal: Goal | None = None
        self._next: Goal | None = None
        self._hold: FloatArray | None = None

    @property
    def status(self) -> GoalStatus:
        """Activity of the robot."""
        return GoalStatus.IDLE if self.goal is None else self.goal.status

    @property
    def current(self) -> Goal | None:
        """The active goal, or None."""
        if self._next is not None:
            return self._next
        if self.goal is not None and self.goal.status == GoalStatus.MOVING:
            return self.goal
        return None

    def adopt(self, goal: Goal) -> Goal | None:
        """Adopt a new goal; return the replaced one."""
        replaced = self.end(GoalStatus.ABORTED, 'replaced')
        self._next = goal
        return replaced

    def end(self, status: GoalStatus, reason: str) -> Goal | None:
        """End the goal; return it, or None."""
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
        """Return a step's command (vx, vy, vz [m/s, body], yaw rate) and the goal reached."""
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
                return self._towards(state, goal.waypoint), None
            goal.status = GoalStatus.REACHED
            self._hold = goal.waypoint
            reached = goal
        # It also stays in a zone, and leaves it only for a goal.
        if self.on_ground or self.exit_from(position) is not None:
            return np.zeros(4), reached
        if self._hold is None:
            self._hold = self._resting(position)
        return self._towards(state, self._hold), reached

    def _towards(self, state: RobotState, waypoint: FloatArray) -> FloatArray:
        """Return the command to a waypoint, which a flying robot approaches above the ground."""
        keep_out = self.motion.keep_out
        terrain = None if self.on_ground else keep_out.area.terrain
        if terrain is None:
            return self.motion.command(state, waypoint)
        least = keep_out.radius + self.motion.settings.clearance
        return follow_terrain(self.motion, terrain, state, waypoint, least)

    def _resting(self, position: FloatArray) -> FloatArray:
        """Return the position to hold, inside of the border if the robot is far outside."""
        keep_out = self.motion.keep_out
        if keep_out.area.outside_by(position) > MARGIN + keep_out.radius:
            inside = keep_out.exit_from(position)
            if inside is not None:
                return inside
        return np.array(position)

    def exit_from(self, position: FloatArray) -> FloatArray | None:
        """Return the exit position from the zone around a robot, (3,), or None."""
        keep_out = self.motion.keep_out
        if not len(keep_out) or keep_out.area.outside_by(position):
            return None
        return keep_out.exit_from(position)

    @property
    def target(self) -> FloatArray | None:
        """The position to reach or hold [m, map]; None before the first update."""
        if self.goal is not None and self.goal.status == GoalStatus.MOVING:
            return self.goal.waypoint
        return self._hold

    def stay(self) -> None:
        """Hold the position of the next step, even if a waypoint was reached before."""
        self._hold = None

    def let_go(self) -> None:
        """Hold the position of the next step from then on."""
        if self.status != GoalStatus.REACHED:
            self._hold = None
