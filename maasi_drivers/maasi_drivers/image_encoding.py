"""Image messages as arrays: dimensions, channel order and row padding checked."""

from __future__ import annotations

from array import array

import cv2
import numpy as np
from numpy.typing import NDArray

# Encoding (sensor_msgs/image_encodings) to channels and, if they are not R, G, B, the conversion.
_ENCODINGS: dict[str, tuple[int, int | None]] = {
    'rgb8': (3, None),
    'bgr8': (3, cv2.COLOR_BGR2RGB),
    'rgba8': (4, cv2.COLOR_RGBA2RGB),
    'bgra8': (4, cv2.COLOR_BGRA2RGB),
}
COLOUR_ENCODINGS = tuple(_ENCODINGS)
_MAXIMUM_SIDE = 16384


def image_to_array(
    height: int,
    width: int,
    encoding: str,
    step: int,
    data: bytes | bytearray | memoryview | array | NDArray[np.uint8],
) -> NDArray[np.uint8]:
    """
    Turn the fields of a ``sensor_msgs/Image`` into an RGB array.

    Parameters
    ----------
    height, width : int
        Rows and columns [px].
    encoding : str
        One of ``COLOUR_ENCODINGS``.
    step : int
        Length of a full row [bytes]; more than ``width`` times the channels if rows are padded.
    data : bytes-like
        ``step * height`` bytes.

    Returns
    -------
    ndarray, shape (height, width, 3), uint8
        Channels in the order R, G, B, rows contiguous or strided by ``step``. A read-only view of
        ``data`` where nothing has to be converted.

    Raises
    ------
    ValueError
        On a size of zero, an encoding without colour or unknown, a step too short for the width, or
        data of another length.

    """
    for name, value in (('height', height), ('width', width)):
        if not 0 < value <= _MAXIMUM_SIDE:
            raise ValueError(f'image {name}: got {value}, allowed 1 to {_MAXIMUM_SIDE} px')
    if encoding not in _ENCODINGS:
        raise ValueError(
            f"image encoding: got '{encoding}', allowed {', '.join(COLOUR_ENCODINGS)} "
            '(the markers are told by their colour)'
        )
    channels, conversion = _ENCODINGS[encoding]
    if step < width * channels:
        raise ValueError(
            f'image step: got {step} bytes, allowed at least {width * channels} '
            f'({width} px of {encoding})'
        )
    flat = np.frombuffer(data, dtype=np.uint8)
    if flat.size != step * height:
        raise ValueError(
            f'image data: got {flat.size} bytes, allowed exactly {step * height} '
            f'(step {step} times height {height})'
        )
    rows = flat.reshape(height, step)[:, : width * channels].reshape(height, width, channels)
    if conversion is None:
        return rows
    return np.asarray(cv2.cvtColor(np.ascontiguousarray(rows), conversion), dtype=np.uint8)
