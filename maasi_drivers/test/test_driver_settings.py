"""Settings of drivers, and calibrations of cameras."""

import math

import pytest
from numpy.testing import assert_allclose
from pydantic import ValidationError

from maasi_drivers.settings.camera import CameraSettings, load_calibration
from maasi_drivers.settings.driver import DriverSettings
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


def test_a_calibration_replaces_the_intrinsics_and_keeps_the_rest(tmp_path):
    settings = CameraSettings(marker_diameter=0.05)
    # The centre of the image is the optical centre unless told otherwise.
    matrix = Camera.from_settings(settings).matrix
    assert_allclose(matrix, [[260.0, 0.0, 79.5], [0.0, 260.0, 59.5], [0.0, 0.0, 1.0]])
    path = tmp_path / 'mambo.yaml'
    path.write_text(CALIBRATION)
    told = settings.with_calibration(160, 120, K, D)
    for calibrated in (told, load_calibration(path, settings)):
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
        ({'d': [1e308] * 4}, 'distortion'),
        ({'width': 2**32 - 1}, 'width'),
        ({'k': [1e300, *K[1:]]}, 'focal_length'),
    ],
)
def test_an_unfit_camera_info_is_refused(changes, message):
    values = {'width': 160, 'height': 120, 'k': K, 'd': D} | changes
    with pytest.raises(ValueError, match=message):
        CameraSettings().with_calibration(**values)


@pytest.mark.parametrize(
    'text',
    [
        *('', 'image_width: 160', '[1, 2]', 'a: ['),
        *(CALIBRATION.replace(*pair) for pair in (('plumb_bob', 'fisheye'), ('160', 'wide'))),
    ],
)
def test_a_wrong_calibration_file_is_named(tmp_path, text):
    path = tmp_path / 'wrong.yaml'
    path.write_text(text)
    with pytest.raises(ValueError, match=r'wrong\.yaml: '):
        load_calibration(path, CameraSettings())


@pytest.mark.parametrize(
    ('values', 'message'),
    [
        ({'lockstep': True, 'command_type': 'twist'}, 'command_type: got'),
        ({'lockstep': True, 'camera': {'stamp_offset': 0.01}}, 'stamp_offset: got'),
        ({'lockstep': True, 'pose_source': 'tf'}, 'pose_source: got'),
        ({'lockstep': True, 'pose_source': 'pose'}, 'pose_source: got'),
        ({'link': 'mambo_wifi', 'pose_source': 'tf'}, 'pose_source: got'),
        ({'link': 'mambo_wifi', 'pose_source': 'pose'}, 'pose_source: got'),
        ({'lockstep': True, 'link': 'mavlink'}, 'link: got'),
        ({'lockstep': True, 'image_source': 'feed'}, 'image_source: got'),
        ({'image_source': 'video'}, 'video: got'),
        ({'video': '/dev/video0'}, 'video: got'),
        ({'lockstep': True, 'scan': {}, 'motion': {'model': 'unicycle'}}, 'scan: got'),
        ({'lockstep': True, 'navigation': 'nav2'}, 'navigation: got'),
        ({'scan': {}, 'motion': {'model': 'mambo'}}, 'scan: got'),
        ({'mambo': {'geofence': [[0.0, 1.0], [1.0, 0.0], [0.0, 1.0]]}}, 'lowest below a highest'),
        ({'mavlink': {'geofence': [[0.0, 1.0], [0.0, 0.0], [0.0, 1.0]]}}, 'lowest below a highest'),
        ({'mavlink': {'system': 9, 'own_system': 9}}, 'own_system: got'),
        ({'mavlink': {'lead': math.nan}}, 'mavlink.lead'),
        ({'camera': {'focal_length': [260.0]}}, 'camera.focal_length'),
        ({'camera': {'distortion': [0.1, 0.2, 0.3]}}, 'distortion: got'),
        ({'camera': {'segmentation': {'rule': 'magic'}}}, 'segmentation.rule'),
        ({'camera': {'segmentation': {'threshold': math.nan}}}, 'segmentation.threshold'),
        ({'camera': {'segmentation': {'peak_saturation': 0.1}}}, 'peak_saturation: got'),
        ({'camera': {'segmentation': {'maximum_diameter': 0.5}}}, 'maximum_diameter: got'),
    ],
)
def test_what_is_wrong_or_does_not_go_together_is_refused(values, message):
    with pytest.raises(ValidationError, match=message):
        DriverSettings.model_validate({'environment': {'bounds': [[0, 2], [0, 2]]}} | values)
