"""Settings of a robot's driver and of its guard."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import Field, model_validator

from maasi_drivers.settings.camera import CameraSettings
from maasi_drivers.settings.vehicles import MamboSettings, MavlinkSettings, PlatformSettings
from maasi_filter.geometry.environment import EnvironmentSettings
from maasi_filter.plugins import PluginGroup
from maasi_filter.ros.node_settings import LIVELINESS_LEASE, NodeSettings
from maasi_filter.settings import Finite, Settings, Vector2, Vector3
from maasi_planner.settings import RobotModel

BatteryUnit = Literal['fraction', 'percent']
CommandType = Annotated[
    Literal['auto', 'stamped', 'twist'],
    Field(
        description='Type of cmd_vel: TwistStamped, Twist, or (auto) the type that the robot '
        'subscribes to; auto is stamped in lockstep'
    ),
]

PLATFORM_LINKS = ('crazyswarm2', 'aerostack2')  # to systems that fly a drone by themselves
# Links that each driver of the suite has.
LINKS: dict[str, tuple[str, ...]] = {
    'mambo_driver': ('topics', 'mambo_wifi', 'mambo_ble'),
    'mambo_onboard_driver': ('mambo_feed',),
    'turtlebot_driver': ('topics',),
    'ranging_driver': ('topics', *PLATFORM_LINKS),
    'camera_driver': ('topics', *PLATFORM_LINKS),
    'mavlink_driver': ('topics', 'mavlink'),
    'mavlink_camera_driver': ('topics', 'mavlink'),
}
TERRAIN_LINKS = ('topics', 'mavlink')  # which keep flying robots above ground that is not flat
DRIVERS = PluginGroup(
    'maasi.drivers',
    'driver',
    'maasi_drivers.agent.agent_driver:AgentDriver',
    # Links of simulated robots.
    {
        name: f'maasi_drivers.drivers:{name.title().replace("_", "")}'
        for name, has in LINKS.items()
        if 'topics' in has
    },
)


class RangingSettings(Settings):
    """Reference of the angles in `ranges`, and mount of the sensor."""

    frame: Literal['map', 'body'] = Field(
        'map',
        description="'map': bearings from the map's x axis, elevations from the horizontal plane; "
        "'body': both in the frame of the sensor on the robot, with slant ranges, as real "
        'sensors measure',
    )
    position: Vector3 = Field(
        [0.0, 0.0, 0.0],
        description="Position of the sensor in the robot's frame, for frame body [m]",
    )
    rpy: Vector3 = Field(
        [0.0, 0.0, 0.0],
        description='Roll, pitch, yaw of the sensor about fixed axes of the robot, for frame body '
        '[rad]',
    )


class ScanSettings(Settings):
    """How a ground robot avoids what its laser scanner sees."""

    position: Vector2 = Field(
        [0.0, 0.0], description="Position of the scanner in the robot's frame, x and y [m]"
    )
    yaw: Finite = Field(0.0, description="Yaw of the scanner in the robot's frame [rad]")
    reach: float = Field(
        0.7, gt=0.0, le=10.0, description='Length of the path ahead that must be free [m]'
    )
    timeout: float = Field(
        1.0,
        gt=0.0,
        description='Odometry time without a scan after which the robot is stopped [s]',
    )
    blocked_timeout: float = Field(
        15.0,
        gt=0.0,
        description='Odometry time without progress to a waypoint after which its goal is aborted '
        '[s]',
    )


class DrivenRobot(RobotModel):
    """Settings of a robot that driver and simulation share."""

    link: Literal[
        'topics', 'mambo_wifi', 'mambo_ble', 'mambo_feed', 'mavlink', 'crazyswarm2', 'aerostack2'
    ] = Field(
        'topics',
        description='Connection: ROS topics; pyparrot over WiFi or Bluetooth (mambo_driver); its '
        'own program by UDP (mambo_onboard_driver); MAVLink (mavlink_driver); the services of '
        'crazyswarm2 or the behaviors of Aerostack2 (ranging_driver, camera_driver)',
    )
    mambo: MamboSettings | None = Field(
        None,
        description='For links mambo_...: connection and permissions; for a simulated drone an '
        'address of another host is replaced',
    )
    mavlink: MavlinkSettings | None = Field(
        None, description='For link mavlink: connection and permissions'
    )
    platform: PlatformSettings | None = Field(
        None, description='For links crazyswarm2 and aerostack2: connection and permissions'
    )
    yaw: Finite = Field(0.0, description='Heading at the start, from the x axis of the map [rad]')
    camera: CameraSettings | None = Field(None, description='Its camera; default: a ranging sensor')
    battery_unit: BatteryUnit = Field(
        'fraction',
        description='Unit of battery_state.percentage: fraction (0 to 1, as defined) or percent '
        '(0 to 100, as of a TurtleBot3)',
    )
    battery_minimum: float = Field(
        0.05,
        ge=0.0,
        lt=1.0,
        description='Charge below which its driver refuses goals and, if possible, lands it; 0 '
        'disables this [1]',
    )


class DriverSettings(DrivenRobot, NodeSettings):
    """Settings of the driver of a robot."""

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

    environment: EnvironmentSettings = Field(description='Area of the robot')
    ranging: RangingSettings = Field(
        default_factory=RangingSettings,
        description='Reference of the angles in `ranges`, for drivers with a ranging sensor',
    )
    scan: ScanSettings | None = Field(
        None,
        description='Use of the laser scan of a ground robot; default: only known obstacles; not '
        'in lockstep',
    )
    navigation: Literal['own', 'nav2'] = Field(
        'own',
        description="Navigation of a ground robot: by the driver or Nav2's NavigateToPose; not in "
        'lockstep',
    )
    nav2_timeout: float = Field(
        2.0,
        gt=0.0,
        description='Time without an answer or feedback from Nav2 after which the goal is aborted '
        'and the robot stopped [s]',
    )
    image_source: Literal['topic', 'video', 'feed'] = Field(
        'topic',
        description='Source of images: a topic, `video`, or blobs that the robot detects on board '
        'and sends to `feed_port` (docs/measurement_feed.md)',
    )
    video: str = Field(
        '', description='Address (rtsp://...), device (/dev/video0) or file that OpenCV can open'
    )
    feed_port: int = Field(14700, ge=1, le=65535, description='UDP port of the measurement feed')
    feed_address: str = Field(
        '127.0.0.1',
        min_length=1,
        description='Address of this host for the measurement feed; 0.0.0.0: all addresses, for a '
        'robot on the network',
    )
    image_transport: Literal['raw', 'compressed'] = Field(
        'raw', description='Topic of images: camera/image_raw or camera/image_raw/compressed'
    )
    image_reliability: Literal['best_effort', 'reliable'] = Field(
        'best_effort',
        description='Quality of service of the image subscription; best_effort matches every '
        'camera',
    )
    calibration_file: str = Field(
        '',
        description="Calibration file of ROS's camera_calibration (YAML); default: the parameters "
        'of the camera',
    )
    odometry_frame: str = Field(
        '',
        description='Required odom.header.frame_id; default: odom, with or without this namespace',
    )
    odometry_origin: Literal['zero', 'first', 'map'] = Field(
        'zero',
        description='Odometry at the start: zero, or its first message; map: poses are map poses '
        'already. Odometry with the frame_id of the map always counts as map poses',
    )
    pose_source: Literal['odometry', 'tf', 'pose'] | None = Field(
        None,
        description='Source of poses: `odom` (with link mavlink the autopilot), the transform '
        'from map to `base_frame` on /tf, or the topic `pose` (geometry_msgs/PoseStamped, in the '
        'map). Default: tf with navigation nav2, else odometry. tf and pose need link topics or '
        'mavlink, without lockstep',
    )
    base_frame: str = Field('', description="The robot's frame on /tf; default: <robot>/base_link")
    tf_rate: float = Field(
        20.0,
        ge=0.0,
        le=1000.0,
        description="Largest rate of the robot's pose on /tf; 0: no frames and no "
        'robot_description [Hz]',
    )
    odometry_timeout: float = Field(
        0.5,
        ge=0.1,
        description='Time without odometry, or a pose on /tf, after which the robot is stopped; '
        'not in lockstep [s]',
    )
    frozen_pose_timeout: float = Field(
        1.0,
        ge=0.0,
        description='Odometry time with a bit-identical pose under a command to move after which '
        'the robot is stopped; 0 disables this; not in lockstep [s]',
    )
    sensor_timeout: float | None = Field(
        None,
        ge=0.0,
        description='Odometry time without a new image or sweep after which the robot is stopped; '
        'default: three periods of the sensor, at least 1 s; 0 disables this; not in '
        'lockstep [s]',
    )
    command_type: CommandType = 'auto'
    battery_timeout: float = Field(
        30.0,
        ge=0.0,
        description='Odometry time without a charge after which it counts as unknown; 0: the last '
        'charge stays [s]',
    )
    chargers: list[Vector3] = Field(
        default_factory=list, description='Position of its charger; default: its start [m, map]'
    )

    @property
    def poses(self) -> str:
        """Source of poses: odometry, tf or pose."""
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
    """Settings of the guard of a robot."""

    lease: float = Field(
        LIVELINESS_LEASE,
        ge=LIVELINESS_LEASE,
        le=60.0,
        description='Wall time without an assertion of liveliness after which the driver counts as '
        'lost [s]',
    )

    command_type: CommandType = 'auto'
