"""The charge of a battery, in the unit that its robot reports it in."""

import math
from types import SimpleNamespace

import pytest
from sensor_msgs.msg import BatteryState

from maasi_drivers.agent.robot_topics import BatteryTopic, charge_of


@pytest.mark.parametrize(
    ('voltage', 'charge'), [(12.6, 1.0), (12.3, 1.0), (11.4, 0.5), (10.527, 0.015), (10.5, 0.0)]
)
def test_a_turtlebot3_reports_per_cent_between_two_voltages(voltage, charge):
    """As `update_battery_status` of OpenCR's turtlebot3.cpp; turtlebot3_node passes it on."""
    percent = (voltage - 3.5 * 3) / (4.1 * 3 - 3.5 * 3) * 100.0
    assert charge_of(0.01 * int(100.0 * percent + 1e-6), 'percent') == pytest.approx(charge)


@pytest.mark.parametrize(
    ('reading', 'charge'),
    [
        *[(0.0, 0.0), (0.9, 0.9), (1.0, 1.0), (1.1, 1.0)],
        *[(value, -1.0) for value in (math.nan, math.inf, -math.inf, -0.1, 1e308, 55.0)],
    ],
)
def test_a_fraction_is_a_fraction_and_what_is_no_charge_is_unknown(reading, charge):
    assert charge_of(reading, 'fraction') == charge


@pytest.mark.parametrize('order', [(0, 1, 2), (2, 0, 1), (1, 2, 0)])
def test_in_lockstep_a_reading_counts_from_the_step_after_its_own(order):
    waiting = [BatteryState(percentage=1.0 - 0.25 * index) for index in order]
    for index, message in zip(order, waiting):
        message.header.stamp.sec = index
    handle = SimpleNamespace(take_message=lambda *_: (waiting.pop(),) if waiting else None)
    taken = []
    topic = BatteryTopic(
        SimpleNamespace(
            settings=SimpleNamespace(lockstep=True, battery_unit='fraction'),
            create_subscription=lambda *_: SimpleNamespace(handle=handle),
            take_charge=taken.append,
        )
    )
    for second, expected in ((0.0, []), (1.0, [1.0]), (1.0, []), (2.5, [0.75, 0.5])):
        taken.clear()
        topic.take_before(round(second * 1e9))
        assert taken == expected
