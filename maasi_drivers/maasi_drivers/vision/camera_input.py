"""A camera as a robot's sensor: images to detections, or boxes of another detector."""

from collections.abc import Callable
from dataclasses import replace
from itertools import islice
from typing import Any
from zlib import crc32

import numpy as np
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from maasi_drivers.agent.odometry import StampedPose
from maasi_drivers.agent.robot_node import RobotNode
from maasi_drivers.agent.sensor_input import SensorInput
from maasi_drivers.agent.sensor_reading import SensorReading
from maasi_drivers.settings.camera import CameraSettings, load_calibration
from maasi_drivers.vision.camera_model import Camera, box_view_margin
from maasi_drivers.vision.detector import Blobs
from maasi_drivers.vision.images import ImageSourceError, VideoSource, decode_image, image_to_array
from maasi_drivers.vision.marker_detector import MarkerDetector, read_markers
from maasi_drivers.vision.measurement_feed import FeedReceiver
from maasi_filter.arrays import FloatArray, ImageArray
from maasi_filter.models.detection import BoxDetection
from maasi_filter.models.pose import Pose
from maasi_filter.records import UNLABELLED, Label, rounded_score
from maasi_filter.ros.conversions import label_problem, stamp_from_ros
from maasi_filter.ros.lifecycle_node import SettingsError
from maasi_filter.ros.qos import RELIABLE, SENSOR, sensor_reader


def boxes_to_blobs(message: Any, camera: CameraSettings) -> tuple[Blobs, list[str]]:
    """Return the usable boxes of a `vision_msgs/Detection2DArray`, and errors of the others.

    A box is labelled by its hypothesis with the largest finite score. A tracker's id is no
    identity, as it changes when a target is seen again.
    """
    settings, size = camera.detections, np.array([camera.width, camera.height], dtype=float)
    assert settings is not None
    corners, labels, problems = [], [], []
    for item in message.detections:
        try:
            best, unknown = _best(item)
            problems += [f'score: read {score}, allowed is 0 to 1' for score in unknown]
            label = Label(best.class_id, rounded_score(best.score))
            if (problem := label_problem(label)) is not None:
                raise ValueError(problem)
            if not settings.classes or label.class_id in settings.classes:
                corners.append(_corners(item.bbox, size))
                labels.append(label)
        except ValueError as error:
            problems.append(str(error))
    low, high = np.reshape(np.array(corners, dtype=float), (-1, 2, 2)).transpose(1, 0, 2)
    points, extents = 0.5 * (low + high), high - low
    if settings.point == 'foot':
        points[:, 1] = high[:, 1]
    # The point of a cut box may be outside of the image.
    cut = ((low < 1.0) | (high > size - 1.0)).any(axis=1)
    deviations = np.where(cut, 0.5, settings.error)[:, None] * extents
    blobs = Blobs(
        # A box of 1 px reaches from 0 to 1, while pixel centres are integers.
        points - 0.5,
        extents.prod(axis=1),
        extents,
        cut,
        deviations[:, :, None] ** 2 * np.eye(2),
        tuple(labels),
        message.header.frame_id.strip('/'),
    )
    return blobs, problems


def _best(item: Any) -> tuple[Any, list[float]]:
    """Return the hypothesis of a box with the largest score, and invalid scores."""
    given = [result.hypothesis for result in item.results]
    known = [hypothesis for hypothesis in given if not np.isnan(hypothesis.score)]
    if given and not known:
        raise ValueError('score: read nan in each hypothesis, allowed is 0 to 1')
    best = max(known, key=lambda hypothesis: float(hypothesis.score), default=UNLABELLED)
    return best, [item.score for item in given if np.isnan(item.score)]


def _corners(box: Any, size: FloatArray) -> FloatArray:
    """Return the least and largest x and y of a (possibly rotated) box in the image (2, 2)."""
    middle, turn = box.center.position, box.center.theta
    numbers = np.array([middle.x, middle.y, box.size_x, box.size_y, turn])
    centre, extent = numbers[:2], numbers[2:4]
    if (numbers[:4] >= 0.0).all() and (numbers[:4] <= 1.0).all() and (extent > 0.0).all():
        raise ValueError(
            f'bbox: read centre and size {numbers[:4].tolist()}, which are shares of the image '
            f'(normalised); allowed are pixels of {size[0]:g} x {size[1]:g}'
        )
    inside = (centre >= 0.0).all() and (centre <= size).all()
    if not (inside and np.isfinite(numbers).all() and (extent > 0.0).all()):
        raise ValueError(
            f'bbox: read centre, size and theta {numbers.tolist()}, allowed are a centre inside '
            f'{size[0]:g} x {size[1]:g} px, sizes above 0 and a finite theta'
        )
    cosine, sine = abs(np.cos(turn)), abs(np.sin(turn))
    half = 0.5 * np.array([[cosine, sine], [sine, cosine]]) @ extent
    return np.clip([centre - half, centre + half], 0.0, size)


# Decodes an image or returns the blobs found on board; only called for images that answer a batch.
Picture = Callable[[], ImageArray | Blobs]


CALIBRATION = 'calibration'  # kind of fault


class CameraInput(SensorInput[Picture]):
    """A camera that sees markers on the floor.

    Calibration: from the parameter `calibration_file`, else the parameters; a `camera_info`
    with a focal length replaces either. An invalid one is a fault. Images come from a topic, a
    video (stream, device or file), or as blobs from on board (measurement feed), by the
    parameter `image_source`; with `camera.detections` boxes come instead. The header names the
    camera's optical frame: that of the settings (`<robot>/camera_optical`, or no name), or one
    that tf connects with the robot.

    Subscribes
    ----------
    `camera/image_raw` (sensor_msgs/Image) or `camera/image_raw/compressed`, or
    `camera/detections` (vision_msgs/Detection2DArray);
    `camera/camera_info` (sensor_msgs/CameraInfo), whose calibration replaces the parameters'
    """

    name = 'image'

    def __init__(self, driver: RobotNode) -> None:
        super().__init__(driver)
        # None if images come from a topic.
        self._source: VideoSource | FeedReceiver | None = None
        self._calibration: tuple[object, ...] | None = None
        self._classes: set[str] = set()  # of boxes
        self._unusable = ''  # why the calibration is unusable
        self._checksum: int | None = None

    def prepare(self) -> None:
        """Open the image source and create the detector."""
        settings = self.driver.settings
        if settings.camera is None:
            raise SettingsError(
                'parameter camera: read nothing, allowed are the settings of a camera '
                '(camera.width, ...)'
            )
        if settings.image_source != 'topic':
            try:
                self._source = self._open_source()
            except ImageSourceError as error:
                raise SettingsError(f'parameter image_source: {error}') from error
        camera = settings.camera
        if settings.calibration_file:
            try:
                camera = load_calibration(settings.calibration_file, camera)
            except (OSError, ValueError) as error:
                raise SettingsError(f'parameter calibration_file: {error}') from error
        self._use(camera)
        self.offset = round(settings.camera.stamp_offset * 1e9)

    def _use(self, camera: CameraSettings) -> None:
        driver, settings = self.driver, self.driver.settings
        detector = MarkerDetector(camera, driver.dimension, driver.volume.area.terrain)
        if isinstance(driver.sensor.detection, BoxDetection):
            margin = box_view_margin(
                detector.camera,
                settings.sensor.detection.lower or [],
                settings.sensor.detection.upper or [],
                max(settings.start[2], 0.0),
            )
            if margin < 0.0:
                driver.get_logger().warning(
                    'sensor.detection: the box is not all inside the field of view of the camera'
                    + (f', by {-margin:.1f} px' if np.isfinite(margin) else '')
                )
        self.camera, self._detector = camera, detector

    def set_up(self) -> None:
        """Compile kernels and connect."""
        driver, settings = self.driver, self.driver.settings
        grey = np.full((self.camera.height, self.camera.width, 3), 120, np.uint8)
        # Images are read-only views of messages.
        view = np.frombuffer(grey.tobytes(), np.uint8).reshape(grey.shape)
        # Above the terrain, whose kernels are compiled too.
        x, y, z = settings.start
        position = driver.volume.area.above_ground([x, y, max(z, 0.1)])
        self._detector.detect(view, Pose.from_yaw(position, 0.0))
        quality = sensor_reader(settings.lockstep)
        driver.create_subscription(CameraInfo, 'camera/camera_info', self._on_calibration, quality)
        if self.camera.detections is not None:
            try:
                from vision_msgs.msg import Detection2DArray as Boxes
            except ImportError as error:
                raise SettingsError(
                    'parameter camera.detections: the package vision_msgs is not installed '
                    '(sudo apt install ros-$ROS_DISTRO-vision-msgs); allowed without it is nothing'
                ) from error
            driver.create_subscription(Boxes, 'camera/detections', self._on_boxes, quality)
            return
        if settings.image_source != 'topic':
            driver.create_wall_timer(0.01, self._poll_source)
            return
        # Lost reliable images are sent again, which delays the next ones on a slow network.
        if settings.image_reliability == 'reliable':
            quality = RELIABLE if settings.lockstep else SENSOR
        if settings.image_transport == 'raw':
            driver.create_subscription(Image, 'camera/image_raw', self._on_image, quality)
        else:
            driver.create_subscription(
                CompressedImage, 'camera/image_raw/compressed', self._on_compressed, quality
            )

    def close(self) -> None:
        """Close video or feed."""
        if self._source is not None:
            self._source.close()
        self._source = None

    # ---- image to detections -----------------------------------------------------------------

    def detect(self, data: Picture, pose: StampedPose) -> SensorReading:
        """Decode an image and return its markers."""
        if self._unusable:
            raise ValueError(self._unusable)
        picture = data()
        if isinstance(picture, Blobs) and self.camera.detections is not None:
            self._detector.camera = self._placed(picture.frame, pose.stamp)
        reading = read_markers(picture, pose, self._detector, self.driver.sensor)
        if isinstance(picture, Blobs):
            return reading
        share = float(np.mean(picture[::4, ::4].max(axis=2) == 255))
        if share > 0.01:
            self.driver.warn_throttled(
                'exposure',
                f'image: {100.0 * share:.0f} % of the pixels are clipped at 255 (good: at most '
                '1 %); reduce the exposure to avoid missed or misplaced markers',
            )
        return reading

    # ---- image source: video or feed ----------------------------------------------------------

    def _open_source(self) -> VideoSource | FeedReceiver:
        settings, peer = self.driver.settings, self.driver.feed_peer
        if settings.image_source == 'video':
            return VideoSource(settings.video)

        def drop(reason: str, text: str, number: int) -> None:
            self.driver.drop(f'feed: {reason}', f'feed: {text}', number)

        sender = None if peer is None else peer.address
        return FeedReceiver(settings.feed_port, settings.feed_address, sender, drop)

    def _poll_source(self) -> None:
        if isinstance(self._source, VideoSource):
            self._receive_video(self._source)
        elif self._source is not None:
            self._receive_feed(self._source)

    def _receive_video(self, source: VideoSource) -> None:
        if source.error:
            self.driver.warn_throttled('video', source.error)
        frame = source.pop_frame()
        stamp = None if frame is None else self.driver.arrivals.stamp(frame.received)
        if frame is None or stamp is None:
            return
        image = frame.image
        try:
            self._detector.check_size(*image.shape[1::-1])
        except ValueError as error:
            self.driver.drop('image', f'video: {error}')
            return
        self.driver.receive_frame(
            'video', stamp, lambda: image, repeated=self._is_repeated(image.tobytes())
        )

    def _receive_feed(self, feed: FeedReceiver) -> None:
        peer = self.driver.feed_peer
        for packet, time in feed.receive():
            if (stamp := self.driver.arrivals.stamp(time)) is None:
                continue
            try:
                self._detector.check_size(packet.width, packet.height)
            except ValueError as error:
                self.driver.drop('image', f'feed: {error}')
                continue
            if packet.pose is not None and peer is not None:
                peer.on_pose(stamp, packet.pose)
            self.driver.receive_frame('feed', stamp, lambda blobs=packet.blobs: blobs)

    # ---- image source: topic ------------------------------------------------------------------

    def _on_calibration(self, message: CameraInfo) -> None:
        # Without a focal length the camera is not calibrated.
        if message.k[0] == 0.0:
            self.driver.warn_throttled(
                'calibration',
                'camera/camera_info: k is zero, so the camera is not calibrated: using the '
                'intrinsics of the settings',
            )
            return
        roi = message.roi
        calibration = (
            (message.width, message.height, message.k.tolist(), list(message.d)),
            (message.distortion_model, message.binning_x, message.binning_y),
            (roi.x_offset, roi.y_offset, roi.width, roi.height),
        )
        if calibration == self._calibration:
            return
        self._calibration, health = calibration, self.driver.health
        try:
            self._use(self.camera.with_camera_info(message))
        except (ValueError, np.linalg.LinAlgError) as error:
            # Measurements with other intrinsics would be wrong.
            self._unusable = f'camera/camera_info: {error}'
            health.begin(CALIBRATION, self._unusable)
            self.driver.publish_fault()
            return
        self._unusable = ''
        health.end(CALIBRATION, 'camera/camera_info: valid calibration received')

    def _on_image(self, message: Image) -> None:
        try:
            image = image_to_array(message)
            self._detector.check_size(*image.shape[1::-1])
        except ValueError as error:
            self.driver.drop('image', f'camera/image_raw: {error}')
            return
        self.driver.receive_frame(
            'camera/image_raw',
            stamp_from_ros(message.header.stamp),
            lambda: image,
            repeated=self._is_repeated(message.data),
        )

    def _on_compressed(self, message: CompressedImage) -> None:
        self.driver.receive_frame(
            'camera/image_raw/compressed',
            stamp_from_ros(message.header.stamp),
            lambda: decode_image(message),
            repeated=self._is_repeated(message.data),
        )

    def _on_boxes(self, message: Any) -> None:
        blobs, problems = boxes_to_blobs(message, self.camera)
        self._watch_classes(message)
        if problems:
            self.driver.drop('box', f'camera/detections: {problems[0]}', len(problems))
        stamp = stamp_from_ros(message.header.stamp)
        self.driver.receive_frame('camera/detections', stamp, lambda: blobs)

    def _watch_classes(self, message: Any) -> None:
        """Warn of each new class while no box has a wanted class."""
        settings, number = self.camera.detections, len(self._classes)
        if settings is None or not settings.classes or self._classes.intersection(settings.classes):
            return
        given = (
            result.hypothesis.class_id for item in message.detections for result in item.results
        )
        self._classes.update(islice(given, 100))
        if not number < len(self._classes) < 100 or self._classes.intersection(settings.classes):
            return
        self.driver.get_logger().warning(
            f'camera/detections: no box has a class of camera.detections.classes, '
            f'{", ".join(map(repr, settings.classes))}; received are '
            f'{", ".join(repr(name[:40]) for name in sorted(self._classes)[:20])}'
        )

    def _placed(self, frame: str, stamp: int) -> Camera:
        """Return the camera with the pose of its optical frame on the robot at a stamp [ns]."""
        camera = Camera.from_settings(self.camera)
        if frame in ('', f'{self.driver.robot}/camera_optical'):
            return camera
        pose = self.driver.frames.on_robot(frame, stamp)
        if pose.rotation()[2, 2] > 0.5:
            raise ValueError(
                f'camera/detections.header.frame_id: read {frame[:40]!r}, whose z axis points up; '
                'allowed is the optical frame of the camera (x right, y down, z forward)'
            )
        return replace(camera, position=pose.position, rotation=pose.rotation())

    def _is_repeated(self, data: Any) -> bool:
        """Return whether an image is bit-identical to the last one, which noise prevents."""
        if self.driver.settings.lockstep or not self.driver.settings.sensor_patience:
            return False
        before, self._checksum = self._checksum, crc32(data)
        return self._checksum == before
