"""A robot moved by another program: an autopilot's simulator, or a real vehicle."""

from __future__ import annotations

import numpy as np

from maasi_filter.models.pose import Pose
from maasi_filter.ros.conversions import pose_from_ros
from maasi_msgs.msg import AgentState
from maasi_planner.motion import RobotState


class ExternalRobot:
    """
    The state of a robot as its driver publishes it; simulated sensors measure from there.

    Parameters
    ----------
    start : Pose
        In the map, until its driver publishes one.

    """

    def __init__(self, start: Pose) -> None:
        self._state = RobotState(start)

    @property
    def state(self) -> RobotState:
        """The last published state, in the map."""
        return self._state

    @property
    def obeys(self) -> bool:
        """False: the simulation does not wait for it at shutdown."""
        return False

    def take(self, message: AgentState) -> None:
        """Store the newest state."""
        linear, angular = message.twist.linear, message.twist.angular
        try:
            self._state = RobotState(
                pose_from_ros(message.pose.pose),
                np.array([linear.x, linear.y, linear.z]),
                np.array([angular.x, angular.y, angular.z]),
            )
        except ValueError:
            # Not finite: keep the last valid pose.
            return

    def cut(self, cut: bool = True) -> None:
        """Do nothing: its link is not simulated."""

    def close(self) -> None:
        """Do nothing."""
