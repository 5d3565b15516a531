"""A robot that another program moves: a simulator of an autopilot, or a real vehicle."""

from __future__ import annotations

import numpy as np

from maasi_filter.models.pose import Pose
from maasi_filter.ros.conversions import pose_from_ros
from maasi_msgs.msg import AgentState
from maasi_planner.motion import RobotState


class ExternalRobot:
    """
    Where a robot is by its own driver; simulated sensors see from there.

    Parameters
    ----------
    start : Pose
        In the map, before its driver says where it is.

    """

    def __init__(self, start: Pose) -> None:
        self._state = RobotState(start)

    @property
    def state(self) -> RobotState:
        """Where its driver says that it is, in the map."""
        return self._state

    @property
    def obeys(self) -> bool:
        """Nothing has to be awaited at the end: it is there without the sim."""
        return False

    def take(self, message: AgentState) -> None:
        """Take the newest state."""
        linear, angular = message.twist.linear, message.twist.angular
        try:
            self._state = RobotState(
                pose_from_ros(message.pose.pose),
                np.array([linear.x, linear.y, linear.z]),
                np.array([angular.x, angular.y, angular.z]),
            )
        except ValueError:
            # Drivers publish finite poses; of others the last good one counts.
            return

    def cut(self, cut: bool = True) -> None:
        """Leave its link alone: it is not simulated."""

    def close(self) -> None:
        """Leave it."""
