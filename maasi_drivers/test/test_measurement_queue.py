"""Which image answers which batch."""

import pytest
from numpy.testing import assert_allclose

from maasi_drivers.agent.measurement_responder import MeasurementQueue, MeasurementRequest
from maasi_drivers.agent.odometry import PoseHistory, StampedPose
from maasi_filter.models.pose import Pose


def pose(stamp):
    return StampedPose(stamp, Pose.from_yaw([0.01 * stamp, 0.0, 0.0], 0.0))


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


@pytest.mark.parametrize(
    ('poses', 'requests', 'frames', 'expected'),
    [
        # The first image at or after the stamp answers.
        ((0, 100), [(1, 20)], (10, 20, 30), [(1, 20, 20)]),
        # One before all odometry is of no use.
        ((10, 20), [(1, 0)], (5, 15), [(1, 15, 15)]),
        # An image answers one batch.
        ((0, 100), [(1, 10), (2, 20)], (30,), [(1, 30, 30)]),
        ((0, 100), [(1, 10), (2, 20)], (30, 40), [(1, 30, 30), (2, 40, 40)]),
        # A batch that comes twice is answered once.
        ((0, 100), [(1, 20), (1, 20)], (20, 30), [(1, 20, 20)]),
        # A request for a time to come holds up no other.
        ((0, 100), [(1, 90), (2, 10)], (20, 95), [(2, 20, 20), (1, 95, 95)]),
    ],
)
def test_which_image_answers_which_request(poses, requests, frames, expected):
    queue = queue_of(*poses)
    for batch, stamp in requests:
        assert queue.add_request(MeasurementRequest(batch, stamp, 0)) is None
    for stamp in frames:
        queue.add_frame(stamp, None)
    assert answers(queue) == expected


def test_an_image_waits_for_the_odometry_after_it():
    queue = queue_of(0, 10)
    queue.add_request(MeasurementRequest(1, 5, 0))
    queue.add_frame(15, None)
    assert queue.next() is None
    queue.history.add(pose(20))
    *_, where = queue.next()
    assert_allclose(where.pose.position[0], 0.15)


def test_an_image_that_turns_out_bad_is_replaced_by_the_next():
    queue = queue_of(0, 100, offset=-5)
    queue.add_request(MeasurementRequest(1, 10, 0))
    queue.add_frame(30, None)
    queue.add_frame(40, None)
    assert queue.next()[1] == 30
    # The offset shifts the time of the pose.
    assert answers(queue) == [(1, 40, 35)]


def test_only_so_many_images_and_requests_are_kept():
    queue = queue_of(0, 100, frames=2, requests=2)
    for stamp in (10, 20, 30):
        queue.add_frame(stamp, None)
    dropped = [queue.add_request(MeasurementRequest(number, 0, 0)) for number in (1, 2, 3)]
    assert dropped == [None, None, MeasurementRequest(1, 0, 0)]
    assert answers(queue) == [(2, 20, 20), (3, 30, 30)]
