"""Blobs over UDP from a robot that segments its images on board. Without ROS.

One datagram per image, little-endian, with the layout in docs/measurement_feed.md.
"""

import socket
import struct
import time
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from maasi_drivers.vision.detector import Blobs
from maasi_drivers.vision.images import ImageSourceError

MAGIC = b'MSMF'
VERSION = 1
#: Most blobs per image.
MOST = 256
BORDER_CUT = 1
HAS_POSE = 1  #: flag: the robot's pose follows the header

_HEADER = struct.Struct('<4sBBHHHII')
_POSE = struct.Struct('<7fI')
_BLOB = np.dtype([('numbers', '<f4', 8), ('mark', '<u4')])
_CHECKSUM = struct.Struct('<I')
_OLDEST = 10.0  # older images are dropped [s]
# Poses farther from the take-off point, or with more tilt, are invalid [m, rad].
_FARTHEST, _MOST_TILT = 1000.0, 1.5
_FAR_BEHIND = 1000  # a larger decrease of the sequence number means a restarted sender
_SILENCE = 2.0  # any number is accepted after a silence of this length [s]


class FeedError(ValueError):
    """An invalid datagram; the text gives field, value read and allowed values."""


class FeedState(IntEnum):
    """Flight state of a robot that sends its pose."""

    GROUND = 0
    AIR = 1
    LANDING = 2


@dataclass(frozen=True)
class FeedPose:
    """The robot's own pose estimate at the image.

    `position` from the take-off point: forward, left, up in the axes of the heading then [m].
    Angles are right-handed about these axes, yaw from the heading at take-off [rad]. A negative
    charge is unknown.
    """

    position: np.ndarray
    roll: float = 0.0
    pitch: float = 0.0
    yaw: float = 0.0
    battery: float = -1.0
    state: FeedState = FeedState.GROUND


@dataclass(frozen=True)
class FeedPacket:
    """The content of one image: number (counted up), age when sent [s], size [px], blobs."""

    sequence: int
    age: float
    width: int
    height: int
    blobs: Blobs
    pose: FeedPose | None = None


def encode(packet: FeedPacket) -> bytes:
    """Return a packet as a datagram."""
    blobs = packet.blobs
    if len(blobs) > MOST:
        raise FeedError(f'blobs: got {len(blobs)}, allowed are at most {MOST}')
    if not 0.0 <= packet.age <= _OLDEST:
        raise FeedError(f'age: got {packet.age} s, allowed is 0 to {_OLDEST:g} s')
    data = _HEADER.pack(
        MAGIC,
        VERSION,
        0 if packet.pose is None else HAS_POSE,
        len(blobs),
        packet.width,
        packet.height,
        packet.sequence % 2**32,
        round(1e6 * packet.age),
    )
    if packet.pose is not None:
        pose = packet.pose
        angles = pose.roll, pose.pitch, pose.yaw
        data += _POSE.pack(*pose.position, *angles, pose.battery, pose.state)
    rows = np.zeros(len(blobs), _BLOB)
    spread = blobs.covariances.reshape(-1, 4)[:, [0, 1, 3]]
    rows['numbers'] = np.column_stack([blobs.centroids, spread, blobs.areas, blobs.extents])
    rows['mark'][blobs.border_cut] = BORDER_CUT
    data += rows.tobytes()
    data += _CHECKSUM.pack(zlib.crc32(data))
    # Raises errors for what a receiver would refuse.
    decode(data)
    return data


def decode(data: bytes) -> FeedPacket:
    """Return the packet of a datagram."""
    least = _HEADER.size + _CHECKSUM.size
    if len(data) < least:
        raise FeedError(f'length: read {len(data)} bytes, allowed are at least {least}')
    magic, version, flags, count, width, height, sequence, age = _HEADER.unpack_from(data)
    if magic != MAGIC:
        raise FeedError(f'magic: read {magic!r}, allowed is {MAGIC!r}')
    if version != VERSION:
        raise FeedError(f'version: read {version}, allowed is {VERSION}')
    if flags & ~HAS_POSE:
        raise FeedError(f'flags: read {flags}, allowed are 0 and {HAS_POSE}')
    if count > MOST:
        raise FeedError(f'count: read {count}, allowed is at most {MOST}')
    begin = _HEADER.size + (_POSE.size if flags else 0)
    size = begin + count * _BLOB.itemsize + _CHECKSUM.size
    if len(data) != size:
        raise FeedError(f'length: read {len(data)} bytes, allowed are {size} with {count} blobs')
    (checksum,) = _CHECKSUM.unpack_from(data, size - _CHECKSUM.size)
    expected = zlib.crc32(data[: -_CHECKSUM.size])
    if checksum != expected:
        raise FeedError(f'checksum: read {checksum:#010x}, allowed is {expected:#010x}')
    if not width or not height:
        raise FeedError(f'width, height: read {width} x {height}, allowed are at least 1 x 1 px')
    if age > 1e6 * _OLDEST:
        raise FeedError(f'age: read {age} us, allowed is at most {1e6 * _OLDEST:.0f} us')
    pose = _read_pose(_POSE.unpack_from(data, _HEADER.size)) if flags else None
    rows = np.frombuffer(data, _BLOB, count, begin)
    numbers, marks = rows['numbers'].astype(float), rows['mark'].astype(np.int64)
    _check(numbers, marks, width, height)
    covariances = numbers[:, [2, 3, 3, 4]].reshape(count, 2, 2)
    blobs = Blobs(
        centroids=numbers[:, :2],
        covariances=covariances,
        areas=numbers[:, 5],
        extents=numbers[:, 6:8],
        border_cut=(marks & BORDER_CUT) != 0,
    )
    return FeedPacket(sequence, 1e-6 * age, width, height, blobs, pose)


def _read_pose(values: tuple[float, ...]) -> FeedPose:
    *numbers, state = values
    position, (roll, pitch, yaw), battery = np.array(numbers[:3]), numbers[3:6], numbers[6]
    for good, what in (
        (np.isfinite(numbers).all(), 'finite numbers'),
        (np.abs(position).max() <= _FARTHEST, f'a position within {_FARTHEST:g} m'),
        (max(abs(roll), abs(pitch)) <= _MOST_TILT, f'roll and pitch within {_MOST_TILT} rad'),
        (battery <= 1.0, 'a charge of at most 1'),
        (state in list(FeedState), 'states ' + ', '.join(str(int(item)) for item in FeedState)),
    ):
        if not good:
            raise FeedError(f'pose: read {list(values)}, allowed are {what}')
    return FeedPose(position, roll, pitch, yaw, battery, FeedState(int(state)))


def _check(numbers: np.ndarray, marks: np.ndarray, width: int, height: int) -> None:
    """Raise an error for the first invalid blob."""
    finite = np.isfinite(numbers).all(axis=1)
    # Pixel centres are integers.
    inside = (numbers[:, :2] >= -0.5).all(axis=1) & (
        numbers[:, :2] <= np.array([width, height]) - 0.5
    ).all(axis=1)
    uu, uv, vv = numbers[:, 2], numbers[:, 3], numbers[:, 4]
    # Tolerance for rounding to single precision.
    proper = (uu >= 0.0) & (vv >= 0.0) & (uv * uv <= uu * vv * (1.0 + 1e-5) + 1e-12)
    sized = (numbers[:, 5:] >= 0.0).all(axis=1)
    for good, what in (
        (finite, 'finite numbers'),
        (inside, f'a centroid inside {width} x {height} px'),
        (proper, 'a covariance uu, uv, vv that is positive semidefinite'),
        (sized, 'area and extents from 0'),
        ((marks & ~BORDER_CUT) == 0, f'marks 0 or {BORDER_CUT}'),
    ):
        if not good.all():
            index = int(np.flatnonzero(~good)[0])
            read = [*numbers[index].tolist(), int(marks[index])]
            raise FeedError(f'blob {index}: read {read}, allowed are {what}')


class FeedReceiver:
    """Receives a feed; to be polled often.

    `on_drop` receives the reason, a text, and the number of refused or lost packets.
    """

    def __init__(
        self,
        port: int,
        address: str = '127.0.0.1',
        sender: str | None = None,
        on_drop: Callable[[str, str, int], None] = lambda *_: None,
    ) -> None:
        self.sender, self._on_drop = sender, on_drop
        self._last: int | None = None
        self._received_at = -1e9
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind((address, port))
        except OSError as error:
            self._socket.close()
            raise ImageSourceError(
                f'feed_address, feed_port: UDP port {port} of {address}: {error.strerror}, allowed '
                'is a free port of an address of this host'
            ) from error
        self._socket.setblocking(False)
        self.port = int(self._socket.getsockname()[1])

    def close(self) -> None:
        """Stop listening."""
        self._socket.close()

    def receive(self) -> list[tuple[FeedPacket, float]]:
        """Return the packets since the last call with image times (monotonic clock [s])."""
        packets = []
        for _ in range(64):
            try:
                data, (host, _) = self._socket.recvfrom(65536)
            except BlockingIOError:
                break
            if self.sender not in (None, host):
                text = f'sender: read {host}, allowed is {self.sender}'
                self._on_drop('foreign sender', text, 1)
                continue
            now = time.monotonic()
            try:
                packet = decode(data)
            except FeedError as error:
                self._on_drop('bad packet', str(error), 1)
                continue
            last = self._last
            if last is not None and now - self._received_at < _SILENCE:
                # As a signed difference, which may wrap.
                ahead = (packet.sequence - last + 2**31) % 2**32 - 2**31
                text = f'sequence: read {packet.sequence}, allowed are numbers after {last}'
                if -_FAR_BEHIND < ahead <= 0:
                    self._on_drop('old packet', text, 1)
                    continue
                if 1 < ahead < _FAR_BEHIND:
                    self._on_drop('lost packet', text, ahead - 1)
            self._last, self._received_at = packet.sequence, now
            packets.append((packet, now - packet.age))
        return packets
