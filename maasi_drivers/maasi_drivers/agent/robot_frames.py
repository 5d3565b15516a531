"""A robot's frames on /tf and /tf_static, its description, and poses from transforms."""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any
from xml.etree import ElementTree

import numpy as np
from geometry_msgs.msg import PoseStamped, TransformStamped
from rclpy.publisher import Publisher
from std_msgs.msg import String

from maasi_drivers.agent.odometry import StampedPose
from maasi_drivers.agent.transform_buffer import TransformBuffer, TransformError
from maasi_drivers.settings.driver import DriverSettings
from maasi_filter.models.pose import Pose, compose, inverse
from maasi_filter.ros.clocks import stamp_problem
from maasi_filter.ros.conversions import (
    FARTHEST,
    bounded,
    point_from_ros,
    stamp_from_ros,
    stamp_to_ros,
)
from maasi_filter.ros.lifecycle_node import LockstepLifecycleNode, SettingsError
from maasi_filter.ros.qos import LATCHED, LATCHED_ALL, TRANSFORMS

# From a camera (x forward) to its optical frame (x right, y down, z forward).
_OPTICAL = (-0.5 * math.pi, 0.0, -0.5 * math.pi)


# A fixed frame of a robot: parent, name, position in the parent [m], rotation `rpy` [rad].
FixedFrame = tuple[str, str, Sequence[float], Sequence[float]]


def base_frame(robot: str, settings: DriverSettings) -> str:
    """Return the name of a robot's own frame."""
    return settings.base_frame.strip('/') or f'{robot}/base_link'


def sensor_frames(robot: str, settings: DriverSettings) -> list[FixedFrame]:
    """Return the frames of the robot's sensors that the settings locate."""
    base = base_frame(robot, settings)
    frames: list[FixedFrame] = []
    if settings.camera is not None:
        mount, camera = settings.camera.mount, f'{robot}/camera'
        frames.append((base, camera, mount.position, mount.rpy))
        frames.append((camera, f'{robot}/camera_optical', (0.0, 0.0, 0.0), _OPTICAL))
    if settings.scan is not None:
        position, turn = (*settings.scan.position, 0.0), (0.0, 0.0, settings.scan.yaw)
        frames.append((base, f'{robot}/base_scan', position, turn))
    ranging = settings.ranging
    if ranging.frame == 'body':
        frames.append((base, f'{robot}/ranging', ranging.position, ranging.rpy))
    return frames


def robot_description(robot: str, settings: DriverSettings) -> str:
    """Return the URDF of a robot: a cylinder as high as its radius, and its sensor frames."""
    root = ElementTree.Element('robot', name=robot)
    link = ElementTree.SubElement(root, 'link', name=base_frame(robot, settings))
    for part in ('visual', 'collision'):
        geometry = ElementTree.SubElement(ElementTree.SubElement(link, part), 'geometry')
        size = repr(settings.radius)
        ElementTree.SubElement(geometry, 'cylinder', radius=size, length=size)
    for parent, name, *pose in sensor_frames(robot, settings):
        ElementTree.SubElement(root, 'link', name=name)
        joint = ElementTree.SubElement(root, 'joint', name=f'{name}_joint', type='fixed')
        ElementTree.SubElement(joint, 'parent', link=parent)
        ElementTree.SubElement(joint, 'child', link=name)
        xyz, rpy = (' '.join(map(str, map(float, item))) for item in pose)
        ElementTree.SubElement(joint, 'origin', xyz=xyz, rpy=rpy)
    ElementTree.indent(root)
    return '<?xml version="1.0"?>\n' + ElementTree.tostring(root, encoding='unicode') + '\n'


class RobotFrames:
    """The frames of a robot, on the team's `tf` and `tf_static`; in lockstep only published."""

    def __init__(
        self,
        node: LockstepLifecycleNode[DriverSettings],
        robot: str,
        on_pose: Callable[[int, Pose], None],
    ) -> None:
        self._node = node
        self._settings = node.settings
        self._robot, self._on_pose = robot, on_pose
        self._base = base_frame(robot, self._settings)
        self._odom = f'{robot}/odom'
        self._buffer = TransformBuffer()
        # By child frame.
        self._static: dict[str, TransformStamped] = {}
        self._map_from_odom: Pose | None = None
        self._slot: int | None = None
        self._last_stamp: int | None = None
        self._publisher: Publisher | None = None
        self._static_publisher: Publisher | None = None
        settings = node.settings
        self._type: Any = None
        try:
            from tf2_msgs.msg import TFMessage
        except ImportError as error:
            if settings.poses == 'tf':
                raise SettingsError(
                    "parameter pose_source: read 'tf', but the package tf2_msgs is not installed "
                    "(sudo apt install ros-$ROS_DISTRO-tf2-msgs); allowed without it is 'odometry'"
                ) from error
            node.get_logger().warning(
                'the package tf2_msgs is not installed (sudo apt install ros-$ROS_DISTRO-tf2-msgs):'
                f' tf and tf_static are not published, and goals must be in the frame '
                f'{settings.frame!r}'
            )
        else:
            self._type = TFMessage
        kind = self._type
        if settings.tf_rate:
            description = node.create_publisher(String, 'robot_description', LATCHED)
            description.publish(String(data=robot_description(self._robot, settings)))
        if kind is None:
            return
        if settings.tf_rate:
            static = node.team_topic('tf_static')
            self._static_publisher = node.create_publisher(kind, static, LATCHED)
            if settings.poses != 'tf':
                self._publisher = node.create_publisher(kind, node.team_topic('tf'), TRANSFORMS)
        for parent, name, position, rpy in sensor_frames(self._robot, settings):
            self._add_static(parent, name, Pose.from_rpy(position, rpy))
        self._publish_static()
        if not settings.lockstep:
            for topic, quality in (('tf', TRANSFORMS), ('tf_static', LATCHED_ALL)):
                callback = partial(self._read, topic)
                node.create_subscription(kind, node.team_topic(topic), callback, quality)

    def clear(self) -> None:
        """Discard transforms that are not static, after a jump of the clock."""
        self._buffer.clear()
        self._slot = self._last_stamp = None

    def publish(self, placed: StampedPose, map_from_odom: Pose) -> None:
        """Publish the robot's pose, at most `tf_rate` times per second of its stamps."""
        settings = self._settings
        if settings.poses == 'tf' or not settings.tf_rate:
            return
        # Depends on the stamp only, so that runs in lockstep are equal.
        slot = math.floor(placed.stamp * settings.tf_rate * 1e-9 + 1e-6)
        if slot == self._slot:
            return
        self._slot = slot
        if map_from_odom != self._map_from_odom:
            self._map_from_odom = map_from_odom
            self._add_static(settings.frame, self._odom, map_from_odom)
            self._publish_static()
        pose = compose(inverse(map_from_odom), placed.pose)
        moving = self._transform(self._odom, self._base, pose, placed.stamp)
        if self._publisher is not None:
            self._publisher.publish(self._type(transforms=[moving]))

    def _add_static(self, parent: str, child: str, pose: Pose) -> None:
        self._static[child] = self._transform(parent, child, pose)

    def _transform(
        self, parent: str, child: str, pose: Pose, stamp: int | None = None
    ) -> TransformStamped:
        """Return a transform and store it; without a stamp [ns] it is static."""
        try:
            self._buffer.add(parent, child, pose, stamp or 0, static=stamp is None)
        except ValueError as error:
            # For example, another node publishes a parent frame of the same name.
            self._node.drop('transform', f'frames of this robot: {error}')
        made = TransformStamped(child_frame_id=child)
        made.header.frame_id, made.header.stamp = parent, stamp_to_ros(stamp or 0)
        translation, turn = made.transform.translation, made.transform.rotation
        translation.x, translation.y, translation.z = pose.position.tolist()
        turn.w, turn.x, turn.y, turn.z = pose.orientation.tolist()
        return made

    def _publish_static(self) -> None:
        # All of them each time, as only the last message is latched.
        if self._static_publisher is not None and self._static:
            self._static_publisher.publish(self._type(transforms=[*self._static.values()]))

    def _read(self, topic: str, message: Any) -> None:
        for item in message.transforms:
            try:
                if (problem := stamp_problem(item)) is not None:
                    raise ValueError(problem)
                translation, turn = item.transform.translation, item.transform.rotation
                bounded('translation', (translation.x, translation.y, translation.z), FARTHEST)
                bounded('rotation', (turn.w, turn.x, turn.y, turn.z), 1e6)
                self._buffer.add(
                    item.header.frame_id.strip('/'),
                    item.child_frame_id.strip('/'),
                    Pose(point_from_ros(translation), np.array([turn.w, turn.x, turn.y, turn.z])),
                    stamp_from_ros(item.header.stamp),
                    static=topic == 'tf_static',
                )
            except ValueError as error:
                self._node.drop(
                    'transform',
                    f'{topic}: {item.header.frame_id[:40]!r} to {item.child_frame_id[:40]!r}: '
                    f'{error}',
                )
        if topic == 'tf' and self._settings.poses == 'tf':
            self._handle_pose()

    def _handle_pose(self) -> None:
        settings = self._settings
        try:
            stamp = self._buffer.latest(settings.frame, self._base)
            if stamp is None or stamp == self._last_stamp:
                return
            pose = self._buffer.pose(settings.frame, self._base, stamp)
        except TransformError:
            return  # the driver reports the missing pose
        self._last_stamp = stamp
        age = 1e-9 * (self._node.get_clock().now().nanoseconds - stamp)
        if age > settings.odometry_timeout:
            self._node.drop(
                'stale transform',
                f'tf: {self._base!r} in {settings.frame!r} is {age:.1f} s old, allowed is up to '
                f'{settings.odometry_timeout:g} s (odometry_timeout)',
            )
            return
        self._on_pose(stamp, pose)

    def on_robot(self, frame: str, stamp: int) -> Pose:
        """Return the pose of a frame on the robot at a stamp [ns], or raise `ValueError`."""
        try:
            return self._buffer.pose(self._base, frame, stamp)
        except TransformError as error:
            allowed = f'allowed is a frame that tf connects with {self._base!r}: {error}'
            raise ValueError(f'header.frame_id: read {frame[:40]!r}, {allowed}') from error

    def to_map(self, waypoint: PoseStamped, now: int) -> str | None:
        """Transform a waypoint into the map at a time [ns]; return the problem if that fails."""
        header, settings = waypoint.header, self._settings
        frame = header.frame_id.strip('/')
        if header.frame_id == settings.frame:
            return None
        problem = f'waypoint.header.frame_id: read {header.frame_id!r}, allowed is '
        problem += f'{settings.frame!r} or a frame that tf connects with it: '
        try:
            latest = self._buffer.latest(settings.frame, frame)
            if latest is None:
                pose = self._buffer.pose(settings.frame, frame)
            else:
                stamp = stamp_from_ros(header.stamp) or now
                age = 1e-9 * (stamp - latest)
                if age > settings.odometry_timeout:
                    return (
                        f'{problem}the transform is {age:.1f} s old, allowed are '
                        f'{settings.odometry_timeout:g} s (odometry_timeout)'
                    )
                pose = self._buffer.pose(settings.frame, frame, min(stamp, latest))
        except TransformError as error:
            return problem + str(error)
        point = waypoint.pose.position
        position = pose.position + pose.rotation() @ point_from_ros(point)
        point.x, point.y, point.z = position.tolist()
        header.frame_id = settings.frame
        return None
