"""The charge of a robot's battery: read from a topic, and the fault of a low one."""

from __future__ import annotations

import math
import time

from sensor_msgs.msg import BatteryState

from maasi_drivers.agent.robot_node import BATTERY, RobotNode
from maasi_drivers.settings.driver import BatteryUnit
from maasi_filter.ros.conversions import stamp_from_ros
from maasi_filter.ros.qos import sensor_reader

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


class BatteryTopic:
    """Hands charges to `driver.take_charge`.

    Subscribes
    ----------
    `battery_state` (sensor_msgs/BatteryState)
    """

    def __init__(self, driver: RobotNode) -> None:
        self._driver = driver
        self._readings = BatteryReadings()
        self._subscription = driver.create_subscription(
            BatteryState, 'battery_state', self._on_battery, sensor_reader(driver.settings.lockstep)
        )

    def _on_battery(self, message: BatteryState) -> None:
        if self._driver.settings.lockstep:
            self._readings.add(stamp_from_ros(message.header.stamp), message.percentage)
        else:
            self._take(message.percentage)

    def _take(self, percentage: float) -> None:
        unit = self._driver.settings.battery_unit
        charge = charge_of(percentage, unit)
        if charge < 0.0 and not math.isnan(percentage):
            self._driver.drop(
                'battery',
                f'battery_state.percentage: read {percentage:g}, allowed is '
                f'{"0 to 1" if unit == "fraction" else "0 to 100"}, or nan: battery_unit is {unit}',
            )
        self._driver.take_charge(charge)

    def take_before(self, stamp: int) -> None:
        """In lockstep: take the readings of the steps before the one at `stamp` [ns]."""
        handle = self._subscription.handle
        while (taken := handle.take_message(BatteryState, False)) is not None:
            self._on_battery(taken[0])
        for reading in self._readings.before(stamp):
            self._take(reading)


# Time without a charge after which a warning says that `battery_minimum` cannot act [s].
_PATIENCE = 10.0


class BatteryWatch:
    """Keeps the last known charge, and compares it with `battery_minimum`."""

    def __init__(self, driver: RobotNode) -> None:
        self._driver = driver
        self.charge = -1.0
        self._known_at = time.monotonic()

    def take(self, charge: float) -> None:
        """Take a charge, 0 to 1; anything else is unknown and leaves a fault as it is."""
        self.charge = charge if 0.0 <= charge <= 1.0 else -1.0
        if self.charge < 0.0:
            return
        self._known_at = time.monotonic()
        minimum, health = self._driver.settings.battery_minimum, self._driver.health
        if not minimum:
            return
        if self.charge >= minimum:
            health.end(BATTERY)
            return
        text = f'battery at {self.charge:.2f}, below {minimum:.2f}'
        if health.begin(BATTERY, text):
            self._driver.get_logger().warning(f'{text}: the robot takes no goals')

    def check(self, now: float) -> None:
        """Warn where the charge has been unknown for long; `now` on the steady clock [s]."""
        unknown = now - self._known_at
        if self._driver.settings.battery_minimum and unknown > _PATIENCE:
            self._driver.warn_throttled(
                'battery',
                f'no charge of the battery for {unknown:.0f} s: battery_minimum cannot act',
            )
