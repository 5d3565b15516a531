"""Settings of drivers, and calibrations of cameras."""

import math
from types import SimpleNamespace

import numpy as np
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
        ({'distortion_model': 'equidistant'}, 'allowed with equidistant are 0, 4'),
        ({'distortion_model': 'fov'}, "distortion_model: got 'fov', allowed plumb_bob or"),
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


def info(width, height, d=(), model='plumb_bob', roi=(0, 0, 0, 0), bins=(0, 0)):
    """Return what a driver or a recording has of a `sensor_msgs/CameraInfo`."""
    region = SimpleNamespace(**dict(zip(('x_offset', 'y_offset', 'width', 'height'), roi)))
    values = {'width': width, 'height': height, 'k': K, 'd': list(d), 'distortion_model': model}
    return SimpleNamespace(**values, roi=region, binning_x=bins[0], binning_y=bins[1])


@pytest.mark.parametrize('seed', range(8))
def test_images_of_a_region_and_of_binned_pixels_are_of_the_same_camera(seed):
    generator = np.random.default_rng([46, seed])
    bins, start = generator.integers(1, 5, 2), generator.integers(0, 40, 2)
    size = bins * generator.integers(8, 20, 2)
    model, d = [('plumb_bob', D), ('rational_polynomial', [*D, 0.1, 0.02, 0.0])][seed % 2]
    whole = Camera.from_settings(CameraSettings().with_camera_info(info(160, 120, d, model)))
    message = info(160, 120, d, model, (*start, *size), bins)
    part = Camera.from_settings(CameraSettings().with_camera_info(message))
    assert [part.width, part.height] == (size // bins).tolist()
    # The middle of a binned pixel is that of the pixels which it consists of.
    binned = generator.integers(0, size // bins, (50, 2))
    pixels = start + bins * binned + 0.5 * (bins - 1)
    assert_allclose(part.undistort(binned)[0], whole.undistort(pixels)[0], atol=1e-9)
    # All zeros: the whole image.
    given = CameraSettings().with_camera_info(info(160, 120, D))
    assert given == CameraSettings().with_calibration(160, 120, K, D)


@pytest.mark.parametrize(
    ('message', 'said'),
    [
        (info(160, 120, roi=(100, 0, 80, 100)), '^roi: got pixels 100 to 180 along x'),
        (info(160, 120, roi=(0, 200, 0, 0)), '^roi: got pixels 200 to|^height'),
        (info(160, 120, bins=(100, 1)), '^width: '),
        (info(0, 0), '^width: '),
        (info(160, 120, D, 'equidistant'), '^distortion: got 5 coefficients, allowed with equi'),
        (info(160, 120, [0.1] * 7, 'rational_polynomial'), 'rational_polynomial are 0, 8, 12, 14'),
    ],
)
def test_a_camera_info_that_cannot_be_used_is_refused_in_one_line(message, said):
    with pytest.raises(ValueError, match=said) as error:
        CameraSettings().with_camera_info(message)
    assert '\n' not in str(error.value) and 'pydantic' not in str(error.value)


def test_zeros_are_no_distortion_however_many():
    given = CameraSettings().with_camera_info(info(160, 120, [0.0] * 8))
    assert given.distortion == [] and given.distortion_model == 'plumb_bob'


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
        ({'mambo': {'geofence': [[0.0, 1.0], [1.0, 0.0], [0.0, 1.0]]}}, 'lower < upper'),
        ({'mavlink': {'geofence': [[0.0, 1.0], [0.0, 0.0], [0.0, 1.0]]}}, 'lower < upper'),
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
