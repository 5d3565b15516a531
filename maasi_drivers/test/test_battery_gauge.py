"""The charge of a battery, in the unit that its robot reports it in."""

import math
from types import SimpleNamespace

import pytest
from sensor_msgs.msg import BatteryState

from maasi_drivers.agent.robot_topics import BatteryTopic, charge_of


@pytest.mark.parametrize(
    ('unit', 'readings'),
    [
        # Of 12.6, 12.3, 11.4, 10.527 and 10.5 V, as `update_battery_status` of OpenCR's
        # turtlebot3.cpp reports them; turtlebot3_node passes it on.
        ('percent', {116.66: 1.0, 99.99: 0.9999, 50.0: 0.5, 1.5: 0.015, 0.0: 0.0}),
        ('fraction', {0.0: 0.0, 0.9: 0.9, 1.0: 1.0, 1.1: 1.0}),
        ('fraction', dict.fromkeys((math.nan, math.inf, -math.inf, -0.1, 1e308, 55.0), -1.0)),
    ],
)
def test_a_charge_is_read_in_its_unit_and_what_is_none_is_unknown(unit, readings):
    assert [charge_of(reading, unit) for reading in readings] == pytest.approx([*readings.values()])


@pytest.mark.parametrize('order', [(0, 1, 2), (2, 0, 1), (1, 2, 0)])
def test_in_lockstep_a_reading_counts_from_the_step_after_its_own(order):
    waiting = [BatteryState(percentage=1.0 - 0.25 * index) for index in order]
    for index, message in zip(order, waiting):
        message.header.stamp.sec = index
    handle = SimpleNamespace(take_message=lambda *_: (waiting.pop(),) if waiting else None)
    charges = []
    topic = BatteryTopic(
        SimpleNamespace(
            settings=SimpleNamespace(lockstep=True, battery_unit='fraction'),
            create_subscription=lambda *_: SimpleNamespace(handle=handle),
            take_charge=charges.append,
        )
    )
    for second, expected in ((0.0, []), (1.0, [1.0]), (1.0, []), (2.5, [0.75, 0.5])):
        charges.clear()
        topic.receive_before(round(second * 1e9))
        assert charges == expected
