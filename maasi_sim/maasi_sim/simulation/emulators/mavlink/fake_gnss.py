"""The GNSS receivers of a fake autopilot, and what its EKF says about the position."""

import math
from typing import Any

from maasi_drivers.links.mavlink.protocol import mavlink

_GOOD, _START = 1 | 2 | 4 | 8 | 16 | 32, 1 | 128  # of EKF_STATUS_REPORT
# From the loss of GNSS to that of the position estimate [s].
_DEAD_RECKONING = 8.0


class FakeGnss:
    """One or two receivers; the first one has no fix from `lost_at` on. Times: of the vehicle [s].

    For tests: `lost_at`.
    """

    def __init__(self, sender: Any, second: bool) -> None:
        self._sender, self._second = sender, second
        self.lost_at = math.inf

    def send_estimator(self, now: float, ready: bool) -> None:
        """Send whether there is a position estimate; `ready`: it has started."""
        lost = now - self.lost_at >= _DEAD_RECKONING and not self._second
        flags = _GOOD if ready and not lost else _START
        self._sender.ekf_status_report_send(flags, 0.1, 0.1, 0.1, 0.1, 0.0)

    def send_first(self, now: float) -> None:
        """Send the fix of the first receiver."""
        has_fix = now < self.lost_at
        fix = mavlink.GPS_FIX_TYPE_3D_FIX if has_fix else mavlink.GPS_FIX_TYPE_NO_FIX
        self._sender.gps_raw_int_send(_microseconds(now), fix, 0, 0, 0, 100, 100, 0, 0xFFFF, 12)

    def send_second(self, now: float) -> None:
        """Send the fix of the second receiver, if there is one."""
        if self._second:
            values = mavlink.GPS_FIX_TYPE_3D_FIX, 0, 0, 0, 100, 100, 0, 0xFFFF, 12, 0, 0
            self._sender.gps2_raw_send(_microseconds(now), *values)


def _microseconds(now: float) -> int:
    return round(now * 1000.0) * 1000
