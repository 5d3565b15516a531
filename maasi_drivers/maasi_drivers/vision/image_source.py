"""Images of a camera that OpenCV opens: streams, V4L2 devices, files. Without ROS."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

ImageArray = NDArray[np.uint8]

# From one try to open a source to the next [s].
_REOPEN = 1.0
_OPEN_TIMEOUT, _READ_TIMEOUT = 5000, 2000
_DEFAULT_RATE = 30.0


class ImageSourceError(ValueError):
    """A source that cannot be opened."""


@dataclass(frozen=True)
class VideoFrame:
    """One image.

    Attributes
    ----------
    image : ndarray, shape (h, w, 3), uint8
        R, G, B.
    received : float
        Time of arrival, monotonic clock [s].
    number : int
        Of the frames of this source, from 1.
    """

    image: ImageArray
    received: float
    number: int


class VideoSource:
    """Reads a source in a thread of its own, and keeps the newest frame.

    A stream or device that breaks off is opened again. A file is played at its own rate, once.

    Parameters
    ----------
    source : str
        Address (rtsp://..., udp://...), device (/dev/video0, or its number), or file.

    Raises
    ------
    ImageSourceError
        If it is none of these, or a file that cannot be read.
    """

    def __init__(self, source: str) -> None:
        if not source:
            raise ImageSourceError(
                "video: got '', allowed are an address (rtsp://...), a device (/dev/video0) or a "
                'file'
            )
        self.source = source
        self.live = '://' in source or source.startswith('/dev/') or source.isdigit()
        #: What is wrong; empty while frames come.
        self.error = ''
        #: Whether a file has come to its end.
        self.ended = False
        self._frame: VideoFrame | None = None
        self._taken = 0
        self._count = 0
        self._closing = threading.Event()
        self._first = None if self.live else self._open()
        self._thread = threading.Thread(target=self._read, name='video source', daemon=True)
        self._thread.start()

    def take(self) -> VideoFrame | None:
        """Return the newest frame, or None if it was returned before."""
        frame = self._frame
        if frame is None or frame.number == self._taken:
            return None
        self._taken = frame.number
        return frame

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
            raise ImageSourceError(f'video: {self.source}: OpenCV cannot open it')
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
        rate = capture.get(cv2.CAP_PROP_FPS) or _DEFAULT_RATE
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
            self._frame = VideoFrame(turned, time.monotonic(), self._count)
