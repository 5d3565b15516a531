"""The charge of a robot's battery from its topic."""

from __future__ import annotations

import math

from sensor_msgs.msg import BatteryState

from maasi_drivers.agent.battery_gauge import BatteryReadings, charge_of
from maasi_drivers.agent.robot_node import RobotNode
from maasi_filter.ros.conversions import stamp_from_ros
from maasi_filter.ros.qos import sensor_reader


class BatteryTopic:
    """Hands charges to `driver.take_charge`.

    Subscribes
    ----------
    `battery_state` (sensor_msgs/BatteryState)

    Parameters
    ----------
    driver : RobotNode
        The robot's node.
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
