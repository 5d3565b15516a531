"""Plausibility of stamps: what is refused, and what is accepted again afterwards."""

import pytest
from builtin_interfaces.msg import Time
from nav_msgs.msg import Odometry
from std_msgs.msg import String

from maasi_filter.ros.clocks import StampGate, batch_id_limit, stamp_problem
from maasi_msgs.msg import MeasurementBatch

SECOND = 10**9


@pytest.mark.parametrize(
    ('stamp', 'problem'),
    [
        (Time(sec=-1), 'sec: read -1, allowed is from 0'),
        (Time(sec=-(2**31), nanosec=5), 'sec: read -2147483648'),
        (Time(sec=1, nanosec=2**32 - 1), 'nanosec: read 4294967295'),
        (Time(), None),
        (Time(sec=2**31 - 1, nanosec=SECOND - 1), None),
    ],
)
def test_a_stamp_that_is_no_time_is_named(stamp, problem):
    odometry = Odometry()
    odometry.header.stamp = stamp
    for message, name in ((odometry, 'header.stamp.'), (MeasurementBatch(stamp=stamp), 'stamp.')):
        found = stamp_problem(message)
        assert found is None if problem is None else found.startswith(name + problem)


def test_a_message_without_a_stamp_has_no_problem():
    assert stamp_problem(String()) is None


@pytest.mark.parametrize('wrong', [10**6 * SECOND, 0, -5 * SECOND])
def test_one_wrong_stamp_is_refused_and_changes_nothing(wrong):
    gate = StampGate()
    good = [100 * SECOND + k * SECOND // 20 for k in range(40)]
    assert all(gate.accepts(stamp) for stamp in good[:20])
    assert not gate.accepts(wrong)
    assert all(gate.accepts(stamp) for stamp in good[20:])


@pytest.mark.parametrize('begin', [3 * SECOND, 500 * SECOND])
def test_a_stream_that_goes_on_elsewhere_is_followed_from_its_second_stamp(begin):
    gate = StampGate()
    assert gate.accepts(100 * SECOND)
    assert not gate.accepts(begin)
    assert gate.accepts(begin + SECOND // 20)
    assert gate.accepts(begin + SECOND // 10)


def test_the_same_wrong_stamp_twice_is_refused_twice():
    gate = StampGate()
    assert gate.accepts(SECOND)
    assert not gate.accepts(10**6 * SECOND)
    assert not gate.accepts(10**6 * SECOND)
    assert gate.accepts(SECOND + 1)


def test_batch_ids_leave_room_to_go_on():
    limit = batch_id_limit(0)
    assert limit < 2**63
    # What is accepted once can be continued.
    assert limit + 1 <= batch_id_limit(limit)
    assert batch_id_limit(500) < 2**64 - 1
