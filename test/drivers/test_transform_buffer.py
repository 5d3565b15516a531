"""The buffer of transforms: chains, times, and what it refuses."""

import pytest
from numpy.testing import assert_allclose

from maasi_drivers.agent.transform_buffer import TransformBuffer, TransformError
from maasi_filter.models.pose import Pose

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


def test_times_between_are_interpolated_and_nothing_is_extrapolated(buffer):
    found = buffer.pose('odom', 'base', round(1.3 * SECOND))
    assert_allclose([found.position[0], found.yaw], [1.3, 0.32], atol=1e-6)
    for stamp in (SECOND - 1, 2 * SECOND + 1):
        with pytest.raises(TransformError, match=f'{SECOND} to {2 * SECOND}'):
            buffer.pose('map', 'base', stamp)


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
    with pytest.raises(TransformError, match="'kitchen' is not known"):
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
