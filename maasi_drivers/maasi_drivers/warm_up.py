"""Compile, or load from the cache, every kernel that a driver uses."""

from __future__ import annotations

import numpy as np

from maasi_drivers.vision.camera_settings import CameraSettings, SegmentationSettings
from maasi_drivers.vision.marker_detector import MarkerDetector
from maasi_filter.models.pose import Pose


def warm_up() -> None:
    """Run segmentation and projection once, so that the first image is not late."""
    image = np.full((120, 160, 3), 120, dtype=np.uint8)
    image[58:63, 78:83] = (20, 40, 160)
    # Images come as read-only views of messages too: another type to the compiler.
    view = np.frombuffer(image.tobytes(), dtype=np.uint8).reshape(image.shape)
    pose = Pose.from_yaw([0.0, 0.0, 1.0], 0.0)
    for rule in ('paper', 'robust'):
        segmentation = SegmentationSettings.model_validate({'rule': rule})
        detector = MarkerDetector(CameraSettings(segmentation=segmentation))
        for picture in (image, view):
            detector.detect(picture, pose)
        detector.camera.project([[0.0, 0.0, 0.0]], pose)
