"""A Parrot Mambo on WiFi or Bluetooth as a driver's robot."""

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np

from maasi_drivers.agent.flight_rules import flight_volume
from maasi_drivers.agent.odometry import PoseSpeed, StampedPose
from maasi_drivers.agent.robot_node import RobotNode
from maasi_drivers.agent.robot_topics import OdometryTopic, PoseTopic
from maasi_drivers.agent.waypoint_follower import Goal
from maasi_drivers.links.mambo.link import MamboLink, MamboLinkError
from maasi_drivers.links.mambo.pilot import MamboPhase, MamboPilot
from maasi_drivers.links.robot_link import RobotLink
from maasi_drivers.settings.vehicles import LEAST_TILT, MOST_TILT, MamboSettings
from maasi_filter.arrays import FloatArray
from maasi_filter.models.pose import Pose
from maasi_filter.ros.lifecycle_node import SettingsError
from maasi_planner.motion import MotionModel, RobotState

POLL_PERIOD = 0.05  # longest time between two updates of the pilot [s]
# At the end: longest wait until the drone reports landing, and time between checks [s].
_LANDING_TIME, _LANDING_PERIOD = 1.0, 0.02
# Weight of a new difference of positions in the velocity.
_SMOOTHING = 0.5
_RISING = (MamboPhase.TAKING_OFF, MamboPhase.CLIMBING)


class MamboRobotLink(RobotLink):
    """A Parrot Mambo that pyparrot controls.

    It takes off after a call of the service `arm` if `mambo.arm` is true, flies by its position
    events or by a topic (`mambo.pose`), and lands at the end, on a low battery, and after a
    long loss of link or pose.

    Subscribes
    ----------
    `pose` (geometry_msgs/PoseStamped) or `odom` (nav_msgs/Odometry) as `mambo.pose` says

    Services
    --------
    `arm` (std_srvs/Trigger): permits one take-off
    """

    def __init__(self, driver: RobotNode) -> None:
        super().__init__(driver)
        self._mambo = driver.settings.mambo or MamboSettings()
        self._phase = MamboPhase.CONNECTING
        self._speed = PoseSpeed()

    def prepare(self) -> None:
        """Make link and geofence; check that a connection is possible."""
        driver, mambo, settings = self.driver, self._mambo, self.driver.settings
        driver.volume = flight_volume(driver.volume.area, settings, mambo)
        if settings.motion.model == 'unicycle':
            raise SettingsError(
                f"parameter motion.model: read 'unicycle', allowed with link {settings.link} "
                'is a model of flying robots such as mambo'
            )
        kind: Literal['wifi', 'ble'] = 'ble' if settings.link == 'mambo_ble' else 'wifi'
        tilt = min(max(settings.motion.tilt, LEAST_TILT), MOST_TILT)
        self._link = MamboLink(kind, mambo.address, mambo.port, tilt, mambo.climb, mambo.land_after)
        try:
            self._link.check()
        except MamboLinkError as error:
            raise SettingsError(f'parameter link: {error}') from error

    def connect(self) -> None:
        """Connect; it takes off only when the driver is active."""
        driver, link = self.driver, self._link
        self.activate()
        link.connect()
        driver.create_wall_timer(min(driver.settings.step, POLL_PERIOD), self._update)
        driver.offer_arm(lambda: self._pilot.permit(time.monotonic()), lambda: link.airborne)
        if self._mambo.pose == 'odometry':
            OdometryTopic(driver)
        elif self._mambo.pose == 'pose':
            PoseTopic(driver, self._handle_pose)
        driver.expect(lambda: self._pilot.phase is MamboPhase.FLYING)

    def close(self) -> None:
        """Close the link; the firmware takes over."""
        self._link.close()

    def activate(self) -> None:
        """Begin a flight."""
        self._phase = MamboPhase.CONNECTING
        self._pilot = MamboPilot(
            self._link, self._motion, self._mambo, self.driver.start_pose, self.driver.volume
        )

    def send(self, placed: StampedPose, command: Sequence[float]) -> None:
        """Fly a velocity command."""
        try:
            self._pilot.fly(np.array(command))
        except ValueError as error:
            self.driver.drop('command', str(error))

    def hold(self) -> None:
        """Let the drone hover."""
        self._pilot.hover()

    def stop(self) -> None:
        """Land and wait until the drone reports it."""
        link = self._link
        self._pilot.end('the driver stops')
        end = time.monotonic() + _LANDING_TIME
        while link.connected and link.airborne and link.flying_state != 'landing':
            if time.monotonic() > end:
                self.driver.get_logger().error(
                    'the drone has not reported landing; without commands its firmware lands by '
                    'itself'
                )
                break
            time.sleep(_LANDING_PERIOD)

    def latch_stop(self) -> None:
        """Let the drone land as `MamboPilot.stop` does; on the ground it stays there."""
        self._pilot.stop(time.monotonic())

    def poll(self) -> None:
        """Report why the drone does not start."""
        self.driver.publish_fault()

    def status(self) -> dict[str, Any]:
        """Return the state of drone and flight."""
        link = self._link
        return {
            'flight': self._phase.value,
            'drone': link.flying_state,
            'bad position events': link.bad_events,
            **{f'datagrams dropped: {key}': number for key, number in link.dropped.items()},
        }

    def _update(self) -> None:
        driver = self.driver
        now, pilot, link = time.monotonic(), self._pilot, self._link
        link.keep_alive()
        if not driver.active:
            return
        pilot.update(now)
        self._judge(pilot)
        if link.battery >= 0.0:
            driver.take_charge(link.battery)  # the drone reports only changes
        state, stamp = pilot.state, driver.arrivals.stamp(now)
        if stamp is None:
            driver.silence.end()  # before the begin of a simulated time nothing is late
        elif self._mambo.pose == 'events' and pilot.has_pose and state is not None:
            driver.restart_if_back('the clock', stamp)
            latest, covariance = driver.history.latest, pilot.reckoning.covariance()
            if latest is None or stamp > latest.stamp:
                driver.take_pose(
                    StampedPose(
                        stamp, state.pose, covariance, state.velocity, state.angular_velocity
                    )
                )

    def _judge(self, pilot: MamboPilot) -> None:
        phase, problem = pilot.phase, pilot.problem
        if phase is not self._phase:
            self._phase = phase
            text = phase.value
            if problem and phase not in _RISING:
                text = problem if problem.startswith(text) else f'{text}: {problem}'
            self.driver.get_logger().info(text)
        # During take-off the current goal is kept.
        if not (problem and phase in _RISING and self.driver.follower.current is not None):
            self.driver.judge('flight', problem, 'flying: accepting goals')

    def observe(self, placed: StampedPose) -> None:
        """Pass a pose of another system to the pilot."""
        if self._mambo.pose != 'events':
            self._pilot.update_pose(
                time.monotonic(), RobotState(placed.pose, placed.velocity, placed.angular_velocity)
            )

    def _handle_pose(self, stamp: int, pose: Pose) -> None:
        driver = self.driver
        if not driver.active or not driver.is_new_pose('pose.header.stamp', stamp):
            return
        placed, latest = self._speed.with_velocity(stamp, pose), driver.history.latest
        before = placed.velocity if latest is None else latest.velocity
        velocity = before + _SMOOTHING * (placed.velocity - before)
        covariance = self._mambo.pose_covariance()
        driver.take_pose(replace(placed, covariance=covariance, velocity=velocity))

    def make_motion(self) -> MotionModel:
        """Return the controller, also used by the pilot."""
        self._motion = super().make_motion()
        return self._motion

    def steer(self, robot: RobotState, step: int | None) -> tuple[FloatArray, Goal | None]:
        """Return the command for the state at which it takes effect, and the goal reached."""
        pilot = self._pilot
        if pilot.phase is MamboPhase.FLYING and pilot.has_pose:
            robot = pilot.ahead()
        return super().steer(robot, step)

    def is_moving(self, placed: StampedPose, command: FloatArray) -> bool:
        """Return whether pose and images must change; on the ground nothing moves."""
        return self._pilot.phase is MamboPhase.FLYING and super().is_moving(placed, command)

    def on_new_goal(self, goal: Goal) -> None:
        """Keep the drone in the air."""
        self._pilot.on_new_goal()

    def goal_cancelled(self) -> None:
        """Let the drone land if no other goal follows."""
        self._pilot.goal_cancelled(time.monotonic())
