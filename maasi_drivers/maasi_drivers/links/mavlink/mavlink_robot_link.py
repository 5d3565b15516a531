"""A MAVLink vehicle as a driver's robot."""

import math
import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from maasi_drivers.agent.flight_rules import HomeLanding, flight_volume, free_length
from maasi_drivers.agent.odometry import PoseHistory, StampedPose
from maasi_drivers.agent.robot_node import BATTERY, ODOMETRY, RobotNode
from maasi_drivers.agent.waypoint_follower import Goal, GoalStatus
from maasi_drivers.links.mavlink.estimate import Telemetry
from maasi_drivers.links.mavlink.fence import fence_items
from maasi_drivers.links.mavlink.link import VehicleLink
from maasi_drivers.links.mavlink.protocol import ERROR, INFO, WARNING
from maasi_drivers.links.robot_link import RobotLink
from maasi_drivers.settings.vehicles import MavlinkSettings
from maasi_filter.arrays import FloatArray
from maasi_filter.geometry.area import Area
from maasi_filter.geometry.operating_volume import MARGIN
from maasi_filter.models.pose import Pose, compose, inverse
from maasi_filter.wording import number, point
from maasi_planner.terrain_frame import least_height

POLL_PERIOD = 0.02
_VEHICLE, _GEOFENCE, _SETPOINT = 'vehicle', 'geofence', 'set-point'  # kinds of faults
_STOP_TIME = 1.0  # at the end: longest wait until the autopilot confirms holding or landing [s]
# Largest time between a localiser's pose and the autopilot's [ns].
_LONGEST_LAG = 300_000_000
_TURNING = 0.3  # closer than this to its target, the vehicle keeps its heading [m]
_STILL = 0.5  # without a goal it stops first and holds its position below this speed [m/s]


class MavlinkRobotLink(RobotLink):
    """A vehicle with an autopilot that flies to set-points.

    Services
    --------
    `arm` (std_srvs/Trigger): permits one take-off, or takes control in the air
    """

    def __init__(self, driver: RobotNode) -> None:
        super().__init__(driver)
        settings = driver.settings
        # Whether poses of a localiser define the autopilot's frame in the map.
        self._localised = settings.poses != 'odometry'
        self._mavlink = settings.mavlink or MavlinkSettings()
        if self._localised:
            self._mavlink = self._mavlink.model_copy(update={'origin': 'local'})
        else:
            driver.pose_name = 'LOCAL_POSITION_NED'
        self._local_poses = PoseHistory()
        self._charge_reports = 0
        # Separate from the driver's: telemetry and images have different delays.
        origin = driver.volume.area.above_ground([*settings.start[:2], self._mavlink.ground])
        self._map_from_local = Pose.from_yaw(origin, -self._mavlink.map_yaw)
        self._local_origin = np.zeros(3)
        self._telemetry: Telemetry | None = None
        self._heading: float | None = None
        self._ending = False
        self._fenced: Area | None = None  # the area that the autopilot has
        # Whether a set-point was rejected since the last goal.
        self._rejected = False
        self._landing = HomeLanding(driver.settings, self._mavlink.home_timeout)
        driver.volume = flight_volume(driver.volume.area, settings, self._mavlink)

    def prepare(self) -> None:
        """Create the link, which remembers the origin of a flight."""
        folder = Path(os.environ.get('ROS_HOME') or '~/.ros').expanduser()
        name = f'{self.driver.namespace.replace("/", "_")}_flight_origin.json'
        memory = folder / 'maasi' / name
        settings = self.driver.settings
        self._link = VehicleLink(self._mavlink, settings.start, memory)
        vehicle, motion = self._link.vehicle, settings.motion
        vehicle.speed, vehicle.braking = motion.speed, motion.acceleration

    def connect(self) -> None:
        """Open the connection; the vehicle is armed only while the driver is active."""
        driver, vehicle = self.driver, self._link.vehicle
        self._link.open()
        driver.create_wall_timer(POLL_PERIOD, self._update)
        driver.offer_arm(self._arm, lambda: vehicle.in_air)
        driver.expect(lambda: vehicle.flying)

    def close(self) -> None:
        """Close the connection."""
        self._link.close()

    def _arm(self) -> str:
        driver, link = self.driver, self._link
        if self._localised and (driver.history.latest is None or ODOMETRY in driver.health):
            return f'no {driver.pose_name}'
        with link.lock:
            problem = link.vehicle.permit(time.monotonic())
        self._ending &= bool(problem)
        return problem

    def send(self, placed: StampedPose, command: Sequence[float]) -> None:
        """Send the position that the command leads to, or its target if that is closer.

        From inside a zone it flies straight to the exit, as the autopilot rejects set-
        points inside.
        """
        follower, position, yaw = self.driver.follower, placed.pose.position, placed.pose.yaw
        moving = follower.status == GoalStatus.MOVING
        if self._rejected and not moving:
            return  # it stays at the autopilot's position
        offset = follower.exit_from(position)
        if offset is not None:
            offset = offset - position if moving else None
        elif moving:
            offset = self._ahead(placed, command)
        elif self._rests(placed):
            offset = np.zeros(3) if follower.target is None else follower.target - position
        if offset is None:
            self._brake()
            return
        if self._heading is None:
            self._heading = yaw
        travels = self.driver.settings.motion.heading == 'travel'
        if travels and math.hypot(offset[0], offset[1]) > _TURNING:
            self._heading = math.atan2(offset[1], offset[0])
        self._send_target(position + offset, self._heading)

    def _rests(self, placed: StampedPose) -> bool:
        """Return whether a vehicle without a goal has stopped or is at its last goal."""
        follower = self.driver.follower
        if follower.status != GoalStatus.REACHED and float(np.hypot(*placed.velocity[:2])) > _STILL:
            follower.stay()
            return False
        return True

    def _ahead(self, placed: StampedPose, command: Sequence[float]) -> FloatArray:
        """Return the offset (3,) of a set-point for flying as commanded, in free space."""
        position, yaw = placed.pose.position, placed.pose.yaw
        cosine, sine = math.cos(yaw), math.sin(yaw)
        along, aside, up = command[:3]
        velocity = np.array([cosine * along - sine * aside, sine * along + cosine * aside, up])
        target, speed = self.driver.follower.target, float(np.linalg.norm(velocity))
        to_target = np.zeros(3) if target is None else target - position
        if speed == 0.0:
            return velocity
        with self._link.lock:
            lead = self._link.vehicle.lead(speed)
        least = self._mavlink.lead * speed
        away = float(np.linalg.norm(to_target))
        straight = self._clears_ground(position, to_target)
        if away <= min(lead, least) and straight:
            return to_target
        # Without another command the vehicle continues to this point.
        motion = self.driver.follower.motion
        free = free_length(motion, position, velocity / speed, min(lead, away))
        lead = max(free, min(least, lead))
        if away <= lead and straight:
            return to_target
        offset = velocity * (lead / speed)
        # The ground curves towards a straight path.
        while lead > least and not self._clears_ground(position, offset):
            lead, offset = 0.5 * lead, 0.5 * offset
        return offset

    def _clears_ground(self, position: FloatArray, offset: FloatArray) -> bool:
        """Return whether a straight path keeps its distance from terrain."""
        terrain = self.driver.volume.area.terrain
        if terrain is None:
            return True
        return terrain.clearance(position, position + offset) >= least_height(self.driver.settings)

    def hold(self) -> None:
        """Stop the vehicle now; with the next pose it holds its position."""
        self._brake()

    def _brake(self) -> None:
        self._heading = None
        with self._link.lock:
            self._link.vehicle.brake()

    def on_new_goal(self, goal: Goal) -> None:
        """Resume position set-points."""
        self._rejected = False
        self._landing.on_new_goal()

    def stop(self) -> None:
        """Let the vehicle hold its position or land, and wait for confirmation."""
        self._ending = True
        if not self._link.finish(self._mavlink.at_end, _STOP_TIME):
            self.driver.get_logger().error(
                f'at_end: {self._mavlink.at_end}: not confirmed by the autopilot; relying on its '
                'failsafe'
            )
        self._log_reports()

    def reset(self) -> None:
        """Discard the autopilot's poses from another time."""
        self._local_poses.clear()

    def latch_stop(self) -> None:
        """End the permission to take off, and abort a take-off."""
        with self._link.lock:
            self._link.vehicle.stop()

    def poll(self) -> None:
        """Report why the vehicle does not start."""
        self.driver.publish_fault()

    def expects_pose(self) -> bool:
        """Return whether no fault of the vehicle explains a missing pose."""
        return _VEHICLE not in self.driver.health

    def status(self) -> dict[str, Any]:
        """Return the state of the vehicle."""
        with self._link.lock:
            vehicle = self._link.vehicle
            read = {} if vehicle.failsafes is None else vehicle.failsafes.values
            return {
                'vehicle': vehicle.phase.name,
                'in the air': vehicle.in_air,
                **{f'parameter {key}': item for key, item in read.items()},
                **{f'ignored: {key}': number for key, number in vehicle.estimate.dropped.items()},
            }

    def _send_target(self, position: FloatArray, yaw: float) -> None:
        inside = self.driver.volume.nearest_inside(position)
        goal = compose(inverse(self._map_from_local), Pose.from_yaw(inside, yaw))
        with self._link.lock:
            self._link.vehicle.set_target(goal.position + self._local_origin, goal.yaw)

    def _update(self) -> None:
        driver, link = self.driver, self._link
        with link.lock:
            vehicle, estimate = link.vehicle, link.vehicle.estimate
            vehicle.active = driver.active and not self._ending
            fault = f'link: {link.failure}' if link.failure else vehicle.fault
            charge, reports = estimate.charge, estimate.charge_reports
            telemetry, self._local_origin = estimate.telemetry, estimate.origin
            rejected, in_air = vehicle.rejected, vehicle.in_air
        if self._fenced is not driver.volume.area:
            self._upload_fence()
        self._log_reports()
        if not driver.active:
            return
        before = driver.health.get(_VEHICLE)
        driver.judge(_VEHICLE, fault, 'the vehicle accepts set-points')
        if fault:
            self._heading = None
            # The first text is logged with the fault.
            if before and fault != before:
                driver.get_logger().info(fault)
        self._check_setpoint(rejected)
        if reports != self._charge_reports:
            self._charge_reports = reports
            driver.take_charge(charge)
        if BATTERY in driver.health:
            # Repeatedly, as a pilot may return the vehicle.
            self._ending = True
            link.finish(self._mavlink.on_low_battery, 0.0)
        elif in_air and (reason := self._at_home(charge)):
            with link.lock:
                vehicle.finish('land', reason)
        if telemetry is not None and telemetry is not self._telemetry:
            self._telemetry = telemetry
            self._handle_telemetry(telemetry)

    def _check_setpoint(self, rejected: FloatArray | None) -> None:
        health = self.driver.health
        if rejected is None:
            health.end(_SETPOINT, 'the autopilot accepts set-points again')
        elif _SETPOINT not in health:
            self._rejected = True
            there = compose(self._map_from_local, Pose(rejected - self._local_origin)).position
            health.begin(
                _SETPOINT,
                f'the autopilot rejected the set-point {point(there)} m, for example because it '
                'is outside of its own fence',
            )

    def _at_home(self, charge: float) -> str:
        """Return why a vehicle that hovers at a charger lands, or nothing."""
        latest, follower = self.driver.history.latest, self.driver.follower
        if latest is None or follower.current is not None:
            return ''
        return self._landing.check(latest.pose.position, charge, time.monotonic())

    def _upload_fence(self) -> None:
        volume, mavlink = self.driver.volume, self._mavlink
        self._fenced, turned = volume.area, mavlink.map_yaw != 0.0 and not self._localised
        if mavlink.fence == 'none' or volume.area.settings.origin is None or turned:
            needs = 'mavlink.fence: upload, environment.origin, mavlink.map_yaw: 0'
            self.driver.get_logger().info(f'fence: not uploaded, which needs {needs}')
            return
        with self._link.lock:
            self._link.vehicle.fence.begin(fence_items(volume, self.driver.settings.start))

    def _log_reports(self) -> None:
        with self._link.lock:
            reports = self._link.vehicle.log.pop_all()
        logger = self.driver.get_logger()
        # The logger ties severities to calling lines.
        for severity, text in reports:
            if severity <= ERROR:
                logger.error(text)
            elif severity <= WARNING:
                logger.warning(text)
            elif severity <= INFO:
                logger.info(text)
            else:
                logger.debug(text)

    def _handle_telemetry(self, telemetry: Telemetry) -> None:
        driver = self.driver
        stamp = driver.arrivals.stamp(telemetry.arrival - self._mavlink.latency)
        if stamp is None:
            # Before the begin of a simulated time nothing is late.
            driver.silence.end()
            return
        if not self._localised:
            driver.restart_if_back('the clock', stamp)
        latest = (self._local_poses if self._localised else driver.history).latest
        if latest is not None and stamp <= latest.stamp:
            return
        pose = Pose(telemetry.position - self._local_origin, telemetry.orientation)
        if not self._localised:
            pose = compose(self._map_from_local, pose)
        velocity = self._map_from_local.rotation() @ telemetry.velocity
        placed = StampedPose(stamp, pose, np.zeros((6, 6)), velocity, telemetry.rates)
        if self._localised:
            self._local_poses.add(placed)
        else:
            driver.take_pose(placed)

    def observe(self, placed: StampedPose) -> None:
        """Align the autopilot's frame with a localiser's pose, and check the geofence."""
        if self._localised:
            self._align(placed)
        position, health = placed.pose.position, self.driver.health
        outside = self.driver.volume.distance_outside(position)
        if outside > MARGIN and _VEHICLE not in health:
            text = f'{number(outside)} m outside the geofence, at {point(position)} m: returning'
            health.begin(_GEOFENCE, text)
        elif not outside and health.end(_GEOFENCE, 'inside the geofence again'):
            self.driver.follower.stay()

    def _align(self, placed: StampedPose) -> None:
        local = self._local_poses.at(placed.stamp) or self._local_poses.latest
        if local is None or abs(local.stamp - placed.stamp) > _LONGEST_LAG:
            return
        turn = Pose.from_yaw(np.zeros(3), placed.pose.yaw - local.pose.yaw)
        position = placed.pose.position - turn.rotation() @ local.pose.position
        self._map_from_local = Pose(position, turn.orientation)
