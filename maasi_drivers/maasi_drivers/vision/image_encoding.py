"""Image messages as arrays: dimensions, channel order and row padding checked."""

from __future__ import annotations

from array import array

import cv2
import numpy as np
from numpy.typing import NDArray

# Encoding (sensor_msgs/image_encodings) to bytes per pixel in a row and, if those are not R, G, B,
# the conversion.
_ENCODINGS: dict[str, tuple[int, int | None]] = {
    'rgb8': (3, None),
    'bgr8': (3, cv2.COLOR_BGR2RGB),
    'rgba8': (4, cv2.COLOR_RGBA2RGB),
    'bgra8': (4, cv2.COLOR_BGRA2RGB),
    # Luminance at each pixel, colour at every other one.
    'yuv422': (2, cv2.COLOR_YUV2RGB_UYVY),
    'uyvy': (2, cv2.COLOR_YUV2RGB_UYVY),
    'yuv422_yuy2': (2, cv2.COLOR_YUV2RGB_YUY2),
    'yuyv': (2, cv2.COLOR_YUV2RGB_YUY2),
    # A plane of luminance, then one of colour with half its rows.
    'nv12': (1, cv2.COLOR_YUV2RGB_NV12),
    'nv21': (1, cv2.COLOR_YUV2RGB_NV21),
    # One colour at each pixel; OpenCV names the pattern by its second row.
    'bayer_rggb8': (1, cv2.COLOR_BayerBG2RGB),
    'bayer_bggr8': (1, cv2.COLOR_BayerRG2RGB),
    'bayer_gbrg8': (1, cv2.COLOR_BayerGR2RGB),
    'bayer_grbg8': (1, cv2.COLOR_BayerGB2RGB),
}
_SUBSAMPLED = ('nv12', 'nv21')
COLOUR_ENCODINGS = tuple(_ENCODINGS)
_MAXIMUM_SIDE = 16384


def image_to_array(
    height: int,
    width: int,
    encoding: str,
    step: int,
    data: bytes | bytearray | memoryview | array | NDArray[np.uint8],
) -> NDArray[np.uint8]:
    """Turn the fields of a ``sensor_msgs/Image`` into an RGB array.

    Parameters
    ----------
    height, width : int
        Rows and columns [px].
    encoding : str
        One of ``COLOUR_ENCODINGS``.
    step : int
        Length of a full row [bytes]; more than what ``width`` pixels take if rows are padded.
    data : bytes-like
        ``step * height`` bytes; half as much again for nv12 and nv21.

    Returns
    -------
    ndarray, shape (height, width, 3), uint8
        Channels in the order R, G, B, rows contiguous or strided by ``step``. A read-only view of
        ``data`` where nothing has to be converted.

    Raises
    ------
    ValueError
        On a size of zero, an encoding without colour or unknown, an odd size where colours are
        subsampled, a step too short for the width, or data of another length.
    """
    for name, value in (('height', height), ('width', width)):
        if not 0 < value <= _MAXIMUM_SIDE:
            raise ValueError(f'image {name}: got {value}, allowed 1 to {_MAXIMUM_SIDE} px')
    if encoding not in _ENCODINGS:
        raise ValueError(
            f"image encoding: got '{encoding}', allowed {', '.join(COLOUR_ENCODINGS)} "
            '(the markers are told by their colour)'
        )
    size, conversion = _ENCODINGS[encoding]
    halved = encoding in _SUBSAMPLED
    odd = (size == 2 or halved) and width % 2, halved and height % 2
    if any(odd):
        raise ValueError(
            f'image size: got {width} x {height} px, allowed are even numbers with {encoding}'
        )
    if step < width * size:
        raise ValueError(
            f'image step: got {step} bytes, allowed at least {width * size} '
            f'({width} px of {encoding})'
        )
    flat = np.frombuffer(data, dtype=np.uint8)
    rows = height * 3 // 2 if halved else height
    if flat.size != step * rows:
        raise ValueError(
            f'image data: got {flat.size} bytes, allowed exactly {step * rows} '
            f'(step {step} times {rows} rows)'
        )
    pixels = flat.reshape(rows, step)[:, : width * size].reshape(rows, width, size)
    if conversion is None:
        return pixels
    return np.asarray(cv2.cvtColor(np.ascontiguousarray(pixels), conversion), dtype=np.uint8)


def decode_image(
    data: bytes | bytearray | array | NDArray[np.uint8], kind: str
) -> NDArray[np.uint8]:
    """Decode the data of a ``sensor_msgs/CompressedImage``.

    Parameters
    ----------
    data : bytes-like
        JPEG, PNG, ...
    kind : str
        Its format, for messages.

    Returns
    -------
    ndarray, shape (height, width, 3), uint8
        R, G, B.

    Raises
    ------
    ValueError
        If it is nothing that OpenCV decodes.
    """
    flat = np.frombuffer(data, np.uint8)
    image = cv2.imdecode(flat, cv2.IMREAD_COLOR) if flat.size else None
    if image is None:
        raise ValueError(
            f"image: got {flat.size} bytes of '{kind}', allowed is what OpenCV decodes"
        )
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), dtype=np.uint8)
