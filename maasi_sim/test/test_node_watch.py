"""Who hangs: silent nodes, but not those that start or wait for a processor."""

import os

import pytest

from maasi_sim.run.supervisor import NodeWatch, waited_for_processor

FILTER, PLANNER = '/filter_node', '/planner_node'


@pytest.fixture
def watch():
    # Time that processes have waited for a processor, by their numbers.
    queued = {}
    made = NodeWatch(4.5, 180.0, lambda pid: queued.get(pid, 0.0))
    made.queued = queued
    made.begin(FILTER, 1, 0.0)
    made.begin(PLANNER, 2, 0.0)
    return made


def look(watch, begin, end):
    """Look ten times a second, and return the first finding."""
    for tick in range(round(10 * begin), round(10 * end)):
        if hung := watch.hung(0.1 * tick):
            return 0.1 * tick, hung
    return None


def test_a_silent_node_is_named_within_five_seconds_and_no_pause_of_three(watch):
    for name in (FILTER, PLANNER):
        watch.beat(name, 26.0)
    assert look(watch, 26.1, 30.0) is None
    watch.beat(FILTER, 30.0)
    for second in range(30, 34):
        watch.beat(PLANNER, float(second))
        assert look(watch, second, second + 1) is None
    watch.beat(PLANNER, 34.0)
    when, hung = look(watch, 34, 36)
    assert list(hung) == [FILTER]
    assert when < 35.0


def test_a_node_that_starts_has_as_long_as_the_limit_says(watch):
    assert look(watch, 0, 179) is None
    assert watch.late(179.0) == []
    watch.beat(PLANNER, 179.5)
    assert watch.starting() == [FILTER]
    assert watch.late(181.0) == [FILTER]
    # The last heartbeat of the process before does not count.
    watch.begin(PLANNER, 3, 190.0)
    watch.beat(PLANNER, 190.2)
    assert set(watch.starting()) == {FILTER, PLANNER}


def test_time_in_the_queue_for_a_processor_does_not_count(watch):
    watch.queued[1] = 2.0
    watch.beat(FILTER, 1.0)
    watch.queued[1] = 5.0
    assert look(watch, 1.1, 8.4) is None
    assert look(watch, 8.4, 9.0) is not None


def test_the_run_itself_may_have_stood_still(watch):
    watch.beat(FILTER, 1.0)
    watch.hung(1.1)
    assert not watch.hung(61.1)
    assert look(watch, 61.2, 65.0) is None
    assert look(watch, 65.0, 66.5) is not None


def test_the_wait_for_a_processor_is_read_from_the_system():
    begin = waited_for_processor(os.getpid())
    assert waited_for_processor(os.getpid()) >= begin >= 0.0
    assert waited_for_processor(None) == 0.0
