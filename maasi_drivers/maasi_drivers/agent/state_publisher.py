"""The topic `state` of a robot."""

from __future__ import annotations

from maasi_drivers.agent.battery_watch import BatteryWatch
from maasi_drivers.agent.odometry import StampedPose
from maasi_drivers.agent.robot_node import RobotNode
from maasi_filter.ros.conversions import pose_to_ros, stamp_to_ros
from maasi_filter.ros.qos import LIVELINESS_PERIOD, LIVELY
from maasi_msgs.msg import AgentState


class StatePublisher:
    """Publishes pose, goal and faults of a robot.

    Publishes
    ---------
    `state` (maasi_msgs/AgentState), with each pose; its liveliness is asserted by the executor

    Parameters
    ----------
    driver : RobotNode
        The robot's node.
    battery : BatteryWatch
        Its charge.
    """

    def __init__(self, driver: RobotNode, battery: BatteryWatch) -> None:
        self._driver = driver
        self._battery = battery
        self._state = AgentState(robot=driver.robot, battery=-1.0)
        self._state.header.frame_id = driver.settings.frame
        self._state.pose.pose = pose_to_ros(driver.start_pose)

    def set_up(self) -> None:
        """Create the publisher."""
        self._publisher = self._driver.create_publisher(AgentState, 'state', LIVELY)
        self._driver.create_wall_timer(LIVELINESS_PERIOD, self._publisher.assert_liveliness)
        self._driver.expect_subscribers(self._publisher, names={'planner_node'})

    @property
    def goal_id(self) -> int:
        """Of the goal that was published last; 0: none."""
        return int(self._state.goal_id)

    def publish(self, placed: StampedPose, step: int) -> None:
        """Publish a pose at a step, with goal and faults."""
        state = self._state
        state.header.stamp = stamp_to_ros(placed.stamp)
        state.step = step
        position, orientation = state.pose.pose.position, state.pose.pose.orientation
        position.x, position.y, position.z = placed.pose.position.tolist()
        orientation.w, orientation.x, orientation.y, orientation.z = (
            placed.pose.orientation.tolist()
        )
        state.pose.covariance = placed.covariance.ravel()
        linear, angular = state.twist.linear, state.twist.angular
        linear.x, linear.y, linear.z = placed.velocity.tolist()
        angular.x, angular.y, angular.z = placed.angular_velocity.tolist()
        self.publish_status()

    def publish_status(self, stamp: int | None = None, step: int | None = None) -> None:
        """Publish goal and faults with the last pose; by default with its stamp [ns] and step."""
        state, follower = self._state, self._driver.follower
        if stamp is not None:
            state.header.stamp = stamp_to_ros(stamp)
        if step is not None:
            state.step = step
        goal, fault = follower.goal, self._driver.health.text
        state.battery = self._battery.charge
        state.goal_id = 0 if goal is None else goal.id
        state.goal_status = int(follower.status)
        state.reason = '' if goal is None else goal.reason
        if fault:
            state.goal_status = AgentState.UNAVAILABLE
            state.reason = fault
        self._publisher.publish(state)

    def repeat(self) -> None:
        """Publish the last state again."""
        self._publisher.publish(self._state)
