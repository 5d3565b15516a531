"""The topic `state` of a robot, and faults that its driver detects itself."""

import time

from maasi_drivers.agent.odometry import StampedPose
from maasi_drivers.agent.robot_node import BATTERY, FROZEN_POSE, ODOMETRY, SENSOR, RobotNode
from maasi_drivers.agent.sensor_input import SensorInput
from maasi_drivers.links.robot_link import RobotLink
from maasi_drivers.settings.driver import DriverSettings
from maasi_filter.ros.conversions import pose_to_ros, stamp_to_ros
from maasi_filter.ros.qos import LIVELINESS_PERIOD, LIVELY
from maasi_msgs.msg import AgentState


class StatePublisher:
    """Publishes `state` with each pose; the executor asserts its liveliness."""

    def __init__(self, driver: RobotNode) -> None:
        self._driver = driver
        #: Battery charge; -1 if unknown.
        self.charge = -1.0
        self._state = AgentState(robot=driver.robot, battery=-1.0)
        self._state.header.frame_id = driver.settings.frame
        self._state.pose.pose = pose_to_ros(driver.start_pose)
        self._publisher = driver.create_publisher(AgentState, 'state', LIVELY)
        driver.create_wall_timer(LIVELINESS_PERIOD, self._publisher.assert_liveliness)
        driver.expect_subscribers(self._publisher, names={'planner_node'})

    def publish(self, placed: StampedPose, step: int) -> None:
        """Publish a pose at a step, with goal and faults."""
        state = self._state
        state.pose.pose = pose_to_ros(placed.pose)
        state.pose.covariance = placed.covariance.ravel()
        linear, angular = state.twist.linear, state.twist.angular
        linear.x, linear.y, linear.z = placed.velocity.tolist()
        angular.x, angular.y, angular.z = placed.angular_velocity.tolist()
        self.publish_status(placed.stamp, step)

    def publish_status(self, stamp: int | None = None, step: int | None = None) -> None:
        """Publish goal and faults with the last pose; default: its stamp [ns] and step."""
        state, follower = self._state, self._driver.follower
        if stamp is not None:
            state.header.stamp = stamp_to_ros(stamp)
        if step is not None:
            state.step = step
        goal, fault = follower.goal, self._driver.health.text
        state.battery = self.charge
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
# Time without a first pose or a charge until a warning is logged [s].
_PATIENCE, _CHARGE_PATIENCE = 3.0, 10.0
_CHARGE_REMINDER = 30.0  # between two warnings that no charge is known [s]
_DEFAULT_MINIMUM = DriverSettings.model_fields['battery_minimum'].default


class Watchdog:
    """Stops a robot without odometry, with a frozen pose, a silent sensor or a low battery."""

    def __init__(
        self, driver: RobotNode, link: RobotLink, sensor: SensorInput, state: StatePublisher
    ) -> None:
        self._driver, self._link, self._sensor, self._state = driver, link, sensor, state
        self.moving = False
        # Stamps of the last pose change, and of the pose at the last image [ns].
        self._changed_at = 0
        self.sensed_at: int | None = None
        self._checked_at = self._charged_at = time.monotonic()
        # Stamp of the pose at the last charge [ns], and the charge.
        self._charge_stamp: int | None = None
        self._last_charge = -1.0
        self._stalled = False
        self._checks = 0

    def reset(self) -> None:
        """Discard data from another time."""
        self.sensed_at = None
        self.moving = False

    def check(self) -> None:
        """Stop a robot without odometry; called on wall time, as the clock may stop."""
        driver = self._driver
        if not driver.active:
            return
        self._checks += 1
        now, before = time.monotonic(), self._checked_at
        self._checked_at = now
        self._stalled = now - before > 2.0 * PERIOD and not self._stalled
        if self._stalled:
            return  # this process was suspended; odometry may be queued
        self._link.poll()
        # The default minimum is for robots that report a charge.
        minimum = driver.settings.battery_minimum
        asked = minimum not in (0.0, _DEFAULT_MINIMUM) or (minimum and self._last_charge >= 0.0)
        if asked and now - self._charged_at > _CHARGE_PATIENCE:
            driver.warn_throttled(
                'battery',
                f'no battery charge for {now - self._charged_at:.0f} s: battery_minimum has '
                'no effect',
                _CHARGE_REMINDER,
            )
        health, silence = driver.health, driver.silence
        age, timeout = silence.length, driver.settings.odometry_timeout
        if driver.history.latest is None and ODOMETRY not in health:
            # Before a simulation begins there is none.
            if age > _PATIENCE and self._link.expects_pose():
                driver.warn_throttled(
                    'no odometry', f'no {driver.pose_name} received for {age:.0f} s'
                )
        elif age > timeout or ODOMETRY in health:
            if health.begin(ODOMETRY, f'no {driver.pose_name} for {age:.1f} s'):
                self._checks = 0
            self._link.hold()
            if self._checks % 2 == 0:
                self._state.publish_status()
        elif silence.wall > timeout + 0.5:
            # No fault: a slow or stopped simulated clock, which real robots do not have.
            self._link.hold()

    def update_charge(self, charge: float) -> None:
        """Update the charge, 0 to 1; other values are unknown and keep a fault."""
        self._state.charge = charge if 0.0 <= charge <= 1.0 else -1.0
        if self._state.charge < 0.0:
            return
        self._charged_at, self._last_charge = time.monotonic(), charge
        latest = self._driver.history.latest
        self._charge_stamp = None if latest is None else latest.stamp
        minimum, health = self._driver.settings.battery_minimum, self._driver.health
        if charge < minimum:
            health.begin(
                BATTERY, f'battery at {100.0 * charge:.0f} %, below {100.0 * minimum:.0f} %'
            )
        else:
            health.end(BATTERY)

    def watch_charge(self, stamp: int) -> None:
        """Let a charge much older than a pose's stamp [ns] become unknown; report it once."""
        timeout = self._driver.settings.battery_timeout
        if self._state.charge < 0.0 or not timeout:
            return
        before = self._charge_stamp
        if before is None or stamp < before:
            self._charge_stamp = stamp
        elif (age := 1e-9 * (stamp - before)) > timeout:
            self._state.charge = -1.0
            self._driver.get_logger().warning(
                f'no battery charge for {age:.0f} s, since {1e-9 * before:.1f} s: treating it as '
                f'unknown (last {100.0 * self._last_charge:.0f} %)'
            )

    def note_frame(self, topic: str, repeated: bool) -> None:
        """Note an image or sweep; see `RobotNode.receive_frame`."""
        latest, health = self._driver.history.latest, self._driver.health
        if latest is None:
            return
        # A robot at rest may see the same twice; after a fault the sensor must deliver new data.
        if not repeated or not (self.moving or SENSOR in health):
            self.sensed_at = latest.stamp
            health.end(SENSOR, f'{topic}: received again')

    def note_pose(self, placed: StampedPose) -> None:
        """Check a new pose before it joins the history; not in lockstep."""
        health, settings = self._driver.health, self._driver.settings
        # A bit-identical pose under a command to move.
        before = self._driver.history.latest
        same = before is not None and placed.pose == before.pose
        if not same:
            health.end(FROZEN_POSE, 'the pose changes again')
        if not settings.frozen_pose_timeout or not same or not self.moving:
            self._changed_at = placed.stamp
        age = 1e-9 * (placed.stamp - self._changed_at)
        if age > settings.frozen_pose_timeout:
            health.begin(FROZEN_POSE, f'the pose has not changed for {age:.1f} s')
        if self.sensed_at is None:
            self.sensed_at = placed.stamp
        age = 1e-9 * (placed.stamp - self.sensed_at)
        if settings.sensor_patience and age > settings.sensor_patience:
            health.begin(SENSOR, f'no new {self._sensor.name} for {age:.1f} s')
