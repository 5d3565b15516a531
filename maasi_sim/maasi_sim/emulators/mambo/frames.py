"""Frames of a Mambo's UDP protocol, as pyparrot 1.5.20 speaks it.

`<BBBI` type, buffer, sequence, total size; and in commands and events `<BBH` project, class, id.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass

ACK, DATA, LOW_LATENCY, DATA_WITH_ACK = 1, 2, 3, 4
_HEADER = struct.Struct('<BBBI')


class FrameError(ValueError):
    """Bytes that are no frame."""


@dataclass(frozen=True)
class Frame:
    """One frame: its type, buffer and sequence number, and what is in it."""

    kind: int
    buffer: int
    sequence: int
    payload: bytes = b''

    def encode(self) -> bytes:
        """Return its bytes."""
        size = _HEADER.size + len(self.payload)
        return _HEADER.pack(self.kind, self.buffer, self.sequence, size) + self.payload


def frames(data: bytes) -> Iterator[Frame]:
    """
    Yield the frames of a datagram.

    Raises
    ------
    FrameError
        Where the rest is too short for the size that it states.

    """
    while data:
        if len(data) < _HEADER.size:
            raise FrameError(f'frame: got {len(data)} bytes, allowed are at least {_HEADER.size}')
        kind, buffer, sequence, size = _HEADER.unpack_from(data)
        if not _HEADER.size <= size <= len(data):
            raise FrameError(
                f'frame size: got {size}, allowed is {_HEADER.size} to the {len(data)} bytes there'
            )
        yield Frame(kind, buffer, sequence, data[_HEADER.size : size])
        data = data[size:]
