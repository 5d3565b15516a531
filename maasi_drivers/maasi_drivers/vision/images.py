"""Images as arrays, from messages, streams, devices and files. Without ROS."""

import threading
import time
from collections import deque
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from maasi_filter.arrays import ImageArray

# Encoding (sensor_msgs/image_encodings): bytes per pixel in a row, and the conversion to RGB.
_ENCODINGS: dict[str, tuple[int, int | None]] = {
    'rgb8': (3, None),
    'bgr8': (3, cv2.COLOR_BGR2RGB),
    'rgba8': (4, cv2.COLOR_RGBA2RGB),
    'bgra8': (4, cv2.COLOR_BGRA2RGB),
    # Luminance of each pixel, colour of every second one.
    'yuv422': (2, cv2.COLOR_YUV2RGB_UYVY),
    'uyvy': (2, cv2.COLOR_YUV2RGB_UYVY),
    'yuv422_yuy2': (2, cv2.COLOR_YUV2RGB_YUY2),
    'yuyv': (2, cv2.COLOR_YUV2RGB_YUY2),
    # A luminance plane, then a colour plane with half its rows.
    'nv12': (1, cv2.COLOR_YUV2RGB_NV12),
    'nv21': (1, cv2.COLOR_YUV2RGB_NV21),
    # One colour per pixel; OpenCV names the pattern by its second row.
    'bayer_rggb8': (1, cv2.COLOR_BayerBG2RGB),
    'bayer_bggr8': (1, cv2.COLOR_BayerRG2RGB),
    'bayer_gbrg8': (1, cv2.COLOR_BayerGR2RGB),
    'bayer_grbg8': (1, cv2.COLOR_BayerGB2RGB),
}
COLOUR_ENCODINGS = tuple(_ENCODINGS)
_MAXIMUM_SIDE = 16384


def image_to_array(message: Any) -> ImageArray:
    """Return the RGB array of a ``sensor_msgs/Image``, also of a recorded one."""
    height, width, step, encoding = message.height, message.width, message.step, message.encoding
    for name, value in (('height', height), ('width', width)):
        if not 0 < value <= _MAXIMUM_SIDE:
            raise ValueError(f'image {name}: got {value}, allowed 1 to {_MAXIMUM_SIDE} px')
    if encoding not in _ENCODINGS:
        raise ValueError(
            f"image encoding: got '{encoding}', allowed {', '.join(COLOUR_ENCODINGS)} "
            '(markers are detected by colour)'
        )
    size, conversion = _ENCODINGS[encoding]
    halved = encoding in ('nv12', 'nv21')
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
    flat = np.frombuffer(message.data, dtype=np.uint8)
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


def decode_image(message: Any) -> ImageArray:
    """Return the RGB array of a ``sensor_msgs/CompressedImage``, also of a recorded one."""
    flat = np.frombuffer(message.data, np.uint8)
    image = cv2.imdecode(flat, cv2.IMREAD_COLOR) if flat.size else None
    if image is None:
        raise ValueError(
            f"image: got {flat.size} bytes of '{message.format}', allowed are formats that OpenCV "
            'decodes'
        )
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), dtype=np.uint8)


# Time between attempts to open a source [s].
_REOPEN = 1.0
_OPEN_TIMEOUT, _READ_TIMEOUT = 5000, 2000


class ImageSourceError(ValueError):
    """A source that cannot be opened."""


@dataclass(frozen=True)
class VideoFrame:
    """One image (h, w, 3) in R, G, B; its arrival, monotonic clock [s]; its number, from 1."""

    image: ImageArray
    received: float
    number: int


class VideoSource:
    """Keeps the newest frame; reopens a broken stream, plays a file once."""

    def __init__(self, source: str) -> None:
        if not source:
            raise ImageSourceError(
                "video: read '', allowed are an address (rtsp://...), a device (/dev/video0) or a "
                'file'
            )
        self.source = source
        self.live = '://' in source or source.startswith('/dev/') or source.isdigit()
        self.error = ''  #: problem; empty while frames arrive
        self.ended = False  #: whether a file has ended
        # The newest one until it is read.
        self._frames: deque[VideoFrame] = deque(maxlen=1)
        self._count = 0
        self._closing = threading.Event()
        self._first = None if self.live else self._open()
        self._thread = threading.Thread(target=self._read, name='video source', daemon=True)
        self._thread.start()

    def pop_frame(self) -> VideoFrame | None:
        """Return the newest frame, or None if it was returned before."""
        return self._frames.popleft() if self._frames else None

    def close(self) -> None:
        """Close the source."""
        self._closing.set()
        self._thread.join(0.001 * _READ_TIMEOUT)

    def _open(self) -> cv2.VideoCapture:
        if self.source.isdigit():
            capture = cv2.VideoCapture(int(self.source))
        elif '://' in self.source:
            limits = [
                *(cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, _OPEN_TIMEOUT),
                *(cv2.CAP_PROP_READ_TIMEOUT_MSEC, _READ_TIMEOUT),
            ]
            capture = cv2.VideoCapture(self.source, cv2.CAP_FFMPEG, limits)
        else:
            capture = cv2.VideoCapture(self.source)
        if not capture.isOpened():
            capture.release()
            raise ImageSourceError(f'video: {self.source}: cannot be opened by OpenCV')
        return capture

    def _read(self) -> None:
        capture = self._first
        while not self._closing.is_set():
            try:
                capture = capture or self._open()
            except ImageSourceError as error:
                self.error = str(error)
                self._closing.wait(_REOPEN)
                continue
            self._play(capture)
            capture.release()
            capture = None
            if not self.live:
                self.ended = True
                return
            self.error = f'video: {self.source}: no more frames'
            self._closing.wait(_REOPEN)

    def _play(self, capture: cv2.VideoCapture) -> None:
        rate = capture.get(cv2.CAP_PROP_FPS) or 30.0
        due = time.monotonic()
        while not self._closing.is_set():
            there, image = capture.read()
            if not there:
                return
            if not self.live:
                due += 1.0 / rate
                self._closing.wait(max(due - time.monotonic(), 0.0))
            self._count += 1
            self.error = ''
            turned = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), dtype=np.uint8)
            self._frames.append(VideoFrame(turned, time.monotonic(), self._count))
