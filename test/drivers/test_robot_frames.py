"""Frames on /tf and /tf_static, the description, poses from tf, and goals in other frames."""

import math
import sys
import time
from xml.etree import ElementTree

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from geometry_msgs.msg import PoseStamped
from numpy.testing import assert_allclose, assert_array_equal
from rclpy.parameter import Parameter
from robot_team import NANOSECONDS, STEP, stamped, transform
from rosbags.typesys import Stores, get_typestore
from std_msgs.msg import String
from tf2_msgs.msg import TFMessage

from maasi_drivers.agent.transform_buffer import TransformBuffer
from maasi_drivers.vision.camera_model import Camera
from maasi_filter.models.pose import Pose, compose, inverse
from maasi_filter.ros.conversions import pose_from_ros, pose_to_ros, stamp_from_ros
from maasi_filter.ros.qos import LATCHED, LATCHED_ALL, RELIABLE
from maasi_msgs.msg import AgentState

BASE = 'rover/base_link'
DOCK = Pose.from_yaw([1.0, 1.2, 0.0], 2.0)


class Listener:
    """What any node receives on /tf and /tf_static."""

    def __init__(self, team):
        self.moving, self.static = [], []
        team.create_subscription(TFMessage, '/tf', self.moving.append, RELIABLE)
        team.create_subscription(TFMessage, '/tf_static', self.static.append, LATCHED_ALL)

    def buffer(self):
        made = TransformBuffer()
        for item in (item for message in self.static + self.moving for item in message.transforms):
            moved, turn = item.transform.translation, item.transform.rotation
            pose = Pose([moved.x, moved.y, moved.z], [turn.w, turn.x, turn.y, turn.z])
            child, stamp = item.child_frame_id, stamp_from_ros(item.header.stamp)
            made.add(item.header.frame_id, child, pose, stamp, static=child != BASE)
        return made


def test_frames_agree_with_the_state_and_who_comes_late_hears_the_static_ones(play):
    driver, team = play(tf_rate=10.0)
    listener = Listener(team)
    team.until(lambda: driver.count_subscribers('/tf') == 2)
    team.send_accepted([1.0, 1.0, 0.0])
    team.move(20)
    team.until(lambda: len(listener.moving) == 10)
    team.until(lambda: any(len(message.transforms) == 3 for message in listener.static))
    buffer = listener.buffer()
    states = {stamp_from_ros(state.header.stamp): state for state in team.states}
    for message in listener.moving:
        (item,) = message.transforms
        stamp = stamp_from_ros(item.header.stamp)
        # Ten times a second, of twenty states.
        assert stamp % (2 * NANOSECONDS) == 0
        found, expected = buffer.pose('map', BASE, stamp), pose_from_ros(states[stamp].pose.pose)
        assert_allclose(found.position, expected.position, atol=1e-9)
        assert_allclose(found.rotation(), expected.rotation(), atol=1e-9)
    assert_allclose(buffer.pose('map', 'rover/odom').position, team.start.position)
    optical = buffer.pose(BASE, 'rover/camera_optical')
    assert_allclose(optical.position, team.settings.camera.mount.position, atol=1e-12)
    camera = Camera.from_settings(team.settings.camera)
    assert_allclose(optical.rotation(), camera.rotation, atol=1e-12)
    # The type is that of a real tf2_msgs.
    expected = get_typestore(Stores.ROS2_JAZZY).hash_rihs01('tf2_msgs/msg/TFMessage')
    hashes = [
        f'RIHS01_{bytes(info.topic_type_hash.value).hex()}'
        for info in team.get_publishers_info_by_topic('/tf')
    ]
    assert hashes == [expected]
    # The description, too.
    listener, texts = Listener(team), []
    team.create_subscription(String, 'robot_description', texts.append, LATCHED)
    team.until(lambda: listener.static and texts)
    (message,) = listener.static
    names = {(item.header.frame_id, item.child_frame_id) for item in message.transforms}
    fixed = {(BASE, 'rover/camera'), ('rover/camera', 'rover/camera_optical')}
    assert names == {('map', 'rover/odom'), *fixed}
    root = ElementTree.fromstring(texts[0].data)
    assert root.tag == 'robot' and root.get('name') == 'rover'
    assert {link.get('name') for link in root.iter('link')} == {name for p in fixed for name in p}
    assert root.find('link/visual/geometry/cylinder').get('radius') == '0.11'
    buffer = listener.buffer()
    for joint in root.iter('joint'):
        parent, child = joint.find('parent').get('link'), joint.find('child').get('link')
        origin = [float(number) for number in joint.find('origin').get('xyz').split()]
        assert_allclose(buffer.pose(parent, child).position, origin, atol=1e-12)


# ---- poses from tf ---------------------------------------------------------------------------


class Localised:
    """A robot whose pose a localiser and its own odometry publish on /tf, in real time."""

    def __init__(self, team):
        self.team = team
        self.map_from_odom = Pose.from_yaw([0.5, -0.2, 0.0], 0.4)
        self.publisher = team.create_publisher(TFMessage, '/tf', RELIABLE)
        team.until(self.publisher.get_subscription_count)
        self.stamp = time.time_ns()

    def publish(self):
        pose = compose(inverse(self.map_from_odom), self.team.body.robot_state().pose)
        # As localisers do, ahead of the odometry.
        correction = transform('map', 'odom', self.map_from_odom, self.stamp + NANOSECONDS // 2)
        moved = transform('odom', 'chassis', pose, self.stamp)
        self.publisher.publish(TFMessage(transforms=[correction, moved]))

    def move(self):
        team, known = self.team, len(self.team.commands)
        self.stamp = max(self.stamp + NANOSECONDS, time.time_ns() - 500_000_000)
        self.publish()
        end = time.monotonic() + 0.5
        team.until(lambda: len(team.commands) > known or time.monotonic() > end)
        if len(team.commands) > known:
            team.body.step(team.command, STEP)


def test_a_driver_follows_poses_on_tf_and_stops_when_they_go_stale(play):
    driver, team = play(pose_source='tf', base_frame='chassis', odometry_timeout=3.0)
    assert not team.count_subscribers('odom')
    robot = Localised(team)
    # One correction without odometry is no pose.
    robot.publisher.publish(
        TFMessage(transforms=[transform('map', 'odom', robot.map_from_odom, robot.stamp)])
    )
    team.until(lambda: robot.move() or team.states)
    goal = team.start.position + np.array([0.15, 0.1, 0.0])
    _, result = team.send_accepted(goal, live=robot.move)
    assert team.ended(result, robot.move)[0] == GoalStatus.STATUS_SUCCEEDED
    assert np.linalg.norm(team.position - goal) <= 0.1
    before = team.position
    _, result = team.send_accepted([1.8, 1.8, 0.0], live=robot.move)
    team.until(lambda: robot.move() or np.any(team.command != 0.0))
    # Silence.
    assert 'no pose on tf for' in team.aborted(result)
    team.until(lambda: team.state.goal_status == AgentState.UNAVAILABLE)
    assert_array_equal(team.command, np.zeros(4))
    assert np.linalg.norm(team.position - before) < 0.5
    # Transforms that come late are no pose.
    robot.stamp += NANOSECONDS
    team.until(lambda: time.time_ns() - robot.stamp > 3_100_000_000)
    known = driver.dropped['stale transform']
    robot.publish()
    team.until(lambda: driver.dropped['stale transform'] > known)
    assert team.state.goal_status == AgentState.UNAVAILABLE
    assert 'no pose on tf' in team.refused([1.8, 1.8, 0.0])
    # They are back.
    team.until(lambda: robot.move() or team.state.goal_status != AgentState.UNAVAILABLE)
    assert team.accepts([1.8, 1.8, 0.0], live=robot.move)


def test_a_driver_takes_poses_of_a_localiser_from_a_topic(play):
    driver, team = play(pose_source='pose', odometry_timeout=1.0, tf_rate=0.0)
    assert not team.count_subscribers('odom')
    # With this rate others publish the frames.
    assert not any(map(team.count_publishers, ('/tf', '/tf_static', 'robot_description')))
    poses = team.create_publisher(PoseStamped, 'pose', RELIABLE)
    # Not where the robot was put down.
    expected = Pose.from_yaw([0.9, 0.4, 0.0], -1.0)
    message = PoseStamped(pose=pose_to_ros(expected))

    def say(frame='map'):
        message.header.frame_id = frame
        poses.publish(stamped(message, time.time_ns()))

    team.until(lambda: say() or team.states)
    found = pose_from_ros(team.state.pose.pose)
    assert_allclose(found.position, expected.position, atol=1e-9)
    assert found.yaw == pytest.approx(-1.0)
    team.until(lambda: say('odom') or driver.dropped['pose'] > 3)
    team.until(lambda: team.state.goal_status == AgentState.UNAVAILABLE)
    assert 'no pose for' in team.state.reason
    team.until(lambda: say() or team.state.goal_status != AgentState.UNAVAILABLE)


def test_odometry_may_be_in_the_map_already(play):
    driver, team = play(odometry_origin='map')
    # The frame is not the map.
    team.until(lambda: team.say() or driver.dropped['odometry'] > 3)
    assert not team.states
    team.odometry_frame = 'map'
    team.until(lambda: team.say() or team.states)
    # What the odometry says is where it is, wherever it was put down.
    odometry = pose_from_ros(team.odometry_message().pose.pose)
    assert_allclose(pose_from_ros(team.state.pose.pose).position, odometry.position, atol=0.02)
    assert np.linalg.norm(odometry.position - team.start.position) > 0.1


@pytest.mark.parametrize('origin', ['zero', 'first'])
def test_odometry_that_says_that_it_is_in_the_map_is_taken_as_that(play, capfd, origin):
    driver, team = play(odometry_origin=origin)
    team.odometry_frame = 'map'
    team.until(lambda: team.say() or team.states)
    odometry = pose_from_ros(team.odometry_message().pose.pose)
    assert_allclose(pose_from_ros(team.state.pose.pose).position, odometry.position, atol=0.02)
    assert np.linalg.norm(odometry.position - team.start.position) > 0.1
    assert "odom: header.frame_id is 'map'" in capfd.readouterr().err
    # It does not mix with odometry from the start, once some messages have fixed the frame.
    team.until(lambda: team.say() or len({state.step for state in team.states}) > 3)
    team.odometry_frame = 'odom'
    team.until(lambda: team.say() or driver.dropped['odometry'] > 3)
    assert "but previous messages were in 'map'" in capfd.readouterr().err


def test_a_first_message_in_the_wrong_frame_does_not_block_the_robot(play):
    driver, team = play(odometry_origin='first')
    team.odometry_frame = 'map'
    team.say()
    team.until(lambda: team.states)
    team.odometry_frame = 'odom'
    team.until(lambda: team.say() or len(team.states) > 3)
    assert driver.dropped['odometry'] == 0
    assert_allclose(pose_from_ros(team.state.pose.pose).position, team.start.position, atol=0.02)
    team.send_accepted([1.0, 1.0, 0.0])


def test_a_goal_in_another_frame_is_reached_where_that_is(play):
    driver, team = play()
    static = team.create_publisher(TFMessage, '/tf_static', LATCHED)
    moving = team.create_publisher(TFMessage, '/tf', RELIABLE)
    team.until(lambda: static.get_subscription_count() and moving.get_subscription_count())
    bad = transform('map', 'nothing', DOCK)
    bad.transform.translation.x = math.nan
    static.publish(TFMessage(transforms=[transform('map', 'dock', DOCK), bad]))
    team.until(lambda: driver.dropped['transform'] == 1)
    team.move()
    offset = np.array([0.7, 0.4, 0.0])
    expected = DOCK.position + DOCK.rotation() @ offset
    _, result = team.send_accepted(offset, frame='dock')
    assert team.ended(result, team.move)[0] == GoalStatus.STATUS_SUCCEEDED
    reached = team.position
    assert np.linalg.norm(reached - expected) <= team.settings.motion.tolerance + 0.01
    # Relative to the robot itself, as it stands.
    heading = team.body.robot_state().pose.rotation()
    _, result = team.send_accepted([-0.1, 0.0, 0.0], frame=BASE, number=2)
    assert team.ended(result, team.move)[0] == GoalStatus.STATUS_SUCCEEDED
    away = np.linalg.norm(team.position - (reached + heading @ [-0.1, 0.0, 0.0]))
    assert away <= team.settings.motion.tolerance + 0.01
    # What tf does not know, knows outside the bounds, or knows no more, is refused.
    assert "unknown frame 'kitchen'" in team.refused([0.0, 0.0, 0.0], frame='kitchen')
    assert 'position.' in team.refused([9.0, 0.0, 0.0], frame='dock')
    odd = transform('map', 'odd', DOCK)
    odd.transform.rotation.w = odd.transform.rotation.z = 0.0
    cart = transform('map', 'cart', DOCK, team.step * NANOSECONDS)
    moving.publish(TFMessage(transforms=[cart, odd]))
    team.until(lambda: driver.dropped['transform'] == 2)
    assert team.accepts([0.0, 0.0, 0.0])
    # Beyond `odometry_timeout`, short of a jump of time.
    team.step += round(35.0 / STEP)
    team.move()
    assert '(odometry_timeout)' in team.refused([0.0, 0.0, 0.0], frame='cart')


def test_without_tf2_msgs_there_is_no_tf_and_all_else_works(play, monkeypatch, capfd):
    monkeypatch.setitem(sys.modules, 'tf2_msgs.msg', None)
    driver, team = play()
    team.move(3)
    assert not team.count_publishers('/tf') and team.count_publishers('robot_description') == 1
    assert capfd.readouterr().err.count('tf2_msgs is not installed') == 1
    assert 'allowed is' in team.refused([0.0, 0.0, 0.0], frame='dock')
    assert team.accepts([1.0, 1.0, 0.0])
    for transition in ('deactivate', 'cleanup'):
        assert getattr(driver, f'trigger_{transition}')().name == 'SUCCESS'
    driver.set_parameters([Parameter('pose_source', value='tf')])
    assert driver.trigger_configure().name == 'FAILURE'
    assert 'tf2_msgs is not installed' in driver.problem
