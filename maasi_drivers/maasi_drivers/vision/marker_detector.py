"""From a camera image and the robot's pose to detections: segmentation and projection."""

import numpy as np
from numpy.typing import ArrayLike

from maasi_drivers.agent.odometry import StampedPose
from maasi_drivers.agent.sensor_reading import SensorReading, measured
from maasi_drivers.settings.camera import DETECTORS, CameraSettings
from maasi_drivers.vision.camera_model import Camera
from maasi_drivers.vision.detector import Blobs, Detector
from maasi_drivers.vision.segmentation import segment
from maasi_drivers.vision.terrain_projection import project_to_terrain
from maasi_filter.arrays import FloatArray, ImageArray
from maasi_filter.geometry.terrain import Terrain
from maasi_filter.models.measurement import RangeAndAngles
from maasi_filter.models.pose import Pose
from maasi_filter.models.sensor import Sensor


class MarkerDetector:
    """The camera as a sensor of range, bearing and (in 3D) elevation to markers on the floor.

    See paper 001, section 6.1. `terrain`: ground instead of the plane z = 0.
    """

    def __init__(
        self, settings: CameraSettings, dimension: int = 2, terrain: Terrain | None = None
    ) -> None:
        self.settings, self.terrain = settings, terrain
        self.camera = Camera.from_settings(settings)
        self._model = RangeAndAngles(dimension)
        rule = settings.segmentation.rule
        self._own: Detector | None = None
        if rule not in DETECTORS.built_in:
            self._own = DETECTORS.load(rule)(settings.segmentation.settings)
        self._pose_covariance: FloatArray | None = None
        if settings.position_noise > 0 or settings.orientation_noise > 0:
            self._pose_covariance = np.diag(
                [settings.position_noise**2] * 3 + [settings.orientation_noise**2] * 3
            )

    def segment(self, image: ImageArray) -> Blobs:
        """Return the markers in an image, by the rule of the settings."""
        self.check_size(*image.shape[1::-1])
        if self._own is not None:
            return self._own.detect(image)
        return segment(image, self.settings.segmentation)

    def check_size(self, width: int, height: int) -> None:
        """Raise `ValueError` if the image size differs from the calibration."""
        camera = self.camera
        if (width, height) != (camera.width, camera.height):
            raise ValueError(
                f'image: got {width} x {height} px, allowed is the size of the calibration, '
                f'{camera.width} x {camera.height} px'
            )

    def _back_project(
        self, pixels: ArrayLike, pose: Pose
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        if self.terrain is None:
            return self.camera.back_project(pixels, pose)
        return project_to_terrain(self.camera, pixels, pose, self.terrain)

    def detect(
        self, picture: ImageArray | Blobs, pose: Pose, pose_covariance: FloatArray | None = None
    ) -> SensorReading:
        """Detect the markers in an image, or in blobs found in it.

        First-order errors from the covariances of pixels and pose (paper 000, eq. (6) to
        (9)); without a pose covariance (6, 6), the settings' deviations count. Raises
        `ValueError` if the image size differs from the calibration.
        """
        camera, settings = self.camera, self.settings
        blobs = picture if isinstance(picture, Blobs) else self.segment(picture)
        if pose_covariance is None:
            pose_covariance = self._pose_covariance
        positions, by_pixel, by_pose = self._back_project(blobs.centroids, pose)
        on_floor = np.isfinite(positions).all(axis=1)
        # Areas and extents in the image, relative to those of a marker there.
        with np.errstate(invalid='ignore'):
            scale = np.abs(
                by_pixel[:, 0, 0] * by_pixel[:, 1, 1] - by_pixel[:, 0, 1] * by_pixel[:, 1, 0]
            )
            parts = 4.0 / np.pi * blobs.areas * scale / settings.marker_diameter**2
            reach = blobs.extents.max(axis=1, initial=0.0) * np.sqrt(scale)
            reach /= settings.marker_diameter
        # The size of a box says nothing about a marker's size.
        sized, boxes = np.ones(len(blobs), dtype=bool), settings.detections is not None
        if settings.segmentation.rule == 'robust' and not boxes:
            least = settings.segmentation.minimum_diameter
            most = settings.segmentation.maximum_diameter
            # Enough of a cut marker must remain to recognise it.
            sized = (parts <= most**2) & (parts >= np.where(blobs.border_cut, 0.4, least**2))
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
        if blobs.border_cut.any() and not boxes:
            # A cut marker's centroid is off by up to its radius: uniform error in any direction.
            middle = (camera.width - 1) / 2.0, (camera.height - 1) / 2.0
            area = np.abs(np.linalg.det(self._back_project([middle], pose)[1][0]))
            radius = 0.5 * settings.marker_diameter * float(1.0 / np.sqrt(area))
            pixel_covariances[blobs.border_cut] += radius**2 / 3.0 * np.eye(2)
        covariances = by_pixel[keep] @ pixel_covariances @ by_pixel[keep].transpose(0, 2, 1)
        if pose_covariance is not None:
            by_pose = by_pose[keep]
            covariances = covariances + by_pose @ pose_covariance @ by_pose.transpose(0, 2, 1)
        padded, spread = np.zeros((len(positions), 3)), np.zeros((len(positions), 3, 3))
        padded[:, :2] = positions
        # A floor height error of 5 mm keeps covariances regular in 3D.
        spread[:, :2, :2], spread[:, 2, 2] = covariances, 0.005**2
        used = slice(self._model.dimension)
        return SensorReading(
            *measured(self._model, padded[:, used], spread[:, used, used], pose),
            padded[:, used],
            dropped,
            blobs.labels,
        )


def read_markers(
    picture: ImageArray | Blobs, pose: StampedPose, detector: MarkerDetector, sensor: Sensor
) -> SensorReading:
    """Return the markers in a decoded image, or blobs: segmentation, projection, field of view.

    Used by driver and in-process search. An all-zero pose covariance counts as unknown. Raises
    `ValueError` if the image size differs from the calibration.
    """
    covariance = pose.covariance if pose.covariance.any() else None
    return detector.detect(picture, pose.pose, covariance).in_field_of_view(sensor, pose.pose)
