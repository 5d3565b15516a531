"""Fiducial markers: from a picture of printed ones to detections with identities."""

import cv2
import numpy as np
import pytest
from marker_view import drone_camera
from numpy.testing import assert_allclose

from maasi_drivers.agent.odometry import StampedPose
from maasi_drivers.vision.marker_detector import MarkerDetector, read_markers
from maasi_filter.models.pose import Pose
from maasi_filter.settings import SensorSettings

SIDE = 0.08
PIXELS = 240


def photograph(camera, pose, markers, dictionary):
    """Return a camera's picture of a white floor with markers: id to centre [m]."""
    picture = np.full((camera.height, camera.width, 3), 230, np.uint8)
    printed = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f'DICT_{dictionary}'))
    for number, centre in markers.items():
        sheet = cv2.aruco.generateImageMarker(printed, number, PIXELS)
        half = 0.5 * SIDE
        corners = half * np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]])
        seen = camera.project(corners + np.array([*centre, 0.0]), pose).astype(np.float32)
        end = PIXELS - 0.5
        sheet_corners = np.array([[-0.5, -0.5], [end, -0.5], [end, end], [-0.5, end]], np.float32)
        turn = cv2.getPerspectiveTransform(sheet_corners, seen)
        size = (camera.width, camera.height)
        warped = cv2.warpPerspective(sheet, turn, size, flags=cv2.INTER_AREA)
        mask = cv2.warpPerspective(np.full_like(sheet, 255), turn, size)
        picture[mask > 127] = warped[mask > 127, None]
    return cv2.GaussianBlur(picture, (3, 3), 0.6)


@pytest.mark.parametrize('dictionary', ['4X4_50', 'APRILTAG_36h11'])
def test_markers_are_located_and_named(dictionary):
    settings = drone_camera(
        width=640,
        height=480,
        focal_length=[520.0, 520.0],
        marker_diameter=SIDE,
        segmentation={'rule': 'aruco', 'dictionary': dictionary},
    )
    detector = MarkerDetector(settings)
    pose = Pose.from_yaw([0.1, 0.2, 1.0], 0.6)
    markers = {7: (0.2, 0.15), 31: (0.02, 0.3)}
    picture = photograph(detector.camera, pose, markers, dictionary)
    sensor = SensorSettings(
        detection={'kind': 'box', 'lower': [-0.5] * 2, 'upper': [0.5] * 2, 'probability': 0.9}
    ).build('drone', 2)
    reading = read_markers(picture, StampedPose(0, pose), detector, sensor)
    seen = {label.identity: position for label, position in zip(reading.labels, reading.positions)}
    assert sorted(seen) == sorted(f'{dictionary}:{number}' for number in markers)
    for number, centre in markers.items():
        assert_allclose(seen[f'{dictionary}:{number}'], centre, atol=0.001)


def test_a_floor_without_markers_shows_none():
    settings = drone_camera(segmentation={'rule': 'aruco'})
    noise = np.random.default_rng(1).integers(90, 160, (settings.height, settings.width, 3))
    seen = MarkerDetector(settings).detect(noise.astype(np.uint8), Pose([0.0, 0.0, 1.0]))
    assert len(seen.values) == 0 and seen.labels == ()
