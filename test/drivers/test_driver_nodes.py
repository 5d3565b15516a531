"""Drivers and guard over real topics, against a robot and a team that the tests play."""

import math
from functools import partial, reduce

import numpy as np
import pytest
import shapely
from action_msgs.msg import GoalStatus
from numpy.testing import assert_allclose, assert_array_equal
from rclpy.node import Node
from robot_team import NANOSECONDS, image_message, rendered, stamped
from sensor_msgs.msg import CameraInfo

from maasi_filter.ros.conversions import pose_from_ros, stamp_to_ros
from maasi_filter.ros.qos import LATCHED, RELIABLE
from maasi_msgs.msg import AgentState, DetectionArray, KeepOuts, RangeArray, RangeMeasurement
from maasi_planner.motion import RobotState


@pytest.mark.parametrize(
    ('kind', 'lockstep'),
    [('turtlebot', False), ('turtlebot', True), ('mambo', False), ('ranging', True)],
)
def test_waypoints_are_followed_without_a_stop_and_the_last_one_is_held(play, kind, lockstep):
    _, team = play(kind, lockstep=lockstep)
    size = 5.0 if kind == 'ranging' else 1.0
    first = team.start.position + size * np.array([0.4, 0.34, 0.0])
    second = first + size * np.array([0.4, 0.2, 0.0])
    team.move()
    assert team.state.goal_status == AgentState.IDLE and team.state.goal_id == 0
    _, replaced = team.send_accepted(first, number=1, step=team.step)
    while np.linalg.norm(team.position - first) > 0.2 * size:
        team.move()
    _, result = team.send_accepted(second, number=2, step=team.step)
    for _ in range(20):
        # Driven and flown on: the controller slows down near a waypoint.
        assert np.linalg.norm(team.body.robot_state().velocity) > 0.09
        team.move()
        assert np.linalg.norm(team.command[:3]) > 0.09
    assert team.state.goal_id == 2 and team.state.goal_status == AgentState.MOVING
    assert team.aborted(replaced) == 'replaced'
    assert not result.done()
    while team.state.goal_status == AgentState.MOVING:
        team.move()
    assert team.state.goal_status == AgentState.REACHED
    place = pose_from_ros(team.state.pose.pose).position
    assert np.linalg.norm(place - second) <= team.settings.motion.tolerance
    assert team.ended(result) == (GoalStatus.STATUS_SUCCEEDED, '')
    assert result.result().result.reached
    assert_allclose(pose_from_ros(result.result().result.pose).position, place, atol=1e-12)
    # Nobody says anything more: it stays.
    team.move(50)
    assert team.state.goal_status == AgentState.REACHED
    assert np.linalg.norm(team.position - second) < 0.1
    assert np.linalg.norm(team.body.robot_state().velocity) < 0.02


def test_the_state_is_the_odometry_placed_in_the_map(play):
    _, team = play()
    team.send_accepted([1.0, 1.0, 0.0])
    team.move(30)
    before = team.body.robot_state()
    team.step = 30
    message = team.odometry_message()
    message.pose.covariance[0] = 0.04
    team.odometry.publish(message)
    team.until(lambda: team.state.step == 30 and len(team.commands) == 31)
    state = team.state
    assert state.robot == 'rover' and state.header.frame_id == 'map'
    assert state.header.stamp == stamp_to_ros(30 * NANOSECONDS) == team.commands[-1].header.stamp
    pose, linear = pose_from_ros(state.pose.pose), state.twist.linear
    assert_allclose(pose.position, before.pose.position, atol=1e-9)
    assert_allclose(pose.yaw, before.pose.yaw, atol=1e-9)
    assert_allclose([linear.x, linear.y, linear.z], before.velocity, atol=1e-9)
    ahead = team.start.rotation()[:2, 0]
    found = state.pose.covariance.reshape(6, 6)[:2, :2]
    assert_allclose(found, 0.04 * np.outer(ahead, ahead), atol=1e-12)


@pytest.mark.parametrize('kind', ['turtlebot', 'ranging'])
def test_a_cancelled_goal_stops_the_robot(play, kind):
    _, team = play(kind)
    assert 'no odometry received' in team.refused(team.start.position)
    team.move()
    handle, result = team.send_accepted(team.start.position + np.array([1.0, 0.0, 0.0]))
    team.move(5)
    assert np.any(team.command != 0.0)
    known = len(team.commands)
    cancelled = handle.cancel_goal_async()
    assert team.ended(result)[0] == GoalStatus.STATUS_CANCELED
    team.until(lambda: cancelled.done() and len(team.commands) > known)
    assert len(cancelled.result().goals_canceling) == 1
    assert_array_equal(team.command, np.zeros(4))
    team.move()
    assert team.state.goal_status == AgentState.CANCELED
    assert_allclose(team.command, np.zeros(4), atol=1e-9)


@pytest.mark.parametrize('kind', ['turtlebot', 'mambo'])
def test_a_robot_in_a_closed_zone_stays_until_it_is_sent_out(play, kind):
    """And then it leaves at its full speed; what it is sent into is refused."""
    changes = {'environment': {'bounds': [[-0.3, 6.0], [-0.3, 6.0]]}, 'start': [1.0, 1.0, 1.0]}
    driver, team = play(kind, **changes)
    team.move()
    publisher = team.create_publisher(KeepOuts, '/keep_outs', LATCHED)
    team.until(lambda: publisher.get_subscription_count())
    publisher.publish(KeepOuts(version=1, zones=['1.2 1.0 1.0']))
    team.until(lambda: len(driver.volume.area.circles))
    team.move(40)
    assert_allclose(team.position[:2], [1.0, 1.0], atol=0.01)
    assert 'keep-outs' in team.refused([1.3, 1.0, 1.0])
    keep_out = driver.follower.motion.keep_out
    goal = keep_out.exit_from(team.position)
    assert np.linalg.norm(goal - team.position) < 1.5
    _, result = team.send_accepted(goal.tolist())
    speeds = []
    for _ in range(400):
        team.move()
        speeds.append(float(np.linalg.norm(team.body.robot_state().velocity)))
        if keep_out.exit_from(team.position) is None:
            break
    assert keep_out.exit_from(team.position) is None
    assert max(speeds) > 0.8 * driver.settings.motion.speed
    # Its goal goes on.
    team.until(lambda: team.move() or result.done())
    assert result.result().result.reached


def test_a_keep_out_on_the_way_stops_the_robot_and_goals_in_it_are_refused(play):
    """What comes while it moves; then the path leads around."""
    driver, team = play()
    team.move()
    publisher = team.create_publisher(KeepOuts, '/keep_outs', LATCHED)
    team.until(lambda: publisher.get_subscription_count())
    _, result = team.send_accepted([1.8, 0.3, 0.0])
    team.move(5)
    assert np.any(team.command != 0.0)
    wall = 'POLYGON ((1 -0.1, 1.2 -0.1, 1.2 0.7, 1 0.7, 1 -0.1))'
    publisher.publish(KeepOuts(version=2, zones=[wall]))
    status, reason = team.ended(result)
    assert status == GoalStatus.STATUS_ABORTED and 'keep-out' in reason
    team.move()
    assert_array_equal(team.command, np.zeros(4))
    assert 'keep-outs' in team.refused([1.1, 0.3, 0.0])
    # An older one, and one that is none, change nothing.
    publisher.publish(KeepOuts(version=1, zones=[]))
    publisher.publish(KeepOuts(version=3, zones=['0.5 0.5']))
    team.until(lambda: driver.dropped['bad keep-outs'] == 1)
    assert 'keep-outs' in team.refused([1.1, 0.3, 0.0])
    team.send_accepted([1.8, 0.3, 0.0])
    places = []
    for _ in range(400):
        team.move()
        places.append(team.body.robot_state().pose.position)
    assert np.hypot(*(places[-1] - [1.8, 0.3, 0.0])[:2]) < 0.1
    zone = shapely.from_wkt(wall)
    assert min(zone.distance(shapely.Point(place[:2])) for place in places) >= 0.11


def test_a_flying_robot_outside_of_its_area_gives_its_goal_up_and_returns(play):
    """Whatever pushed it; the border has a margin of half a metre."""
    area = 'POLYGON ((-0.3 -0.3, 2.4 -0.3, 2.4 2.4, -0.3 2.4, -0.3 -0.3))'
    place = {'area': area, 'altitude': [0.0, 9.0]}
    _, team = play('ranging', environment=place, start=[1.0, 1.0, 5.0])
    team.move()
    assert 'area' in team.refused([2.45, 1.0, 5.0])
    _, result = team.send_accepted([2.0, 1.0, 5.0])
    team.move(3)
    team.body = team.motion.body(RobotState.at_rest([3.2, 1.0, 5.0]))
    team.move()
    status, reason = team.ended(result)
    assert status == GoalStatus.STATUS_ABORTED and '0.8 m outside of the area' in reason
    assert team.state.goal_status == AgentState.UNAVAILABLE
    team.move(40)
    assert team.state.goal_status != AgentState.UNAVAILABLE
    assert 2.0 < team.body.robot_state().pose.position[0] < 2.4


def test_a_goal_that_makes_no_sense_is_refused(play, capfd):
    driver, team = play()
    team.move()
    for position, changes, field in (
        ([math.nan, 0.5, 0.0], {}, 'position'),
        ([0.5, 0.5, math.inf], {}, 'position'),
        ([2.6, 0.5, 0.0], {}, 'position.x'),
        ([0.5, -0.5, 0.0], {}, 'position.y'),
        ([0.5, 0.5, 0.0], {'frame': 'odom'}, 'frame_id'),
        ([0.5, 0.5, 0.0], {'tolerance': math.nan}, 'tolerance'),
        ([0.5, 0.5, 0.0], {'tolerance': -0.1}, 'tolerance'),
    ):
        assert field in team.refused(position, **changes)
    assert driver.dropped['goal'] == 7
    assert 'go_to: waypoint.pose.position' in capfd.readouterr().err
    team.move()
    assert team.state.goal_status == AgentState.IDLE
    # On the border, within the robot's radius, is allowed.
    assert team.accepts([2.5, 0.5, 0.0])


def test_bad_odometry_is_counted_and_nothing_else(play):
    driver, team = play()
    team.move(3)
    for field, value in (
        ('pose.pose.position.x', math.nan),
        ('pose.pose.orientation.x', math.nan),
        ('twist.twist.linear.x', math.inf),
        ('pose.covariance', [0.1, *[math.nan] * 35]),
        ('header.frame_id', 'other/odom'),
        ('header.frame_id', '/other/odom'),
        ('header.stamp.sec', -5),
        ('header.stamp.nanosec', 2**32 - 1),
        ('header.stamp.sec', 2**31 - 1),
        ('header.stamp.sec', 0),
    ):
        bad = team.odometry_message(10**9 + NANOSECONDS // 5)
        *path, name = field.split('.')
        setattr(reduce(getattr, path, bad), name, value)
        team.odometry.publish(bad)
    team.ask(10**15)
    dropped = {'odometry': 6, 'bad stamp': 2, 'odometry stamp': 2, 'batch': 1}
    team.until(lambda: all(driver.dropped[reason] == n for reason, n in dropped.items()))
    for allowed in ('odom', 'rover/odom', '/rover/odom', ''):
        team.odometry_frame = allowed
        team.move()
    assert team.state.step == 6


def test_a_jump_of_the_stamps_begins_anew(play):
    driver, team = play()
    team.step = 99
    team.move()
    _, result = team.send_accepted([1.5, 1.5, 0.0])
    team.move(5)
    team.step = 2
    team.move()
    assert team.state.step == 3
    assert 'back' in team.aborted(result)
    # The driver notices a jump of the clock without odometry: its pose is unknown until some comes.
    driver.reset()
    assert 'no odometry' in team.refused([1.0, 1.0, 0.0])
    team.move()
    assert team.accepts([1.0, 1.0, 0.0])


def test_a_batch_is_answered_with_what_the_image_shows(play):
    driver, team = play()
    team.move()
    pose = team.body.robot_state().pose
    front, left = pose.rotation()[:2, 0], pose.rotation()[:2, 1]
    offset = 0.12 * front + 0.05 * left
    # In the image, but not in the box.
    outside = pose.position[:2] - 0.13 * front
    image = rendered(team, [(pose.position[:2] + offset).tolist(), outside.tolist()], pose)
    team.images.publish(stamped(image, team.step * NANOSECONDS))
    # A batch of others is not answered.
    team.ask(team.step * NANOSECONDS, robots=['other'])
    team.ask(team.step * NANOSECONDS, robots=['other', 'rover'])
    answer = team.answer()
    assert (answer.batch_id, answer.measurement, answer.robot) == (2, 8, 'rover')
    assert answer.step == team.step and answer.header.frame_id == 'map'
    assert answer.header.stamp == stamp_to_ros(team.step * NANOSECONDS)
    assert_allclose(pose_from_ros(answer.pose.pose).position, pose.position, atol=1e-9)
    assert answer.dropped == 1
    (seen,) = answer.detections
    assert_allclose(seen.range, np.hypot(*offset), atol=2e-3)
    assert_allclose(seen.bearing, np.arctan2(offset[1], offset[0]), atol=0.02)
    assert np.linalg.eigvalsh(np.reshape(seen.covariance, (2, 2))).min() > 0.0
    assert 'outside the field of view' in str(driver.status())


def test_in_lockstep_an_image_answers_its_own_batch_after_an_older_one(play):
    """A driver that was restarted gets the batch before again, and one image only."""
    _, team = play(lockstep=True)
    team.move(2)
    stamp = team.step * NANOSECONDS
    team.ask(stamp - NANOSECONDS)
    pose = team.body.robot_state().pose
    team.images.publish(stamped(rendered(team, [], pose), stamp))
    assert team.answer(1).batch_id == 1
    team.ask(stamp)
    answer = team.answer(2)
    assert (answer.batch_id, answer.step) == (2, team.step)


def test_images_that_cannot_be_used_are_counted_and_the_next_good_one_answers(play, capfd):
    driver, team = play()
    team.move()
    good = np.full((120, 160, 3), 254, np.uint8)
    team.ask(0)
    cut, small = image_message(good, 1), image_message(good[:60, :80], 1)
    cut.data = cut.data[:-5]
    for message in (cut, small):
        team.images.publish(message)
    team.until(lambda: driver.dropped['image'] == 2)
    team.images.publish(image_message(good, 2))
    team.move()
    # Seeing nothing is an answer, too.
    assert team.answer().header.stamp.nanosec == 2 and not team.answer().detections
    team.images.publish(image_message(good, 1))
    team.until(lambda: driver.dropped['image stamp'] == 1)
    said = capfd.readouterr().err
    assert 'camera/image_raw' in said and 'clipped' not in said
    # A lamp on the floor.
    good[40:64, 40:64] = 255
    team.images.publish(image_message(good, team.step * NANOSECONDS))
    team.ask(team.step * NANOSECONDS)
    assert not team.answer(2).detections
    assert '3 % of the pixels are clipped' in capfd.readouterr().err
    # A calibration replaces that of the parameters.
    info = CameraInfo(width=320, height=240, distortion_model='fisheye')
    info.k = [240.0, 0.0, 159.5, 0.0, 240.0, 119.5, 0.0, 0.0, 1.0]
    team.until(team.calibrations.get_subscription_count)
    team.calibrations.publish(info)
    # One that cannot be used is a fault, and nothing is measured by another one meanwhile.
    reason = "camera/camera_info: distortion_model: got 'fisheye', allowed plumb_bob or"
    team.until(lambda: reason in driver.health.text)
    team.move()
    assert (state := team.states[-1]).goal_status == AgentState.UNAVAILABLE
    assert reason in state.reason
    before = driver.dropped['image']
    team.images.publish(image_message(good, team.step * NANOSECONDS))
    team.ask(team.step * NANOSECONDS)
    team.until(lambda: driver.dropped['image'] > before)
    assert driver.sensor_input.camera.width == 160
    info.distortion_model = 'plumb_bob'
    # One without a focal length is none.
    for message in (CameraInfo(width=640, height=480), info):
        team.calibrations.publish(message)
    team.until(lambda: driver.sensor_input.camera.width == 320)
    assert not driver.health.text
    assert 'k is zero' in capfd.readouterr().err
    assert driver.sensor_input.camera.mount == team.settings.camera.mount


def sweep_of(*rows, **label):
    names = ('range', 'bearing', 'elevation')
    return RangeArray(ranges=[RangeMeasurement(**dict(zip(names, row)), **label) for row in rows])


def test_ranges_pass_through_as_they_come(play):
    driver, team = play('ranging')
    team.move()
    label = {'class_id': 'person', 'score': 0.7, 'identity': 'tag_4'}
    sweep = sweep_of((2.0, 0.3, -0.2), **label)
    # The second of these is outside the box, the third is no measurement, the last has no score.
    sweep.ranges += sweep_of((3.0, -2.0, 0.1), (9.0, 0.0, 0.0), (1.0, math.nan, 0.0)).ranges
    sweep.ranges += sweep_of((3.0, 0.1, 0.0), **label | {'score': 1.5}).ranges
    team.ranges.publish(sweep)
    team.ask(0)
    answer = team.answer()
    assert [
        (item.range, item.bearing, item.elevation, item.class_id, item.score, item.identity)
        for item in answer.detections
    ] == [(2.0, 0.3, -0.2, 'person', 0.7, 'tag_4'), (3.0, -2.0, 0.1, '', 0.0, '')]
    assert not any(len(item.covariance) for item in answer.detections)
    assert answer.dropped == 1 and driver.dropped['range'] == 2


def test_ranges_of_a_mounted_sensor_are_turned_by_the_pose(play):
    _, team = play('ranging', ranging={'frame': 'body', 'rpy': [0.0, 0.0, 0.5]}, yaw=0.7)
    team.move()
    team.ranges.publish(sweep_of((2.0, -0.2, 0.0)))
    team.ask(0)
    (item,) = team.answer().detections
    assert (item.range, item.elevation) == pytest.approx((2.0, 0.0))
    yaw = pose_from_ros(team.answer().pose.pose).yaw
    assert item.bearing == pytest.approx(yaw + 0.3)
    assert len(item.covariance) == 9


def test_in_lockstep_each_step_has_a_state_and_a_command(play):
    _, team = play(lockstep=True)
    image = rendered(team, [[2.0, 2.0]], team.start)
    for k in range(5):
        team.begin_step(k)
        team.until_done(k + 1)
        assert team.state.step == k
        assert team.commands[-1].header.stamp == stamp_to_ros(k * NANOSECONDS)
        team.images.publish(stamped(image, k * NANOSECONDS))
        team.ask(k * NANOSECONDS, step=k)
        assert team.answer(k + 1).step == k
        if k == 2:
            team.send_accepted([1.0, 1.0, 0.0], step=k)
            assert_array_equal(team.command, np.zeros(4))
    expected = [AgentState.IDLE] * 3 + [AgentState.MOVING] * 2
    assert [state.goal_status for state in team.states] == expected
    # A step and a batch can come twice: a program was restarted.
    team.begin_step(4)
    team.until_done(6)
    assert team.states[-1] == team.states[-2] and team.commands[-1] == team.commands[-2]
    team.batch -= 1
    team.ask(4 * NANOSECONDS, step=4)
    assert team.answer(6) == team.answer(5)


def test_in_lockstep_nobody_waits_for_bad_odometry_or_a_robot_that_has_left(play):
    driver, team = play(lockstep=True)
    team.begin_step(0)
    team.until_done(1)
    _, result = team.send_accepted([1.0, 1.0, 0.0])
    bad = team.odometry_message(NANOSECONDS)
    bad.pose.pose.position.x = math.nan
    team.odometry.publish(bad)
    team.until_done(2)
    assert team.state.step == 1 and driver.dropped['odometry'] == 1
    assert_array_equal(team.command, np.zeros(4))
    assert team.commands[-1].header.stamp == stamp_to_ros(NANOSECONDS)
    team.begin_step(2, robots=['other'])
    assert team.aborted(result) == 'left'
    assert 'the robot left' in team.refused([1.0, 1.0, 0.0])
    team.begin_step(3)
    team.until_done(3)
    assert [item.step for item in team.states] == [0, 1, 3]
    assert team.state.goal_status == AgentState.ABORTED and team.state.reason == 'left'


def test_a_driver_is_ready_once_filter_and_planner_hear_it(play, start_node):
    _, team = play()

    for name, kind, topic in (
        ('filter_node', DetectionArray, 'detections'),
        ('planner_node', AgentState, 'state'),
    ):
        team.move(20)
        assert not team.ready
        node = start_node(partial(Node, name))
        node.create_subscription(kind, topic, lambda message: None, RELIABLE)
    team.until(lambda: team.ready)
    assert team.ready[0].node == '/rover/driver' and team.ready[0].step == 0
