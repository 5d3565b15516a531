"""Which image answers which batch."""

import numpy as np
from numpy.testing import assert_allclose

from maasi_drivers.agent.measurement_responder import MeasurementQueue, MeasurementRequest
from maasi_drivers.agent.odometry import PoseHistory, StampedPose
from maasi_filter.models.pose import Pose


def pose(stamp):
    return StampedPose(
        stamp, Pose.from_yaw([0.01 * stamp, 0.0, 0.0], 0.0), np.zeros((6, 6)), *np.zeros((2, 3))
    )


def queue_of(*stamps, **options):
    history = PoseHistory()
    for stamp in stamps:
        history.add(pose(stamp))
    return MeasurementQueue(history, **options)


def answers(queue):
    found = []
    while (item := queue.next()) is not None:
        request, stamp, _, where = item
        queue.answered(request)
        found.append((request.batch, stamp, where.stamp))
    return found


def test_the_first_image_at_or_after_the_stamp_answers():
    queue = queue_of(0, 100)
    for stamp in (10, 20, 30):
        queue.add_frame(stamp, None)
    queue.add_request(MeasurementRequest(1, 20, 0))
    assert answers(queue) == [(1, 20, 20)]


def test_an_image_waits_for_the_odometry_after_it():
    queue = queue_of(0, 10)
    queue.add_request(MeasurementRequest(1, 5, 0))
    queue.add_frame(15, None)
    assert queue.next() is None
    queue.history.add(pose(20))
    *_, where = queue.next()
    assert_allclose(where.pose.position[0], 0.15)


def test_an_image_before_all_odometry_is_of_no_use():
    queue = queue_of(10, 20)
    queue.add_request(MeasurementRequest(1, 0, 0))
    queue.add_frame(5, None)
    queue.add_frame(15, None)
    assert answers(queue) == [(1, 15, 15)]


def test_an_image_answers_one_batch():
    queue = queue_of(0, 100)
    queue.add_request(MeasurementRequest(1, 10, 0))
    queue.add_request(MeasurementRequest(2, 20, 1))
    queue.add_frame(30, None)
    assert answers(queue) == [(1, 30, 30)]
    queue.add_frame(40, None)
    assert answers(queue) == [(2, 40, 40)]


def test_a_batch_that_comes_twice_is_answered_once():
    queue = queue_of(0, 100)
    for _ in range(2):
        assert queue.add_request(MeasurementRequest(1, 20, 0)) is None
    for stamp in (20, 30):
        queue.add_frame(stamp, None)
    assert answers(queue) == [(1, 20, 20)]


def test_an_image_that_turns_out_bad_is_replaced_by_the_next():
    queue = queue_of(0, 100)
    queue.add_request(MeasurementRequest(1, 10, 0))
    queue.add_frame(30, None)
    queue.add_frame(40, None)
    assert queue.next()[1] == 30
    assert answers(queue) == [(1, 40, 40)]


def test_the_offset_shifts_the_time_of_the_pose():
    queue = queue_of(0, 100, offset=-5)
    queue.add_request(MeasurementRequest(1, 10, 0))
    queue.add_frame(30, None)
    assert answers(queue) == [(1, 30, 25)]


def test_only_so_many_images_and_requests_are_kept():
    queue = queue_of(0, 100, frames=2, requests=2)
    for stamp in (10, 20, 30):
        queue.add_frame(stamp, None)
    dropped = [queue.add_request(MeasurementRequest(number, 0, 0)) for number in (1, 2, 3)]
    assert dropped == [None, None, MeasurementRequest(1, 0, 0)]
    assert answers(queue) == [(2, 20, 20), (3, 30, 30)]


def test_a_request_for_a_time_to_come_holds_up_no_other():
    queue = queue_of(0, 100)
    queue.add_request(MeasurementRequest(1, 90, 0))
    queue.add_request(MeasurementRequest(2, 10, 1))
    queue.add_frame(20, None)
    queue.add_frame(95, None)
    assert answers(queue) == [(2, 20, 20), (1, 95, 95)]
