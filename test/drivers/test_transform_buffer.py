"""The buffer of transforms: chains, times, and what it refuses."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from maasi_drivers.agent.transform_buffer import TransformBuffer, TransformError
from maasi_filter.models.pose import Pose, compose

SECOND = 1_000_000_000
MAP_FROM_ODOM = Pose.from_yaw([1.0, 2.0, 0.0], 0.5)
MOUNT = Pose([0.1, 0.0, 0.2], [0.5, -0.5, 0.5, -0.5])


def robot(buffer, stamp, x, yaw=0.0):
    buffer.add('odom', 'base', Pose.from_yaw([x, 0.0, 0.0], yaw), stamp)


@pytest.fixture
def buffer():
    made = TransformBuffer()
    made.add('map', 'odom', MAP_FROM_ODOM, static=True)
    made.add('base', 'camera', MOUNT, static=True)
    robot(made, SECOND, 1.0, 0.2)
    robot(made, 2 * SECOND, 2.0, 0.6)
    return made


def test_chains_are_composed_up_and_down(buffer):
    base = compose(MAP_FROM_ODOM, Pose.from_yaw([2.0, 0.0, 0.0], 0.6))
    found = buffer.pose('map', 'camera')
    assert_allclose(found.position, compose(base, MOUNT).position, atol=1e-12)
    assert_allclose(found.rotation(), compose(base, MOUNT).rotation(), atol=1e-12)
    both = compose(buffer.pose('camera', 'map'), found)
    assert_allclose(both.position, np.zeros(3), atol=1e-12)
    assert_allclose(both.rotation(), np.eye(3), atol=1e-12)
    # Two branches of the tree.
    buffer.add('map', 'dock', Pose.from_yaw([0.0, 1.0, 0.0], np.pi), static=True)
    seen = buffer.pose('dock', 'base').position
    assert_allclose(seen, [-base.position[0], 1.0 - base.position[1], 0.0])
    assert buffer.latest('map', 'camera') == 2 * SECOND
    assert buffer.latest('map', 'dock') is None
    assert buffer.pose('nowhere', 'nowhere') == Pose(np.zeros(3))


def test_times_between_are_interpolated_and_nothing_is_extrapolated(buffer):
    found = buffer.pose('odom', 'base', round(1.3 * SECOND))
    assert_allclose([found.position[0], found.yaw], [1.3, 0.32], atol=1e-6)
    for stamp in (SECOND - 1, 2 * SECOND + 1):
        with pytest.raises(TransformError, match=f'{SECOND} to {2 * SECOND}'):
            buffer.pose('map', 'base', stamp)


def test_the_latest_is_what_all_transforms_are_known_at():
    buffer = TransformBuffer()
    buffer.add('map', 'odom', MAP_FROM_ODOM, 3 * SECOND)
    robot(buffer, 3 * SECOND - 5, 0.0)
    with pytest.raises(TransformError):
        buffer.pose('map', 'base')
    robot(buffer, 3 * SECOND + 5, 1.0)
    assert buffer.latest('map', 'base') == 3 * SECOND
    expected = compose(MAP_FROM_ODOM, Pose([0.5, 0.0, 0.0])).position
    assert_allclose(buffer.pose('map', 'base').position, expected, atol=1e-12)


def test_frames_that_make_no_sense_are_named_and_change_nothing(buffer):
    before = buffer.pose('map', 'camera')
    for parent, child, stamp, problem in (
        ('', 'a', 0, 'frame'),
        ('a', 'b' * 201, 0, 'frame'),
        ('a', 'a', 0, 'loop'),
        ('camera', 'odom', 0, 'loop'),
        ('odom', 'base', -1, 'stamp'),
    ):
        with pytest.raises(ValueError, match=problem):
            buffer.add(parent, child, MOUNT, stamp)
    with pytest.raises(TransformError, match="unknown frame 'kitchen'"):
        buffer.pose('map', 'kitchen')
    buffer.add('world', 'kitchen', MOUNT, static=True)
    with pytest.raises(TransformError, match="not connected: their roots are 'world' and 'map'"):
        buffer.pose('map', 'kitchen')
    assert buffer.pose('map', 'camera') == before
    for k in range(4, 2000):
        buffer.add('odom', f'frame {k}', MOUNT, static=True)
    with pytest.raises(ValueError, match='2000 frames'):
        buffer.add('odom', 'one more', MOUNT, static=True)


def test_one_stamp_far_off_changes_nothing_and_a_real_jump_is_followed(buffer):
    robot(buffer, 10**18, 9.0)
    assert buffer.latest('map', 'base') == 2 * SECOND
    robot(buffer, 20 * SECOND, 2.5)
    robot(buffer, 20 * SECOND + 5, 3.0)
    assert buffer.latest('map', 'base') == 20 * SECOND + 5
    # Time has been set back: the second message shows it.
    robot(buffer, 100, 4.0)
    robot(buffer, 200, 5.0)
    assert buffer.latest('map', 'base') == 200
    assert_allclose(buffer.pose('odom', 'base').position[0], 5.0)
    buffer.clear()
    with pytest.raises(TransformError, match='base'):
        buffer.pose('odom', 'base')
    assert buffer.pose('base', 'camera') == MOUNT
