"""Topics of the simulation node: robots, truth, and checks of subscriptions."""

import array
import contextlib
import math
from collections.abc import Mapping, Sequence

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseArray
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from sensor_msgs.msg import BatteryState, CameraInfo, Image, LaserScan
from std_msgs.msg import Header
from visualization_msgs.msg import Marker, MarkerArray

from maasi_drivers.agent.sensor_reading import Sweep
from maasi_drivers.settings.camera import CameraSettings
from maasi_drivers.vision.camera_model import Camera
from maasi_filter.models.pose import Pose
from maasi_filter.records import UNLABELLED
from maasi_filter.ros.conversions import (
    MarkerBoard,
    colour,
    point_to_ros,
    pose_from_ros,
    pose_to_ros,
    shape_marker,
)
from maasi_filter.ros.qos import LATCHED
from maasi_msgs.msg import AgentState, RangeArray, RangeMeasurement
from maasi_planner.motion import RobotState
from maasi_sim.scenario.schema import steps_of
from maasi_sim.simulation.robots import SimulatedRobot, Simulation
from maasi_sim.simulation.sensors import LaserSettings
from maasi_sim.simulation.world import World

# Period of battery messages [s of simulated time].
_BATTERY_PERIOD = 1.0
_LEAST_VARIANCE = 1e-12
_OF_ALL_NODES = ('/diagnostics', '/rosout', '/parameter_events')


class RobotTopics:
    """Publishes the data of one robot; reuses messages, as creating them is slower."""

    def __init__(self, node: Node, simulation: Simulation, name: str, qos: QoSProfile) -> None:
        self.name, self.simulation = name, simulation
        self.robot: SimulatedRobot = simulation.robots[name]
        self._battery_steps = steps_of(_BATTERY_PERIOD, simulation.scenario.step)

        def publisher(kind: type, topic: str) -> Publisher:
            return node.create_publisher(kind, f'{name}/{topic}', qos)

        robot = self.robot.settings
        # A linked or external robot reports its own pose.
        self.linked = robot.link != 'topics' or robot.external
        self._odometry_publisher = None if self.linked else publisher(Odometry, 'odom')
        self._odometry = Odometry(child_frame_id=f'{name}/base_link')
        self._odometry.header.frame_id = f'{name}/odom'
        linear = max(robot.odometry.velocity_noise**2, _LEAST_VARIANCE)
        angular = max(robot.odometry.heading_noise**2, _LEAST_VARIANCE)
        self._odometry.twist.covariance[::7] = [linear] * 3 + [angular] * 3
        self._battery_publisher = None if self.linked else publisher(BatteryState, 'battery_state')
        self._battery = BatteryState(
            **dict.fromkeys(('voltage', 'temperature', 'current', 'charge', 'capacity'), math.nan),
            design_capacity=math.nan,
            power_supply_status=BatteryState.POWER_SUPPLY_STATUS_DISCHARGING,
            present=True,
        )
        self._full = 100.0 if robot.battery_unit == 'percent' else 1.0
        self._battery.header.frame_id = f'{name}/base_link'
        self.needed: list[str] = []  #: full names of the topics that its driver needs
        if self._odometry_publisher is not None:
            self.needed.append(self._odometry_publisher.topic_name)
        # Measurements that another program publishes.
        self._measures = robot.measurements == 'simulated'
        if self.robot.camera is not None and self._measures:
            assert robot.camera is not None
            self._image_publisher = publisher(Image, 'camera/image_raw')
            self._info_publisher = publisher(CameraInfo, 'camera/camera_info')
            self._image, self._info = camera_messages(robot.camera, f'{name}/camera_optical')
            self.needed.append(self._image_publisher.topic_name)
        elif self.robot.ranging is not None and self._measures:
            self._ranges_publisher = publisher(RangeArray, 'ranges')
            self._ranges = RangeArray(header=Header(frame_id=f'{name}/base_link'))
            self.needed.append(self._ranges_publisher.topic_name)
        # The program that moves an external robot also publishes its scan.
        laser = self.robot.laser
        self._scans = laser is not None and robot.body == 'simulated'
        if laser is not None and self._scans:
            self._scan_publisher = publisher(LaserScan, 'scan')
            self._scan = scan_message(laser.settings, f'{name}/base_scan')

    def publish_sensors(self, stamp: Time) -> None:
        """Publish the readings of its sensors and battery in this step."""
        simulation, robot, name = self.simulation, self.robot, self.name
        imaging = self._measures and simulation.images_due(name)
        if imaging and robot.camera is not None:
            image = robot.image(simulation.step, simulation.time)
            self._info.header.stamp = stamp
            self._info_publisher.publish(self._info)
            self._image.header.stamp = stamp
            # array.array is copied as one block, an ndarray element by element.
            self._image.data = array.array('B', image.tobytes())
            self._image_publisher.publish(self._image)
        elif imaging and robot.ranging is not None:
            self._ranges.header.stamp = stamp
            self._ranges.ranges = range_messages(robot.sweep(simulation.step))
            self._ranges_publisher.publish(self._ranges)
        if self._scans and simulation.scan_due(name):
            self._scan.header.stamp = stamp
            self._scan.ranges = array.array('f', simulation.scan(name).tobytes())
            self._scan_publisher.publish(self._scan)
        if self._battery_publisher is not None and simulation.step % self._battery_steps == 0:
            self._battery.header.stamp = stamp
            self._battery.percentage = self._full * robot.battery.charge
            self._battery_publisher.publish(self._battery)

    def publish_odometry(self, stamp: Time) -> None:
        """Publish the odometry, unless the robot reports its own pose."""
        if self._odometry_publisher is None:
            return
        reading, message = self.robot.odometry, self._odometry
        message.header.stamp = stamp
        place, turn = message.pose.pose.position, message.pose.pose.orientation
        place.x, place.y, place.z = reading.pose.position.tolist()
        turn.w, turn.x, turn.y, turn.z = reading.pose.orientation.tolist()
        message.pose.covariance = reading.covariance.reshape(36)
        linear, angular = message.twist.twist.linear, message.twist.twist.angular
        linear.x, linear.y, linear.z = reading.velocity.tolist()
        angular.x, angular.y, angular.z = reading.angular_velocity.tolist()
        self._odometry_publisher.publish(message)


def range_messages(sweep: Sweep) -> list[RangeMeasurement]:
    """Return the messages of a ranging sensor's returns."""
    labels = sweep.labels or (UNLABELLED,) * len(sweep.values)
    return [
        RangeMeasurement(
            range=values[0],
            bearing=values[1],
            elevation=values[2] if len(values) == 3 else 0.0,
            class_id=label.class_id,
            score=label.score,
            identity=label.identity,
        )
        for values, label in zip(sweep.values.tolist(), labels)
    ]


def camera_messages(settings: CameraSettings, frame: str) -> tuple[Image, CameraInfo]:
    """Return a camera's image message without data, and its calibration."""
    image = Image(
        height=settings.height,
        width=settings.width,
        encoding='rgb8',
        is_bigendian=0,
        step=3 * settings.width,
    )
    camera = Camera.from_settings(settings)
    (fx, _, cx), (_, fy, cy), _ = camera.matrix.tolist()
    info = CameraInfo(
        height=settings.height,
        width=settings.width,
        distortion_model=camera.model,
        d=camera.distortion.tolist(),
        k=[fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0],
        r=[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        p=[fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
    )
    image.header.frame_id = info.header.frame_id = frame
    return image, info


def scan_message(settings: LaserSettings, frame: str) -> LaserScan:
    """Return a laser scan message without ranges."""
    increment = 2.0 * math.pi / settings.beams
    return LaserScan(
        header=Header(frame_id=frame),
        angle_min=0.0,
        angle_max=increment * (settings.beams - 1),
        angle_increment=increment,
        time_increment=0.0,
        scan_time=1.0 / settings.rate,
        range_min=settings.minimum_range,
        range_max=settings.maximum_range,
    )


def publish_truth(node: Node, world: World, frame: str) -> None:
    """Publish `ground_truth/targets` and `ground_truth/markers` once."""
    header = Header(frame_id=frame)
    targets = node.create_publisher(PoseArray, 'ground_truth/targets', LATCHED)
    markers = node.create_publisher(MarkerArray, 'ground_truth/markers', LATCHED)
    targets.publish(
        PoseArray(
            header=header, poses=[pose_to_ros(Pose(target)) for target in world.targets_3d_at(0)]
        )
    )
    size = 0.01 * float((world.bounds[:, 1] - world.bounds[:, 0]).max())
    shapes = [
        shape_marker(header, 'truth', number, target, size, colour(0.0, 0.3, 1.0, 0.7))
        for number, target in enumerate(world.targets_3d_at(0), start=1)
    ]
    for number, (*centre, radius, sphere) in enumerate(world.area.solid.tolist(), start=1):
        shape = shape_marker(
            header, 'obstacles', number, centre, 2.0 * radius, colour(0.3, 0.3, 0.3)
        )
        if not sphere:
            shape.type = Marker.CYLINDER
            low, high = world.bounds[2] if world.dimension == 3 else (0.0, radius)
            shape.pose.position = point_to_ros([*centre[:2], 0.5 * (low + high)])
            shape.scale.z = float(high - low)
        shapes.append(shape)
    markers.publish(MarkerBoard().replace(MarkerArray(markers=shapes)))


class Connections:
    """Reports whether nodes would receive what is published now, by their expected topics."""

    def __init__(self, node: Node, expected: Mapping[str, Sequence[str]]) -> None:
        self._node, self._expected = node, expected
        self._endpoints: dict[tuple[str, str], set[bytes]] = {}

    def unsubscribed(self, name: str) -> list[str]:
        """Return the topics of a node without a subscription since `remember`."""
        return [
            topic
            for topic in self._expected[name]
            if not self._subscriptions(name, topic) - self._endpoints.get((name, topic), set())
        ]

    def unmatched(self) -> list[str]:
        """Return the topics of publishers with a known but unconnected subscription."""
        known = self._node.get_subscriptions_info_by_topic
        return [
            item.topic_name
            for item in self._node.publishers
            if item.topic_name not in _OF_ALL_NODES
            and item.get_subscription_count() < len(known(item.topic_name))
        ]

    def remember(self) -> None:
        """Remember all subscriptions; a restarted node has new ones."""
        for name, topics in self._expected.items():
            for topic in topics:
                self._endpoints[name, topic] = self._subscriptions(name, topic)

    def _subscriptions(self, name: str, topic: str) -> set[bytes]:
        return {
            bytes(info.endpoint_gid)
            for info in self._node.get_subscriptions_info_by_topic(topic)
            if f'{info.node_namespace.rstrip("/")}/{info.node_name}' == name
        }


class ExternalRobot:
    """A robot moved by another program, which measures at its driver's pose."""

    obeys = False  #: the simulation does not wait for it at shutdown

    def __init__(self, start: Pose) -> None:
        self.state = RobotState(start)  #: in the map

    def update(self, message: AgentState) -> None:
        """Store the latest state."""
        linear, angular = message.twist.linear, message.twist.angular
        # An invalid state keeps the last valid one.
        with contextlib.suppress(ValueError):
            self.state = RobotState(
                pose_from_ros(message.pose.pose),
                np.array([linear.x, linear.y, linear.z]),
                np.array([angular.x, angular.y, angular.z]),
            )

    def cut(self, cut: bool = True) -> None:
        """Do nothing: its link is not simulated."""

    def close(self) -> None:
        """Do nothing."""
