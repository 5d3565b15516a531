"""The charge of a robot's battery, and the fault of a low one."""

from __future__ import annotations

import time

from maasi_drivers.agent.health import BATTERY
from maasi_drivers.agent.robot_node import RobotNode

# Time without a charge after which a warning says that `battery_minimum` cannot act [s].
_PATIENCE = 10.0


class BatteryWatch:
    """Keeps the last known charge, and compares it with `battery_minimum`.

    Parameters
    ----------
    driver : RobotNode
        The robot's node.

    Attributes
    ----------
    charge : float
        0 to 1; -1 where the last reading was unknown.
    """

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
