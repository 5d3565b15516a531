"""Image messages as arrays."""

from array import array

import numpy as np
import pytest

from maasi_drivers.image_encoding import COLOUR_ENCODINGS, image_to_array

CHANNELS = {'rgb8': 'RGB', 'bgr8': 'BGR', 'rgba8': 'RGBA', 'bgra8': 'BGRA'}


def _message(encoding, padding, height=3, width=5):
    """Bytes of an image whose channel c at (row, column) is 40 c + 8 row + column."""
    order = {'R': 0, 'G': 1, 'B': 2, 'A': 3}
    rows, columns = np.mgrid[:height, :width]
    planes = [40 * order[name] + 8 * rows + columns for name in CHANNELS[encoding]]
    pixels = np.stack(planes, axis=2).astype(np.uint8).reshape(height, -1)
    padded = np.pad(pixels, ((0, 0), (0, padding)), constant_values=255)
    return padded.shape[1], padded.tobytes()


@pytest.mark.parametrize('encoding', COLOUR_ENCODINGS)
@pytest.mark.parametrize('padding', [0, 7])
@pytest.mark.parametrize('container', [bytes, bytearray, memoryview, lambda b: array('B', b)])
def test_channels_come_out_in_rgb_order_without_the_padding(encoding, padding, container):
    step, data = _message(encoding, padding)
    image = image_to_array(3, 5, encoding, step, container(data))
    rows, columns = np.mgrid[:3, :5]
    assert image.shape == (3, 5, 3)
    assert image.dtype == np.uint8
    for channel in range(3):
        np.testing.assert_array_equal(image[..., channel], 40 * channel + 8 * rows + columns)


@pytest.mark.parametrize(
    'encoding', ['mono8', 'mono16', '16UC1', 'bayer_rggb8', 'nv12', '', 'RGB8']
)
def test_encodings_without_colour_or_unknown_are_refused_by_name(encoding):
    with pytest.raises(ValueError, match=f"encoding: got '{encoding}', allowed rgb8, bgr8"):
        image_to_array(3, 5, encoding, 15, bytes(45))


@pytest.mark.parametrize(
    ('height', 'width', 'step', 'size', 'word'),
    [
        (0, 5, 15, 0, 'height'),
        (3, 0, 0, 0, 'width'),
        (3, -1, 15, 45, 'width'),
        (100_000, 5, 15, 45, 'height'),
        (3, 5, 14, 42, 'step'),
        (3, 5, 15, 44, 'data'),
        (3, 5, 15, 46, 'data'),
        (3, 5, 15, 0, 'data'),
    ],
)
def test_sizes_that_do_not_fit_are_refused(height, width, step, size, word):
    with pytest.raises(ValueError, match=f'image {word}: got .* allowed'):
        image_to_array(height, width, 'rgb8', step, bytes(size))
