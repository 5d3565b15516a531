"""Stamps for what arrives without one."""

import itertools

import numpy as np
import pytest
from rclpy.clock import ROSClock
from rclpy.time import Time

from maasi_filter.ros import clocks
from maasi_filter.ros.clocks import ArrivalClock


class Simulated:
    """A node's clock that follows a simulated time, and the steady clock next to it."""

    def __init__(self, monkeypatch):
        self.steady = 0.0
        monkeypatch.setattr(clocks.time, 'monotonic', lambda: self.steady)
        self.clock = ROSClock()
        self.clock._set_ros_time_is_active(True)
        self.arrivals = ArrivalClock(self.clock)

    def tick(self, steady, time):
        """Let a time [ns] begin."""
        self.steady = steady
        self.clock.set_ros_time_override(Time(nanoseconds=time, clock_type=self.clock.clock_type))


@pytest.fixture
def simulated(monkeypatch):
    made = Simulated(monkeypatch)
    yield made
    made.arrivals.close()


def test_before_the_time_begins_there_is_no_stamp(simulated):
    arrivals = simulated.arrivals
    assert arrivals.stamp(5.0) is None
    simulated.tick(5.0, 0)
    assert arrivals.stamp(5.0) is None
    simulated.tick(5.0, 10_000_000)
    assert arrivals.stamp(5.0) == 10_000_000
    # It was not there yet.
    assert arrivals.stamp(4.9) is None


def test_without_a_simulated_time_it_is_that_of_the_host():
    arrivals = ArrivalClock(ROSClock())
    before, now = ROSClock().now().nanoseconds, clocks.time.monotonic()
    assert abs(arrivals.stamp(now - 3.0) - before + 3_000_000_000) < 100_000_000
    arrivals.close()


@pytest.mark.parametrize('seed', range(12))
def test_a_time_that_passes_at_any_rate_is_followed(simulated, seed):
    """Rates change as on a busy host, ticks are handled late: the error is a tick or two."""
    rng = np.random.default_rng(seed)
    step, lateness = 0.05, rng.choice([0.0, 0.02])
    begins, errors, stamps = 100.0, [], []
    true_steady, true_time = [], []
    for _ in range(8):
        rate = rng.choice([1.0, rng.uniform(0.2, 1.0)])
        for _ in range(int(rng.integers(10, 60))):
            true_steady.append(begins)
            true_time.append(step * (1 + len(true_time)))
            begins += step / rate
    handled = [begin + rng.uniform(0.0, lateness) for begin in true_steady]
    for index, (instant, time) in enumerate(zip(handled, true_time)):
        simulated.tick(instant, round(1e9 * time))
        later = handled[index + 1] if index + 1 < len(handled) else instant
        for now in np.arange(instant, later, 0.02):
            simulated.steady = now
            stamps.append(simulated.arrivals.stamp(now))
            if index > 10:
                errors.append(1e-9 * stamps[-1] - np.interp(now, true_steady, true_time))
    assert np.abs(errors).max() <= 2.0 * step + lateness
    assert np.abs(errors).mean() <= 0.5 * step


def test_a_time_that_comes_in_steps_goes_on_between_them(simulated):
    rng = np.random.default_rng(3)
    for tick in range(100):
        simulated.tick(100.0 + 0.05 * tick + rng.choice([0.0, 0.03]), 50_000_000 * (tick + 1))
    simulated.steady = 104.99
    stamps = [simulated.arrivals.stamp(104.95 + 0.01 * index) for index in range(4)]
    steps = [after - before for before, after in itertools.pairwise(stamps)]
    assert all(9_000_000 <= step <= 11_000_000 for step in steps)
    assert abs(stamps[0] - 5_000_000_000) <= 10_000_000


def test_a_jump_is_followed_at_once(simulated):
    for time in (2_000_000_000, 2_050_000_000, 1_000_000, 900_000_000_000):
        simulated.tick(simulated.steady + 0.05, time)
        assert simulated.arrivals.stamp(simulated.steady) == time
    simulated.tick(simulated.steady + 0.05, 0)
    assert simulated.arrivals.stamp(simulated.steady) is None
