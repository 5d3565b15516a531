"""The charge of a battery, whatever unit the robot reports it in."""

import math

import pytest

from maasi_drivers.agent.battery_gauge import BatteryGauge, BatteryReadings


def charges(readings):
    gauge = BatteryGauge()
    return [gauge.charge(reading) for reading in readings]


@pytest.mark.parametrize('more', [1.0001, 1.1, 1.3])
def test_a_reading_above_one_is_a_full_battery_and_changes_no_later_one(more):
    assert charges([0.9, more, 0.8, 0.5]) == [0.9, 1.0, 0.8, 0.5]


def test_per_cent_stays_per_cent_down_to_the_end():
    readings = [80.0, 40.0, 9.0, 2.5, 1.5, 0.9, 0.2]
    assert charges(readings) == pytest.approx([0.01 * value for value in readings])


@pytest.mark.parametrize('wrong', [3.0, 15.0, 55.0])
def test_one_reading_in_per_cent_does_not_stay(wrong):
    assert charges([0.9, wrong, 0.8]) == pytest.approx([0.9, 0.01 * wrong, 0.8])


@pytest.mark.parametrize('reading', [math.nan, math.inf, -math.inf, -0.1, 100.5, 1e308])
def test_what_is_no_charge_is_unknown_and_forgotten(reading):
    assert charges([0.8, reading, 0.7]) == [0.8, -1.0, 0.7]


@pytest.mark.parametrize('order', [(0, 1, 2), (2, 0, 1), (1, 2, 0)])
def test_in_lockstep_a_reading_counts_from_the_step_after_its_own(order):
    readings = BatteryReadings()
    for index in order:
        readings.add(10 * index, 1.0 - 0.1 * index)
    assert readings.before(0) == []
    assert readings.before(10) == [1.0]
    assert readings.before(10) == []
    assert readings.before(25) == [0.9, 0.8]
