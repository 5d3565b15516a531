"""The set-point of a vehicle."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from maasi_drivers.links.mavlink.estimate import swap_enu_ned, swap_yaw
from maasi_drivers.links.mavlink.protocol import mavlink
from maasi_drivers.settings.vehicles import MavlinkSettings
from maasi_filter.arrays import FloatArray

# Position only, and yaw: no velocity, acceleration, yaw rate; and no yaw either.
_POSITION_AND_YAW, _NO_YAW = 0x9F8, 0x400


class Setpoint:
    """Where an autopilot is to hold its vehicle."""

    def __init__(self, settings: MavlinkSettings, sender: Any) -> None:
        self._settings = settings
        self._sender = sender
        self._sent_at = -math.inf
        self.position: FloatArray | None = None
        self.yaw: float | None = None

    def hold(self, position: FloatArray) -> None:
        """Set a position, with the present yaw."""
        self.position, self.yaw = position, None

    def send(self, now: float) -> None:
        """Send it if it is due; `now` on the steady clock [s]."""
        period = 1.0 / self._settings.setpoint_rate
        if self.position is None or now - self._sent_at < period - 1e-6:
            return
        self._sent_at = now
        self._sender.set_position_target_local_ned_send(
            int(now * 1000.0) & 0xFFFFFFFF,
            self._settings.system,
            mavlink.MAV_COMP_ID_AUTOPILOT1,
            mavlink.MAV_FRAME_LOCAL_NED,
            _POSITION_AND_YAW | (_NO_YAW if self.yaw is None else 0),
            *swap_enu_ned(self.position).tolist(),
            *[0.0] * 6,
            0.0 if self.yaw is None else swap_yaw(self.yaw),
            0.0,
        )


def checked_target(position: ArrayLike, yaw: float) -> FloatArray:
    """Return a position (3,) [m]; `ValueError` for numbers that are not finite."""
    target = np.array(position, dtype=float)
    if target.shape != (3,) or not np.isfinite([*target, yaw]).all():
        raise ValueError(
            f'setpoint: got {target.tolist()}, {yaw}, allowed are finite numbers [m, rad]'
        )
    return target
