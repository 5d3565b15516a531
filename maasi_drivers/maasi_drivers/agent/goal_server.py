"""The action `go_to` of a robot: accepts, aborts and concludes goals."""

import time

import numpy as np
from rclpy.action.server import ActionServer, CancelResponse, GoalResponse, ServerGoalHandle

from maasi_drivers.agent.odometry import StampedPose
from maasi_drivers.agent.robot_node import RobotNode
from maasi_drivers.agent.waypoint_follower import Goal, GoalStatus
from maasi_drivers.links.robot_link import RobotLink
from maasi_filter.ros.conversions import pose_to_ros
from maasi_msgs.action import GoToWaypoint

# At the end: longest wait for the last results [s], and executor tasks that send them.
_SETTLE_TIME, _LAST_TASKS = 0.3, 5


class GoalServer:
    """Handles goals of `go_to`: a new one replaces the current one, an invalid one is aborted."""

    def __init__(self, driver: RobotNode, link: RobotLink) -> None:
        self._driver, self._link = driver, link
        self.away = False
        # Ended goals whose results are not sent yet.
        self._ended: dict[bytes, Goal] = {}
        self._feedback_at = 0
        server = driver.permanent(
            'go_to', lambda: ActionServer(driver, GoToWaypoint, 'go_to', self._conclude)
        )
        # Without a configuration goals are refused.
        server.register_goal_callback(
            lambda _: GoalResponse.ACCEPT if driver.configured else GoalResponse.REJECT
        )
        server.register_handle_accepted_callback(self._answer)
        server.register_cancel_callback(self._cancel)
        server.register_execute_callback(self._conclude)

    def finish(self, goal: Goal) -> None:
        """Let the executor send the result of a goal."""
        self._link.goal_ended(goal)
        self._ended[bytes(goal.handle.goal_id.uuid)] = goal
        goal.handle.execute()

    def settle(self) -> None:
        """Wait until the results of ended goals are sent."""
        executor = self._driver.executor
        if not self._ended or executor is None:
            return
        deadline = time.monotonic() + _SETTLE_TIME
        while self._ended and time.monotonic() < deadline:
            executor.spin_once(timeout_sec=0.01)
        # Later tasks send concluded results.
        for _ in range(_LAST_TASKS):
            executor.spin_once(timeout_sec=0.0)

    def publish_feedback(self, placed: StampedPose) -> None:
        """Publish the remaining distance, twice per second of pose stamps."""
        follower = self._driver.follower
        if (
            follower.status == GoalStatus.MOVING
            and placed.stamp - self._feedback_at >= 500_000_000
            and follower.goal is not None
        ):
            self._feedback_at = placed.stamp
            distance = follower.distance(placed.pose.position, follower.goal)
            follower.goal.handle.publish_feedback(GoToWaypoint.Feedback(distance=distance))

    def problem(self, request: GoToWaypoint.Goal) -> str | None:
        """Return why a goal is refused (field, value read, allowed values), or None."""
        driver = self._driver
        if not driver.active:
            return 'the driver is not active'
        if self.away:
            return 'the robot left the team'
        if driver.health.text:
            return f'robot unavailable: {driver.health.text}'
        latest = driver.history.latest
        if latest is None and not driver.settings.lockstep:
            return f'no {driver.pose_name} received yet'
        now = driver.get_clock().now().nanoseconds if latest is None else latest.stamp
        if problem := self._driver.frames.to_map(request.waypoint, now):
            return problem
        point = request.waypoint.pose.position
        position = (point.x, point.y, point.z)
        if not np.isfinite(position).all():
            return f'waypoint.pose.position: read {list(position)}, allowed are finite numbers [m]'
        if problem := driver.volume.goal_problem(position):
            return f'waypoint.pose.position{problem}'
        if not (np.isfinite(request.tolerance) and request.tolerance >= 0.0):
            return f'tolerance: read {request.tolerance}, allowed are finite numbers from 0 [m]'
        return self._link.goal_problem(position)

    def _answer(self, handle: ServerGoalHandle) -> None:
        request = handle.request
        problem = self.problem(request)
        # After `problem`, which transforms the waypoint into the map.
        point = request.waypoint.pose.position
        goal = Goal(
            id=int(request.goal_id),
            step=int(request.step),
            waypoint=np.array([point.x, point.y, point.z]),
            tolerance=float(request.tolerance),
            handle=handle,
        )
        if problem is not None:
            self._driver.drop('goal', f'go_to: {problem}')
            goal.status, goal.reason = GoalStatus.ABORTED, problem
            self.finish(goal)
            return
        replaced = self._driver.follower.adopt(goal)
        # Before the other goal ends: the link must not stop the robot in between.
        self._link.on_new_goal(goal)
        if replaced is not None:
            self.finish(replaced)

    def _cancel(self, handle: ServerGoalHandle) -> CancelResponse:
        goal = self._driver.follower.current
        if goal is None or goal.handle is not handle:
            return CancelResponse.REJECT  # already ended or replaced
        self._driver.end_goal(GoalStatus.CANCELED, 'cancelled')
        if not self._driver.settings.lockstep:
            self._link.hold()
        self._link.goal_cancelled()
        return CancelResponse.ACCEPT

    def _conclude(self, handle: ServerGoalHandle) -> GoToWaypoint.Result:
        goal = self._ended.pop(bytes(handle.goal_id.uuid))
        if goal.status == GoalStatus.REACHED:
            handle.succeed()
        elif goal.status == GoalStatus.CANCELED and handle.is_cancel_requested:
            handle.canceled()
        else:
            handle.abort()
        result = GoToWaypoint.Result(reached=goal.status == GoalStatus.REACHED, reason=goal.reason)
        latest = self._driver.history.latest
        result.pose = pose_to_ros(self._driver.start_pose if latest is None else latest.pose)
        return result
