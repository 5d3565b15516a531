"""Ground robots with topics: driven by the driver, with a laser scan, or by Nav2."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from action_msgs.msg import GoalStatus as ActionStatus
from geometry_msgs.msg import PoseStamped
from rclpy.action.client import ActionClient
from sensor_msgs.msg import LaserScan

from maasi_drivers.agent.odometry import StampedPose
from maasi_drivers.agent.robot_node import RobotNode
from maasi_drivers.agent.scan_motion import ScanUnicycle, scan_points
from maasi_drivers.agent.waypoint_follower import Goal, GoalStatus
from maasi_drivers.links.topic_link import TopicLink
from maasi_filter.arrays import FloatArray
from maasi_filter.ros.clocks import Silence
from maasi_filter.ros.conversions import point_to_ros, stamp_from_ros, stamp_to_ros
from maasi_filter.ros.lifecycle_node import SettingsError
from maasi_filter.ros.qos import sensor_reader
from maasi_planner.motion import MotionModel, RobotState

_SCAN = 'scan'  # kind of fault
_PROGRESS = 0.02  # smaller distances to the waypoint by this much are progress [m]


class TurtlebotLink(TopicLink):
    """A differential drive; see `TopicLink`.

    A TurtleBot has no timeout on commands: it keeps executing the last one. So the driver
    publishes zero commands when it stops, loses odometry, camera or scan, or ends; `guard_node`
    does when the driver dies.

    Subscribes
    ----------
    `scan` (sensor_msgs/LaserScan), with the parameters `scan.*`: a dynamic window keeps clear of it
    """

    def __init__(self, driver: RobotNode) -> None:
        super().__init__(driver)
        self._motion: ScanUnicycle | None = None  # its controller, if it uses the scan
        self.reset()

    def make_motion(self) -> MotionModel:
        """Return the controller, which uses the scan if there is one."""
        settings = self.driver.settings
        if settings.scan is None:
            return super().make_motion()
        area = self.driver.volume.area
        self._motion = ScanUnicycle(settings.motion, area, settings.radius, settings.scan)
        return self._motion

    def connect(self) -> None:
        """Compile and subscribe."""
        super().connect()
        motion, (x, y, z) = self._motion, self.driver.settings.start
        if motion is None:
            return
        motion.see([[x + 0.4, y], [x + 9.0, y]])
        motion.command(RobotState.at_rest([x, y, z]), [x + 1.0, y, z])
        motion.see(np.zeros((0, 2)))
        self.driver.create_subscription(LaserScan, 'scan', self._on_scan, sensor_reader(False))

    def reset(self) -> None:
        """Discard the scan from another time."""
        self._scan: LaserScan | None = None
        self._scanned_at: int | None = None
        # The current goal, the smallest distance to it [m], and its stamp [ns].
        self._nearest: tuple[Goal, float, int] | None = None

    def steer(self, robot: RobotState, step: int | None) -> tuple[FloatArray, Goal | None]:
        """Return command and goal reached; stop without scans, abort when blocked."""
        driver, settings, latest = (
            self.driver,
            self.driver.settings.scan,
            self.driver.history.latest,
        )
        if settings is None or latest is None:
            return super().steer(robot, step)
        self._place_scan()
        if self._scanned_at is None:
            self._scanned_at = latest.stamp
        age = 1e-9 * (latest.stamp - self._scanned_at)
        if age > settings.timeout:
            driver.health.begin(_SCAN, f'no scan for {age:.1f} s')
        command, reached = super().steer(robot, step)
        if self._without_progress(latest) > settings.blocked_timeout:
            driver.end_goal(
                GoalStatus.ABORTED,
                f'blocked: no closer to the waypoint for {settings.blocked_timeout:g} s',
            )
            command = np.zeros(4)
        return command, reached

    def _without_progress(self, placed: StampedPose) -> float:
        follower = self.driver.follower
        goal = follower.goal
        if goal is None or goal.status != GoalStatus.MOVING:
            self._nearest = None
            return 0.0
        left, before = follower.distance(placed.pose.position, goal), self._nearest
        if before is None or before[0] is not goal or left < before[1] - _PROGRESS:
            self._nearest = before = goal, left, placed.stamp
        return 1e-9 * (placed.stamp - before[2])

    def _on_scan(self, message: LaserScan) -> None:
        if self.driver.active:
            self._scan = message
            self._place_scan()

    def _place_scan(self) -> None:
        driver, message, settings = self.driver, self._scan, self.driver.settings.scan
        latest = driver.history.latest
        if message is None or latest is None or settings is None or self._motion is None:
            return
        stamp = stamp_from_ros(message.header.stamp)
        if stamp > latest.stamp:
            return
        self._scan = None
        placed = driver.history.at(stamp)
        if placed is None:
            driver.drop(
                'scan',
                f'scan.header.stamp: read {stamp} ns, allowed is the range of the odometry, up to '
                f'{latest.stamp} ns',
            )
            return
        try:
            points = scan_points(
                message.ranges,
                (message.angle_min, message.angle_increment),
                (message.range_min, message.range_max),
                message.time_increment,
                placed,
                [*settings.position, settings.yaw],
            )
        except ValueError as error:
            driver.drop('scan', f'scan.{error}')
            return
        self._motion.see(points)
        self._scanned_at = latest.stamp
        driver.health.end(_SCAN, 'scan: received again')


class Nav2Link(TurtlebotLink):
    """A ground robot that Nav2 drives to its waypoints; see `TurtlebotLink`.

    Actions
    -------
    client of `navigate_to_pose` (nav2_msgs/NavigateToPose); `cmd_vel` is Nav2's while the robot is
    moving
    """

    def __init__(self, driver: RobotNode) -> None:
        super().__init__(driver)
        try:
            from nav2_msgs.action import NavigateToPose
        except ImportError as error:
            raise SettingsError(
                "parameter navigation: read 'nav2', but the package nav2_msgs is not installed "
                "(sudo apt install ros-$ROS_DISTRO-nav2-msgs); allowed without it is 'own'"
            ) from error
        self._type = NavigateToPose
        # Time since the last answer or feedback.
        self._silence = Silence(driver)
        self._client = driver.permanent(
            'navigate_to_pose', lambda: ActionClient(driver, NavigateToPose, 'navigate_to_pose')
        )
        # The goal that Nav2 drives to, and its handle.
        self._goal: Goal | None = None
        self._handle: Any = None
        # Handle of the replaced goal, until Nav2 has accepted the present one.
        self._replaced: Any = None

    def is_moving(self, placed: StampedPose, command: FloatArray) -> bool:
        """Return whether it moves, from the velocity of the odometry."""
        velocity = np.array([*placed.velocity, placed.angular_velocity[2]])
        return super().is_moving(placed, velocity)

    def send(self, placed: StampedPose, command: Sequence[float]) -> None:
        """Publish zero commands, and nothing while Nav2 drives."""
        self._command.header.stamp = stamp_to_ros(placed.stamp)
        if self._goal is None:
            self.hold()

    def poll(self) -> None:
        """Check the link; stop a robot if Nav2 is lost or silent."""
        super().poll()
        silence = self._silence.length
        # DDS detects a killed server only after about 20 s.
        gone = not self._client.server_is_ready()
        if self._goal is None or not (gone or silence > self.driver.settings.nav2_timeout):
            return
        silent = f'no answer or feedback from Nav2 for {silence:.1f} s'
        self.driver.end_goal(GoalStatus.ABORTED, 'Nav2 not available' if gone else silent)
        self.hold()

    def goal_problem(self, position: Sequence[float]) -> str | None:
        """Refuse goals without Nav2."""
        there = self._client.server_is_ready()
        return None if there else 'navigate_to_pose: Nav2 not available'

    def on_new_goal(self, goal: Goal) -> None:
        """Send the goal to Nav2, which replaces the previous one without a stop."""
        latest, heading = self.driver.history.latest, self.driver.settings.yaw
        if latest is not None:
            ahead = goal.waypoint - latest.pose.position
            heading = float(np.arctan2(ahead[1], ahead[0]))
        self._replaced = self._handle or self._replaced
        self._goal, self._handle = goal, None
        self._silence.end()
        pose = PoseStamped()
        pose.header.frame_id = self.driver.settings.frame
        pose.pose.position = point_to_ros([goal.waypoint[0], goal.waypoint[1], 0.0])
        pose.pose.orientation.z = float(np.sin(0.5 * heading))
        pose.pose.orientation.w = float(np.cos(0.5 * heading))
        request = self._type.Goal(pose=pose)
        future = self._client.send_goal_async(request, lambda _: self._silence.end())
        future.add_done_callback(lambda answer: self._answered(goal, answer.result()))

    def goal_ended(self, goal: Goal) -> None:
        """Let Nav2 stop if it is driving to this goal."""
        if goal is not self._goal:
            return
        handle, self._goal, self._handle = self._handle, None, None
        self._stop_replaced()
        if handle is not None:
            handle.cancel_goal_async()

    def _answered(self, goal: Goal, handle: Any) -> None:
        self._silence.end()
        if handle is None or not handle.accepted:
            if goal is self._goal:
                self._stop_replaced()
            self._end(goal, GoalStatus.ABORTED, 'Nav2 rejected the waypoint')
            return
        if goal is self._goal:
            self._handle, self._replaced = handle, None
        elif self._goal is None:
            # Aborted before Nav2 answered.
            handle.cancel_goal_async()
            return
        elif self._handle is None:
            self._replaced = handle
        result = handle.get_result_async()
        result.add_done_callback(lambda answer: self._finished(goal, answer.result()))

    def _finished(self, goal: Goal, answer: Any) -> None:
        if answer.status == ActionStatus.STATUS_SUCCEEDED:
            self._end(goal, GoalStatus.REACHED, '')
            return
        ended = 'cancelled it' if answer.status == ActionStatus.STATUS_CANCELED else 'aborted it'
        # Humble's result is empty, newer ones have a code and a text.
        code = getattr(answer.result, 'error_code', 0)
        text = getattr(answer.result, 'error_msg', '')
        reason = f'Nav2 {ended}{f", error {code}" if code else ""}{f": {text}" if text else ""}'
        self._end(goal, GoalStatus.ABORTED, reason)

    def _end(self, goal: Goal, status: GoalStatus, reason: str) -> None:
        if goal is self._goal:
            self._goal = self._handle = None
            if goal is self.driver.follower.current:
                self.driver.end_goal(status, reason)

    def _stop_replaced(self) -> None:
        handle, self._replaced = self._replaced, None
        if handle is not None:
            handle.cancel_goal_async()
