"""Image messages as arrays."""

from array import array

import cv2
import numpy as np
import pytest

from maasi_drivers.vision.images import COLOUR_ENCODINGS, image_to_array

CHANNELS = {'rgb8': 'RGB', 'bgr8': 'BGR', 'rgba8': 'RGBA', 'bgra8': 'BGRA'}


def _message(encoding, padding, height=3, width=5):
    """Bytes of an image whose channel c at (row, column) is 40 c + 8 row + column."""
    rows, columns = np.mgrid[:height, :width]
    planes = [40 * 'RGBA'.index(name) + 8 * rows + columns for name in CHANNELS[encoding]]
    pixels = np.stack(planes, axis=2).astype(np.uint8).reshape(height, -1)
    padded = np.pad(pixels, ((0, 0), (0, padding)), constant_values=255)
    return padded.shape[1], padded.tobytes()


@pytest.mark.parametrize('encoding', CHANNELS)
@pytest.mark.parametrize('padding', [0, 7])
@pytest.mark.parametrize('container', [bytes, memoryview, lambda b: array('B', b)])
def test_channels_come_out_in_rgb_order_without_the_padding(encoding, padding, container):
    step, data = _message(encoding, padding)
    image = image_to_array(3, 5, encoding, step, container(data))
    rows, columns = np.mgrid[:3, :5]
    expected = np.stack([40 * channel + 8 * rows + columns for channel in range(3)], axis=2)
    assert image.dtype == np.uint8
    np.testing.assert_array_equal(image, expected)


# A smooth picture: what subsampling loses is little.
ROWS, COLUMNS = np.mgrid[:24, :32]
SMOOTH = np.stack([40 + 4 * ROWS, 200 - 3 * COLUMNS, 60 + 2 * ROWS + 2 * COLUMNS], axis=2).astype(
    np.uint8
)


def luminance_and_colour():
    planar = cv2.cvtColor(SMOOTH, cv2.COLOR_RGB2YUV_I420).reshape(-1)
    size = SMOOTH[..., 0].size
    half = (12, 16)
    return (
        planar[:size].reshape(24, 32),
        planar[size : size + size // 4].reshape(half),
        planar[size + size // 4 :].reshape(half),
    )


def encoded(encoding):
    """Return rows of bytes, by the layouts of sensor_msgs and not by the code under test."""
    if encoding.startswith('bayer'):
        pattern = np.array(['rgb'.index(name) for name in encoding[6:10]]).reshape(2, 2)
        channel = np.tile(pattern, (12, 16))
        return np.take_along_axis(SMOOTH, channel[..., None], axis=2)[..., 0]
    light, u, v = luminance_and_colour()
    if encoding in ('nv12', 'nv21'):
        pair = (u, v) if encoding == 'nv12' else (v, u)
        return np.concatenate([light, np.stack(pair, axis=2).reshape(12, 32)])
    colour = np.repeat(np.stack([u, v], axis=2).reshape(12, 32), 2, axis=0)
    order = (colour, light) if encoding in ('uyvy', 'yuv422') else (light, colour)
    return np.stack(order, axis=2).reshape(24, 64)


@pytest.mark.parametrize('encoding', sorted(set(COLOUR_ENCODINGS) - set(CHANNELS)))
@pytest.mark.parametrize('padding', [0, 6])
def test_what_cameras_of_small_computers_send_is_decoded(encoding, padding):
    rows = np.pad(encoded(encoding), ((0, 0), (0, padding)), constant_values=255)
    image = image_to_array(24, 32, encoding, rows.shape[1], rows.tobytes())
    assert image.shape == SMOOTH.shape
    inner = np.s_[2:-2, 2:-2]
    assert np.abs(image[inner].astype(int) - SMOOTH[inner]).max() <= 8


@pytest.mark.parametrize(
    ('encoding', 'height', 'width', 'step', 'size', 'text'),
    [
        ('yuyv', 4, 5, 10, 40, 'size: got .* allowed are even numbers'),
        ('nv12', 5, 4, 8, 40, 'size: got .* allowed are even numbers'),
        ('mono8', 3, 5, 15, 45, "encoding: got 'mono8', allowed rgb8, bgr8"),
        ('RGB8', 3, 5, 15, 45, "encoding: got 'RGB8', allowed rgb8, bgr8"),
        ('rgb8', 0, 5, 15, 0, 'height: got .* allowed'),
        ('rgb8', 3, -1, 15, 45, 'width: got .* allowed'),
        ('rgb8', 100_000, 5, 15, 45, 'height: got .* allowed'),
        ('rgb8', 3, 5, 14, 42, 'step: got .* allowed'),
        ('rgb8', 3, 5, 15, 44, 'data: got .* allowed'),
        ('rgb8', 3, 5, 15, 46, 'data: got .* allowed'),
    ],
)
def test_what_does_not_fit_is_refused(encoding, height, width, step, size, text):
    with pytest.raises(ValueError, match=f'image {text}'):
        image_to_array(height, width, encoding, step, bytes(size))
