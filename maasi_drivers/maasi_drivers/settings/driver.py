"""Settings of a robot's driver and of its guard."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import Field, model_validator

from maasi_drivers.settings.camera import CameraSettings
from maasi_drivers.settings.vehicles import MamboSettings, MavlinkSettings
from maasi_filter.geometry.environment import EnvironmentSettings
from maasi_filter.plugins import PluginGroup
from maasi_filter.ros.node_settings import LIVELINESS_LEASE, NodeSettings
from maasi_filter.settings import Finite, Settings, Vector2, Vector3
from maasi_planner.settings import RobotModel

BatteryUnit = Literal['fraction', 'percent']
CommandType = Annotated[
    Literal['auto', 'stamped', 'twist'],
    Field(
        description='Type of cmd_vel: TwistStamped, Twist, or the type that it subscribes to; auto '
        'is stamped in lockstep'
    ),
]

# Links that each driver of the suite has.
LINKS: dict[str, tuple[str, ...]] = {
    'mambo_driver': ('topics', 'mambo_wifi', 'mambo_ble'),
    'mambo_onboard_driver': ('mambo_feed',),
    'turtlebot_driver': ('topics',),
    'ranging_driver': ('topics',),
    'mavlink_driver': ('topics', 'mavlink'),
    'mavlink_camera_driver': ('topics', 'mavlink'),
}
DRIVERS = PluginGroup(
    'maasi.drivers',
    'driver',
    'maasi_drivers.agent.agent_driver:AgentDriver',
    # Those of robots that the simulation stands in for.
    {name: f'maasi_drivers.drivers:{name}' for name, has in LINKS.items() if 'topics' in has},
)


class RangingSettings(Settings):
    """What the angles of `ranges` are relative to, and where the sensor sits."""

    frame: Literal['map', 'body'] = Field(
        'map',
        description="'map': bearings from the map's x axis, elevations from the horizontal plane; "
        "'body': both in the frame of the sensor on the robot, as real ones give them, with slant "
        'ranges',
    )
    position: Vector3 = Field(
        [0.0, 0.0, 0.0], description="Of the sensor in the robot's frame, with frame body [m]"
    )
    rpy: Vector3 = Field(
        [0.0, 0.0, 0.0],
        description='Roll, pitch, yaw of the sensor about fixed axes of the robot, with frame body '
        '[rad]',
    )


class ScanSettings(Settings):
    """How a ground robot keeps clear of what its laser scanner sees."""

    position: Vector2 = Field(
        [0.0, 0.0], description="Of the scanner in the robot's frame, x and y [m]"
    )
    yaw: Finite = Field(0.0, description="Of the scanner in the robot's frame [rad]")
    reach: float = Field(
        0.7, gt=0.0, le=10.0, description='How far ahead the way has to be free [m]'
    )
    timeout: float = Field(
        1.0,
        gt=0.0,
        description='Time by the odometry without a scan after which the robot is stopped [s]',
    )
    blocked_timeout: float = Field(
        15.0,
        gt=0.0,
        description='Time by the odometry without getting nearer to a waypoint after which it is '
        'given up [s]',
    )


class DrivenRobot(RobotModel):
    """What driver and simulation know of a robot."""

    link: Literal['topics', 'mambo_wifi', 'mambo_ble', 'mambo_feed', 'mavlink'] = Field(
        'topics',
        description='How it is reached: ROS topics; pyparrot over WiFi or Bluetooth '
        '(mambo_driver); a program of its own by UDP (mambo_onboard_driver); MAVLink '
        '(mavlink_driver)',
    )
    mambo: MamboSettings | None = Field(
        None,
        description='With a link mambo_...: how, and what it may be made to do; where the drone '
        'is simulated, an address that is not of this host is replaced',
    )
    mavlink: MavlinkSettings | None = Field(
        None, description='With link mavlink: how, and what it may be made to do'
    )
    yaw: Finite = Field(0.0, description='Heading at the start, from the x axis of the map [rad]')
    camera: CameraSettings | None = Field(None, description='Its camera; none: a ranging sensor')
    battery_unit: BatteryUnit = Field(
        'fraction',
        description='Unit of battery_state.percentage: fraction, 0 to 1 as its definition says, or '
        'percent, 0 to 100 as a TurtleBot3 has it',
    )
    battery_minimum: float = Field(
        0.05,
        ge=0.0,
        lt=1.0,
        description='Charge below which its driver takes no goals, and lands it where it can; '
        '0: disabled [1]',
    )


class DriverSettings(DrivenRobot, NodeSettings):
    """What the driver of a robot needs to know."""

    live: ClassVar[frozenset[str]] = frozenset(
        {
            'odometry_timeout',
            'frozen_pose_timeout',
            'sensor_timeout',
            'battery_minimum',
            'battery_timeout',
            'scan.timeout',
            'scan.blocked_timeout',
        }
    )

    environment: EnvironmentSettings = Field(description='Where the robot may go')
    ranging: RangingSettings = Field(
        default_factory=RangingSettings,
        description='What the angles of `ranges` are relative to; of drivers with a ranging sensor',
    )
    scan: ScanSettings | None = Field(
        None,
        description='How a ground robot uses its laser scan; none: it drives by the known '
        'obstacles alone; not in lockstep',
    )
    navigation: Literal['own', 'nav2'] = Field(
        'own',
        description="What drives a ground robot to its waypoints: the driver, or Nav2's "
        'NavigateToPose; not in lockstep',
    )
    nav2_timeout: float = Field(
        2.0,
        gt=0.0,
        description='Longest silence of Nav2 while it has a goal, answer or feedback: then the '
        'goal is aborted and the robot stopped [s]',
    )
    image_source: Literal['topic', 'video', 'feed'] = Field(
        'topic',
        description='Where images come from: a topic, what `video` names, or blobs that the robot '
        'finds on board and sends to `feed_port` (docs/measurement_feed.md)',
    )
    video: str = Field(
        '', description='Address (rtsp://...), device (/dev/video0) or file, as OpenCV opens it'
    )
    feed_port: int = Field(14700, ge=1, le=65535, description='UDP port of the measurement feed')
    feed_address: str = Field(
        '127.0.0.1',
        min_length=1,
        description='Address of this host on which the measurement feed is received; 0.0.0.0: all, '
        'from a robot on the network',
    )
    image_transport: Literal['raw', 'compressed'] = Field(
        'raw', description='Images as camera/image_raw, or as camera/image_raw/compressed'
    )
    image_reliability: Literal['best_effort', 'reliable'] = Field(
        'best_effort',
        description='Quality of service with which images are read; best_effort matches every '
        'camera',
    )
    calibration_file: str = Field(
        '',
        description="Calibration of the camera as ROS's camera_calibration writes it (YAML); "
        'none: the parameters of the camera',
    )
    odometry_frame: str = Field(
        '',
        description='What odom.header.frame_id has to be; none: odom, with this namespace or '
        'without one',
    )
    odometry_origin: Literal['zero', 'first', 'map'] = Field(
        'zero',
        description='What the odometry shows at the start: zero, or its first message; '
        'map: it is in the map already, and so is its header.frame_id. Odometry with this '
        'frame_id is taken as in the map in any case',
    )
    pose_source: Literal['odometry', 'tf', 'pose'] | None = Field(
        None,
        description='Where poses come from: `odom` (with link mavlink the autopilot), the '
        'transform from the frame map to `base_frame` on /tf, or the topic `pose` '
        '(geometry_msgs/PoseStamped, in the map); none: tf with navigation nav2, so that targets '
        'are placed where the robot drives, else odometry; the others not in lockstep, and with '
        'link topics or mavlink',
    )
    base_frame: str = Field('', description="The robot's own frame on /tf; none: <robot>/base_link")
    tf_rate: float = Field(
        20.0,
        ge=0.0,
        le=1000.0,
        description="How often the robot's pose is published on /tf, at most; 0: neither its "
        'frames nor robot_description are published [Hz]',
    )
    odometry_timeout: float = Field(
        0.5,
        ge=0.1,
        description='Time without odometry, or without a pose on /tf, after which the robot is '
        'stopped; not in lockstep [s]',
    )
    frozen_pose_timeout: float = Field(
        1.0,
        ge=0.0,
        description='Time by the odometry for which its pose may be the same to the bit under a '
        'command to move, before the robot is stopped; 0: disabled; not in lockstep [s]',
    )
    sensor_timeout: float | None = Field(
        None,
        ge=0.0,
        description='Time by the odometry without a new image or sweep after which the robot is '
        'stopped; none: three periods of the sensor, at least 1 s; 0: disabled; not in '
        'lockstep [s]',
    )
    command_type: CommandType = 'auto'
    battery_timeout: float = Field(
        30.0,
        ge=0.0,
        description='Time by the odometry without a charge after which that counts as unknown; '
        '0: the last one stays [s]',
    )
    chargers: list[Vector3] = Field(
        default_factory=list, description='Where it is charged; none: at its start [m, map]'
    )

    @property
    def poses(self) -> str:
        """Where poses come from: odometry, tf or pose."""
        if self.pose_source is not None:
            return self.pose_source
        return 'tf' if self.navigation == 'nav2' else 'odometry'

    @property
    def sensor_patience(self) -> float:
        """Time without a new image or sweep after which the robot is stopped [s]; 0: never."""
        if self.sensor_timeout is not None:
            return self.sensor_timeout
        return max(1.0, 3.0 * self.sensor.period)

    @model_validator(mode='after')
    def _consistent(self) -> DriverSettings:
        def wrong(name: str, allowed: str) -> ValueError:
            return ValueError(f'{name}: got {getattr(self, name)!r}, allowed {allowed}')

        lockstep = self.lockstep
        if self.pose_source in ('tf', 'pose') and (
            lockstep or self.link not in ('topics', 'mavlink')
        ):
            where = ' in lockstep' if lockstep else ''
            raise wrong('pose_source', f'with link {self.link!r}{where} is odometry')
        if lockstep and self.link != 'topics':
            raise wrong('link', 'in lockstep is topics: others run in real time')
        if lockstep and self.image_source != 'topic':
            raise wrong('image_source', 'in lockstep is topic: others run in real time')
        if self.camera is not None and self.camera.detections and self.image_source != 'topic':
            raise wrong('image_source', 'with camera.detections is topic')
        if (self.image_source == 'video') != bool(self.video):
            raise wrong('video', 'is a source with image_source video, and nothing with others')
        if lockstep and self.command_type == 'twist':
            raise wrong('command_type', 'is stamped (or auto) in lockstep')
        if lockstep and self.navigation != 'own':
            raise wrong('navigation', 'in lockstep is that the driver drives by known obstacles')
        if self.scan is not None and (lockstep or self.motion.model != 'unicycle'):
            raise ValueError(
                f"scan: got settings, allowed with motion.model 'unicycle', not "
                f'{self.motion.model!r}, and not in lockstep'
            )
        if lockstep and self.camera is not None and self.camera.stamp_offset > 0.0:
            raise ValueError(
                f'camera.stamp_offset: got {self.camera.stamp_offset}, allowed is at most 0 in '
                'lockstep: the pose after an image is not awaited there'
            )
        return self


class GuardSettings(NodeSettings):
    """What the guard of a robot needs to know."""

    lease: float = Field(
        LIVELINESS_LEASE,
        ge=LIVELINESS_LEASE,
        le=60.0,
        description='Time without an assertion of liveliness after which the driver is dead '
        '[s of wall time]',
    )

    command_type: CommandType = 'auto'
