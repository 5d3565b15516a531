"""The topic `state` of a robot, and the faults that its driver finds by itself."""

from __future__ import annotations

import time

from maasi_drivers.agent.odometry import StampedPose
from maasi_drivers.agent.robot_link import RobotLink
from maasi_drivers.agent.robot_node import BATTERY, FROZEN_POSE, ODOMETRY, SENSOR, RobotNode
from maasi_drivers.agent.sensor_input import SensorInput
from maasi_filter.ros.conversions import pose_to_ros, stamp_to_ros
from maasi_filter.ros.qos import LIVELINESS_PERIOD, LIVELY
from maasi_msgs.msg import AgentState

# Time without a charge after which a warning says that `battery_minimum` cannot act [s].
_CHARGE_PATIENCE = 10.0


class BatteryWatch:
    """Keeps the last known charge, and compares it with `battery_minimum`."""

    def __init__(self, driver: RobotNode) -> None:
        self._driver = driver
        self.charge = -1.0
        self._known_at = time.monotonic()

    def take(self, charge: float) -> None:
        """Take a charge, 0 to 1; anything else is unknown and leaves a fault as it is."""
        self.charge = charge if 0.0 <= charge <= 1.0 else -1.0
        if self.charge < 0.0:
            return
        self._known_at = time.monotonic()
        minimum, health = self._driver.settings.battery_minimum, self._driver.health
        if not minimum:
            return
        if self.charge >= minimum:
            health.end(BATTERY)
            return
        text = f'battery at {self.charge:.2f}, below {minimum:.2f}'
        if health.begin(BATTERY, text):
            self._driver.get_logger().warning(f'{text}: the robot takes no goals')

    def check(self, now: float) -> None:
        """Warn where the charge has been unknown for long; `now` on the steady clock [s]."""
        unknown = now - self._known_at
        if self._driver.settings.battery_minimum and unknown > _CHARGE_PATIENCE:
            self._driver.warn_throttled(
                'battery',
                f'no charge of the battery for {unknown:.0f} s: battery_minimum cannot act',
            )


class StatePublisher:
    """Publishes pose, goal and faults of a robot.

    Publishes
    ---------
    `state` (maasi_msgs/AgentState), with each pose; its liveliness is asserted by the executor
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


PERIOD = 0.1
# Checks per published state of a robot without odometry.
_CHECKS_PER_STATE = 2
# Time without a first pose after which a warning is logged [s].
_PATIENCE = 3.0
# Wall time beyond its timeout after which a robot with silent odometry is stopped without a
# fault: a simulated clock may be slow [s].
_CLOCK_PATIENCE = 0.5


class Watchdog:
    """Stops a robot without odometry, with a frozen pose or with a silent sensor."""

    def __init__(
        self,
        driver: RobotNode,
        link: RobotLink,
        sensor: SensorInput,
        state: StatePublisher,
        battery: BatteryWatch,
    ) -> None:
        self._driver = driver
        self._link = link
        self._sensor = sensor
        self._state = state
        self._battery = battery
        self.moving = False
        # Stamps of the last change of the pose, and of the pose at the last image [ns].
        self._changed_at = 0
        self._sensed_at: int | None = None
        self._checked_at = time.monotonic()
        self._stalled = False
        self._checks = 0

    def reset(self) -> None:
        """Discard what belongs to another time."""
        self._sensed_at = None
        self.moving = False

    def check(self) -> None:
        """Stop a robot without odometry; called on wall time, as the clock may stand still."""
        driver = self._driver
        if not driver.active:
            return
        self._checks += 1
        now, before = time.monotonic(), self._checked_at
        self._checked_at = now
        self._stalled = now - before > 2.0 * PERIOD and not self._stalled
        if self._stalled:
            # This process was suspended: odometry may be waiting in the queue.
            return
        self._link.poll()
        self._battery.check(now)
        health, silence = driver.health, driver.silence
        age, timeout = silence.length, driver.settings.odometry_timeout
        if driver.history.latest is None and ODOMETRY not in health:
            wall = silence.wall
            if wall > _PATIENCE and self._link.expects_pose():
                driver.warn_throttled('no odometry', f'no {driver.pose_name} yet, for {wall:.0f} s')
        elif age > timeout or ODOMETRY in health:
            text = f'no {driver.pose_name} for {age:.1f} s'
            if health.begin(ODOMETRY, text):
                driver.get_logger().warning(f'{text}: stopping the robot')
                self._checks = 0
            self._link.hold()
            if self._checks % _CHECKS_PER_STATE == 0:
                self._state.publish_status()
        elif silence.wall > timeout + _CLOCK_PATIENCE:
            # The simulated clock is slow or stands, which real robots do not.
            self._link.hold()

    def note_pose(self, placed: StampedPose) -> None:
        """Check a new pose, before it is added to the history; not in lockstep."""
        self._check_frozen(placed)
        self._check_sensor(placed)

    def pose_is_back(self) -> None:
        """Begin the sensor's timeout anew: it may have been silent with the odometry."""
        self._sensed_at = None

    def note_frame(self, topic: str, repeated: bool) -> None:
        """Note an image or sweep; see `RobotNode.take_frame`."""
        latest, health = self._driver.history.latest, self._driver.health
        if latest is None:
            return
        # A robot at rest may see the same twice; a sensor that hung has to deliver something new.
        if not repeated or not (self.moving or SENSOR in health):
            self._sensed_at = latest.stamp
            if health.end(SENSOR):
                self._driver.get_logger().info(f'{topic}: received again')

    def _check_frozen(self, placed: StampedPose) -> None:
        """Stop a robot whose pose stays the same to the bit under a command to move."""
        driver = self._driver
        timeout, before = driver.settings.frozen_pose_timeout, driver.history.latest
        same = before is not None and placed.pose == before.pose
        if not same and driver.health.end(FROZEN_POSE):
            driver.get_logger().info('the pose changes again')
        if not timeout or not same or not self.moving:
            self._changed_at = placed.stamp
            return
        age = 1e-9 * (placed.stamp - self._changed_at)
        if age > timeout:
            text = f'the pose has not changed for {age:.1f} s'
            if driver.health.begin(FROZEN_POSE, text):
                driver.get_logger().warning(f'odom: {text}: stopping the robot')

    def _check_sensor(self, placed: StampedPose) -> None:
        """Stop a robot whose sensor is silent."""
        timeout = self._driver.settings.sensor_patience
        if self._sensed_at is None:
            self._sensed_at = placed.stamp
        age = 1e-9 * (placed.stamp - self._sensed_at)
        if timeout and age > timeout:
            text = f'no new {self._sensor.name} for {age:.1f} s'
            if self._driver.health.begin(SENSOR, text):
                self._driver.get_logger().warning(f'{text}: stopping the robot')
