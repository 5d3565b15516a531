"""The driver of a vehicle that speaks MAVLink: ArduCopter, ArduSub or PX4."""

from __future__ import annotations

import math
import time
from typing import Any

import numpy as np

from maasi_drivers.agent.agent_driver import BATTERY, ODOMETRY, AgentDriver, DataT, FloatArray
from maasi_drivers.agent.arm_permission import offer_arm
from maasi_drivers.agent.arrival_clock import ArrivalClock
from maasi_drivers.agent.odometry import PoseHistory, StampedPose
from maasi_drivers.links.mavlink.link import VehicleLink
from maasi_drivers.links.mavlink.settings import MavlinkSettings
from maasi_drivers.links.mavlink.vehicle import Telemetry
from maasi_drivers.ranging_driver import RangingDriver
from maasi_filter.models.pose import Pose, compose
from maasi_filter.ros.conversions import stamp_to_ros
from maasi_filter.ros.lifecycle_node import run
from maasi_msgs.action import GoToWaypoint

_POLL_PERIOD = 0.02
# Kinds of trouble.
_VEHICLE, _GEOFENCE = 'vehicle', 'geofence'
# Outside the geofence, the vehicle cannot go on from this on [m].
_FENCE_MARGIN = 0.5
# Between the heights at the start and the geofence, where none is given [m].
_FENCE_HEIGHT = 1.0
# At the end: how long it waits for the autopilot to say that it holds or lands [s].
_FAREWELL = 1.0
# Between a localiser's pose and what the autopilot said, at most [ns].
_LONGEST_LAG = 300_000_000
# Closer than this to where it goes, it keeps its heading [m].
_TURNING = 0.3
# Of MAVLink's MAV_SEVERITY: up to here errors, warnings, and what is worth a line.
_ERROR, _WARNING, _INFO = 3, 4, 6


class MavlinkRobot(AgentDriver[DataT]):
    """
    A vehicle with an autopilot.

    Services
    --------
    `arm` (std_srvs/Trigger), with `link: mavlink`: it takes off once, or is taken over in the air

    With `link: mavlink` it is reached by MAVLink; `odom`, `battery_state` and `cmd_vel` are
    not used then. With `link: topics` it is a robot like any other.
    """

    links = ('topics', 'mavlink')

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self._vehicle_link: VehicleLink | None = None

    def prepare(self) -> None:
        """Make controller, sensor and geofence."""
        super().prepare()
        settings = self.settings
        self._mavlink = settings.mavlink or MavlinkSettings()
        # Poses of a localiser say where the autopilot's frame is in the map.
        self._localised = settings.link == 'mavlink' and settings.poses != 'odometry'
        if settings.link == 'mavlink' and not self._localised:
            self._posed = 'LOCAL_POSITION_NED'
        self._locals = PoseHistory()
        self._charge_reports = 0
        self._arrivals = ArrivalClock()
        self._map_from_local = Pose.from_yaw(
            [*settings.start[:2], self._mavlink.ground], -self._mavlink.map_yaw
        )
        self._local_origin = np.zeros(3)
        self._taken = -1
        self._heading: float | None = None
        self._ending = False
        self._fence = self._make_fence()

    def _make_fence(self) -> FloatArray:
        """Return the lowest and highest x, y, z (3, 2) that the vehicle is sent to [m, map]."""
        given = self._mavlink.geofence
        if given is not None:
            return np.array(given)
        radius = self.settings.radius
        heights = (self._mavlink.ground, self.settings.start[2])
        fence = np.array(
            [[0.0, 0.0], [0.0, 0.0], [min(heights) - _FENCE_HEIGHT, max(heights) + _FENCE_HEIGHT]]
        )
        fence[: self.dimension] = self._bounds + np.array([-radius, radius])
        if self.settings.start[2] > self._mavlink.ground:
            # What flies is not sent into the ground.
            fence[2, 0] = max(fence[2, 0], self._mavlink.ground)
        return fence

    # ---- the link ----------------------------------------------------------------------------

    def connect_robot(self) -> None:
        """Open the wire; the vehicle is armed only once the driver is active."""
        if self.settings.link == 'topics':
            super().connect_robot()
            return
        link = VehicleLink(self._mavlink, self.settings.start[2] - self._mavlink.ground)
        self._vehicle_link = link
        self._taken, self._heading, self._ending = -1, None, False
        self.create_wall_timer(_POLL_PERIOD, self._poll)
        offer_arm(self, self._arm)

        def flying() -> bool:
            with link.vehicle() as vehicle:
                return vehicle.flying

        self.expect(flying)

    def _arm(self) -> str:
        """Let the vehicle take off; return why not, empty where it may."""
        link, problem = self._vehicle_link, self.arm_problem()
        if link is None or problem:
            return problem or 'the driver is not active'
        if self._localised and (self._history.latest is None or ODOMETRY in self._troubles):
            return f'no {self._posed}'
        with link.vehicle() as vehicle:
            problem = vehicle.permit(time.monotonic())
        if not problem:
            self._ending = False
        return problem

    def stop_by_service(self) -> None:
        """Have it hold its position; on the ground it is not armed any more."""
        super().stop_by_service()
        if self._vehicle_link is not None:
            with self._vehicle_link.vehicle() as vehicle:
                vehicle.forbid()

    def disconnect_robot(self) -> None:
        """Close the wire."""
        super().disconnect_robot()
        if self._vehicle_link is not None:
            self._vehicle_link.close()
            self._vehicle_link = None

    def destroy_node(self) -> None:
        """Close the wire, and leave."""
        super().destroy_node()
        if self._vehicle_link is not None:
            self._vehicle_link.close()
            self._vehicle_link = None

    def stop_robot(self) -> None:
        """Have the vehicle hold its position or land, as the driver ends."""
        super().stop_robot()
        if self._vehicle_link is None:
            return
        self._ending = True
        if not self._vehicle_link.finish(self._mavlink.at_end, _FAREWELL):
            self.get_logger().error(
                f'at_end: {self._mavlink.at_end}: the autopilot has not said that it does; its own '
                'failsafe is what is left'
            )
        self._report()

    def hold_robot(self) -> None:
        """Have the vehicle stay where it is."""
        if self._vehicle_link is None:
            super().hold_robot()
            return
        latest = self._history.latest
        # Without a pose the last setpoint stays: it is a short way ahead.
        if latest is not None and ODOMETRY not in self._troubles:
            self._send_target(latest.pose.position, latest.pose.yaw)

    def awaits_pose(self) -> bool:
        """Return whether nothing else says why there is none."""
        return _VEHICLE not in self._troubles

    def watch_robot(self) -> None:
        """Look after the link."""
        super().watch_robot()
        if self._vehicle_link is not None and self.trouble and self._history.latest is None:
            # The planner is to hear why it does not start.
            self._state.header.stamp = stamp_to_ros(self.get_clock().now().nanoseconds)
            self._fill_status()
            self._state_publisher.publish(self._state)

    def status(self) -> dict[str, Any]:
        """Return what the vehicle does."""
        status = super().status()
        if self._vehicle_link is not None:
            with self._vehicle_link.vehicle() as vehicle:
                status['vehicle'] = vehicle.phase.name
                status |= {f'parameter {key}': item for key, item in vehicle.parameters.items()}
                status |= {f'ignored: {key}': number for key, number in vehicle.dropped.items()}
        return status

    # ---- what comes in -----------------------------------------------------------------------

    def _poll(self) -> None:
        link = self._vehicle_link
        if link is None:
            return
        with link.vehicle() as vehicle:
            vehicle.active = self.active and not self._ending
            trouble, charge = vehicle.trouble, vehicle.charge
            reports = vehicle.charge_reports
            telemetry, self._local_origin = vehicle.telemetry, vehicle.origin
        if link.failure:
            trouble = f'link: {link.failure}'
        self._report()
        self._arrivals.observe(time.monotonic(), self.get_clock().now().nanoseconds)
        if not self.active:
            return
        self._judge(trouble)
        if reports != self._charge_reports:
            self._charge_reports = reports
            self.take_charge(charge)
            if BATTERY in self._troubles and not self._ending:
                self._ending = True
                link.finish(self._mavlink.on_low_battery, 0.0)
        if telemetry is not None and telemetry.number != self._taken:
            self._taken = telemetry.number
            self._take_telemetry(telemetry)

    def _report(self) -> None:
        """Log what the vehicle says."""
        if self._vehicle_link is None:
            return
        with self._vehicle_link.vehicle() as vehicle:
            reports = vehicle.reports()
        logger = self.get_logger()
        for severity, text in reports:
            if severity <= _ERROR:
                logger.error(text)
            elif severity <= _WARNING:
                logger.warning(text)
            elif severity <= _INFO:
                logger.info(text)
            else:
                logger.debug(text)

    def _judge(self, trouble: str) -> None:
        """Note whether the vehicle can go on."""
        if trouble:
            told = self._troubles.get(_VEHICLE)
            self.begin_trouble(_VEHICLE, trouble)
            if told is None:
                self.get_logger().warning(trouble)
            elif trouble != told:
                self.get_logger().info(trouble)
            self._heading = None
        elif self.end_trouble(_VEHICLE):
            self.get_logger().info('the vehicle flies where it is sent')
            # Where it is to stay was of before.
            self._follower.stay()

    def _take_telemetry(self, telemetry: Telemetry) -> None:
        stamp = self._arrivals.stamp(telemetry.arrival - self._mavlink.latency)
        if stamp is None:
            # A simulated time has not begun: nothing is late.
            self._silence.end()
        latest = (self._locals if self._localised else self._history).latest
        if stamp is None or (latest is not None and stamp <= latest.stamp):
            return
        local = Pose(telemetry.position - self._local_origin, telemetry.orientation)
        placed = StampedPose(
            stamp,
            local if self._localised else compose(self._map_from_local, local),
            np.zeros((6, 6)),
            self._map_from_local.rotation() @ telemetry.velocity,
            telemetry.rates,
        )
        if self._localised:
            self._locals.add(placed)
        else:
            self.take_pose(placed)

    def take_pose(self, placed: StampedPose) -> None:
        """Take where it is."""
        if self._vehicle_link is not None:
            if self._localised:
                self._align(placed)
            self._watch_fence(placed.pose.position)
        super().take_pose(placed)

    def _align(self, placed: StampedPose) -> None:
        """Note where the autopilot's frame is, by what it said when a localiser saw it."""
        local = self._locals.at(placed.stamp) or self._locals.latest
        if local is None or abs(local.stamp - placed.stamp) > _LONGEST_LAG:
            return
        turn = Pose.from_yaw(np.zeros(3), placed.pose.yaw - local.pose.yaw)
        position = placed.pose.position - turn.rotation() @ local.pose.position
        self._map_from_local = Pose(position, turn.orientation)

    def _watch_fence(self, position: FloatArray) -> None:
        outside = float(np.abs(position - self._inside(position)).max())
        if outside <= _FENCE_MARGIN:
            if not outside and self.end_trouble(_GEOFENCE):
                self.get_logger().info('it is inside the geofence again')
                self._follower.stay()
            return
        if _VEHICLE not in self._troubles:
            text = f'{outside:.1f} m outside the geofence, at {np.round(position, 2).tolist()} m'
            if self.begin_trouble(_GEOFENCE, text):
                self.get_logger().error(f'{text}: it comes back inside')

    def _inside(self, position: FloatArray) -> FloatArray:
        return np.clip(position, self._fence[:, 0], self._fence[:, 1])

    # ---- what goes out -----------------------------------------------------------------------

    def _problem(self, request: GoToWaypoint.Goal) -> str | None:
        problem = super()._problem(request)
        if problem is not None or self._vehicle_link is None:
            return problem
        point = request.waypoint.pose.position
        for axis, value in enumerate((point.x, point.y, point.z)):
            low, high = self._fence[axis].tolist()
            if not low <= value <= high:
                return (
                    f'waypoint.pose.position.{"xyz"[axis]}: read {value}, allowed is {low:g} to '
                    f'{high:g} [m], the geofence'
                )
        return None

    def send_command(self, placed: StampedPose, command: list[float]) -> None:
        """Send the place that the command leads to, or where it ends if that is nearer."""
        if self._vehicle_link is None:
            super().send_command(placed, command)
            return
        position, yaw = placed.pose.position, placed.pose.yaw
        cosine, sine = math.cos(yaw), math.sin(yaw)
        along, aside, up = command[:3]
        ahead = self._mavlink.lead * np.array(
            [cosine * along - sine * aside, sine * along + cosine * aside, up]
        )
        target = self._follower.target
        way = np.zeros(3) if target is None else target - position
        if float(ahead @ ahead) < float(way @ way):
            way = ahead
        if self._heading is None:
            self._heading = yaw
        if self.settings.motion.heading == 'travel' and math.hypot(way[0], way[1]) > _TURNING:
            self._heading = math.atan2(way[1], way[0])
        self._send_target(position + way, self._heading)

    def _send_target(self, position: FloatArray, yaw: float) -> None:
        if self._vehicle_link is None:
            return
        goal = compose(self._map_from_local.inverse(), Pose.from_yaw(self._inside(position), yaw))
        with self._vehicle_link.vehicle() as vehicle:
            vehicle.set_target(goal.position + self._local_origin, goal.yaw)


class MavlinkDriver(MavlinkRobot[FloatArray], RangingDriver):
    """A vehicle with an autopilot and a ranging sensor; see `RangingDriver`."""


def main(arguments: list[str] | None = None) -> int:
    """Run the driver."""
    return run(MavlinkDriver, arguments)


if __name__ == '__main__':
    raise SystemExit(main())
