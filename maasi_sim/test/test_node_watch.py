"""Who hangs: silent nodes, but not those that start or wait for a processor."""

import os
import time

from maasi_sim.run.supervisor import NodeWatch, waited_for_processor


def watch(waited=lambda pid: 0.0):
    made = NodeWatch(4.5, 180.0, waited)
    made.begin('/filter_node', 1, 0.0)
    made.begin('/planner_node', 2, 0.0)
    return made


def look(made, begin, end):
    """Look ten times a second, and return the first finding."""
    for tick in range(round(10 * begin), round(10 * end)):
        if hung := made.hung(0.1 * tick):
            return 0.1 * tick, hung
    return None


def test_a_silent_node_is_named_within_five_seconds():
    made = watch()
    for name in ('/filter_node', '/planner_node'):
        made.beat(name, 30.0)
    for second in range(31, 35):
        made.beat('/planner_node', float(second))
        assert second == 34 or look(made, second, second + 1) is None
    when, hung = look(made, 34, 36)
    assert list(hung) == ['/filter_node']
    assert when < 35.0


def test_a_pause_of_three_seconds_is_no_fault():
    made = watch()
    made.beat('/filter_node', 30.0)
    assert look(made, 30.1, 34.0) is None
    made.beat('/filter_node', 34.0)
    assert look(made, 34.1, 38.0) is None


def test_a_node_that_starts_has_as_long_as_the_limit_says():
    made = watch()
    assert look(made, 0, 179) is None
    assert made.late(179.0) == []
    made.beat('/planner_node', 179.5)
    assert made.starting() == ['/filter_node']
    assert made.late(181.0) == ['/filter_node']


def test_the_last_heartbeat_of_the_process_before_does_not_count():
    made = watch()
    made.beat('/filter_node', 1.0)
    made.begin('/filter_node', 3, 10.0)
    made.beat('/filter_node', 10.2)
    assert set(made.starting()) == {'/filter_node', '/planner_node'}


def test_time_in_the_queue_for_a_processor_does_not_count():
    queued = {1: 2.0}
    made = watch(lambda pid: queued.get(pid, 0.0))
    made.beat('/filter_node', 1.0)
    queued[1] = 5.0
    assert look(made, 1.1, 8.4) is None
    assert look(made, 8.4, 9.0) is not None


def test_the_run_itself_may_have_stood_still():
    made = watch()
    made.beat('/filter_node', 1.0)
    made.hung(1.1)
    assert not made.hung(61.1)
    assert look(made, 61.2, 65.0) is None
    assert look(made, 65.0, 66.5) is not None


def test_the_wait_for_a_processor_is_read_from_the_system():
    begin = waited_for_processor(os.getpid())
    end = time.monotonic() + 0.2
    while time.monotonic() < end:
        pass
    assert begin >= 0.0
    assert waited_for_processor(os.getpid()) >= begin
    assert waited_for_processor(None) == 0.0
