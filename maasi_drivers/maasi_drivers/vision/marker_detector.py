"""From a camera image and the robot's pose to detections: segmentation and projection in one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from maasi_drivers.vision.blobs import Blobs
from maasi_drivers.vision.camera_model import Camera
from maasi_drivers.vision.camera_settings import DETECTORS, CameraSettings
from maasi_drivers.vision.detector import Detector
from maasi_drivers.vision.projection import propagate, range_bearing
from maasi_drivers.vision.segmentation import segment
from maasi_filter.models.pose import Pose

Array = NDArray[np.float64]

# Part of a marker's area that must be seen where the image's border cuts it.
_LEAST_CUT = 0.4


@dataclass(frozen=True)
class MarkerDetections:
    """Markers seen in one image.

    Attributes
    ----------
    values : ndarray, shape (n, d)
        Range [m], bearing from the map's x axis [rad], in 3D elevation [rad].
    covariances : ndarray, shape (n, d, d)
        Of the values, from pixel noise and the pose's covariance.
    positions : ndarray, shape (n, 2)
        On the floor, map frame [m].
    position_covariances : ndarray, shape (n, 2, 2)
        [m^2].
    blobs : Blobs
        Where they are in the image.
    dropped : dict
        Blobs left out: reason to count.
    """

    values: Array
    covariances: Array
    positions: Array
    position_covariances: Array
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
        self._pose_covariance: Array | None = None
        if settings.position_noise > 0 or settings.orientation_noise > 0:
            self._pose_covariance = np.diag(
                [settings.position_noise**2] * 3 + [settings.orientation_noise**2] * 3
            )

    def detect(
        self, image: NDArray[np.uint8], pose: Pose, pose_covariance: ArrayLike | None = None
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

    def segment(self, image: NDArray[np.uint8]) -> Blobs:
        """Return where markers are in an image, by the rule of the settings.

        Raises
        ------
        ValueError
            If the image has another size than the calibrated one.
        """
        self.check_size(image)
        if self._own is not None:
            return self._own.detect(image)
        return segment(image, self.settings.segmentation)

    def check_size(self, image: NDArray[np.uint8]) -> None:
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
        """Find the markers that blobs in an image are; pose and covariance as in `detect`.

        Raises
        ------
        ValueError
            If the covariance is not finite.
        """
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
