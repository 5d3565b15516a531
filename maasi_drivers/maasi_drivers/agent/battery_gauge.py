"""The charge of a battery from `percentage` of sensor_msgs/BatteryState. Without ROS."""

from __future__ import annotations

from typing import Literal

BatteryUnit = Literal['fraction', 'percent']

# A full battery may read more than 1: a TurtleBot3 with 12.6 V says 116.7 per cent, as OpenCR maps
# 10.5 V to 12.3 V on 0 to 100 (`update_battery_status` in turtlebot3.cpp).
_MOST = 1.5


def charge_of(percentage: float, unit: BatteryUnit) -> float:
    """Return the charge, 0 to 1, or -1 for what is none in this unit."""
    charge = percentage if unit == 'fraction' else 0.01 * percentage
    return min(charge, 1.0) if 0.0 <= charge <= _MOST else -1.0


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
