"""The interface between a driver and its robot, which every link implements."""

# ruff: noqa: B027 - optional hooks do nothing.

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any

from maasi_drivers.agent.odometry import StampedPose
from maasi_drivers.agent.robot_node import RobotNode
from maasi_drivers.agent.waypoint_follower import Goal
from maasi_filter.arrays import FloatArray
from maasi_planner.motion import MotionModel, RobotState, make_motion


class RobotLink(ABC):
    """The link to one robot.

    A driver creates it in *configure*. The link passes poses to `driver.take_pose`, charges to
    `take_charge` and faults to `judge`. No method waits, except `stop`.

    Parameters
    ----------
    driver : RobotNode
        The robot's node.
    """

    def __init__(self, driver: RobotNode) -> None:
        self.driver = driver

    @abstractmethod
    def connect(self) -> None:
        """Open the link, in *configure*; if this raises, the node stays unconfigured."""

    @abstractmethod
    def send(self, placed: StampedPose, command: Sequence[float]) -> None:
        """Send a velocity command, after each pose.

        Parameters
        ----------
        placed : StampedPose
            Pose of the robot.
        command : sequence of float
            vx, vy, vz [m/s, axes turned by the heading], yaw rate [rad/s].
        """

    @abstractmethod
    def hold(self) -> None:
        """Stop the robot now: its goal was cancelled or its pose is unknown."""

    @abstractmethod
    def stop(self) -> None:
        """Stop the robot because the driver ends; may wait for confirmation."""

    @abstractmethod
    def poll(self) -> None:
        """Check the link: ten times a second on wall time while active; not in lockstep."""

    def close(self) -> None:
        """Undo `connect`; called once. ROS entities are destroyed by the node."""

    def status(self) -> dict[str, Any]:
        """Return values for the diagnostics."""
        return {}

    def prepare(self) -> None:
        """Check the settings, before `connect`; raises `SettingsError`."""

    def activate(self) -> None:
        """Start working, in *activate*: from now on the robot may move."""

    def reset(self) -> None:
        """Discard data from before a jump back of the clock."""

    def latch_stop(self) -> None:
        """Handle the service `stop`, after `hold`."""

    def observe(self, placed: StampedPose) -> None:
        """Handle a new pose, before it is used."""

    def on_new_goal(self, goal: Goal) -> None:
        """Handle a new goal."""

    # ---- autopilots, Nav2 and the Mambo --------------------------------------------------------

    def expects_pose(self) -> bool:
        """Return whether to warn about a missing first pose."""
        return True

    def goal_problem(self, position: Sequence[float]) -> str | None:
        """Return why a waypoint (x, y, z) [m, map] inside the volume is refused, or None."""
        return None

    def goal_ended(self, goal: Goal) -> None:
        """Handle the end of a goal, before its result is sent."""

    def goal_cancelled(self) -> None:
        """Handle the cancellation of the goal by a client, after `hold`."""

    # ---- robots that a simulation moves in steps -----------------------------------------------

    def begin_step(self, stamp: int) -> None:
        """Process data older than the step at `stamp` [ns], before its control step."""

    def hold_step(self, stamp: int) -> None:
        """Answer the step at `stamp` [ns], whose odometry was unusable, with a stop."""
        self.hold()

    def repeat(self) -> None:
        """Send the last command again: a restarted peer may have missed it."""

    # ---- motion --------------------------------------------------------------------------------

    def make_motion(self) -> MotionModel:
        """Return the controller."""
        settings = self.driver.settings
        return make_motion(settings.motion, self.driver.volume.area, settings.radius)

    def steer(self, robot: RobotState, step: int | None) -> tuple[FloatArray, Goal | None]:
        """Return the command for a pose.

        Parameters
        ----------
        robot : RobotState
            Present state of the robot.
        step : int or None
            In lockstep the step.

        Returns
        -------
        command : (4,) array
            vx, vy, vz [m/s, axes turned by the heading] and yaw rate [rad/s].
        goal : Goal or None
            The goal that was reached.
        """
        return self.driver.follower.update(robot, step)

    def is_moving(self, placed: StampedPose, command: FloatArray) -> bool:
        """Return whether this command must change pose and images.

        Parameters
        ----------
        placed : StampedPose
            Present pose.
        command : (4,) array
            vx, vy, vz [m/s] and yaw rate [rad/s].
        """
        return bool(math.hypot(*command[:3]) > 0.02 or abs(command[3]) > 0.05)
