"""The driver of a Parrot Mambo, or of another flying robot with a camera."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rclpy.action.server import CancelResponse, ServerGoalHandle

from maasi_drivers.agent import geofence
from maasi_drivers.agent.agent_driver import FloatArray
from maasi_drivers.agent.arm_permission import offer_arm
from maasi_drivers.agent.odometry import StampedPose
from maasi_drivers.agent.waypoint_follower import Goal
from maasi_drivers.camera_driver import CameraDriver
from maasi_drivers.links.mambo.link import MamboLink, MamboLinkError
from maasi_drivers.links.mambo.pilot import MamboPilot, Phase, tilt_limit
from maasi_drivers.links.mambo.settings import MamboSettings
from maasi_filter.models.pose import Pose
from maasi_filter.ros.conversions import pose_from_ros, stamp_from_ros, stamp_to_ros
from maasi_filter.ros.lifecycle_node import SettingsError, run
from maasi_filter.ros.qos import sensor_reader
from maasi_msgs.action import GoToWaypoint
from maasi_planner.motion import RobotState

# Longest time from one look at the link to the next [s].
_POLL_PERIOD = 0.05
# At the end: how long it waits for the drone to say that it lands [s].
_FAREWELL, _FAREWELL_POLL = 1.0, 0.02
# Part of a new difference of positions in the velocity.
_SMOOTHING = 0.5
# Kind of trouble.
_FLIGHT = 'flight'
_RISING = (Phase.TAKING_OFF, Phase.CLIMBING)


class MamboDriver(CameraDriver):
    """
    A quadrotor with a camera that looks down; see `CameraDriver`.

    With `link: mambo_wifi` or `mambo_ble` it is a Parrot Mambo that pyparrot talks to;
    `battery_state` and `cmd_vel` are not used then. It takes off when the driver is active and
    `mambo.arm` is true, flies by its own position events or by a topic of another system
    (`mambo.pose`), and lands at the end, on a low battery, and when link or pose are lost for long.

    Subscribes
    ----------
    with a link of its own, `pose` (geometry_msgs/PoseStamped) or `odom` (nav_msgs/Odometry) where
    `mambo.pose` says so
    """

    links = ('topics', 'mambo_wifi', 'mambo_ble')

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self._link: MamboLink | None = None
        self._pilot: MamboPilot | None = None

    def prepare(self) -> None:
        """Make controller, detector and geofence; check that the link can be had."""
        super().prepare()
        settings = self.settings
        self._mambo = settings.mambo or MamboSettings()
        self._phase = Phase.CONNECTING
        self._fence = geofence.make_fence(
            self._mambo.geofence,
            self._bounds,
            self.settings.radius,
            self._mambo.ground,
            self.settings.start[2],
        )
        if settings.link != 'topics':
            if settings.motion.model == 'unicycle':
                raise SettingsError(
                    f"parameter motion.model: read 'unicycle', allowed with link {settings.link} "
                    'is that of a flying robot, as mambo'
                )
            try:
                self._make_link().check()
            except MamboLinkError as error:
                raise SettingsError(f'parameter link: {error}') from error

    def _make_link(self) -> MamboLink:
        mambo = self._mambo
        return MamboLink(
            'ble' if self.settings.link == 'mambo_ble' else 'wifi',
            mambo.address,
            mambo.port,
            tilt_limit(self.settings.motion),
            mambo.climb,
            mambo.land_after,
        )

    # ---- the link ----------------------------------------------------------------------------

    def connect_robot(self) -> None:
        """Connect; it takes off once the driver is active."""
        if self.settings.link == 'topics':
            super().connect_robot()
            return
        self._link = self._make_link()
        self._link.connect()
        self.create_wall_timer(min(self.settings.step, _POLL_PERIOD), self._poll)
        offer_arm(self, self._arm)
        quality = sensor_reader(self.settings.lockstep)
        if self._mambo.pose == 'odometry':
            self.create_subscription(Odometry, 'odom', self._on_odometry, quality)
        elif self._mambo.pose == 'pose':
            self.create_subscription(PoseStamped, 'pose', self._on_pose, quality)
        self.expect(lambda: self._pilot is not None and self._pilot.phase is Phase.FLYING)

    def _arm(self) -> str:
        """Let the drone take off; return why not, empty where it may."""
        problem = self.arm_problem()
        if self._pilot is None or problem:
            return problem or 'the driver is not active'
        return self._pilot.permit(time.monotonic())

    def disconnect_robot(self) -> None:
        """Leave the drone to its firmware."""
        super().disconnect_robot()
        self._pilot = None
        if self._link is not None:
            self._link.close()
            self._link = None

    def destroy_node(self) -> None:
        """Leave the drone to its firmware, and the graph."""
        super().destroy_node()
        if self._link is not None:
            self._link.close()
            self._link = None

    def start(self) -> None:
        """Begin to work: it may take off now."""
        super().start()
        if self._link is not None:
            self._phase = Phase.CONNECTING
            self._pilot = MamboPilot(
                self._link, self._motion, self._mambo, self._start, self._fence
            )

    def stop_robot(self) -> None:
        """Land, as the driver ends; it waits until the drone says that it does."""
        super().stop_robot()
        pilot, link = self._pilot, self._link
        if pilot is None or link is None:
            return
        self._pilot = None
        pilot.end('the driver stops')
        end = time.monotonic() + _FAREWELL
        while link.connected and link.airborne and link.flying_state != 'landing':
            if time.monotonic() > end:
                self.get_logger().error(
                    'the drone has not said that it lands: its firmware does so by itself when it '
                    'hears nothing'
                )
                break
            time.sleep(_FAREWELL_POLL)

    def stop_by_service(self) -> None:
        """Have the drone hover, then land as after a cancelled goal; from the ground it stays."""
        super().stop_by_service()
        if self._pilot is not None:
            self._pilot.goal_cancelled(time.monotonic())

    def hold_robot(self) -> None:
        """Have the drone hover."""
        if self._link is None:
            super().hold_robot()
        elif self._pilot is not None:
            self._pilot.hover()

    def watch_robot(self) -> None:
        """Look after the link."""
        super().watch_robot()
        if self._link is not None and self.trouble and self._history.latest is None:
            # The planner is to hear why it does not start.
            self._state.header.stamp = stamp_to_ros(self.get_clock().now().nanoseconds)
            self._fill_status()
            self._state_publisher.publish(self._state)

    def status(self) -> dict[str, Any]:
        """Return what the drone does."""
        status = super().status()
        if self._link is not None:
            status['flight'] = self._phase.value
            status['drone'] = self._link.flying_state
            status['bad position events'] = self._link.bad_events
            status['listener started again'] = self._link.revived
            status |= {f'datagrams dropped: {key}': n for key, n in self._link.dropped.items()}
        return status

    # ---- what comes in -----------------------------------------------------------------------

    def _poll(self) -> None:
        now, pilot, link = time.monotonic(), self._pilot, self._link
        if link is not None:
            link.keep_alive()
        self.arrivals.observe(now, self.get_clock().now().nanoseconds)
        if pilot is None or link is None or not self.active:
            return
        pilot.update(now)
        self._judge(pilot)
        if link.battery >= 0.0:
            # The drone says it when it changes.
            self.take_charge(link.battery)
        state, stamp = pilot.state, self.arrivals.stamp(now)
        if stamp is None:
            # A simulated time has not begun: nothing is late.
            self._silence.end()
        latest = self._history.latest
        if (
            self._mambo.pose == 'events'
            and pilot.has_pose
            and state is not None
            and stamp is not None
            and (latest is None or stamp > latest.stamp)
        ):
            self.take_pose(
                StampedPose(
                    stamp,
                    state.pose,
                    pilot.reckoning.covariance(),
                    state.velocity,
                    state.angular_velocity,
                )
            )

    def _judge(self, pilot: MamboPilot) -> None:
        """Note whether it can go on."""
        if pilot.phase is not self._phase:
            self._phase = pilot.phase
            why = '' if pilot.phase in _RISING else pilot.problem
            self.get_logger().info(pilot.phase.value + (f': {why}' if why else ''))
        # One that takes off for a goal is on its way.
        if pilot.problem and (pilot.phase not in _RISING or self._follower.current is None):
            if self.begin_trouble(_FLIGHT, pilot.problem):
                self.get_logger().warning(pilot.problem)
        elif not pilot.problem and self.end_trouble(_FLIGHT):
            self.get_logger().info('it goes where it is sent')
            # Where it was to stay was of before.
            self._follower.stay()

    def take_pose(self, placed: StampedPose) -> None:
        """Take where the drone is."""
        if self._pilot is not None and self._mambo.pose != 'events':
            self._pilot.take_pose(
                time.monotonic(), RobotState(placed.pose, placed.velocity, placed.angular_velocity)
            )
        super().take_pose(placed)

    def _on_pose(self, message: PoseStamped) -> None:
        if not self.active:
            return
        stamp = stamp_from_ros(message.header.stamp)
        if not self._is_new('pose.header.stamp', stamp):
            return
        frame = message.header.frame_id.lstrip('/')
        try:
            if frame != self.settings.frame:
                raise ValueError(
                    f'header.frame_id: read {frame!r}, allowed is {self.settings.frame!r}'
                )
            placed = self._with_velocity(stamp, pose_from_ros(message.pose))
        except ValueError as error:
            self.drop('pose', f'pose: {error}')
            return
        self.take_pose(placed)

    def _with_velocity(self, stamp: int, pose: Pose) -> StampedPose:
        latest = self._history.latest
        velocity = np.zeros(3)
        if latest is not None:
            passed = 1e-9 * (stamp - latest.stamp)
            measured = (pose.position - latest.pose.position) / passed
            velocity = latest.velocity + _SMOOTHING * (measured - latest.velocity)
        noise = self._mambo
        variances = [noise.position_noise**2] * 3 + [noise.attitude_noise**2] * 3
        return StampedPose(stamp, pose, np.diag(variances), velocity, np.zeros(3))

    # ---- goals, and what goes out ------------------------------------------------------------

    def steer(self, robot: RobotState, step: int | None) -> tuple[FloatArray, Goal | None]:
        """Return the command for where it will be when that acts, and the goal reached."""
        pilot = self._pilot
        flies = pilot is not None and pilot.phase is Phase.FLYING and pilot.has_pose
        return super().steer(pilot.ahead() if pilot and flies else robot, step)

    def is_moving(self, placed: StampedPose, command: FloatArray) -> bool:
        """Return whether pose and images have to change: a command on the ground moves nothing."""
        if self._pilot is not None and self._pilot.phase is not Phase.FLYING:
            return False
        return super().is_moving(placed, command)

    def _problem(self, request: GoToWaypoint.Goal) -> str | None:
        problem = super()._problem(request)
        if problem is not None or self._link is None:
            return problem
        point = request.waypoint.pose.position
        return geofence.goal_problem(self._fence, (point.x, point.y, point.z))

    def _take_goal(self, handle: ServerGoalHandle) -> None:
        if self._pilot is not None:
            self._pilot.goal_taken()
        super()._take_goal(handle)

    def _cancel_goal(self, handle: ServerGoalHandle) -> CancelResponse:
        answer = super()._cancel_goal(handle)
        if answer == CancelResponse.ACCEPT and self._pilot is not None:
            self._pilot.goal_cancelled(time.monotonic())
        return answer

    def send_command(self, placed: StampedPose, command: list[float]) -> None:
        """Fly a velocity command."""
        if self._link is None:
            super().send_command(placed, command)
        elif self._pilot is not None:
            try:
                self._pilot.fly(np.array(command))
            except ValueError as error:
                self.drop('command', str(error))


def main(arguments: list[str] | None = None) -> int:
    """Run the driver."""
    return run(MamboDriver, arguments)


if __name__ == '__main__':
    raise SystemExit(main())
