"""Orders over UDP to a robot that flies by a program of its own. Without ROS.

The way back of the measurement feed: the layout is in docs/measurement_feed.md; everything is
little-endian.
"""

from __future__ import annotations

import math
import socket
import struct
import zlib
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

MAGIC = b'MSWO'
VERSION = 1
_ORDER = struct.Struct('<4sBBHI4f')
_CHECKSUM = struct.Struct('<I')
_FARTHEST = 1000.0


class OrderError(ValueError):
    """An invalid order; the text has field, value read, values allowed."""


class OrderKind(IntEnum):
    """What the robot is to do."""

    LAND = 0
    HOLD = 1
    GO = 2


@dataclass(frozen=True)
class Order:
    """An order.

    Attributes
    ----------
    sequence : int
        Counted up by the sender, 0 to 2^32 - 1.
    kind : OrderKind
        What to do: be on the ground, hover where it is, or fly to the position.
    position : ndarray, shape (3,)
        From where it took off: forward, left, up, axes of the heading then [m].
    yaw : float
        From the heading at take-off, anticlockwise [rad].
    """

    sequence: int
    kind: OrderKind
    position: np.ndarray
    yaw: float = 0.0


def encode(order: Order) -> bytes:
    """Return an order as a datagram; `OrderError` for numbers that are not allowed."""
    data = _ORDER.pack(
        MAGIC, VERSION, order.kind, 0, order.sequence % 2**32, *order.position, order.yaw
    )
    data += _CHECKSUM.pack(zlib.crc32(data))
    decode(data)
    return data


def decode(data: bytes) -> Order:
    """Return the order of a datagram.

    Raises
    ------
    OrderError
        If it is damaged, of another version, or holds values that are not allowed.
    """
    size = _ORDER.size + _CHECKSUM.size
    if len(data) != size:
        raise OrderError(f'length: read {len(data)} bytes, allowed are {size}')
    magic, version, kind, reserved, sequence, *numbers = _ORDER.unpack_from(data)
    (checksum,) = _CHECKSUM.unpack_from(data, _ORDER.size)
    expected = zlib.crc32(data[: _ORDER.size])
    for good, what in (
        (magic == MAGIC, f'magic: read {magic!r}, allowed is {MAGIC!r}'),
        (version == VERSION, f'version: read {version}, allowed is {VERSION}'),
        (checksum == expected, f'checksum: read {checksum:#010x}, allowed is {expected:#010x}'),
        (kind in list(OrderKind), f'kind: read {kind}, allowed are 0 to 2'),
        (reserved == 0, f'reserved: read {reserved}, allowed is 0'),
        (
            all(math.isfinite(value) and abs(value) <= _FARTHEST for value in numbers),
            f'position, yaw: read {numbers}, allowed are finite numbers within {_FARTHEST:g}',
        ),
    ):
        if not good:
            raise OrderError(what)
    return Order(sequence, OrderKind(kind), np.array(numbers[:3]), numbers[3])


class OrderSender:
    """Sends orders to one robot.

    Parameters
    ----------
    address : str
        Of the robot.
    port : int
        UDP, on which it receives them.
    """

    def __init__(self, address: str, port: int) -> None:
        self._to = (address, port)
        self._sequence = 0
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)

    def send(self, kind: OrderKind, position: np.ndarray, yaw: float = 0.0) -> str:
        """Send an order; return why it could not be sent, or nothing."""
        self._sequence += 1
        try:
            self._socket.sendto(encode(Order(self._sequence, kind, position, yaw)), self._to)
        except OSError as error:
            return f'orders to {self._to[0]}: {error.strerror or error}'
        return ''

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()
