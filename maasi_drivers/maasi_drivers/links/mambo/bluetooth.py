"""Additions to pyparrot's Bluetooth connection to a Mambo. Without ROS.

pyparrot 1.5.20 (`pyparrot/networking/bleConnection.py`) cannot send one piloting command, only
repeat one and wait meanwhile; and its acknowledged commands wait half a second at least. The
packets are those of its own methods, without the waiting.
"""

from __future__ import annotations

import math
import struct
from typing import Any

# Project, class and command of the largest tilt.
_MAX_TILT = (2, 8, 1)


def mend(connection: Any) -> None:
    """Give a connection the method by which pyparrot's `fly_direct` sends one command."""

    def send_single_pcmd_command(
        command: tuple[int, int, int], roll: int, pitch: int, yaw: int, climb: int
    ) -> None:
        content = struct.pack('<BbbbbI', 1, roll, pitch, yaw, climb, 0)
        _write(connection, 'SEND_NO_ACK', 'DATA_NO_ACK', command, content)

    connection.send_single_pcmd_command = send_single_pcmd_command


def ask_for_answer(connection: Any, tilt: float) -> None:
    """Send a command that the drone has to acknowledge, and that changes nothing.

    Parameters
    ----------
    connection : BLEConnection
        Of pyparrot.
    tilt : float
        The largest, as set before [rad].
    """
    content = struct.pack('<f', math.degrees(tilt))
    _write(connection, 'SEND_WITH_ACK', 'DATA_WITH_ACK', _MAX_TILT, content)


def _write(
    connection: Any, channel: str, kind: str, command: tuple[int, int, int], content: bytes
) -> None:
    number = (connection.characteristic_send_counter[channel] + 1) % 256
    connection.characteristic_send_counter[channel] = number
    packet = struct.pack('<BBBBH', connection.data_types[kind], number, *command) + content
    connection._safe_ble_write(connection.send_characteristics[channel], packet)
