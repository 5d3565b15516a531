"""The charge of a battery from `percentage` of sensor_msgs/BatteryState. Without ROS."""

from __future__ import annotations

import math

# `percentage` is 0 to 1. Robots report somewhat more when full (TurtleBot3), and some report
# per cent: above this it can be nothing else.
_FULL = 2.0
# A battery in per cent gets below `_FULL` only from near there [%].
_NEARLY_EMPTY = 20.0
# Consecutive readings above `_FULL` after which the unit is per cent.
_SETTLED = 2


class BatteryGauge:
    """Converts readings to a charge of 0 to 1.

    A reading above 2 is per cent. One of at most 2 is a fraction, unless several in per cent led
    down to it.
    """

    def __init__(self) -> None:
        # Readings in per cent in a row, and the last of them.
        self._in_a_row = 0
        self._per_cent = 0.0

    def charge(self, reading: float) -> float:
        """Return the charge, 0 to 1, or -1 for an invalid reading."""
        if not (math.isfinite(reading) and 0.0 <= reading <= 100.0):
            return -1.0
        settled = self._in_a_row >= _SETTLED and self._per_cent <= _NEARLY_EMPTY
        if reading > _FULL or settled:
            self._in_a_row += 1
            self._per_cent = reading
            return 0.01 * reading
        self._in_a_row = 0
        return min(reading, 1.0)


class BatteryReadings:
    """Readings that are held back until a later step, for lockstep.

    Whether a reading arrives before the odometry of its own step depends on the scheduler; by the
    next step it has arrived in any case.
    """

    def __init__(self) -> None:
        self._waiting: list[tuple[int, float]] = []

    def add(self, stamp: int, reading: float) -> None:
        """Add a reading of a time [ns]."""
        self._waiting.append((stamp, reading))

    def before(self, stamp: int) -> list[float]:
        """Remove and return the readings before a time [ns], in order of their stamps."""
        ready = sorted(item for item in self._waiting if item[0] < stamp)
        self._waiting = [item for item in self._waiting if item[0] >= stamp]
        return [reading for _, reading in ready]
