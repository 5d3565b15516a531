"""The driver of a Mambo whose own program segments, flies, and takes waypoints by UDP (001)."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import numpy as np

from maasi_drivers.agent import geofence
from maasi_drivers.agent.arm_permission import UNTIL_ARM, ArmPermission, offer_arm
from maasi_drivers.agent.odometry import StampedPose
from maasi_drivers.camera_driver import CameraDriver
from maasi_drivers.links.mambo.settings import MamboSettings
from maasi_drivers.links.waypoint_orders import OrderKind, OrderSender
from maasi_drivers.vision.measurement_feed import FeedPose, FeedState
from maasi_filter.models.pose import Pose, compose, inverse, quaternion_product
from maasi_filter.ros.lifecycle_node import SettingsError, run
from maasi_msgs.action import GoToWaypoint

# From one order to the next [s]; without them the program on board hovers, then lands.
_PERIOD = 0.1
# How far from its altitude the drone counts as there after take-off [m].
_ALTITUDE_TOLERANCE = 0.1
# At the end: orders to land, and between them [s].
_FAREWELLS, _FAREWELL_PERIOD = 5, 0.05
_FLIGHT = 'flight'


class MamboOnboardDriver(CameraDriver):
    """
    A drone with a program of its own; see `CameraDriver`, and docs/measurement_feed.md.

    The feed carries blobs and pose, orders go back ten times a second: be on the ground, hover, or
    fly to a waypoint. It takes off when the service `arm` is called and `mambo.arm` is true.
    """

    links = ('mambo_feed',)

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self._sender: OrderSender | None = None

    def prepare(self) -> None:
        """Check the settings."""
        settings = self.settings
        if settings.image_source != 'feed':
            raise SettingsError(
                f'parameter image_source: read {settings.image_source!r}, allowed with link '
                'mambo_feed is feed'
            )
        self._mambo = settings.mambo or MamboSettings()
        super().prepare()
        self._fence = geofence.make_fence(
            self._mambo.geofence,
            self._bounds,
            settings.radius,
            self._mambo.ground,
            settings.start[2],
        )
        place = [*settings.start[:2], self._mambo.ground]
        #: What the feed's positions are relative to.
        self._origin = Pose.from_yaw(place, settings.yaw)
        self._order = OrderKind.LAND
        self._goal = self._start.position
        self._up = False
        self._rising_since: float | None = None
        self._lost_since: float | None = None
        # Why it landed.
        self._landed_for = ''
        self._feed_state: FeedState | None = None
        self._permission = ArmPermission(self._mambo.arm_timeout)

    def feed_sender(self) -> str | None:
        """Return the drone's address."""
        return self._mambo.address

    # ---- the link ----------------------------------------------------------------------------

    def connect_robot(self) -> None:
        """Send orders from now on: to be on the ground until it is active and may fly."""
        self._sender = OrderSender(self._mambo.address, self._mambo.order_port)
        self.create_wall_timer(_PERIOD, self._send)
        self.expect(lambda: self._up)
        offer_arm(self, self._arm)

    def _arm(self) -> str:
        """Let the drone take off; return why not, empty where it may."""
        problem = self.arm_problem()
        if not problem and not self._mambo.arm:
            problem = 'on the ground: it may not take off (parameter mambo.arm)'
        if not problem and self._feed_state is not FeedState.GROUND:
            problem = 'it is in the air, or not heard'
        if not problem:
            self._up, self._landed_for, self._rising_since = False, '', None
            self._permission.give(time.monotonic())
        return problem

    def disconnect_robot(self) -> None:
        """Leave the drone to its program."""
        if self._sender is not None:
            self._sender.close()
            self._sender = None

    def destroy_node(self) -> None:
        """Leave the drone to its program, and the graph."""
        super().destroy_node()
        self.disconnect_robot()

    def start(self) -> None:
        """Begin to work: it may take off now."""
        super().start()
        self._up, self._landed_for = False, ''
        self._rising_since = self._lost_since = None

    def stop_robot(self) -> None:
        """Land, as the driver ends."""
        self._permission.end()
        self._give_up('the driver stops')
        for _ in range(_FAREWELLS):
            self._send()
            time.sleep(_FAREWELL_PERIOD)

    def hold_robot(self) -> None:
        """Have the drone hover."""
        if self._order is OrderKind.GO:
            self._order = OrderKind.HOLD

    def watch_robot(self) -> None:
        """Land a drone that has not been heard for long."""
        risen = self._rising_since is not None
        silent = risen and self._silence.length > self.settings.odometry_timeout
        now = time.monotonic()
        self._lost_since = (self._lost_since or now) if silent else None
        if self._lost_since is not None and now - self._lost_since > self._mambo.land_after:
            self._give_up('nothing heard from the drone')

    def send_command(self, placed: StampedPose, command: list[float]) -> None:
        """Order it to where it goes or stays; its own program flies."""
        if self._up and not self._landed_for:
            target = self._follower.target
            self._goal = placed.pose.position if target is None else target
            self._order = OrderKind.HOLD if self.trouble else OrderKind.GO

    def _send(self) -> None:
        if self._sender is None:
            return
        order = self._order if self.active or self._landed_for else OrderKind.LAND
        there = compose(inverse(self._origin), Pose(self._goal))
        problem = self._sender.send(order, there.position)
        if problem:
            self.warn_throttled('orders', problem)

    # ---- the flight --------------------------------------------------------------------------

    def take_feed_pose(self, stamp: int, pose: FeedPose) -> None:
        """Take where the drone says that it was."""
        if not self.active or not self._is_new('feed', stamp):
            return
        if pose.battery >= 0.0:
            self.take_charge(pose.battery)
        place = compose(self._origin, Pose(pose.position, _orientation(pose)))
        problem = self._go_on(pose, place)
        if problem:
            if self.begin_trouble(_FLIGHT, problem):
                self.get_logger().warning(problem)
        elif self.end_trouble(_FLIGHT):
            self.get_logger().info('it goes where it is sent')
            self._follower.stay()
        noise = self._mambo
        variances = [noise.position_noise**2] * 3 + [noise.attitude_noise**2] * 3
        placed = self._pose_speed.place(stamp, place)
        self.take_pose(replace(placed, covariance=np.diag(variances)))

    def _go_on(self, pose: FeedPose, place: Pose) -> str:
        """Do what the flight asks for; return why it takes no goals, or nothing."""
        mambo, now = self._mambo, time.monotonic()
        self._feed_state = pose.state
        if self._landed_for:
            landed = pose.state == FeedState.GROUND
            if landed:
                return f'landed: {self._landed_for}, {UNTIL_ARM}'
            return f'landing: {self._landed_for}'
        if not mambo.arm:
            return 'on the ground: it may not take off (parameter mambo.arm)'
        if 0.0 <= pose.battery < mambo.battery_minimum:
            return self._give_up(
                f'battery at {pose.battery:.2f}, below {mambo.battery_minimum:.2f}'
            )
        too_far = geofence.outside(self._fence, place.position)
        if too_far:
            return self._give_up(too_far)
        if self._up:
            down = pose.state != FeedState.AIR
            return (
                self._give_up(f'the drone is {pose.state.name.lower()} by itself') if down else ''
            )
        if self._rising_since is None:
            if not self._permission.holds(now):
                return f'on the ground, {UNTIL_ARM}'
            self._permission.end()
            self._rising_since = now
        self._goal, self._order = self._start.position, OrderKind.GO
        height = self._start.position[2] - place.position[2]
        self._up = pose.state == FeedState.AIR and abs(height) <= _ALTITUDE_TOLERANCE
        if not self._up and now - self._rising_since > mambo.take_off_timeout:
            return self._give_up(f'it did not come to its altitude in {mambo.take_off_timeout:g} s')
        return '' if self._up else 'taking off'

    def _give_up(self, reason: str) -> str:
        self._landed_for = self._landed_for or reason
        self._order = OrderKind.LAND
        return self._landed_for

    def _problem(self, request: GoToWaypoint.Goal) -> str | None:
        point = request.waypoint.pose.position
        return super()._problem(request) or geofence.goal_problem(
            self._fence, (point.x, point.y, point.z)
        )

    def status(self) -> dict[str, Any]:
        """Return what the drone is ordered to."""
        return super().status() | {
            'order': self._order.name.lower(),
            'landed for': self._landed_for,
        }


def _orientation(pose: FeedPose) -> np.ndarray:
    """Return w, x, y, z of yaw, then pitch, then roll."""
    turned = np.array([1.0, 0.0, 0.0, 0.0])
    for axis, angle in ((3, pose.yaw), (2, pose.pitch), (1, pose.roll)):
        turn = np.zeros(4)
        turn[0], turn[axis] = np.cos(0.5 * angle), np.sin(0.5 * angle)
        turned = quaternion_product(turned, turn)
    return turned


def main(arguments: list[str] | None = None) -> int:
    """Run the driver."""
    return run(MamboOnboardDriver, arguments)


if __name__ == '__main__':
    raise SystemExit(main())
