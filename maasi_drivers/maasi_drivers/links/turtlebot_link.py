"""A ground robot with topics, and where it has them a laser scan and Nav2."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from maasi_drivers.agent.odometry import StampedPose
from maasi_drivers.agent.robot_node import RobotNode
from maasi_drivers.agent.scan_avoidance import ScanUnicycle
from maasi_drivers.agent.scan_input import ScanInput
from maasi_drivers.agent.waypoint_follower import Goal, GoalStatus
from maasi_drivers.links.nav2_navigation import Nav2Navigation
from maasi_drivers.links.robot_link import FloatArray
from maasi_drivers.links.topic_link import TopicLink
from maasi_filter.ros.conversions import stamp_to_ros
from maasi_planner.motion import MotionModel, RobotState
from maasi_planner.obstacles import Obstacles


class TurtlebotLink(TopicLink):
    """A differential drive; see `TopicLink`.

    A TurtleBot has no time limit on commands: it executes the last one for ever. So zeros are
    published when the driver stops, loses odometry, camera or scan, or ends, and by `guard_node`
    when the driver dies.

    Subscribes
    ----------
    `scan` (sensor_msgs/LaserScan), with the parameters `scan.*`: a dynamic window keeps clear of it

    Actions
    -------
    client of `navigate_to_pose` (nav2_msgs/NavigateToPose), with `navigation: nav2`; `cmd_vel` is
    then Nav2's while the robot is on its way
    """

    def __init__(self, driver: RobotNode) -> None:
        super().__init__(driver)
        self._scan: ScanInput | None = None
        self._nav2: Nav2Navigation | None = None

    def prepare(self) -> None:
        """Make the client of Nav2."""
        settings = self.driver.settings
        if settings.navigation == 'nav2':
            self._nav2 = Nav2Navigation(
                self.driver, settings.frame, settings.nav2_timeout, self._on_nav2_end
            )

    def make_motion(self) -> MotionModel:
        """Return the controller, which uses the scan where there is one."""
        settings = self.driver.settings
        if settings.scan is None:
            return super().make_motion()
        obstacles = Obstacles.from_settings(settings.environment.obstacles)
        motion = ScanUnicycle(settings.motion, obstacles, settings.radius, settings.scan)
        self._scan = ScanInput(self.driver, settings.scan, motion)
        return motion

    def connect(self) -> None:
        """Subscribe, and publish commands."""
        super().connect()
        if self._scan is not None:
            self._scan.set_up()

    def close(self) -> None:
        """Destroy the publisher, and drop the client of Nav2."""
        super().close()
        self._nav2 = None

    def reset(self) -> None:
        """Discard the scan of another time."""
        if self._scan is not None:
            self._scan.reset()

    def steer(self, robot: RobotState, step: int | None) -> tuple[FloatArray, Goal | None]:
        """Return command and goal reached; a blocked robot gives its goal up."""
        scan, settings, latest = self._scan, self.driver.settings.scan, self.driver.history.latest
        if scan is None or settings is None or latest is None:
            return super().steer(robot, step)
        scan.update(latest)
        command, reached = super().steer(robot, step)
        if scan.is_blocked(latest):
            self.driver.end_goal(
                GoalStatus.ABORTED,
                f'blocked: no nearer to the waypoint for {settings.blocked_timeout:g} s',
            )
            command = np.zeros(4)
        return command, reached

    def is_moving(self, placed: StampedPose, command: FloatArray) -> bool:
        """Return whether it moves: where Nav2 drives, by the velocity of the odometry."""
        if self._nav2 is None:
            return super().is_moving(placed, command)
        velocity = np.array([*placed.velocity, placed.angular_velocity[2]])
        return super().is_moving(placed, velocity)

    def send(self, placed: StampedPose, command: Sequence[float]) -> None:
        """Publish a command; with Nav2 zeros, and nothing while it drives."""
        if self._nav2 is None:
            super().send(placed, command)
            return
        self._command.header.stamp = stamp_to_ros(placed.stamp)
        if not self._nav2.driving:
            self.hold()

    def poll(self) -> None:
        """Check the link, and Nav2."""
        super().poll()
        if self._nav2 is not None and (problem := self._nav2.problem()):
            self.driver.end_goal(GoalStatus.ABORTED, problem)
            self.hold()

    def goal_problem(self, position: Sequence[float]) -> str | None:
        """Refuse goals without Nav2, where Nav2 is to drive."""
        if self._nav2 is None:
            return super().goal_problem(position)
        return None if self._nav2.available else 'navigate_to_pose: Nav2 is not there'

    def goal_taken(self, goal: Goal) -> None:
        """Send the goal to Nav2."""
        if self._nav2 is None:
            return
        latest, heading = self.driver.history.latest, self.driver.settings.yaw
        if latest is not None:
            ahead = goal.waypoint - latest.pose.position
            heading = float(np.arctan2(ahead[1], ahead[0]))
        self._nav2.go(goal, heading)

    def goal_ended(self, goal: Goal) -> None:
        """Cancel the goal of Nav2."""
        if self._nav2 is not None:
            self._nav2.give_up(goal)

    def _on_nav2_end(self, goal: Goal, reached: bool, reason: str) -> None:
        if goal is self.driver.follower.current:
            status = GoalStatus.REACHED if reached else GoalStatus.ABORTED
            self.driver.end_goal(status, reason)
