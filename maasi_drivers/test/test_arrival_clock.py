"""Stamps for what arrives without one."""

import itertools

from maasi_drivers.agent.robot_node import ArrivalClock


def test_before_the_time_begins_there_is_no_stamp():
    clock = ArrivalClock()
    assert clock.stamp(5.0) is None
    clock.observe(5.0, 0)
    assert clock.stamp(5.0) is None
    clock.observe(5.0, 10_000_000)
    assert clock.stamp(5.0) == 10_000_000
    # It was not there yet.
    assert clock.stamp(4.9) is None


def test_a_time_that_comes_in_steps_goes_on_between_them():
    clock = ArrivalClock()
    for tick in range(100):
        now = 100.0 + 0.02 * tick
        # Steps of 50 ms, that come up to one look late.
        clock.observe(now, 50_000_000 * (1 + int((now - 100.0) / 0.05)))
    stamps = [clock.stamp(101.0 + 0.01 * index) for index in range(50)]
    steps = [after - before for before, after in itertools.pairwise(stamps)]
    assert all(abs(step - 10_000_000) < 1000 for step in steps)
    assert abs(stamps[0] - 1_050_000_000) <= 20_000_000


def test_a_time_that_slows_down_is_followed():
    clock = ArrivalClock()
    for tick in range(400):
        clock.observe(0.02 * tick, 1_000_000_000 + 10_000_000 * tick)
    # Only the last two seconds count, in which it lost one.
    assert 0 < clock.stamp(7.98) - (1_000_000_000 + 3_990_000_000) <= 1_020_000_000
    # A jump back is followed at once.
    clock.observe(8.05, 1_000_000)
    assert clock.stamp(8.05) == 1_000_000
    clock.observe(8.1, 0)
    assert clock.stamp(8.1) is None
