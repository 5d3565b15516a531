"""Corrections of pyparrot 1.5.20 for a Mambo by Bluetooth and UDP. Without ROS.

`bleConnection.py` can only repeat a piloting command, and waits for that; it waits half a second
for acknowledgements. The socket of `wifiConnection.py` accepts datagrams from everyone, returns the
last one again after a timeout, and its listener dies on a truncated frame, or loops on an empty
one.
"""

import math
import socket
import struct
from collections import Counter
from typing import Any

_MAX_TILT = (2, 8, 1)  # project, class and command of the largest tilt


def mend(connection: Any) -> None:
    """Add to a Bluetooth connection the method by which `fly_direct` sends one command."""

    def send_single_pcmd_command(
        command: tuple[int, int, int], roll: int, pitch: int, yaw: int, climb: int
    ) -> None:
        content = struct.pack('<BbbbbI', 1, roll, pitch, yaw, climb, 0)
        _write(connection, 'SEND_NO_ACK', 'DATA_NO_ACK', command, content)

    connection.send_single_pcmd_command = send_single_pcmd_command


def ask_for_answer(connection: Any, tilt: float) -> None:
    """Send a command that the drone must acknowledge: the tilt [rad] that it already has."""
    content = struct.pack('<f', math.degrees(tilt))
    _write(connection, 'SEND_WITH_ACK', 'DATA_WITH_ACK', _MAX_TILT, content)


def _write(
    connection: Any, channel: str, kind: str, command: tuple[int, int, int], content: bytes
) -> None:
    number = (connection.characteristic_send_counter[channel] + 1) % 256
    connection.characteristic_send_counter[channel] = number
    packet = struct.pack('<BBBBH', connection.data_types[kind], number, *command) + content
    connection._safe_ble_write(connection.send_characteristics[channel], packet)


# Type, buffer, sequence, total size.
_HEADER = struct.Struct('<BBBI')
_TYPES = range(1, 5)
_TIMEOUT = 0.3  # longest wait for a datagram until the listener checks its end condition [s]


def has_whole_frames(data: bytes) -> bool:
    """Return whether a datagram consists of frames that pyparrot can parse."""
    while data:
        if len(data) < _HEADER.size:
            return False
        kind, _, _, size = _HEADER.unpack_from(data)
        if kind not in _TYPES or not _HEADER.size <= size <= len(data):
            return False
        data = data[size:]
    return True


class DroneSocket:
    """Receives the datagrams of one drone only."""

    def __init__(self, drone: str, port: int) -> None:
        self.dropped: Counter[str] = Counter()
        self._drone = drone
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            # On the address of this host that routes to the drone.
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
                probe.connect((drone, 9))
                self._socket.bind((probe.getsockname()[0], port))
        except OSError:
            self._socket.close()
            raise
        self._socket.settimeout(_TIMEOUT)

    def recvfrom(self, size: int) -> tuple[bytes, Any]:
        """Return the next datagram, or no bytes without a valid one."""
        try:
            data, sender = self._socket.recvfrom(size)
        except OSError:
            return b'', None
        foreign = sender[0] != self._drone
        if not foreign and has_whole_frames(data):
            return data, sender
        self.dropped['foreign sender' if foreign else 'bad frame'] += 1
        return b'', None

    def close(self) -> None:
        """Close it."""
        self._socket.close()


def guard(connection: Any, drone: str, port: int) -> None:
    """Let a connection receive by a `DroneSocket` and drop frames that it cannot parse."""
    handle = connection.handle_data

    def open_sockets() -> None:
        connection.udp_send_sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        connection.udp_receive_sock = DroneSocket(drone, port)

    def handle_data(data: bytes) -> None:
        try:
            handle(data)
        except Exception:
            connection.udp_receive_sock.dropped['bad content'] += 1

    connection._create_udp_connection = open_sockets
    connection.handle_data = handle_data
