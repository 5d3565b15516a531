"""The driver of a TurtleBot3, or another ground robot with a camera."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from action_msgs.msg import GoalStatus as ActionStatus
from geometry_msgs.msg import PoseStamped
from rclpy.action.client import ActionClient
from rclpy.action.server import ServerGoalHandle
from rclpy.node import Node
from sensor_msgs.msg import LaserScan

from maasi_drivers.agent.odometry import StampedPose
from maasi_drivers.agent.scan_avoidance import ScanUnicycle, scan_points
from maasi_drivers.agent.waypoint_follower import Goal, GoalStatus
from maasi_drivers.camera_driver import CameraDriver
from maasi_filter.ros.conversions import point_to_ros, stamp_from_ros
from maasi_filter.ros.lifecycle_node import SettingsError, run
from maasi_filter.ros.qos import sensor_reader
from maasi_filter.ros.silence import Silence
from maasi_msgs.action import GoToWaypoint
from maasi_planner.motion import MotionModel, RobotState
from maasi_planner.obstacles import Obstacles

FloatArray = np.ndarray[Any, np.dtype[np.float64]]

_SCAN = 'scan'
# So much nearer to the waypoint counts as progress [m].
_PROGRESS = 0.02


class Nav2Navigation:
    """
    Hands waypoints to Nav2's `navigate_to_pose` (nav2_msgs/NavigateToPose).

    Parameters
    ----------
    node : Node
        In the robot's namespace.
    frame : str
        Of the waypoints: Nav2's global frame.
    timeout : float
        Longest silence while Nav2 has a goal [s]: its feedback comes many times a
        second, whatever the robot does.
    on_end : callable
        Told when Nav2 ended a goal by itself: goal, whether it was reached, and why if not.

    Raises
    ------
    SettingsError
        If nav2_msgs is not installed.
    """

    def __init__(
        self,
        node: Node,
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
        self._client = ActionClient(node, NavigateToPose, 'navigate_to_pose')
        self._goal: Goal | None = None
        self._handle: Any = None

    @property
    def there(self) -> bool:
        """Whether there is a Nav2; of one that was killed, DDS notices only after some 20 s."""
        return bool(self._client.server_is_ready())

    @property
    def driving(self) -> bool:
        """Whether it has a goal of ours."""
        return self._goal is not None

    def problem(self) -> str | None:
        """Return what is wrong with Nav2 while it drives; None if nothing is."""
        if not self.driving:
            return None
        if not self.there:
            return 'Nav2 is gone'
        silence = self._silence.length
        if silence > self._timeout:
            return f'Nav2 has said nothing for {silence:.1f} s'
        return None

    def go(self, goal: Goal, heading: float) -> None:
        """Send the robot to a waypoint, to face `heading` there [rad]; the goal before is over."""
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
            self._ended(goal, False, 'Nav2 refuses the waypoint')
            return
        if goal is not self._goal:
            # It was given up before Nav2 had answered.
            handle.cancel_goal_async()
            return
        self._handle = handle
        result = handle.get_result_async()
        result.add_done_callback(lambda answer: self._finished(goal, answer.result()))

    def _finished(self, goal: Goal, answer: Any) -> None:
        if answer.status == ActionStatus.STATUS_SUCCEEDED:
            self._ended(goal, True, '')
            return
        ended = 'cancelled it' if answer.status == ActionStatus.STATUS_CANCELED else 'gave it up'
        # Humble's result is empty, that of newer ones says more.
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
        if handle is not None:
            handle.cancel_goal_async()


class TurtlebotDriver(CameraDriver):
    """
    A differential drive with a camera that sees the floor; see `CameraDriver`.

    A TurtleBot has no time limit on commands: the last one goes on. So zeros are published when the
    driver stops, loses the odometry, the camera or the scan, or ends, and `guard_node` does so when
    the driver dies.

    Subscribes
    ----------
    `scan` (sensor_msgs/LaserScan), with the parameters `scan.*`: a dynamic window keeps clear of it

    Actions
    -------
    client of `navigate_to_pose` (nav2_msgs/NavigateToPose), with `navigation: nav2`; `cmd_vel` is
    then Nav2's while the robot is on its way
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self._nav2: Nav2Navigation | None = None

    def prepare(self) -> None:
        """Make controller, detector, and the client of Nav2."""
        self._seen: ScanUnicycle | None = None
        super().prepare()
        self._scan: LaserScan | None = None
        self._scanned_at: int | None = None
        # The goal on the way, the least distance that was left to it, and when that was.
        self._nearest: tuple[Goal, float, int] | None = None
        if self.settings.navigation == 'nav2':
            self._nav2 = Nav2Navigation(
                self, self.settings.frame, self.settings.nav2_timeout, self._nav2_ended
            )

    def make_motion(self) -> MotionModel:
        """Return the controller, which sees the scan where there is one."""
        settings = self.settings
        if settings.scan is None:
            return super().make_motion()
        obstacles = Obstacles.from_settings(settings.environment.obstacles)
        self._seen = ScanUnicycle(settings.motion, obstacles, settings.radius, settings.scan)
        return self._seen

    def set_up_sensor(self) -> None:
        """Compile and connect."""
        super().set_up_sensor()
        if self._seen is None:
            return
        position = self.settings.start
        self._seen.see([[position[0] + 0.4, position[1]], [position[0] + 9.0, position[1]]])
        state = RobotState.at_rest(position)
        self._seen.command(state, [position[0] + 1.0, position[1], position[2]])
        self._seen.see(np.zeros((0, 2)))
        self.create_subscription(
            LaserScan, 'scan', self._on_scan, sensor_reader(self.settings.lockstep)
        )

    def _begin_anew(self) -> None:
        super()._begin_anew()
        self._scan = self._scanned_at = self._nearest = None

    def tear_down(self) -> None:
        """Let go of Nav2 as well."""
        super().tear_down()
        self._nav2 = None

    # ---- the laser scan ----------------------------------------------------------------------

    def _on_scan(self, message: LaserScan) -> None:
        if self.active:
            self._scan = message
            self._place_scan()

    def _place_scan(self) -> None:
        """Place the scan in the map once the odometry is as far."""
        message, latest, settings = self._scan, self._history.latest, self.settings.scan
        if message is None or latest is None or self._seen is None or settings is None:
            return
        stamp = stamp_from_ros(message.header.stamp)
        if stamp > latest.stamp:
            return
        self._scan = None
        placed = self._history.at(stamp)
        if placed is None:
            self.drop(
                'scan',
                f'scan.header.stamp: read {stamp} ns, allowed is what the odometry covers, up to '
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
            self.drop('scan', f'scan.{error}')
            return
        self._seen.see(points)
        self._scanned_at = latest.stamp
        if self.end_trouble(_SCAN):
            self.get_logger().info('scan: it is back')

    def _watch_scan(self, stamp: int, timeout: float) -> None:
        if self._scanned_at is None:
            self._scanned_at = stamp
        age = 1e-9 * (stamp - self._scanned_at)
        if age > timeout:
            text = f'no scan for {age:.1f} s'
            if self.begin_trouble(_SCAN, text):
                self.get_logger().warning(f'{text}: the robot is stopped')

    def steer(self, robot: RobotState, step: int | None) -> tuple[FloatArray, Goal | None]:
        """Return the command and the goal that is reached; see `AgentDriver.steer`."""
        latest, scan = self._history.latest, self.settings.scan
        if scan is not None and latest is not None:
            self._place_scan()
            self._watch_scan(latest.stamp, scan.timeout)
        command, reached = super().steer(robot, step)
        if (
            scan is not None
            and latest is not None
            and self._is_blocked(latest, scan.blocked_timeout)
        ):
            self._end_goal(
                GoalStatus.ABORTED,
                f'blocked: no nearer to the waypoint for {scan.blocked_timeout:g} s',
            )
            command = np.zeros(4)
        return command, reached

    def _is_blocked(self, placed: StampedPose, timeout: float) -> bool:
        goal = self._follower.goal
        if goal is None or goal.status != GoalStatus.MOVING:
            self._nearest = None
            return False
        left = self._follower.distance(placed.pose.position)
        if (
            self._nearest is None
            or self._nearest[0] is not goal
            or left < self._nearest[1] - _PROGRESS
        ):
            self._nearest = (goal, left, placed.stamp)
        return 1e-9 * (placed.stamp - self._nearest[2]) > timeout

    # ---- Nav2 --------------------------------------------------------------------------------

    def _problem(self, request: GoToWaypoint.Goal) -> str | None:
        problem = super()._problem(request)
        if problem is None and self._nav2 is not None and not self._nav2.there:
            return 'navigate_to_pose: Nav2 is not there'
        return problem

    def _take_goal(self, handle: ServerGoalHandle) -> None:
        super()._take_goal(handle)
        goal, latest = self._follower.current, self._history.latest
        if self._nav2 is None or goal is None:
            return
        heading = self.settings.yaw
        if latest is not None:
            ahead = goal.waypoint - latest.pose.position
            heading = float(np.arctan2(ahead[1], ahead[0]))
        self._nav2.go(goal, heading)

    def _finish(self, goal: Goal) -> None:
        if self._nav2 is not None:
            self._nav2.give_up(goal)
        super()._finish(goal)

    def _nav2_ended(self, goal: Goal, reached: bool, reason: str) -> None:
        if goal is self._follower.current:
            self._end_goal(GoalStatus.REACHED if reached else GoalStatus.ABORTED, reason)

    def is_moving(self, placed: StampedPose, command: FloatArray) -> bool:
        """Return whether it moves: where Nav2 drives, by the odometry's velocity."""
        if self._nav2 is None:
            return super().is_moving(placed, command)
        velocity = np.array([*placed.velocity, placed.angular_velocity[2]])
        return super().is_moving(placed, velocity)

    def send_command(self, placed: StampedPose, command: list[float]) -> None:
        """Have the robot move, unless Nav2 does."""
        if self._nav2 is None:
            super().send_command(placed, command)
        elif not self._nav2.driving:
            self.hold_robot()

    def watch_robot(self) -> None:
        """Look after the link, and after Nav2."""
        super().watch_robot()
        if self._nav2 is not None and (problem := self._nav2.problem()):
            self._end_goal(GoalStatus.ABORTED, problem)
            self.hold_robot()


def main(arguments: list[str] | None = None) -> int:
    """Run the driver."""
    return run(TurtlebotDriver, arguments)


if __name__ == '__main__':
    raise SystemExit(main())
