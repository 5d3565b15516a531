"""Set-points: lead distance, and detection of rejections."""

import math
from collections import deque
from typing import Any

import numpy as np

from maasi_filter.arrays import FloatArray

_NO_POSITION = 0b111  # mask bits that omit the position
# A reported target matches one sent within this time and distance [s, m].
_MEMORY, _SAME = 2.0, 0.3
# Duration of a difference at standstill until a set-point counts as rejected [s].
_PATIENCE, _STANDS = 1.0, 5.0
# Largest speed of standstill, and smallest distance from the set-point [m/s, m].
_STILL, _AWAY = 0.1, 1.0


def braking_lead(speed: float, acceleration: float, jerk: float) -> float:
    """Return the lead of a position for which ArduCopter flies with a speed [m].

    The inverse of `shape_pos_vel_accel_xy` (ArduPilot, AP_Math/control.cpp) in steady flight,
    with a position that moves along with the vehicle.
    """
    gain = jerk / acceleration
    slow = acceleration / gain
    if speed <= 0.5 * slow:
        return 2.0 * speed / gain
    allowed = 0.5 * (speed + math.sqrt(speed * (speed + 4.0 * slow)))
    return 0.5 * allowed**2 / acceleration + 0.5 * slow / gain


class SetpointCheck:
    """Detects set-points that an autopilot rejects silently.

    ArduPilot rejects those outside of its fence. It reports its current target; without
    reports, a vehicle that stands away from its set-point shows it. Times: steady clock [s];
    positions: local frame, ENU [m].
    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Discard all set-points, after another kind of them."""
        self._sent: deque[tuple[float, FloatArray]] = deque()
        self._since = self._other_since = self._standing_since = math.inf
        #: Position (3,) that the autopilot has instead; None: unknown, or a velocity.
        self.other: FloatArray | None = None

    def note(self, position: FloatArray, now: float) -> None:
        """Note a sent set-point."""
        self._since = min(self._since, now)
        self._sent.append((now, position))
        while self._sent[0][0] < now - _MEMORY:
            self._sent.popleft()

    def observe(self, position: FloatArray, velocity: FloatArray, now: float) -> None:
        """Note position and velocity of the vehicle."""
        away = self._sent and float(np.linalg.norm(self._sent[-1][1] - position)) > _AWAY
        if away and float(np.linalg.norm(velocity)) < _STILL:
            self._standing_since = min(self._standing_since, now)
        else:
            self._standing_since = math.inf

    def update(self, message: Any, position: FloatArray, now: float) -> None:
        """Handle POSITION_TARGET_LOCAL_NED, the current target."""
        if now - self._since < _PATIENCE:
            return
        has_position = not message.type_mask & _NO_POSITION
        here = has_position and any(
            float(np.linalg.norm(item - position)) < _SAME for _, item in self._sent
        )
        self.other = position if has_position else None
        self._other_since = math.inf if here else min(self._other_since, now)

    def rejected(self, now: float) -> FloatArray | None:
        """Return the rejected set-point (3,), or None."""
        other = now - self._other_since > _PATIENCE
        stands = now - max(self._standing_since, self._since) > _STANDS
        return self._sent[-1][1] if self._sent and (other or stands) else None
