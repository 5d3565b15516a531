"""Image messages as arrays."""

from array import array
from functools import partial
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from maasi_drivers.vision.images import COLOUR_ENCODINGS, image_to_array

CHANNELS = {'rgb8': 'RGB', 'bgr8': 'BGR', 'rgba8': 'RGBA', 'bgra8': 'BGRA'}
# A smooth picture: what subsampling loses is little.
ROWS, COLUMNS = np.mgrid[:24, :32]
SMOOTH = np.stack([40 + 4 * ROWS, 200 - 3 * COLUMNS, 60 + 2 * ROWS + 2 * COLUMNS], axis=2)
SMOOTH = SMOOTH.astype(np.uint8)


def message(encoding, height, width, step, data):
    return SimpleNamespace(encoding=encoding, height=height, width=width, step=step, data=data)


def encoded(encoding):
    """Return rows of bytes, by the layouts of sensor_msgs and not by the code under test."""
    if encoding in CHANNELS:
        planes = dict(zip('RGBA', np.moveaxis(np.pad(SMOOTH, ((0, 0), (0, 0), (0, 1))), 2, 0)))
        return np.stack([planes[name] for name in CHANNELS[encoding]], axis=2).reshape(24, -1)
    if encoding.startswith('bayer'):
        pattern = np.array(['rgb'.index(name) for name in encoding[6:10]]).reshape(2, 2)
        channel = np.tile(pattern, (12, 16))
        return np.take_along_axis(SMOOTH, channel[..., None], axis=2)[..., 0]
    planar = cv2.cvtColor(SMOOTH, cv2.COLOR_RGB2YUV_I420).reshape(-1)
    light = planar[: 24 * 32].reshape(24, 32)
    u, v = planar[24 * 32 :].reshape(2, 12, 16)
    if encoding in ('nv12', 'nv21'):
        pair = (u, v) if encoding == 'nv12' else (v, u)
        return np.concatenate([light, np.stack(pair, axis=2).reshape(12, 32)])
    colour = np.repeat(np.stack([u, v], axis=2).reshape(12, 32), 2, axis=0)
    order = (colour, light) if encoding in ('uyvy', 'yuv422') else (light, colour)
    return np.stack(order, axis=2).reshape(24, 64)


@pytest.mark.parametrize('encoding', COLOUR_ENCODINGS)
@pytest.mark.parametrize('padding', [0, 6])
def test_what_cameras_send_is_decoded_without_the_padding(encoding, padding):
    rows = np.pad(encoded(encoding), ((0, 0), (0, padding)), constant_values=255)
    for container in (bytes, memoryview, partial(array, 'B')):
        data = container(rows.tobytes())
        image = image_to_array(message(encoding, 24, 32, rows.shape[1], data))
        assert image.shape == SMOOTH.shape and image.dtype == np.uint8
        inner = np.s_[2:-2, 2:-2]
        error = np.abs(image[inner].astype(int) - SMOOTH[inner]).max()
        assert error <= (0 if encoding in CHANNELS else 8)


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
        image_to_array(message(encoding, height, width, step, bytes(size)))
