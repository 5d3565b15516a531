"""A robot in a recording: its poses, and its images or detections."""

import sys
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from maasi_drivers.agent.odometry import MapOdometry, PoseHistory, StampedPose, is_in_map
from maasi_drivers.calibration.bag_reader import BagError, BagReader
from maasi_drivers.calibration.sensor_calibration import Observation
from maasi_drivers.settings.driver import DriverSettings
from maasi_drivers.vision.images import decode_image, image_to_array
from maasi_drivers.vision.marker_detector import MarkerDetector
from maasi_filter.arrays import FloatArray, ImageArray
from maasi_filter.geometry.area import Area
from maasi_filter.models.pose import Pose

# Topics of a robot with targets.
USED = {
    'images': ('/camera/image_raw', '/camera/image_raw/compressed'),
    'detections': ('/detections',),
}
# The driver's poses first, as its detections are relative to them.
_POSES = ('/state', '/pose', '/odom', '/amcl_pose')
_POSE_TYPES = ('AgentState', 'Odometry', 'PoseStamped', 'PoseWithCovarianceStamped')
# Otherwise the transforms from the map to the robot's frame, without a namespace.
_TRANSFORMS, _FIXED = '/tf', '/tf_static'
_TRANSFORM_TYPES = ('TFMessage', 'tfMessage')
_IMAGES = {'Image': image_to_array, 'CompressedImage': decode_image}


class RecordedRobot:
    """A robot in a recording."""

    def __init__(
        self,
        bag: Path,
        settings: DriverSettings,
        robot: str | None = None,
        use: str | None = None,
        poses: str | None = None,
        remap: Mapping[str, str] | None = None,
    ) -> None:
        self.settings = settings
        #: Number of unused images or detections, by reason.
        self.reasons: Counter[str] = Counter()
        self.in_map = False  # whether its odometry is in the map, so that its start is not added
        self._bag, self._remap = bag, remap
        with BagReader(bag, remap) as reader:
            self._types = {topic: reader.types[topic] for topic, n in reader.counts.items() if n}
            self.recovered = reader.recovered
        kinds = (use,) if use else (*USED,)
        for kind in kinds:
            robots = {
                topic[: -len(end)].strip('/')
                for topic in self._types
                for end in USED[kind]
                if topic.endswith(end)
            }
            if robot is not None:
                robots &= {robot.strip('/')}
            if robots:
                break
        if len(robots) != 1:
            there = ', '.join(sorted(self._types)) or 'no topics'
            ends = [end.removeprefix('/') for kind in kinds for end in USED[kind]]
            wanted = '' if robot is None else f' named {robot}'
            raise ValueError(
                f'{bag}: robot: found {", ".join(sorted(robots)) or "none"}{wanted} with '
                f'{" or ".join(ends)}, allowed is one; recorded are {there}'
            )
        self.robot, self.use = robots.pop(), kind
        topics = [*map(self._topic, _POSES), _TRANSFORMS]
        recorded = [topic for topic in topics if topic in self._types]
        self.poses = poses or (recorded or [self._topic('/odom')])[0]
        known = self._types.get(self.poses, 'not recorded')
        self._pose_type = known.rpartition('/')[2]
        allowed = _POSE_TYPES + _TRANSFORM_TYPES
        if self._pose_type not in allowed:
            raise ValueError(
                f'{bag}: poses: {self.poses} is {known}, allowed are {", ".join(allowed)}; '
                f'looked for are {", ".join(topics)}'
            )

    @property
    def left_out(self) -> int:
        """Number of unused images or detections."""
        return self.reasons.total()

    @property
    def why(self) -> str:
        """Numbers of unused ones by reason, as text."""
        return '; '.join(f'{reason} ({number})' for reason, number in self.reasons.most_common())

    def _topic(self, name: str) -> str:
        return f'/{self.robot}{name}' if self.robot else name

    def pose_source(self) -> str:
        """Return the topic of its poses for messages, after reading them."""
        return self.poses + (' (in the map: start and yaw are not added)' if self.in_map else '')

    def records(self, name: str) -> bool:
        """Return whether it has messages of a topic, named from its namespace."""
        return self._topic(name) in self._types

    def _messages(self, *topics: str) -> Iterator[tuple[str, Any]]:
        with BagReader(self._bag, self._remap) as reader:
            try:
                for item in reader.messages(topics):
                    yield item.type.rpartition('/')[2], item.message
            except BagError as error:
                # Messages before the damage are used.
                self.recovered = f'{error}; using the part before it'

    def observations(self) -> list[Observation]:
        """Return its observations with their poses."""
        if self.use == 'images' and self.settings.camera is None:
            raise ValueError(
                'parameter camera: read nothing, allowed with images are the settings of a camera'
            )
        seen = list(self._published() if self.use == 'detections' else self._segmented())
        if self.reasons and not seen:
            raise ValueError(f'{self._bag}: {self.use}: none is usable: {self.why}')
        return seen

    def _published(self) -> Iterator[Observation]:
        dimension = self.settings.environment.dimension
        for _, message in self._messages(*map(self._topic, USED['detections'])):
            values = [[item.range, item.bearing, item.elevation] for item in message.detections]
            array = np.reshape(np.array(values, dtype=float), (-1, 3))[:, :dimension]
            pose = _pose(message.pose.pose)
            if pose is None or not np.isfinite(array).all():
                self.reasons['a number is not finite'] += 1
            else:
                yield Observation(pose, array)

    def _segmented(self) -> Iterator[Observation]:
        detector = self.detector()
        for placed, image in self.images():
            try:
                seen = detector.detect(image, placed.pose)
            except ValueError as error:
                self.reasons[str(error)] += 1
                continue
            yield Observation(placed.pose, seen.values)

    def detector(self) -> MarkerDetector:
        """Return the detector of its camera, with the recorded calibration."""
        assert self.settings.camera is not None
        camera = self.settings.camera
        for _, message in self._messages(self._topic('/camera/camera_info')):
            if hasattr(message, 'K'):
                # The fields of ROS 1 have capital letters.
                message = SimpleNamespace(**{k.lower(): v for k, v in vars(message).items()})
            if message.k[0] != 0.0:
                camera = camera.with_camera_info(message)
                break
        area = Area(self.settings.environment)
        return MarkerDetector(camera, area.dimension, area.terrain)

    def images(self, period: float = 0.0) -> Iterator[tuple[StampedPose, ImageArray]]:
        """Yield poses and images: the first valid image in each period [s]."""
        assert self.settings.camera is not None
        history, due = self._history(), 0
        offset, gap = round(self.settings.camera.stamp_offset * 1e9), round(period * 1e9)
        for kind, message in self._messages(*map(self._topic, USED['images'])):
            if kind not in _IMAGES:
                self.reasons[f'image: read {kind}, allowed are {", ".join(_IMAGES)}'] += 1
                continue
            stamp = _stamp(message)
            if stamp < due:
                continue
            placed = history.at(stamp + offset)
            try:
                image = _IMAGES[kind](message)
                if placed is None:
                    raise ValueError(f'{self.poses} has no pose before and after its stamp')
            except ValueError as error:
                self.reasons[str(error)] += 1
                continue
            if gap:
                due = stamp + gap if due == 0 else due + gap * ((stamp - due) // gap + 1)
            yield placed, image

    def _history(self) -> PoseHistory:
        settings, kind = self.settings, self._pose_type
        history = PoseHistory(sys.maxsize)
        if kind in _TRANSFORM_TYPES:
            for placed in self._transformed():
                history.add(placed)
            return history
        unmoved, odometry = MapOdometry(Pose(np.zeros(3))), None
        start = Pose.from_yaw(Area(settings.environment).above_ground(settings.start), settings.yaw)
        for _, message in self._messages(self.poses):
            pose = _pose(message.pose if kind == 'PoseStamped' else message.pose.pose)
            if pose is None:
                continue
            if kind == 'Odometry':
                frame, origin = message.header.frame_id, settings.odometry_origin
                in_map = is_in_map(frame, origin, settings.frame)
                if odometry is None:
                    self.in_map = in_map
                    initial = Pose(np.zeros(3)) if in_map else start
                    first = origin == 'first' and not in_map
                    odometry = MapOdometry(initial, pose if first else None)
                elif in_map != self.in_map:
                    raise ValueError(
                        f'{self._bag}: {self.poses}: header.frame_id: read {frame!r}, while the '
                        f'first was {"" if self.in_map else "not "}{settings.frame!r}; allowed is '
                        'one frame'
                    )
                history.add(odometry.apply(_stamp(message), pose, _covariance(message)))
            elif kind == 'PoseWithCovarianceStamped':
                history.add(unmoved.apply(_stamp(message), pose, _covariance(message)))
            else:
                history.add(StampedPose(_stamp(message), pose))
        return history

    def _transformed(self) -> Iterator[StampedPose]:
        """Yield the poses of the robot's frame in the map from the transforms."""
        # It needs ROS, unlike other poses.
        from maasi_drivers.agent.transform_buffer import TransformBuffer, TransformError

        buffer, problem, last = TransformBuffer(), 'there is none', -1
        base = self.settings.base_frame.strip('/') or f'{self.robot}/base_link'.strip('/')
        wanted, children = self.settings.frame, set()
        for topic in (_FIXED, self.poses):
            for _, message in self._messages(topic):
                for item in message.transforms:
                    child, parent = item.child_frame_id.strip('/'), item.header.frame_id.strip('/')
                    if (pose := _pose(item.transform)) is not None:
                        children.add(child)
                        buffer.add(parent, child, pose, _stamp(item), static=topic == _FIXED)
                try:
                    stamp = buffer.latest(wanted, base)
                    if stamp is not None and stamp > last:
                        yield StampedPose(stamp, buffer.pose(wanted, base, stamp))
                        last = stamp
                except TransformError as error:
                    problem = str(error)
        if last < 0:
            raise ValueError(
                f'{self._bag}: poses: {self.poses}: no transform of {base!r} in {wanted!r}: '
                f'{problem}; recorded are {", ".join(sorted(children))} (parameter base_frame)'
            )


def _covariance(message: Any) -> FloatArray | None:
    covariance = np.asarray(message.pose.covariance, dtype=float)
    return covariance if covariance.any() and covariance[0] >= 0.0 else None


def _stamp(message: Any) -> int:
    stamp = message.header.stamp
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def _pose(message: Any) -> Pose | None:
    """Return a pose from a pose or transform; None if its numbers are invalid."""
    if hasattr(message, 'rotation'):
        point, turn = message.translation, message.rotation
    else:
        point, turn = message.position, message.orientation
    try:
        return Pose(
            np.array([point.x, point.y, point.z]), np.array([turn.w, turn.x, turn.y, turn.z])
        )
    except ValueError:
        return None
