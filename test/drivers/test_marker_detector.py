"""From a rendered image to detections."""

import cv2
import numpy as np
import pytest
from ideal_floor import ideal
from marker_view import drone_camera, hard_floor, one_image, score
from numpy.testing import assert_allclose

from maasi_drivers.agent.odometry import StampedPose
from maasi_drivers.vision.marker_detector import MarkerDetector, read_markers
from maasi_filter.models.pose import Pose
from maasi_filter.settings import SensorSettings
from maasi_sim.simulation.floor import RenderSettings

DOWN = Pose([0.0, 0.0, 1.0])


@pytest.mark.parametrize('rule', ['paper', 'robust'])
@pytest.mark.parametrize('dimension', [2, 3])
def test_a_marker_is_measured_to_millimetres(rule, dimension):
    settings = drone_camera(segmentation={'rule': rule})
    pose = Pose.from_yaw([0.1, 0.2, 1.0], 0.8)
    target = np.array([0.16, 0.11, 0.0])
    image = one_image(settings, [target[:2].tolist()], pose)
    seen = MarkerDetector(settings, dimension).detect(image, pose)
    offset = target - pose.position
    expected = [np.hypot(*offset[:2]), np.arctan2(offset[1], offset[0])]
    if dimension == 3:
        distance = np.linalg.norm(offset)
        expected = [distance, expected[1], np.arcsin(offset[2] / distance)]
    assert len(seen.values) == 1
    assert_allclose(seen.values[0], expected, atol=0.01)
    assert_allclose(seen.positions[0], target[:dimension], atol=0.001)
    assert seen.covariances.shape == (1, dimension, dimension)


@pytest.mark.parametrize('seed', range(900, 908))
def test_the_robust_rule_on_hard_sequences(seed):
    result = score(drone_camera(), hard_floor(seed), seed, 30)
    assert result.recall >= 0.98 and result.false_per_image <= 0.2 and result.rmse <= 0.005


@pytest.mark.parametrize('rule', ['paper', 'robust'])
def test_both_rules_on_a_moderate_floor(rule):
    result = score(drone_camera(segmentation={'rule': rule}), RenderSettings(), 31, 60)
    assert result.recall >= 0.98 and result.false_per_image <= 0.02 and result.rmse <= 0.001


@pytest.mark.parametrize(
    ('camera', 'floor', 'least'),
    [
        ({'pixel_noise': 0.03}, {'read_noise': 6.0}, 1.2),
        ({'pixel_noise': 0.03}, {'read_noise': 12.0}, 1.2),
        ({}, {'jpeg_quality': 90}, 0.0),
    ],
)
def test_covariances_are_honest_about_noise(camera, floor, least):
    result = score(drone_camera(**camera), ideal(blur=0.5, **floor), 32, 100)
    # Two coordinates: the mean is 2 where the covariance says what the error is.
    assert least < result.nees < 3.0


def test_a_cut_marker_is_kept_with_more_covariance_or_dropped():
    settings = drone_camera(distortion=[])
    edge = MarkerDetector(settings).camera.back_project([[80.0, 0.5]], DOWN)[0][0]
    image = one_image(settings, [edge.tolist(), [0.0, 0.0]], DOWN)
    detector = MarkerDetector(settings)
    kept = detector.detect(image, DOWN)
    assert detector.segment(image).border_cut.tolist() == [True, False]
    assert kept.covariances[0, 0, 0] > 50 * kept.covariances[1, 0, 0]
    error = kept.values[0, 0] - np.linalg.norm(edge)
    assert error**2 < 9.0 * kept.covariances[0, 0, 0]
    dropped = MarkerDetector(drone_camera(distortion=[], cut_blobs='drop')).detect(image, DOWN)
    assert len(dropped.values) == 1
    assert dropped.dropped == {'not on the floor': 0, 'size': 0, 'cut by the border': 1}


@pytest.mark.parametrize(
    ('settings', 'diameter', 'pixel', 'dropped'),
    [
        ({}, 0.08, (79.5, 59.5), 'size'),
        ({'segmentation': {'rule': 'paper'}}, 0.08, (79.5, 59.5), None),
        # The edge of something large is no cut marker.
        *(({'distortion': []}, 0.065, (80.0, row), 'size') for row in (-0.5, -0.8, -1.2)),
    ],
)
def test_markers_of_the_wrong_size_are_dropped_and_counted(settings, diameter, pixel, dropped):
    detector = MarkerDetector(drone_camera(**settings))
    place = detector.camera.back_project([pixel], DOWN)[0][0]
    floor = ideal(marker_diameter=diameter)
    seen = detector.detect(one_image(detector.settings, [place.tolist()], DOWN, floor), DOWN)
    assert len(seen.values) == (dropped is None)
    assert {reason for reason, number in seen.dropped.items() if number} == {dropped} - {None}


def test_the_pose_covariance_of_the_message_wins_over_the_settings():
    image = one_image(drone_camera(), [[0.1, 0.0]], DOWN)
    own = MarkerDetector(drone_camera(position_noise=0.02))
    variances = [
        detector.detect(image, DOWN, given).covariances[0, 0, 0]
        for detector, given in (
            (MarkerDetector(drone_camera()), None),
            (own, None),
            (own, 0.05**2 * np.eye(6)),
        )
    ]
    assert_allclose(variances[1], variances[0] + 0.02**2 * (1 + 0.1**2), rtol=0.01)
    assert variances[2] > 0.05**2


def test_blobs_above_the_horizon_are_no_detections():
    settings = drone_camera(mount={'position': [0, 0, 0.2], 'rpy': [0, 0, 0]}, distortion=[])
    image = np.full((120, 160, 3), 120, dtype=np.uint8)
    image[20:26, 40:46] = (20, 45, 160)
    seen = MarkerDetector(settings).detect(image, Pose.from_yaw([0, 0, 0.0], 0.0))
    assert len(seen.values) == 0
    assert seen.dropped['not on the floor'] == 1


# ---- fiducial markers ------------------------------------------------------------------------


def photograph(camera, pose, markers, dictionary):
    """Return a camera's picture of a white floor with markers: id to centre [m]."""
    picture = np.full((camera.height, camera.width, 3), 230, np.uint8)
    printed = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f'DICT_{dictionary}'))
    for number, centre in markers.items():
        sheet = cv2.aruco.generateImageMarker(printed, number, 240)
        corners = 0.04 * np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]])
        seen = camera.project(corners + np.array([*centre, 0.0]), pose).astype(np.float32)
        sheet_corners = np.array([[0, 0], [240, 0], [240, 240], [0, 240]], np.float32) - 0.5
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
        marker_diameter=0.08,
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
    seen = MarkerDetector(settings).detect(noise.astype(np.uint8), DOWN)
    assert len(seen.values) == 0 and seen.labels == ()
