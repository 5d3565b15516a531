"""From a camera image and the robot's pose to detections: segmentation and projection."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from maasi_drivers.agent.odometry import StampedPose
from maasi_drivers.agent.sensor_reading import SensorReading, measured
from maasi_drivers.settings.camera import DETECTORS, CameraSettings, SegmentationSettings
from maasi_drivers.vision.camera_model import Camera
from maasi_drivers.vision.detector import Blobs, Detector
from maasi_drivers.vision.segmentation import segment
from maasi_filter.arrays import FloatArray, ImageArray
from maasi_filter.models.measurement import (
    MeasurementModel,
    RangeBearing,
    RangeBearingElevation,
)
from maasi_filter.models.pose import Pose
from maasi_filter.models.sensor import Sensor
from maasi_filter.records import Label

_MODELS: dict[int, MeasurementModel] = {2: RangeBearing(), 3: RangeBearingElevation()}


def propagate(
    by_pixel: FloatArray,
    pixel_covariances: ArrayLike,
    by_pose: FloatArray,
    pose_covariance: ArrayLike | None = None,
) -> FloatArray:
    """Return the covariances (n, 2, 2) of floor positions, from those of pixels and pose [m^2].

    Shapes and units: by_pixel, by_pose (n, 2, 2) and (n, 2, 6); pixel_covariances (n, 2, 2)
    [px^2]; pose_covariance (6, 6) [rad].
    """
    pixel = np.asarray(pixel_covariances, dtype=np.float64)
    covariances = by_pixel @ pixel @ by_pixel.transpose(0, 2, 1)
    if pose_covariance is not None:
        matrix = np.asarray(pose_covariance, dtype=np.float64)
        if matrix.shape != (6, 6):
            raise ValueError(f'pose_covariance: got shape {matrix.shape}, allowed is (6, 6)')
        if not np.isfinite(matrix).all():
            raise ValueError('pose_covariance: got a number that is not finite')
        covariances = covariances + by_pose @ matrix @ by_pose.transpose(0, 2, 1)
    return np.asarray(covariances)


def range_bearing(
    positions: FloatArray,
    covariances: FloatArray,
    pose: Pose,
    dimension: int = 2,
    floor_height: float = 0.0,
    floor_deviation: float = 0.005,
) -> tuple[FloatArray, FloatArray]:
    """
    Turn floor positions into range, bearing (and elevation) from the robot (000, eq. (6) to (9)).

    Returned are values (n, dimension) and their covariances (n, dimension, dimension), to first
    order, from positions (n, 2) [m] and covariances (n, 2, 2) [m^2] on the floor. The bearing
    counts from the map's x axis. `floor_deviation` [m] keeps the covariance regular in 3D.
    """
    if dimension not in _MODELS:
        raise ValueError(f'dimension: got {dimension}, allowed 2 or 3')
    places = np.full((len(positions), 3), floor_height)
    places[:, :2] = positions
    spread = np.zeros((len(positions), 3, 3))
    spread[:, :2, :2] = covariances
    spread[:, 2, 2] = floor_deviation**2
    used = slice(dimension)
    return measured(_MODELS[dimension], places[:, used], spread[:, used, used], pose)


# Part of a marker's area that must be seen where the image's border cuts it.
_LEAST_CUT = 0.4


@dataclass(frozen=True)
class MarkerDetections:
    """Markers seen in one image, and what was left out: reason to count.

    Values (n, d) and their covariances [m, rad], from pixel noise and that of the pose; positions
    (n, 2) on the floor [m, map] and their covariances; blobs in the image.
    """

    values: FloatArray
    covariances: FloatArray
    positions: FloatArray
    position_covariances: FloatArray
    blobs: Blobs
    dropped: dict[str, int]

    def __len__(self) -> int:
        return len(self.values)


class MarkerDetector:
    """The camera as a sensor of range and bearing (001, section 6.1).

    Parameters
    ----------
    settings : CameraSettings
        Camera, mount, noise and segmentation rule.
    dimension : {2, 3}
        Of the search: range and bearing, or with elevation.
    floor_height : float
        Of the plane on which the markers lie, in the map frame [m].
    """

    def __init__(
        self, settings: CameraSettings, dimension: int = 2, floor_height: float = 0.0
    ) -> None:
        if dimension not in (2, 3):
            raise ValueError(f'dimension: got {dimension}, allowed are 2 and 3')
        self.settings = settings
        self.camera = Camera.from_settings(settings)
        self.dimension = dimension
        self.floor_height = floor_height
        rule = settings.segmentation.rule
        self._own: Detector | None = None
        if rule not in DETECTORS.own:
            self._own = DETECTORS.load(rule)(settings.segmentation.settings)
        self._pose_covariance: FloatArray | None = None
        if settings.position_noise > 0 or settings.orientation_noise > 0:
            self._pose_covariance = np.diag(
                [settings.position_noise**2] * 3 + [settings.orientation_noise**2] * 3
            )

    def detect(
        self, image: ImageArray, pose: Pose, pose_covariance: ArrayLike | None = None
    ) -> MarkerDetections:
        """Find the markers in an image.

        Parameters
        ----------
        image : ndarray, shape (h, w, 3), uint8
            R, G, B; of the size in the settings.
        pose : Pose
            Of the robot in the map frame when the image was taken.
        pose_covariance : array_like, shape (6, 6), optional
            As in ``geometry_msgs/PoseWithCovariance``; without it, the settings' deviations.

        Returns
        -------
        MarkerDetections

        Raises
        ------
        ValueError
            If the image has another size than the calibrated one, or the covariance is not finite.
        """
        return self.locate(self.segment(image), pose, pose_covariance)

    def segment(self, image: ImageArray) -> Blobs:
        """Return where markers are in an image, by the rule of the settings."""
        self.check_size(image)
        if self._own is not None:
            return self._own.detect(image)
        return segment(image, self.settings.segmentation)

    def check_size(self, image: ImageArray) -> None:
        """Raise `ValueError` for an image of another size than the calibrated one."""
        camera = self.camera
        if image.shape[:2] != (camera.height, camera.width):
            raise ValueError(
                f'image: got {image.shape[1]} x {image.shape[0]} px, allowed is the size of the '
                f'calibration, {camera.width} x {camera.height} px'
            )

    def locate(
        self, blobs: Blobs, pose: Pose, pose_covariance: ArrayLike | None = None
    ) -> MarkerDetections:
        """Find the markers that blobs in an image are; pose and covariance as in `detect`."""
        camera, settings = self.camera, self.settings
        if pose_covariance is None:
            pose_covariance = self._pose_covariance
        positions, by_pixel, by_pose = camera.back_project(blobs.centroids, pose, self.floor_height)
        on_floor = np.isfinite(positions).all(axis=1)
        # Areas and extents in the image, in those of a marker there.
        with np.errstate(invalid='ignore'):
            scale = np.abs(
                by_pixel[:, 0, 0] * by_pixel[:, 1, 1] - by_pixel[:, 0, 1] * by_pixel[:, 1, 0]
            )
            parts = 4.0 / np.pi * blobs.areas * scale / settings.marker_diameter**2
            reach = blobs.extents.max(axis=1, initial=0.0) * np.sqrt(scale)
            reach /= settings.marker_diameter
        sized = np.ones(len(blobs), dtype=bool)
        if settings.segmentation.rule == 'robust':
            least, most = (
                settings.segmentation.minimum_diameter,
                settings.segmentation.maximum_diameter,
            )
            # Of a marker that the border cuts enough must be left to tell it from other things.
            sized = (parts <= most**2) & (parts >= np.where(blobs.border_cut, _LEAST_CUT, least**2))
            sized &= ~blobs.border_cut | (reach <= most)
        whole = ~blobs.border_cut if settings.cut_blobs == 'drop' else np.ones(len(blobs), bool)
        dropped = {
            'not on the floor': int(np.count_nonzero(~on_floor)),
            'size': int(np.count_nonzero(on_floor & ~sized)),
            'cut by the border': int(np.count_nonzero(on_floor & sized & ~whole)),
        }
        keep = on_floor & sized & whole
        blobs, positions = blobs.select(keep), positions[keep]
        pixel_covariances = blobs.covariances + settings.pixel_noise**2 * np.eye(2)
        if blobs.border_cut.any():
            # A cut marker's centroid is off by up to its radius: a uniform error, in any direction.
            radius = 0.5 * settings.marker_diameter * camera.pixels_per_metre(pose)
            pixel_covariances[blobs.border_cut] += radius**2 / 3.0 * np.eye(2)
        covariances = propagate(by_pixel[keep], pixel_covariances, by_pose[keep], pose_covariance)
        values, value_covariances = range_bearing(
            positions, covariances, pose, self.dimension, self.floor_height
        )
        return MarkerDetections(values, value_covariances, positions, covariances, blobs, dropped)


def read_markers(
    picture: ImageArray | Blobs, pose: StampedPose, detector: MarkerDetector, sensor: Sensor
) -> SensorReading:
    """Return the markers in a decoded image, or blobs: segmentation, projection, field of view.

    Driver and in-process search call this same function. An all-zero covariance of the pose is
    unknown. `ValueError` for an image of another size than the calibrated one.
    """
    if not isinstance(picture, Blobs):
        picture = detector.segment(picture)
    covariance = pose.covariance if pose.covariance.any() else None
    markers = detector.locate(picture, pose.pose, covariance)
    # On the floor, z = 0.
    positions = np.pad(markers.positions, ((0, 0), (0, sensor.dimension - 2)))
    labels = tuple(Label(identity=name) for name in markers.blobs.identities)
    reading = SensorReading(markers.values, markers.covariances, positions, markers.dropped, labels)
    return reading.in_field_of_view(sensor, pose.pose)


def warm_up() -> None:
    """Run segmentation and projection once, so that the first image is not late."""
    image = np.full((120, 160, 3), 120, dtype=np.uint8)
    image[58:63, 78:83] = (20, 40, 160)
    for rule in ('paper', 'robust'):
        segmentation = SegmentationSettings.model_validate({'rule': rule})
        detector = MarkerDetector(CameraSettings(segmentation=segmentation))
        detector.detect(image, Pose.from_yaw([0.0, 0.0, 1.0], 0.0))
