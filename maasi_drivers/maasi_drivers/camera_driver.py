"""What the drivers of robots with a camera share."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from functools import partial
from typing import Any
from zlib import crc32

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from maasi_drivers.agent.agent_driver import AgentDriver, Sighting
from maasi_drivers.agent.arrival_clock import ArrivalClock
from maasi_drivers.agent.odometry import StampedPose
from maasi_drivers.vision.camera_settings import CameraSettings, load_calibration
from maasi_drivers.vision.camera_view import box_view_margin
from maasi_drivers.vision.image_encoding import decode_image, image_to_array
from maasi_drivers.vision.image_source import ImageSourceError, VideoSource
from maasi_drivers.vision.marker_detector import MarkerDetector
from maasi_drivers.vision.measurement_feed import FeedPose, FeedReceiver
from maasi_drivers.vision.segmentation import Blobs
from maasi_drivers.warm_up import warm_up
from maasi_filter.models.detection import BoxDetection
from maasi_filter.models.pose import Pose
from maasi_filter.ros.conversions import stamp_from_ros
from maasi_filter.ros.lifecycle_node import SettingsError
from maasi_filter.ros.qos import RELIABLE, SENSOR, sensor_reader

ImageArray = NDArray[np.uint8]
# An image that may still have to be decoded, or what was found in it on board.
Picture = Callable[[], ImageArray | Blobs]

# Between two looks at a video or feed [s].
_POLL_PERIOD = 0.01
# Of each so many rows and columns one tells whether an image is overexposed.
_EXPOSURE_STRIDE = 4
# Largest share of pixels that may be as bright as the camera can tell.
_MOST_CLIPPED = 0.01


def _known(blobs: Blobs) -> Blobs:
    return blobs


class CameraDriver(AgentDriver[Picture]):
    """
    A robot with a camera that sees markers on the floor.

    Calibration: from the file that the parameter `calibration_file` names, else from the
    parameters;
    a `camera_info` with a focal length replaces either.

    Images come from a topic, or by the parameter `image_source` from a video (a stream, a device
    or a file), or as blobs that were found on board (measurement feed).

    Subscribes
    ----------
    `camera/image_raw` (sensor_msgs/Image) or `camera/image_raw/compressed`;
    `camera/camera_info` (sensor_msgs/CameraInfo), whose calibration replaces the parameters'
    """

    sensed = 'image'

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self._video: VideoSource | None = None
        self._feed: FeedReceiver | None = None

    def prepare(self) -> None:
        """Make the detector, and open where images come from."""
        super().prepare()
        if self.settings.camera is None:
            raise SettingsError(
                'parameter camera: got nothing, allowed are the settings of a camera '
                '(camera.width, ...)'
            )
        self._calibration: tuple[object, ...] | None = None
        self._checksum: int | None = None
        #: Stamps for what comes without one.
        self.arrivals = ArrivalClock()
        self._counted: Counter[str] = Counter()
        if self.settings.image_source != 'topic':
            try:
                self._open_source()
            except (ImageSourceError, OSError) as error:
                raise SettingsError(f'parameter image_source: {error}') from error
        camera = self.settings.camera
        if self.settings.calibration_file:
            try:
                camera = load_calibration(self.settings.calibration_file, camera)
            except (OSError, ValueError) as error:
                raise SettingsError(f'parameter calibration_file: {error}') from error
        self._use(camera)
        self.offset = round(self.settings.camera.stamp_offset * 1e9)

    def _use(self, camera: CameraSettings) -> None:
        detector = MarkerDetector(camera, self.dimension)
        box = self.sensor.detection
        if isinstance(box, BoxDetection):
            margin = box_view_margin(
                detector.camera,
                self.settings.sensor.detection.lower or [],
                self.settings.sensor.detection.upper or [],
                max(self.settings.start[2], 0.0),
            )
            if margin < 0.0:
                self.get_logger().warning(
                    'sensor.detection: the box is not all inside what the camera sees'
                    + (f', by {-margin:.1f} px' if np.isfinite(margin) else '')
                )
        self.camera, self.detector = camera, detector

    def set_up_sensor(self) -> None:
        """Compile and connect."""
        warm_up()
        grey = np.full((self.camera.height, self.camera.width, 3), 120, np.uint8)
        # Images are read-only views of messages.
        view = np.frombuffer(grey.tobytes(), np.uint8).reshape(grey.shape)
        height = max(self.settings.start[2], 0.1)
        self.detector.detect(view, Pose.from_yaw([0.0, 0.0, height], 0.0), np.zeros((6, 6)))
        if self.settings.image_source != 'topic':
            self.create_wall_timer(_POLL_PERIOD, self._poll_source)
        quality = sensor_reader(self.settings.lockstep)
        self.create_subscription(CameraInfo, 'camera/camera_info', self._on_calibration, quality)
        if self.settings.image_source != 'topic':
            return
        # Images read reliably are sent again when lost: on a thin link that delays the next ones.
        if self.settings.image_reliability == 'reliable':
            quality = RELIABLE if self.settings.lockstep else SENSOR
        if self.settings.image_transport == 'raw':
            self.create_subscription(Image, 'camera/image_raw', self._on_image, quality)
        else:
            self.create_subscription(
                CompressedImage, 'camera/image_raw/compressed', self._on_compressed, quality
            )

    # ---- images that are no topic ------------------------------------------------------------

    def _open_source(self) -> None:
        if self.settings.image_source == 'video':
            self._video = VideoSource(self.settings.video)
            return
        address, port = self.settings.feed_address, self.settings.feed_port
        try:
            self._feed = FeedReceiver(port, address, self.feed_sender())
        except OSError as error:
            raise OSError(
                f'feed_address, feed_port: UDP port {port} of {address}: {error.strerror}, allowed '
                'is a free port of an address of this host'
            ) from error

    def feed_sender(self) -> str | None:
        """Return the address of the only one whose feed is heard; none: anybody's."""
        return None

    def take_feed_pose(self, stamp: int, pose: FeedPose) -> None:
        """Take where the robot was at an image of the feed; not used here."""

    def tear_down(self) -> None:
        """Disconnect, and let go of video or feed."""
        super().tear_down()
        self._close_source()

    def destroy_node(self) -> None:
        """Let go of video or feed, and leave."""
        super().destroy_node()
        self._close_source()

    def _close_source(self) -> None:
        for source in (self._video, self._feed):
            if source is not None:
                source.close()
        self._video = self._feed = None

    def _poll_source(self) -> None:
        self.arrivals.observe(time.monotonic(), self.get_clock().now().nanoseconds)
        if self._video is not None:
            self._take_video(self._video)
        if self._feed is not None:
            self._take_feed(self._feed)

    def _take_video(self, source: VideoSource) -> None:
        if source.error:
            self.warn_throttled('video', source.error)
        frame = source.take()
        stamp = None if frame is None else self.arrivals.stamp(frame.received)
        if frame is None or stamp is None:
            return
        image = frame.image
        try:
            self._check_size(image)
        except ValueError as error:
            self.drop('image', f'video: {error}')
            return
        self.take_frame('video', stamp, lambda: image, repeated=self._is_repeated(image.tobytes()))

    def _take_feed(self, feed: FeedReceiver) -> None:
        camera = self.camera
        for item in feed.take():
            packet, stamp = item.packet, self.arrivals.stamp(item.taken)
            if stamp is None:
                continue
            if (packet.width, packet.height) != (camera.width, camera.height):
                self.drop(
                    'image',
                    f'feed: width, height: read {packet.width} x {packet.height} px, allowed is '
                    f'the size of the calibration, {camera.width} x {camera.height} px',
                )
                continue
            if packet.pose is not None:
                self.take_feed_pose(stamp, packet.pose)
            self.take_frame('feed', stamp, partial(_known, packet.blobs))
        for reason, number in feed.counts.items():
            new = number - self._counted[reason]
            if new and reason != 'received':
                self._counted[reason] = number
                self.drop(f'feed: {reason}', f'feed: {feed.problem or reason}', new)

    # ---- images of a topic -------------------------------------------------------------------

    def _on_calibration(self, message: CameraInfo) -> None:
        calibration = (
            message.width,
            message.height,
            message.k.tolist(),
            list(message.d),
            message.distortion_model,
        )
        # Without a focal length the camera has not been calibrated.
        if calibration == self._calibration or message.k[0] == 0.0:
            return
        self._calibration = calibration
        try:
            self._use(self.camera.with_calibration(*calibration))
        except (ValueError, np.linalg.LinAlgError) as error:
            self.drop('calibration', f'camera/camera_info: {error}')

    def _on_image(self, message: Image) -> None:
        try:
            image = image_to_array(
                message.height, message.width, message.encoding, message.step, message.data
            )
            self._check_size(image)
        except ValueError as error:
            self.drop('image', f'camera/image_raw: {error}')
            return
        self.take_frame(
            'camera/image_raw',
            stamp_from_ros(message.header.stamp),
            lambda: image,
            repeated=self._is_repeated(message.data),
        )

    def _on_compressed(self, message: CompressedImage) -> None:
        topic = 'camera/image_raw/compressed'
        stamp = stamp_from_ros(message.header.stamp)
        self.take_frame(
            topic,
            stamp,
            lambda: decode_image(message.data, message.format),
            repeated=self._is_repeated(message.data),
        )

    def _is_repeated(self, data: Any) -> bool:
        """Return whether an image is the one before to the bit: noise never is."""
        if self.settings.lockstep or not self.settings.sensor_patience:
            return False
        before, self._checksum = self._checksum, crc32(data)
        return self._checksum == before

    def _check_size(self, image: ImageArray) -> None:
        camera = self.camera
        if image.shape[:2] != (camera.height, camera.width):
            raise ValueError(
                f'image: got {image.shape[1]} x {image.shape[0]} px, allowed is the size of the '
                f'calibration, {camera.width} x {camera.height} px'
            )

    def _watch_exposure(self, image: ImageArray) -> None:
        """Warn of an image whose colours are cut off: markers are missed there, or misplaced."""
        sample = image[::_EXPOSURE_STRIDE, ::_EXPOSURE_STRIDE]
        share = float(np.mean(sample.max(axis=2) == np.iinfo(np.uint8).max))
        if share > _MOST_CLIPPED:
            self.warn_throttled(
                'exposure',
                f'image: {share:.0%} of the pixels are clipped at 255, good is at most '
                f'{_MOST_CLIPPED:.0%}: lower the exposure, or markers are missed or misplaced',
            )

    def look(self, data: Picture, pose: StampedPose) -> Sighting:
        """Find the markers in an image."""
        # Odometry that says nothing of its errors carries zeros.
        covariance = pose.covariance if pose.covariance.any() else None
        picture = data()
        if isinstance(picture, Blobs):
            seen = self.detector.locate(picture, pose.pose, covariance)
        else:
            seen = self.detector.detect(picture, pose.pose, covariance)
            self._watch_exposure(picture)
        positions = seen.positions
        if self.dimension == 3:
            positions = np.pad(positions, ((0, 0), (0, 1)))
        return Sighting(seen.values, seen.covariances, positions, seen.dropped)
