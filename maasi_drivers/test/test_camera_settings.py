"""Camera settings and calibrations."""

import pytest
from numpy.testing import assert_allclose
from pydantic import ValidationError

from maasi_drivers.settings.camera import CameraSettings, load_calibration
from maasi_drivers.vision.camera_model import Camera

K = [250.0, 0.0, 81.0, 0.0, 251.0, 62.0, 0.0, 0.0, 1.0]
D = [-0.2, 0.05, 0.001, -0.002, 0.0]
CALIBRATION = """
image_width: 160
image_height: 120
camera_name: mambo
camera_matrix: {rows: 3, cols: 3, data: [250.0, 0.0, 81.0, 0.0, 251.0, 62.0, 0.0, 0.0, 1.0]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [-0.2, 0.05, 0.001, -0.002, 0.0]}
"""


def test_the_centre_of_the_image_is_the_optical_centre_unless_told_otherwise():
    view = Camera.from_settings(CameraSettings(width=160, height=120))
    assert_allclose(view.matrix, [[260.0, 0.0, 79.5], [0.0, 260.0, 59.5], [0.0, 0.0, 1.0]])


def test_camera_info_replaces_the_intrinsics_and_keeps_the_rest():
    settings = CameraSettings(marker_diameter=0.05)
    calibrated = settings.with_calibration(160, 120, K, D)
    view = Camera.from_settings(calibrated)
    assert_allclose(view.matrix, [[250, 0, 81], [0, 251, 62], [0, 0, 1]])
    assert_allclose(view.distortion, D)
    assert calibrated.marker_diameter == 0.05
    assert calibrated.mount == settings.mount


@pytest.mark.parametrize(
    ('changes', 'message'),
    [
        ({'k': K[:8]}, 'k: got 8 numbers, allowed 9'),
        ({'k': [0.0] * 9}, 'k: got'),
        ({'k': [250.0, 3.0, *K[2:]]}, 'k: got'),
        ({'k': [float('nan'), *K[1:]]}, 'focal_length'),
        ({'d': [0.1] * 8}, 'distortion: got 8 coefficients'),
        ({'d': [float('inf')] * 5}, 'distortion'),
        ({'distortion_model': 'equidistant'}, "distortion_model: got 'equidistant'"),
        ({'width': 0}, 'width'),
        ({'d': [1e308] * 4}, 'd .distortion.: got'),
        ({'width': 2**32 - 1}, 'width, height: got'),
        ({'k': [1e300, *K[1:]]}, 'focal_length'),
    ],
)
def test_an_unfit_camera_info_is_refused(changes, message):
    values = {'width': 160, 'height': 120, 'k': K, 'd': D} | changes
    with pytest.raises(ValueError, match=message):
        CameraSettings().with_calibration(**values)


def test_a_calibration_file_is_read(tmp_path):
    path = tmp_path / 'mambo.yaml'
    path.write_text(CALIBRATION)
    settings = load_calibration(path, CameraSettings())
    assert settings.focal_length == [250.0, 251.0]
    assert settings.principal_point == [81.0, 62.0]
    assert settings.distortion == D


@pytest.mark.parametrize(
    'text',
    [
        '',
        'image_width: 160',
        '[1, 2]',
        'a: [',
        CALIBRATION.replace('plumb_bob', 'fisheye'),
        CALIBRATION.replace('160', 'wide'),
    ],
)
def test_a_wrong_calibration_file_is_named(tmp_path, text):
    path = tmp_path / 'wrong.yaml'
    path.write_text(text)
    with pytest.raises(ValueError, match=r'wrong\.yaml: '):
        load_calibration(path, CameraSettings())


@pytest.mark.parametrize(
    'values',
    [
        {'width': 0},
        {'focal_length': [260.0]},
        {'focal_length': [0.0, 260.0]},
        {'focal_length': [float('nan'), 260.0]},
        {'distortion': [0.1, 0.2, 0.3]},
        {'rate': 0.0},
        {'mount': {'rpy': [0.0, 0.0]}},
        {'focal': 3},
    ],
)
def test_wrong_settings_are_refused(values):
    with pytest.raises(ValidationError):
        CameraSettings.model_validate(values)
