"""Flying robots behind links: each with its driver and its team, and the same verbs for all."""

import math
from functools import partial

import numpy as np
from geometry_msgs.msg import PoseStamped
from onboard_program import OnboardProgram
from rclpy.executors import SingleThreadedExecutor
from robot_team import MAMBO, RANGING, Team, parameters_of, stamped

from maasi_drivers.drivers import (
    MamboDriver,
    MamboOnboardDriver,
    MavlinkCameraDriver,
    MavlinkDriver,
)
from maasi_filter.models.pose import Pose, compose
from maasi_filter.ros.conversions import pose_to_ros
from maasi_msgs.msg import AgentState
from maasi_sim.simulation.emulators.mambo.fake_mambo import FakeMambo, free_address, free_port
from maasi_sim.simulation.emulators.mambo.firmware import FirmwareSettings, MamboFirmware
from maasi_sim.simulation.emulators.mavlink.autopilot_settings import AutopilotSettings
from maasi_sim.simulation.emulators.mavlink.fake_mavlink_vehicle import FakeVehicle
from maasi_sim.simulation.odometry import OdometrySettings

YAW = 0.6
FULL_SPEED = 9.81 * math.tan(MAMBO['motion']['tilt']) / FirmwareSettings().drag
FLYING = MAMBO | {
    'start': [1.0, 1.2, 0.4],
    'yaw': YAW,
    'link': 'mambo_wifi',
    'odometry_timeout': 0.5,
    'battery_minimum': 0.0,
}
COPTER = RANGING | {
    'environment': {'bounds': [[-8.0, 8.0], [-8.0, 8.0], [-5.0, 5.0]]},
    'radius': 0.3,
    # The machine may be busy.
    'odometry_timeout': 5.0,
    'motion': {'speed': 1.0, 'acceleration': 1.0, 'tolerance': 0.25},
    'link': 'mavlink',
}


class LinkedFlight:
    """What all have in common; `doing` is 'ground', 'air' or 'landing' of the drone itself."""

    program, make = 'mambo_driver', MamboDriver
    start, far = FLYING['start'], [2.3, -0.2, 0.5]
    outside = ([1.7, 0.8, 2.1], [1.7, 0.8, -0.1], [2.6, 0.8, 0.5], [math.nan, 0.8, 0.5])
    # Two waypoints, how near it is to them when the next one is sent, and its least speed.
    route, near, least_speed = ([1.0, 0.4, 0.4], [1.0, -0.1, 0.4]), 0.4, 0.1
    stopping = 1.5  # what it may fly until it stands, at its speed [s]

    def __init__(self, context, drone, settings):
        self.context = context
        self.drone = drone
        self.settings = settings
        # What counts its take-offs.
        self.driver, self.inside = None, drone
        self.executor = SingleThreadedExecutor(context=context)
        self.team = team = Team(context, settings, self.executor, deaf=True)
        # It is not reached by topics.
        team.used = [item for item in team.used if item not in (team.odometry, team.battery)]
        self.call = partial(team.call, until=self.until)

    def begin(self, process=None):
        """Run the driver here, or in its own process by the fixture `process`."""
        if process is not None:
            self.driver = process(program=(self.program,), settings=self.settings)
        else:
            options = {'namespace': '/rover', 'parameter_overrides': parameters_of(self.settings)}
            self.driver = self.make(context=self.context, **options)
            self.executor.add_node(self.driver)
            assert self.driver.trigger_configure().name == 'SUCCESS', self.driver.problem
            assert self.driver.trigger_activate().name == 'SUCCESS'
        self.team.connect()
        return self

    def close(self):
        if hasattr(self.driver, 'halt'):
            self.driver.halt()
            self.driver.destroy_node()
        self.drone.close()
        self.team.destroy_node()
        self.executor.shutdown()

    @property
    def where(self):
        return self.drone.state.pose.position

    @property
    def speed(self):
        """Over the ground [m/s]."""
        return float(np.linalg.norm(self.drone.state.velocity[:2]))

    @property
    def grounded(self):
        return self.doing == 'ground'

    @property
    def reason(self):
        return self.team.state.reason if self.team.states else 'silent'

    @property
    def status(self):
        return self.team.state.goal_status if self.team.states else None

    def until(self, condition, what=''):
        self.team.until(condition, what or (lambda: f'{self.status}, {self.reason!r}'))

    def until_said(self, reason):
        self.until(lambda: reason in self.reason)

    def away(self, point):
        return float(np.linalg.norm(self.where - point))

    def arm(self):
        # Refused until the driver receives from the drone.
        self.until(lambda: self.call('arm').success)
        return self

    def ready(self):
        """Return itself, once it takes goals."""
        self.until(lambda: self.status in (AgentState.IDLE, AgentState.ABORTED))
        return self

    def up(self):
        return self.arm().ready()

    def moving_to_goal(self):
        """Wait until it flies to a goal; return the goal's handle and result to come."""
        before = self.where
        sent = self.team.send_accepted(self.far)
        self.until(lambda: self.away(before) > 0.3)
        return sent

    def reaches(self, goal):
        _, result = self.team.send_accepted(goal)
        self.until(result.done)
        assert result.result().result.reached, result.result().result.reason

    def stops(self, since):
        """Check that it stops soon: set-points lead by a second, and by what it needs to brake."""
        self.until(lambda: self.speed < 0.1)
        assert self.away(since) < self.stopping * self.settings['motion']['speed']

    def gives_up(self, result, reason):
        """Check that it stops, ends its goal and reports the reason, and that no goal follows."""
        self.until(lambda: self.status == AgentState.UNAVAILABLE and reason in self.reason)
        # Until it is noticed, which takes up to the timeout of the link, it flies on.
        before = self.where
        assert reason in self.team.aborted(result)
        assert self.team.refused(self.start)
        self.stops(before)

    def seen_from_outside(self, source='pose', origin=None):
        """Have another system report its pose relative to `origin`; return the timer for it."""
        team = self.team
        publisher = team.create_publisher(PoseStamped, 'pose', 10)

        def say():
            stamp, state = team.get_clock().now().nanoseconds, self.drone.state
            if source == 'odometry':
                # The robot of the team is where the drone is.
                team.body = team.motion.body(state)
                team.odometry.publish(team.odometry_message(stamp))
                return
            pose = state.pose if origin is None else compose(origin, state.pose)
            message = PoseStamped(pose=pose_to_ros(pose))
            message.header.frame_id = 'map'
            publisher.publish(stamped(message, stamp))

        return team.create_timer(0.04, say)


def mambo_firmware(lost_link='land'):
    return MamboFirmware(
        Pose.from_yaw([*LinkedFlight.start[:2], 0.0], YAW),
        FirmwareSettings(take_off_height=0.3, lost_link=lost_link),
        odometry=OdometrySettings(position_noise=0.002, heading_noise=0.002),
    )


class MamboFlight(LinkedFlight):
    """A fake Mambo behind pyparrot."""

    def __init__(self, context, drone=None, own=(), **changes):
        drone = drone or FakeMambo(mambo_firmware(), free_address())
        # The machine may be busy.
        mambo = {'arm': True, 'full_speed': FULL_SPEED, 'link_timeout': 2.0}
        mambo |= {'address': drone.address, 'port': free_port()} | dict(own)
        super().__init__(context, drone, FLYING | {'mambo': mambo} | changes)
        self.inside = drone.firmware

    @property
    def doing(self):
        state = self.inside.flying_state.name.lower()
        return {'landed': 'ground', 'landing': 'landing'}.get(state, 'air')


class OnboardFlight(LinkedFlight):
    """A drone with its own program, on ground that is not at height 0."""

    make = MamboOnboardDriver

    def __init__(self, context, own=(), **changes):
        port, start = free_port(), Pose.from_yaw([*self.start[:2], 0.1], YAW)
        drone = OnboardProgram(free_address(), ('127.0.0.1', port), start)
        mambo = {'arm': True, 'ground': 0.1, 'land_after': 1.0}
        mambo |= {'address': drone.address, 'order_port': drone.port} | dict(own)
        feed = {'link': 'mambo_feed', 'image_source': 'feed', 'feed_port': port}
        super().__init__(context, drone, FLYING | feed | {'mambo': mambo} | changes)

    @property
    def doing(self):
        return ('ground', 'air', 'landing')[self.drone.doing]


class VehicleFlight(LinkedFlight):
    """A fake vehicle that speaks MAVLink."""

    program = 'mavlink_driver'
    start, far = [1.0, 2.0, 0.8], [1.0, -6.0, 0.8]
    # Without a geofence it is not sent into the ground.
    outside = ([math.nan, 0.0, 0.8], [0.0, 0.0, math.inf], [0.0, 1.0, -0.1], [0.0, 9.0, 1.0])
    route, near, least_speed = ([1.0, -3.0, 0.8], [3.0, -5.0, 0.8]), 1.5, 0.4
    stopping = 2.2

    def __init__(self, context, autopilot=(), own=(), **changes):
        self.make = MavlinkCameraDriver if 'camera' in changes else MavlinkDriver
        mavlink = {'arm': True, 'link_timeout': 3.0, 'url': f'udpin:127.0.0.1:{free_port()}'}
        mavlink |= dict(own)
        drone = FakeVehicle(
            AutopilotSettings.model_validate({'estimator_time': 0.2} | dict(autopilot)),
            mavlink['url'].replace('udpin', 'udpout'),
            Pose.from_yaw([*self.start[:2], 0.0], 0.0),
            np.random.default_rng(1),
        )
        super().__init__(
            context, drone, COPTER | {'start': self.start, 'mavlink': mavlink} | changes
        )
        self.inside, self.lock = drone.autopilot, drone._lock

    @property
    def doing(self):
        if not self.inside.armed:
            return 'ground'
        return 'landing' if self.inside.mode_name == 'LAND' else 'air'


KINDS = {'mambo': MamboFlight, 'onboard': OnboardFlight, 'vehicle': VehicleFlight}
