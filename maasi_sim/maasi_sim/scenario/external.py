"""What other programs publish for a robot: its topics, their types and reliability."""

from dataclasses import dataclass

from maasi_sim.scenario.schema import RobotSettings

# Types of ros_gz_bridge, as in its README.md.
_GAZEBO = {
    'nav_msgs/msg/Odometry': 'gz.msgs.Odometry',
    'geometry_msgs/msg/TwistStamped': 'gz.msgs.Twist',
    'sensor_msgs/msg/Image': 'gz.msgs.Image',
    'sensor_msgs/msg/CameraInfo': 'gz.msgs.CameraInfo',
    'sensor_msgs/msg/LaserScan': 'gz.msgs.LaserScan',
}


@dataclass(frozen=True)
class ExternalTopic:
    """A topic of another program."""

    name: str
    type: str
    quality: str  # what its publisher, or the subscriber of a command, may offer
    command: bool = False  # published by the driver

    @property
    def gazebo_type(self) -> str | None:
        """Type in Gazebo; None: it has none."""
        return _GAZEBO.get(self.type)

    def __str__(self) -> str:
        verb = 'subscribe to' if self.command else 'publish'
        return f'{verb} {self.name} ({self.type}, {self.quality})'


_ANY = 'reliable or best effort'


def external_topics(name: str, robot: RobotSettings) -> list[ExternalTopic]:
    """Return what another program must publish, and subscribe to, for a robot."""
    topics = []
    if robot.body == 'external':
        topics += [
            ExternalTopic(f'/{name}/odom', 'nav_msgs/msg/Odometry', _ANY),
            ExternalTopic(f'/{name}/cmd_vel', 'geometry_msgs/msg/TwistStamped', _ANY, command=True),
        ]
        if robot.laser is not None:
            topics.append(ExternalTopic(f'/{name}/scan', 'sensor_msgs/msg/LaserScan', _ANY))
    if robot.measurements == 'external':
        camera = robot.camera
        if camera is None:
            topics.append(ExternalTopic(f'/{name}/ranges', 'maasi_msgs/msg/RangeArray', _ANY))
        elif camera.detections is not None:
            topic, kind = f'/{name}/camera/detections', 'vision_msgs/msg/Detection2DArray'
            topics.append(ExternalTopic(topic, kind, _ANY))
        else:
            info = f'{_ANY}; without it: the calibration of the scenario'
            topics += [
                ExternalTopic(f'/{name}/camera/image_raw', 'sensor_msgs/msg/Image', _ANY),
                ExternalTopic(f'/{name}/camera/camera_info', 'sensor_msgs/msg/CameraInfo', info),
            ]
    return topics
