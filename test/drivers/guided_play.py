"""A driver's link over ArduCopter and a fake one, in simulated time and without ROS."""

import contextlib
import math
from types import SimpleNamespace

import numpy as np
from mavlink_play import Play

from maasi_drivers.agent.agent_driver import AgentDriver
from maasi_drivers.agent.odometry import PoseHistory
from maasi_drivers.agent.robot_node import Health, RobotNode
from maasi_drivers.agent.waypoint_follower import Goal, GoalStatus, WaypointFollower
from maasi_drivers.links.mavlink import mavlink_robot_link
from maasi_drivers.links.mavlink.link import make_sender
from maasi_drivers.links.mavlink.mavlink_robot_link import MavlinkRobotLink
from maasi_drivers.links.mavlink.vehicle import Vehicle
from maasi_drivers.settings.driver import DriverSettings
from maasi_filter.geometry.area import Area
from maasi_filter.geometry.environment import EnvironmentSettings
from maasi_filter.geometry.geodesy import OriginSettings, geodetic
from maasi_filter.geometry.operating_volume import OperatingVolume
from maasi_planner.motion import RobotState

ORIGIN = OriginSettings(latitude=46.6, longitude=9.9)
START = [0.0, 0.0, 30.0]
# The drone of docs/field_sitl.yaml, and an area wide enough to reach its speed.
MOTION = {'speed': 8.0, 'acceleration': 2.5, 'clearance': 2.0, 'tolerance': 1.0}
FIELD = {'area': 'POLYGON ((-200 -200, 200 -200, 200 200, -200 200, -200 -200))'}
COPTER = {'speed': 10.0, 'acceleration': 2.5}
FENCE = {'FENCE_ENABLE': 1, 'FENCE_TYPE': 4, 'FENCE_ACTION': 0}


class PlainDriver:
    """What a link and the parts of a driver that are tried here need of the node."""

    judge = RobotNode.judge
    take_pose, adopt_area = AgentDriver.take_pose, AgentDriver._adopt_area

    def __init__(self, settings, make_link):
        self.settings, self.active, self.pose_name = settings, True, 'odometry'
        self.volume = OperatingVolume(Area(settings.environment), settings.radius)
        self.namespace, self.history = 'rover', PoseHistory()
        self.logged = []
        log = SimpleNamespace(
            **dict.fromkeys(('error', 'warning', 'info', 'debug'), self.logged.append)
        )
        self.health = Health(log, self._on_fault)
        self.silence = SimpleNamespace(end=lambda: None)
        self._responder = SimpleNamespace(serve=lambda: None)
        self._watchdog = SimpleNamespace(
            watch_charge=lambda _: None, note_pose=lambda _: None, moving=False
        )
        self.get_logger = lambda: log
        self.take_charge = lambda charge: setattr(self, 'charge', charge)
        self.restart_if_back = lambda *_: False
        self.charge, self.ended = -1.0, []
        self.link = make_link(self)
        self._motion = self.link.make_motion()
        self.follower = WaypointFollower(self._motion)

    def _on_fault(self, text):
        self.end_goal(GoalStatus.ABORTED, text)
        self.follower.let_go()

    def end_goal(self, status, reason):
        goal = self.follower.end(status, reason)
        if goal is not None:
            self.ended.append(reason)

    def _control(self, placed):
        robot = RobotState(placed.pose, placed.velocity, placed.angular_velocity)
        command, _ = self.link.steer(robot, None)
        self.link.send(placed, command.tolist())


class GuidedPlay(Play):
    """A copter, its driver's link and what went over the wire; `go_to` is a goal of the planner.

    environment: of the field, or settings of another one, whose origin is that of the map.
    """

    def __init__(
        self, monkeypatch, environment=(), motion=(), parameters=(), start=START, **changes
    ):
        if isinstance(environment, EnvironmentSettings):
            area = environment
        else:
            area = FIELD | {'altitude': [0.0, 60.0], 'origin': ORIGIN} | dict(environment)
            if 'bounds' in area:
                area.pop('area')
                area.pop('altitude')
        self.start = start
        own = {'arm': True} | changes.pop('mavlink', {})
        self.driver_settings = DriverSettings.model_validate(
            {
                'environment': area,
                'start': start,
                'radius': 0.5,
                'motion': MOTION | dict(motion),
                'link': 'mavlink',
                'mavlink': own,
            }
            | changes
        )
        clock = SimpleNamespace(monotonic=lambda: self.now)
        monkeypatch.setattr(mavlink_robot_link, 'time', clock)
        autopilot = COPTER | {'parameters': FENCE | dict(parameters), 'endurance': 1e9}
        super().__init__('arducopter', autopilot, **own)
        self.body.climb = 2.5
        origin = self.driver_settings.environment.origin
        latitude, longitude, _ = geodetic(np.array([start]), origin)[0].tolist()
        self.autopilot.fence.home = OriginSettings(latitude=latitude, longitude=longitude)
        self.speeds = []

    def start_driver(self):
        sender = make_sender(self.settings.own_system)
        sender.file = self.to_autopilot
        self.vehicle = Vehicle(self.settings, self.start, sender, None)
        self.vehicle.active = self.driver_lives = True
        self.reports = []
        self.driver = PlainDriver(self.driver_settings, MavlinkRobotLink)
        self.link = link = self.driver.link
        link._link = SimpleNamespace(
            vehicle=self.vehicle,
            lock=contextlib.nullcontext(),
            failure='',
            finish=lambda ending, _: self.vehicle.finish(ending),
        )
        motion = self.driver_settings.motion
        self.vehicle.speed, self.vehicle.braking = motion.speed, motion.acceleration
        self.driver.arrivals = SimpleNamespace(stamp=lambda instant: round(1e9 * instant))

    def turn(self):
        super().turn()
        if self.driver_lives:
            self.link._update()
        self.speeds.append(self.speed)

    def go_to(self, *position):
        """Send a goal."""
        goal = Goal(1, 0, np.array(position, dtype=float))
        replaced = self.driver.follower.adopt(goal)
        assert replaced is None
        self.link.on_new_goal(goal)
        return self

    def arrives(self, limit=120.0):
        """Run until the goal is reached."""
        follower = self.driver.follower
        self.until(lambda: follower.current is None, limit)
        assert self.status is GoalStatus.REACHED, self.driver.ended
        return self

    def draw(self, *zones):
        """Close zones while it flies; the fence follows."""
        environment = self.driver_settings.environment
        zones = type(environment).model_validate(
            environment.model_dump() | {'keep_outs': list(zones)}
        )
        self.driver.adopt_area(Area(zones))
        return self

    @property
    def status(self):
        return self.driver.follower.status

    @property
    def position(self):
        """On the map; the local frame begins at the start, on the ground."""
        return self.body.position + np.array([*self.start[:2], 0.0])

    @property
    def fault(self):
        return self.driver.health.text

    @property
    def said(self):
        return ' | '.join([*self.driver.logged, *(text for _, text in self.reports)])

    def away(self, *position):
        return math.dist(self.position[:2], position[:2])
