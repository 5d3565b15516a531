"""A Mambo with its own program: poses from the feed, orders by UDP (paper 001)."""

import socket
import struct
import time
import zlib
from collections.abc import Sequence
from dataclasses import replace
from enum import IntEnum
from typing import Any

import numpy as np

from maasi_drivers.agent.flight_rules import UNTIL_ARM, ArmPermission, flight_volume
from maasi_drivers.agent.odometry import PoseSpeed, StampedPose
from maasi_drivers.agent.robot_node import FeedPeer, RobotNode
from maasi_drivers.links.mambo.pilot import ALTITUDE_TOLERANCE, NOT_ALLOWED
from maasi_drivers.links.robot_link import RobotLink
from maasi_drivers.settings.vehicles import MamboSettings
from maasi_drivers.vision.measurement_feed import FeedPose, FeedState
from maasi_filter.arrays import FloatArray
from maasi_filter.models.pose import Pose, compose, inverse
from maasi_filter.ros.lifecycle_node import SettingsError

_ORDER = struct.Struct('<4sBBHI4f')  # magic and version, kind, padding, sequence, position and yaw


class OrderKind(IntEnum):
    """Order for the robot: be on the ground, hover, or fly to the position."""

    LAND = 0
    HOLD = 1
    GO = 2


def encode(sequence: int, kind: OrderKind, position: FloatArray) -> bytes:
    """Return an order as a datagram; position (3,) [m] forward, left, up from the take-off."""
    if not np.isfinite(position).all():
        raise ValueError(f'order: got {position}, allowed are finite numbers [m]')
    data = _ORDER.pack(b'MSWO', 1, kind, 0, sequence % 2**32, *position, 0.0)
    return data + struct.pack('<I', zlib.crc32(data))


_PERIOD = 0.1  # period of orders [s]; without them the program on board hovers, then lands
_LAST_ORDERS, _LAST_PERIOD = 5, 0.05  # at the end: number of landing orders, and their period [s]


class OnboardLink(RobotLink):
    """A drone with its own program; see docs/measurement_feed.md.

    The feed carries blobs and pose; orders are sent ten times per second: be on the ground,
    hover, or fly to a waypoint.

    Services
    --------
    `arm` (std_srvs/Trigger): permits one take-off, if `mambo.arm` is true
    """

    def __init__(self, driver: RobotNode) -> None:
        super().__init__(driver)
        self._mambo = driver.settings.mambo or MamboSettings()
        self._socket: socket.socket | None = None
        self._sequence = 0
        self._speed = PoseSpeed()
        self._order = OrderKind.LAND
        self._target = driver.start_pose.position
        self._feed_state: FeedState | None = None
        self._permission = ArmPermission(self._mambo.arm_timeout)
        self.activate()

    def prepare(self) -> None:
        """Check the settings, and make the geofence."""
        driver, mambo, settings = self.driver, self._mambo, self.driver.settings
        if settings.image_source != 'feed':
            raise SettingsError(
                f'parameter image_source: read {settings.image_source!r}, allowed with link '
                'mambo_feed is feed'
            )
        driver.feed_peer = FeedPeer(mambo.address, self._handle_feed_pose)
        driver.volume = flight_volume(driver.volume.area, settings, mambo)
        # Positions of the feed are relative to this.
        self._origin = Pose.from_yaw([*settings.start[:2], mambo.ground], settings.yaw)

    def connect(self) -> None:
        """Send orders from now on: to be on the ground until it is active and may fly."""
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.driver.create_wall_timer(_PERIOD, self._send_order)
        self.driver.expect(lambda: self._up)
        self.driver.offer_arm(self._arm)

    def close(self) -> None:
        """Stop sending; its own program takes over."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def activate(self) -> None:
        """Begin a flight without altitude and landing reason."""
        self._up, self._landed_for = False, ''
        self._rising_since: float | None = None
        self._lost_since: float | None = None

    def _arm(self) -> str:
        problem = '' if self._mambo.arm else NOT_ALLOWED
        if not problem and self._feed_state is not FeedState.GROUND:
            problem = 'it is in the air or not connected'
        if not problem:
            self.activate()
        return self._permission.ask(time.monotonic(), problem)

    def send(self, placed: StampedPose, command: Sequence[float]) -> None:
        """Order a flight to its target; its own program flies."""
        if self._up and not self._landed_for:
            target = self.driver.follower.target
            self._target = placed.pose.position if target is None else target
            self._order = OrderKind.HOLD if self.driver.health.text else OrderKind.GO

    def hold(self) -> None:
        """Let the drone hover."""
        if self._order is OrderKind.GO:
            self._order = OrderKind.HOLD
            self._send_order()

    def stop(self) -> None:
        """Land: the order is repeated, as datagrams may be lost."""
        self._permission.end()
        self._land('the driver stops')
        for _ in range(_LAST_ORDERS):
            self._send_order()
            time.sleep(_LAST_PERIOD)

    def latch_stop(self) -> None:
        """End the permission to take off, and a take-off."""
        self._permission.end()
        if self._rising_since is not None and not self._up:
            self._land('take-off stopped')

    def poll(self) -> None:
        """Land a drone whose feed is silent for long; on the ground it needs a new arm."""
        driver, now = self.driver, time.monotonic()
        if driver.silence.length <= driver.settings.odometry_timeout:
            self._lost_since = None
            return
        self._permission.end()
        self._feed_state = None
        if self._rising_since is not None:
            self._lost_since = self._lost_since or now
            if now - self._lost_since > self._mambo.land_after:
                self._land('no data from the drone')

    def status(self) -> dict[str, Any]:
        """Return the current order."""
        return {'order': self._order.name.lower(), 'landed for': self._landed_for}

    def _send_order(self) -> None:
        if self._socket is None:
            return
        kind = self._order if self.driver.active or self._landed_for else OrderKind.LAND
        position = compose(inverse(self._origin), Pose(self._target)).position
        self._sequence += 1
        address = self._mambo.address
        try:
            data = encode(self._sequence, kind, position)
            self._socket.sendto(data, (address, self._mambo.order_port))
        except OSError as error:
            text = f'orders to {address}: {error.strerror or error}'
            self.driver.warn_throttled('orders', text)

    def _handle_feed_pose(self, stamp: int, pose: FeedPose) -> None:
        driver = self.driver
        if not driver.active or not driver.is_new_pose('feed', stamp):
            return
        if pose.battery >= 0.0:
            driver.take_charge(pose.battery)
        in_map = compose(
            self._origin, Pose.from_rpy(pose.position, (pose.roll, pose.pitch, pose.yaw))
        )
        driver.judge('flight', self._next_order(pose, in_map), 'flying: accepting goals')
        placed = self._speed.with_velocity(stamp, in_map)
        driver.take_pose(replace(placed, covariance=self._mambo.pose_covariance()))

    def _next_order(self, pose: FeedPose, in_map: Pose) -> str:
        mambo, now = self._mambo, time.monotonic()
        self._feed_state = pose.state
        if self._landed_for:
            landed = pose.state == FeedState.GROUND
            text, rest = ('landed', f', {UNTIL_ARM}') if landed else ('landing', '')
            return f'{text}: {self._landed_for}{rest}'
        if not mambo.arm:
            return NOT_ALLOWED
        if 0.0 <= pose.battery < mambo.battery_minimum:
            least = 100.0 * mambo.battery_minimum
            return self._land(f'battery at {100.0 * pose.battery:.0f} %, below {least:.0f} %')
        if too_far := self.driver.volume.drift_problem(in_map.position):
            return self._land(too_far)
        if self._up:
            down = pose.state != FeedState.AIR
            return self._land(f'the drone is {pose.state.name.lower()} by itself') if down else ''
        if self._rising_since is None:
            if not self._permission.holds(now):
                return f'on the ground, {UNTIL_ARM}'
            self._permission.end()
            self._rising_since = now
        start = self.driver.start_pose.position
        self._target, self._order = start, OrderKind.GO
        height = start[2] - in_map.position[2]
        self._up = pose.state == FeedState.AIR and abs(height) <= ALTITUDE_TOLERANCE
        if not self._up and now - self._rising_since > mambo.take_off_timeout:
            return self._land(f'altitude not reached within {mambo.take_off_timeout:g} s')
        return '' if self._up else 'taking off'

    def _land(self, reason: str) -> str:
        self._landed_for = self._landed_for or reason
        self._order = OrderKind.LAND
        return self._landed_for
