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
    assert stamp_problem(String()) is None


@pytest.mark.parametrize(
    ('stamps', 'accepted'),
    [
        # One wrong stamp changes nothing, nor does the same one again.
        ((100.0, 1e6, 100.05), '101'),
        ((100.0, 0.0, 100.05), '101'),
        ((100.0, -5.0, 100.05), '101'),
        ((100.0, 1e6, 1e6, 100.05), '1001'),
        # A late message is none.
        ((100.0, 99.5, 100.05), '111'),
        # A stream that goes on elsewhere is followed from its second stamp.
        ((100.0, 3.0, 3.05, 3.1), '1011'),
        ((100.0, 500.0, 500.05, 500.1), '1011'),
    ],
)
def test_single_wrong_stamps_are_refused_and_streams_followed(stamps, accepted):
    gate = StampGate()
    assert [gate.accepts(round(stamp * SECOND)) for stamp in stamps] == [
        item == '1' for item in accepted
    ]


def test_batch_ids_leave_room_to_go_on():
    limit = batch_id_limit(0)
    assert limit < 2**63
    # What is accepted once can be continued.
    assert limit + 1 <= batch_id_limit(limit)
