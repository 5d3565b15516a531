"""What a Mambo's commands mean: (project, class, id) and content, as in Parrot's minidrone.xml."""

from __future__ import annotations

import math
import struct

from maasi_sim.emulators.mambo.firmware import MamboFirmware, Piloting

ALL_STATES = (0, 4, 0)
_TAKE_OFF, _PILOTING, _LAND, _EMERGENCY = (2, 0, 1), (2, 0, 2), (2, 0, 3), (2, 0, 4)
_LIMITS = {(2, 8, 1): 'limit_tilt', (2, 1, 0): 'limit_climb', (2, 1, 1): 'limit_turn'}


def obey(firmware: MamboFirmware, number: tuple[int, int, int], content: bytes) -> None:
    """
    Execute a command on a firmware; unknown ones are ignored.

    Raises
    ------
    ValueError
        If the content is no such command's.

    """
    try:
        _obey(firmware, number, content)
    except struct.error as error:
        raise ValueError(f'command {number}: {error}') from error


def _obey(firmware: MamboFirmware, number: tuple[int, int, int], content: bytes) -> None:
    if number == _PILOTING:
        flag, roll, pitch, yaw, climb, _ = struct.unpack('<BbbbbI', content)
        values = [max(-100, min(value, 100)) for value in (roll, pitch, yaw, climb)]
        if not flag:
            # Without the flag the drone keeps itself level.
            values[:2] = [0, 0]
        firmware.pilot(Piloting(*values))
    elif number == _TAKE_OFF:
        firmware.take_off()
    elif number == _LAND:
        firmware.land()
    elif number == _EMERGENCY:
        firmware.emergency()
    elif number in _LIMITS:
        (value,) = struct.unpack('<f', content)
        if not math.isfinite(value):
            raise ValueError(f'command {number}: got {value}, allowed is a finite number')
        getattr(firmware, _LIMITS[number])(value)
