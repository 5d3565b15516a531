"""Waypoints by Nav2 instead of velocity commands."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from action_msgs.msg import GoalStatus as ActionStatus
from geometry_msgs.msg import PoseStamped
from rclpy.action.client import ActionClient

from maasi_drivers.agent.waypoint_follower import Goal
from maasi_filter.ros.clocks import Silence
from maasi_filter.ros.conversions import point_to_ros
from maasi_filter.ros.lifecycle_node import LockstepLifecycleNode, SettingsError


class Nav2Navigation:
    """Hands waypoints to Nav2's `navigate_to_pose` (nav2_msgs/NavigateToPose).

    Parameters
    ----------
    node : LockstepLifecycleNode
        In the robot's namespace.
    frame : str
        Of the waypoints: Nav2's global frame.
    timeout : float
        Longest silence while Nav2 has a goal [s]: its feedback comes many times a
        second, whatever the robot does.
    on_end : callable
        Called when Nav2 ended a goal by itself: goal, whether it was reached, and why if not.

    Raises
    ------
    SettingsError
        If nav2_msgs is not installed.
    """

    def __init__(
        self,
        node: LockstepLifecycleNode[Any],
        frame: str,
        timeout: float,
        on_end: Callable[[Goal, bool, str], None],
    ) -> None:
        try:
            from nav2_msgs.action import NavigateToPose
        except ImportError as error:
            raise SettingsError(
                "parameter navigation: read 'nav2', but the package nav2_msgs is not installed "
                "(sudo apt install ros-$ROS_DISTRO-nav2-msgs); allowed without it is 'own'"
            ) from error
        self._type = NavigateToPose
        self._frame = frame
        self._timeout = timeout
        self._on_end = on_end
        self._silence = Silence(node)
        self._client = node.permanent(
            'navigate_to_pose', lambda: ActionClient(node, NavigateToPose, 'navigate_to_pose')
        )
        self._goal: Goal | None = None
        self._handle: Any = None
        # Handle of the replaced goal, until Nav2 has accepted the present one.
        self._replaced: Any = None

    @property
    def available(self) -> bool:
        """Whether its action server is there; DDS notices a killed one only after some 20 s."""
        return bool(self._client.server_is_ready())

    @property
    def driving(self) -> bool:
        """Whether it has a goal of ours."""
        return self._goal is not None

    def problem(self) -> str | None:
        """Return what is wrong with Nav2 while it drives; None if nothing is."""
        if not self.driving:
            return None
        if not self.available:
            return 'Nav2 is gone'
        silence = self._silence.length
        if silence > self._timeout:
            return f'no answer or feedback of Nav2 for {silence:.1f} s'
        return None

    def go(self, goal: Goal, heading: float) -> None:
        """Send the robot to a waypoint, to face `heading` there [rad].

        Nav2 replaces the goal before, without a stop.
        """
        self._replaced = self._handle or self._replaced
        self._goal, self._handle = goal, None
        self._silence.end()
        pose = PoseStamped()
        pose.header.frame_id = self._frame
        pose.pose.position = point_to_ros([goal.waypoint[0], goal.waypoint[1], 0.0])
        pose.pose.orientation.z = float(np.sin(0.5 * heading))
        pose.pose.orientation.w = float(np.cos(0.5 * heading))
        future = self._client.send_goal_async(self._type.Goal(pose=pose), self._on_feedback)
        future.add_done_callback(lambda answer: self._answered(goal, answer.result()))

    def _on_feedback(self, _: Any) -> None:
        self._silence.end()

    def _answered(self, goal: Goal, handle: Any) -> None:
        self._silence.end()
        if handle is None or not handle.accepted:
            if goal is self._goal:
                self._stop_replaced()
            self._ended(goal, False, 'Nav2 refuses the waypoint')
            return
        if goal is self._goal:
            self._handle, self._replaced = handle, None
        elif self._goal is None:
            # Given up before Nav2 had answered.
            handle.cancel_goal_async()
            return
        elif self._handle is None:
            self._replaced = handle
        result = handle.get_result_async()
        result.add_done_callback(lambda answer: self._finished(goal, answer.result()))

    def _finished(self, goal: Goal, answer: Any) -> None:
        if answer.status == ActionStatus.STATUS_SUCCEEDED:
            self._ended(goal, True, '')
            return
        ended = 'cancelled it' if answer.status == ActionStatus.STATUS_CANCELED else 'gave it up'
        # Humble's result is empty, newer ones have code and text.
        code = getattr(answer.result, 'error_code', 0)
        text = getattr(answer.result, 'error_msg', '')
        reason = (
            f'Nav2 {ended}' + (f', error {code}' if code else '') + (f': {text}' if text else '')
        )
        self._ended(goal, False, reason)

    def _ended(self, goal: Goal, reached: bool, reason: str) -> None:
        if goal is self._goal:
            self._goal = self._handle = None
            self._on_end(goal, reached, reason)

    def give_up(self, goal: Goal) -> None:
        """Have Nav2 stop, if it is on the way to this goal."""
        if goal is not self._goal:
            return
        handle, self._goal, self._handle = self._handle, None, None
        self._stop_replaced()
        if handle is not None:
            handle.cancel_goal_async()

    def _stop_replaced(self) -> None:
        """Cancel the goal before, where Nav2 has not taken another one instead."""
        handle, self._replaced = self._replaced, None
        if handle is not None:
            handle.cancel_goal_async()
