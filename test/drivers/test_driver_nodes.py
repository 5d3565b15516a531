"""Drivers and guard over real topics, against a robot and a team that the tests play."""

import math
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
import rclpy
import yaml
from action_msgs.msg import GoalStatus
from geometry_msgs.msg import Twist, TwistStamped
from nav_msgs.msg import Odometry
from numpy.testing import assert_allclose, assert_array_equal
from rclpy.action import ActionClient
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import BatteryState, CameraInfo, Image

from maasi_drivers.driver_settings import DriverSettings
from maasi_drivers.guard_node import GuardNode
from maasi_drivers.mambo_driver import MamboDriver
from maasi_drivers.projection import Camera
from maasi_drivers.ranging_driver import RangingDriver
from maasi_drivers.turtlebot_driver import TurtlebotDriver
from maasi_filter.conversions import pose_from_ros, pose_to_ros, stamp_to_ros
from maasi_filter.parameters import flatten
from maasi_filter.pose import Pose, compose, inverse
from maasi_filter.qos import LATCHED_ALL, RELIABLE
from maasi_filter.settings import EnvironmentSettings
from maasi_msgs.action import GoToWaypoint
from maasi_msgs.msg import (
    AgentState,
    BatchMember,
    DetectionArray,
    LockstepDone,
    LockstepStep,
    MeasurementBatch,
    RangeArray,
    RangeMeasurement,
)
from maasi_planner.motion import RobotState, make_motion
from maasi_sim.camera import CameraRenderer, RenderSettings, scene_of
from maasi_sim.world import TargetSettings, World

DOMAIN = 74
STEP = 0.05
NANOSECONDS = round(STEP * 1e9)
# Longest wait for anything; the machine may be busy.
LIMIT = 60.0
BOUNDS = [[-0.3, 2.4], [-0.3, 2.4]]
TURTLEBOT = {
    'step': STEP,
    'environment': {'bounds': BOUNDS},
    'start': [0.4, 0.3, 0.0],
    'yaw': 0.7,
    'radius': 0.11,
    'odometry_timeout': 30.0,
    # Most tests have no images.
    'sensor_timeout': 0.0,
    'motion': {'model': 'unicycle', 'speed': 0.2, 'acceleration': 0.5, 'heading': 'travel'},
    'sensor': {'detection': {'kind': 'box', 'lower': [-0.1, -0.1], 'upper': [0.2, 0.2]}},
    'camera': {
        'focal_length': [120.0, 120.0],
        'mount': {'position': [0.05, 0.05, 0.4], 'rpy': [0.0, math.pi / 2, 0.0]},
    },
}
MAMBO = TURTLEBOT | {
    'start': [1.0, 1.0, 1.0],
    'motion': {'model': 'mambo', 'speed': 0.4, 'tilt': 0.1},
    'sensor': {'detection': {'kind': 'box'}},
    'camera': {'focal_length': [220.0, 220.0]},
}
RANGING = {
    'step': STEP,
    'environment': {'bounds': [[0.0, 20.0], [0.0, 20.0], [0.0, 20.0]]},
    'start': [5.0, 5.0, 5.0],
    'odometry_timeout': 30.0,
    'sensor_timeout': 0.0,
    'motion': {'model': 'constant_speed', 'speed': 2.0},
    'sensor': {'detection': {'kind': 'box', 'lower': [-4, -4, -6], 'upper': [4, 4, 6]}},
}
KINDS = {
    'turtlebot': (TurtlebotDriver, TURTLEBOT),
    'mambo': (MamboDriver, MAMBO),
    'ranging': (RangingDriver, RANGING),
}


@pytest.fixture
def context(monkeypatch):
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    monkeypatch.setenv('ROS_DOMAIN_ID', str(DOMAIN))
    context = Context()
    rclpy.init(context=context, domain_id=DOMAIN, signal_handler_options=SignalHandlerOptions.NO)
    yield context
    rclpy.shutdown(context=context)


class Team(Node):
    """The robot, its camera, and whoever the driver talks to."""

    def __init__(self, context, settings, executor):
        super().__init__('robot', context=context, namespace='/rover')
        self.settings = DriverSettings.model_validate(settings)
        self.start = Pose.from_yaw(self.settings.start, self.settings.yaw)
        self.motion = make_motion(self.settings.motion, radius=self.settings.radius)
        self.body = self.motion.body(RobotState(self.start))
        self.executor_used = executor
        executor.add_node(self)
        self.step = -1
        self.states, self.commands, self.detections = [], [], []
        self.ready, self.done = [], []
        lockstep = self.settings.lockstep
        kind = Twist if self.settings.command_type == 'twist' else TwistStamped
        self.create_subscription(AgentState, 'state', self.states.append, RELIABLE)
        self.create_subscription(kind, 'cmd_vel', self.commands.append, RELIABLE)
        self.create_subscription(DetectionArray, 'detections', self.detections.append, RELIABLE)
        self.create_subscription(LockstepDone, '/lockstep/ready', self.ready.append, LATCHED_ALL)
        self.odometry = self.create_publisher(Odometry, 'odom', RELIABLE)
        self.battery = self.create_publisher(BatteryState, 'battery', RELIABLE)
        self.batches = self.create_publisher(MeasurementBatch, '/measurement_batch', RELIABLE)
        self.images = self.create_publisher(Image, 'camera/image_raw', RELIABLE)
        self.calibrations = self.create_publisher(CameraInfo, 'camera/camera_info', RELIABLE)
        self.ranges = self.create_publisher(RangeArray, 'ranges', RELIABLE)
        self.used = [self.odometry, self.battery, self.batches]
        self.used += [self.images] if self.settings.camera else [self.ranges]
        if lockstep:
            self.steps = self.create_publisher(LockstepStep, '/lockstep/step', RELIABLE)
            self.create_subscription(LockstepDone, '/lockstep/done', self.done.append, RELIABLE)
            self.used.append(self.steps)
        self.go_to = ActionClient(self, GoToWaypoint, 'go_to')
        self.batch = 0

    def until(self, condition, what=''):
        end = time.monotonic() + LIMIT
        while not condition():
            assert time.monotonic() < end, what or 'nothing came of it'
            self.executor_used.spin_once(timeout_sec=0.02)

    def until_done(self, steps):
        self.until(
            lambda: all(len(heard) == steps for heard in (self.done, self.states, self.commands)),
            'a step has no end',
        )

    def connect(self):
        self.until(
            lambda: (
                all(publisher.get_subscription_count() for publisher in self.used)
                and self.go_to.server_is_ready()
                and self.count_publishers('state')
                and self.count_publishers('cmd_vel')
            ),
            'no driver',
        )

    # ---- what the robot says -----------------------------------------------------------------

    def odometry_message(self, stamp=None):
        state = self.body.robot_state()
        message = Odometry()
        message.header.stamp = stamp_to_ros(self.step * NANOSECONDS if stamp is None else stamp)
        message.pose.pose = pose_to_ros(compose(inverse(self.start), state.pose))
        turn = state.pose.rotation().T
        linear, angular = message.twist.twist.linear, message.twist.twist.angular
        linear.x, linear.y, linear.z = (turn @ state.velocity).tolist()
        angular.x, angular.y, angular.z = state.angular_velocity.tolist()
        return message

    def move(self, steps=1):
        """Go on in time: odometry, and the command for it."""
        for _ in range(steps):
            self.step += 1
            known = len(self.commands)
            self.odometry.publish(self.odometry_message())
            self.until(
                lambda known=known: (
                    len(self.commands) > known and self.states[-1:] and self.state.step == self.step
                ),
                'no command',
            )
            self.body.step(self.command, STEP)

    def awaken(self):
        """Send odometry until the driver hears it: whether it does is not known from here."""

        def heard():
            self.step += 1
            self.odometry.publish(self.odometry_message())
            return self.states and self.commands

        self.until(heard, 'no driver')
        self.until(lambda: self.state.step == self.step, 'no state')

    @property
    def state(self):
        return self.states[-1]

    @property
    def command(self):
        return numbers(self.commands[-1])

    # ---- what the team says ------------------------------------------------------------------

    def goal(self, position, number=1, frame='map', tolerance=0.0, step=0):
        goal = GoToWaypoint.Goal(goal_id=number, step=step, tolerance=tolerance)
        goal.waypoint.header.frame_id = frame
        point = goal.waypoint.pose.position
        point.x, point.y, point.z = (float(value) for value in position)
        return goal

    def send(self, *arguments, **options):
        future = self.go_to.send_goal_async(self.goal(*arguments, **options))
        self.until(future.done, 'no answer to the goal')
        return future.result()

    def send_accepted(self, *arguments, **options):
        handle = self.send(*arguments, **options)
        assert handle.accepted
        return handle, handle.get_result_async()

    def ask(self, stamp, robots=('rover',), step=0):
        self.batch += 1
        members = [
            BatchMember(robot=name, decision=3, measurement=self.batch + 6) for name in robots
        ]
        self.batches.publish(
            MeasurementBatch(id=self.batch, step=step, stamp=stamp_to_ros(stamp), members=members)
        )

    def answer(self, number=1):
        self.until(lambda: len(self.detections) >= number, 'no detections')
        return self.detections[number - 1]


def numbers(message):
    twist = message.twist if isinstance(message, TwistStamped) else message
    return np.array([twist.linear.x, twist.linear.y, twist.linear.z, twist.angular.z])


def parameters_of(settings):
    return [
        Parameter(name, value=value)
        for name, value in flatten(DriverSettings.model_validate(settings)).items()
    ]


@pytest.fixture
def play(context):
    """Return a function that starts a driver in this process, and the team around it."""
    started = []
    executor = SingleThreadedExecutor(context=context)

    def start(kind='turtlebot', **changes):
        made, settings = KINDS[kind]
        settings = settings | changes
        driver = made(
            context=context, namespace='/rover', parameter_overrides=parameters_of(settings)
        )
        executor.add_node(driver)
        team = Team(context, settings, executor)
        started.extend([driver, team])
        assert driver.trigger_configure().name == 'SUCCESS'
        assert driver.trigger_activate().name == 'SUCCESS'
        team.connect()
        return driver, team

    yield start
    for node in started:
        if hasattr(node, 'halt'):
            node.halt()
        node.destroy_node()
    executor.shutdown()


def rendered(team, targets, pose):
    """Return what the robot's camera sees, as an image message without its stamp."""
    floor = RenderSettings.ideal()
    world = World.from_settings(
        EnvironmentSettings(bounds=BOUNDS), TargetSettings(positions=targets), 1
    )
    camera = Camera.from_settings(team.settings.camera)
    image = CameraRenderer(camera, floor, scene_of(world, floor, 1), 1, 'rover').render(pose, 0, 0)
    return image_message(image)


def image_message(image, stamp=0):
    height, width, _ = image.shape
    message = Image(height=height, width=width, encoding='rgb8', step=3 * width)
    message.data = image.tobytes()
    message.header.stamp = stamp_to_ros(stamp)
    return message


def stamped(message, stamp):
    message.header.stamp = stamp_to_ros(stamp)
    return message


# ---- goals -----------------------------------------------------------------------------------


@pytest.mark.parametrize('kind', ['turtlebot', 'mambo', 'ranging'])
def test_a_waypoint_is_reached_and_held(play, kind):
    _, team = play(kind)
    goal = team.start.position + np.array([0.15, 0.1, 0.0])
    team.move()
    assert team.state.goal_status == AgentState.IDLE and team.state.goal_id == 0
    _, result = team.send_accepted(goal, number=5)
    for _ in range(400):
        team.move()
        pose = pose_from_ros(team.state.pose.pose)
        assert team.state.goal_id == 5
        if team.state.goal_status != AgentState.MOVING:
            break
    assert team.state.goal_status == AgentState.REACHED
    assert np.linalg.norm(pose.position - goal) <= team.settings.motion.tolerance
    team.until(result.done, 'no result')
    assert result.result().status == GoalStatus.STATUS_SUCCEEDED
    outcome = result.result().result
    assert outcome.reached and not outcome.reason
    assert_allclose(pose_from_ros(outcome.pose).position, pose.position, atol=1e-12)
    team.move(20)
    assert team.state.goal_status == AgentState.REACHED
    if kind == 'turtlebot':
        assert_array_equal(team.command, np.zeros(4))
    else:
        assert np.linalg.norm(team.body.robot_state().pose.position - goal) < 0.1


def test_the_state_is_the_odometry_placed_in_the_map(play):
    _, team = play()
    team.send_accepted([1.0, 1.0, 0.0])
    team.move(30)
    before = team.body.robot_state()
    message = team.odometry_message(30 * NANOSECONDS)
    message.pose.covariance[0] = 0.04
    team.step = 30
    team.odometry.publish(message)
    team.until(lambda: team.state.step == 30 and len(team.commands) == 31)
    state = team.state
    assert state.robot == 'rover' and state.header.frame_id == 'map'
    assert state.header.stamp == stamp_to_ros(30 * NANOSECONDS)
    pose = pose_from_ros(state.pose.pose)
    assert_allclose(pose.position, before.pose.position, atol=1e-9)
    assert_allclose(pose.yaw, before.pose.yaw, atol=1e-9)
    linear = state.twist.linear
    assert_allclose([linear.x, linear.y, linear.z], before.velocity, atol=1e-9)
    turn = team.start.rotation()[:2, :2]
    expected = turn @ np.diag([0.04, 0.0]) @ turn.T
    assert_allclose(state.pose.covariance.reshape(6, 6)[:2, :2], expected, atol=1e-12)
    assert team.commands[-1].header.stamp == state.header.stamp


def test_a_new_goal_replaces_the_one_before(play):
    _, team = play()
    team.move()
    _, first = team.send_accepted([1.0, 1.0, 0.0], number=1)
    team.move(3)
    team.send_accepted([0.0, 0.0, 0.0], number=2)
    team.until(first.done)
    assert first.result().status == GoalStatus.STATUS_ABORTED
    assert first.result().result.reason == 'replaced'
    team.move()
    assert team.state.goal_id == 2 and team.state.goal_status == AgentState.MOVING


@pytest.mark.parametrize('kind', ['turtlebot', 'ranging'])
def test_a_cancelled_goal_stops_the_robot(play, kind):
    _, team = play(kind)
    team.move()
    handle, result = team.send_accepted(team.start.position + np.array([1.0, 0.0, 0.0]))
    team.move(5)
    assert np.any(team.command != 0.0)
    known = len(team.commands)
    cancelled = handle.cancel_goal_async()
    team.until(lambda: result.done() and cancelled.done())
    assert len(cancelled.result().goals_canceling) == 1
    assert result.result().status == GoalStatus.STATUS_CANCELED
    team.until(lambda: len(team.commands) > known)
    assert_array_equal(team.command, np.zeros(4))
    team.move()
    assert team.state.goal_status == AgentState.CANCELED
    assert_allclose(team.command, np.zeros(4), atol=1e-9)


@pytest.mark.parametrize(
    ('changes', 'field'),
    [
        ({'position': [math.nan, 0.5, 0.0]}, 'position'),
        ({'position': [0.5, 0.5, math.inf]}, 'position'),
        ({'position': [2.6, 0.5, 0.0]}, 'position.x'),
        ({'position': [0.5, -0.5, 0.0]}, 'position.y'),
        ({'frame': 'odom'}, 'frame_id'),
        ({'tolerance': math.nan}, 'tolerance'),
        ({'tolerance': -0.1}, 'tolerance'),
    ],
)
def test_a_goal_that_makes_no_sense_is_refused(play, capfd, changes, field):
    driver, team = play()
    team.move()
    assert not team.send(**({'position': [0.5, 0.5, 0.0]} | changes)).accepted
    assert driver.dropped['goal'] == 1
    assert field in capfd.readouterr().err
    team.move()
    assert team.state.goal_status == AgentState.IDLE
    # On the border, within the robot's radius, is allowed.
    assert team.send([2.5, 0.5, 0.0]).accepted


# ---- odometry that is missing or bad ---------------------------------------------------------


@pytest.mark.parametrize('frozen', [False, True])
def test_without_odometry_the_robot_is_stopped(play, frozen):
    _, team = play(odometry_timeout=0.3)
    team.move()
    _, result = team.send_accepted([1.5, 1.5, 0.0])
    team.move(20)
    assert np.any(team.command != 0.0)

    def stopped():
        if frozen:
            team.odometry.publish(team.odometry_message())
        return team.state.goal_status == AgentState.UNAVAILABLE

    team.until(stopped)
    assert 'no odometry for' in team.state.reason
    team.until(result.done)
    assert result.result().status == GoalStatus.STATUS_ABORTED
    assert 'no odometry for' in result.result().result.reason
    known = len(team.commands), len(team.states)
    team.until(lambda: len(team.commands) >= known[0] + 3 and len(team.states) > known[1])
    assert_array_equal([numbers(item) for item in team.commands[-3:]], np.zeros((3, 4)))
    assert not team.send([1.0, 1.0, 0.0]).accepted
    team.until(lambda: team.state.goal_status == AgentState.UNAVAILABLE)
    team.step += 1
    team.odometry.publish(team.odometry_message())
    team.until(lambda: team.state.step == team.step)
    assert team.state.goal_status == AgentState.ABORTED
    assert team.send([1.0, 1.0, 0.0]).accepted


def test_bad_odometry_is_counted_and_nothing_else(play):
    driver, team = play()
    team.move(3)
    for field in ('position', 'orientation'):
        bad = team.odometry_message(10 * NANOSECONDS)
        getattr(bad.pose.pose, field).x = math.nan
        team.odometry.publish(bad)
    bad = team.odometry_message(10 * NANOSECONDS)
    bad.twist.twist.linear.x = math.inf
    team.odometry.publish(bad)
    bad = team.odometry_message(10 * NANOSECONDS)
    bad.pose.covariance[7] = math.nan
    bad.pose.covariance[0] = 0.1
    team.odometry.publish(bad)
    back = team.odometry_message(NANOSECONDS)
    team.odometry.publish(back)
    team.until(lambda: driver.dropped['odometry'] == 4 and driver.dropped['odometry stamp'] == 1)
    team.step = 10
    team.move()
    assert team.state.step == 11


def test_a_jump_of_the_stamps_begins_anew(play):
    _, team = play()
    team.step = 99
    team.move()
    _, result = team.send_accepted([1.5, 1.5, 0.0])
    team.move(5)
    team.step = 2
    team.move()
    assert team.state.step == 3
    team.until(result.done)
    assert result.result().status == GoalStatus.STATUS_ABORTED
    assert 'back' in result.result().result.reason


def test_a_low_battery_ends_the_way(play):
    _, team = play(battery_minimum=0.2)
    team.move()
    _, result = team.send_accepted([1.5, 1.5, 0.0])
    team.battery.publish(BatteryState(percentage=0.5))
    team.until(lambda: team.move() or team.state.battery == pytest.approx(0.5))
    assert team.state.goal_status == AgentState.MOVING
    team.battery.publish(BatteryState(percentage=0.1))
    team.until(result.done)
    team.move()
    assert team.state.goal_status == AgentState.UNAVAILABLE
    assert 'battery at 0.10' in team.state.reason
    assert_array_equal(team.command, np.zeros(4))


def test_a_twist_without_a_stamp_for_a_robot_that_wants_it(play):
    _, team = play(command_type='twist')
    team.send_accepted([1.0, 1.0, 0.0])
    team.move(3)
    assert np.any(team.command != 0.0)


# ---- measurements ----------------------------------------------------------------------------


def test_a_batch_is_answered_with_what_the_image_shows(play):
    driver, team = play()
    team.move()
    pose = team.body.robot_state().pose
    front, left = pose.rotation()[:2, 0], pose.rotation()[:2, 1]
    inside = pose.position[:2] + 0.12 * front + 0.05 * left
    # In the image, but not in the box.
    outside = pose.position[:2] - 0.13 * front
    image = rendered(team, [inside.tolist(), outside.tolist()], pose)
    team.images.publish(stamped(image, team.step * NANOSECONDS))
    team.ask(team.step * NANOSECONDS)
    answer = team.answer()
    assert answer.batch_id == 1 and answer.measurement == 7 and answer.robot == 'rover'
    assert answer.step == team.step and answer.header.frame_id == 'map'
    assert answer.header.stamp == stamp_to_ros(team.step * NANOSECONDS)
    assert_allclose(pose_from_ros(answer.pose.pose).position, pose.position, atol=1e-9)
    assert len(answer.detections) == 1 and answer.dropped == 1
    seen = answer.detections[0]
    offset = inside - pose.position[:2]
    assert_allclose(seen.range, np.hypot(*offset), atol=2e-3)
    assert_allclose(seen.bearing, np.arctan2(offset[1], offset[0]), atol=0.02)
    assert np.linalg.eigvalsh(np.reshape(seen.covariance, (2, 2))).min() > 0.0
    assert 'outside the field of view' in str(driver.status())


def test_seeing_nothing_is_said_too(play):
    _, team = play()
    team.move()
    image = rendered(team, [[2.0, 2.0]], team.body.robot_state().pose)
    team.images.publish(stamped(image, team.step * NANOSECONDS))
    team.ask(team.step * NANOSECONDS)
    assert not team.answer().detections


def test_the_pose_is_that_of_the_image(play):
    _, team = play()
    team.move()
    team.ask(NANOSECONDS)
    image = rendered(team, [[2.0, 2.0]], team.body.robot_state().pose)
    team.images.publish(stamped(image, round(1.25 * NANOSECONDS)))
    team.send_accepted([1.0, 1.0, 0.0])
    team.move()
    before = pose_from_ros(team.state.pose.pose).position
    assert not team.detections
    team.body.state[:2] += 0.04
    team.move()
    after = pose_from_ros(team.state.pose.pose).position
    answer = team.answer()
    position = pose_from_ros(answer.pose.pose).position
    assert_allclose(position, 0.75 * before + 0.25 * after, atol=1e-9)


def test_a_batch_of_others_is_not_answered(play):
    _, team = play()
    team.move()
    image = rendered(team, [[2.0, 2.0]], team.body.robot_state().pose)
    team.images.publish(stamped(image, 0))
    team.ask(0, robots=['other'])
    team.ask(0, robots=['other', 'rover'])
    assert team.answer().batch_id == 2


def test_bad_images_are_counted_and_the_next_good_one_answers(play, capfd):
    driver, team = play()
    team.move()
    pose = team.body.robot_state().pose
    good = np.full((120, 160, 3), 120, np.uint8)
    team.ask(0)
    bad = [image_message(good, 1) for _ in range(6)]
    bad[0].width = bad[0].height = bad[0].step = 0
    bad[0].data = b''
    bad[1].encoding = 'mono16'
    bad[2].step = 10
    bad[3].step = 481
    bad[4].data = bad[4].data[:-5]
    bad[5] = image_message(np.full((60, 80, 3), 120, np.uint8), 1)
    for message in bad:
        team.images.publish(message)
    team.until(lambda: driver.dropped['image'] == len(bad))
    assert 'camera/image_raw' in capfd.readouterr().err
    # Padded rows are fine.
    padded = np.pad(good.reshape(120, 480), ((0, 0), (0, 32)))
    message = image_message(good, 2)
    message.step, message.data = 512, padded.tobytes()
    team.images.publish(message)
    team.move()
    answer = team.answer()
    assert answer.header.stamp.nanosec == 2 and not answer.detections
    assert_allclose(pose_from_ros(answer.pose.pose).position, pose.position, atol=1e-6)
    team.images.publish(image_message(good, 1))
    team.until(lambda: driver.dropped['image stamp'] == 1)


def test_a_calibration_replaces_that_of_the_parameters(play):
    driver, team = play()
    team.move()
    wrong = CameraInfo(width=320, height=240, distortion_model='fisheye')
    wrong.k = [240.0, 0.0, 159.5, 0.0, 240.0, 119.5, 0.0, 0.0, 1.0]
    team.until(lambda: team.calibrations.get_subscription_count())
    team.calibrations.publish(wrong)
    team.until(lambda: driver.dropped['calibration'] == 1)
    assert driver.camera.width == 160
    wrong.distortion_model = 'plumb_bob'
    team.calibrations.publish(wrong)
    team.until(lambda: driver.camera.width == 320)
    assert driver.camera.mount == team.settings.camera.mount
    team.calibrations.publish(CameraInfo(width=640, height=480))
    team.images.publish(image_message(np.full((240, 320, 3), 120, np.uint8)))
    team.ask(0)
    assert team.answer().batch_id == 1


def test_ranges_pass_through_as_they_come(play):
    driver, team = play('ranging')
    team.move()
    sweep = RangeArray()
    for values in ([2.0, 0.3, -0.2], [3.0, -2.0, 0.1], [9.0, 0.0, 0.0], [1.0, math.nan, 0.0]):
        sweep.ranges.append(
            RangeMeasurement(range=values[0], bearing=values[1], elevation=values[2])
        )
    team.ranges.publish(sweep)
    team.ask(0)
    answer = team.answer()
    # The third is outside the box, the fourth is no measurement.
    assert [(item.range, item.bearing, item.elevation) for item in answer.detections] == [
        (2.0, 0.3, -0.2),
        (3.0, -2.0, 0.1),
    ]
    assert not any(len(item.covariance) for item in answer.detections)
    assert answer.dropped == 1 and driver.dropped['range'] == 1


# ---- lockstep --------------------------------------------------------------------------------


def lockstep_step(team, k, robots=('rover',), first='odom'):
    team.step = k
    message = LockstepStep(step=k, stamp=stamp_to_ros(k * NANOSECONDS), robots=robots)
    if first == 'odom' and 'rover' in robots:
        team.odometry.publish(team.odometry_message())
    team.steps.publish(message)
    if first != 'odom':
        team.odometry.publish(team.odometry_message())


@pytest.mark.parametrize('first', ['odom', 'step'])
def test_in_lockstep_each_step_has_a_state_a_command_and_an_end(play, first):
    _, team = play(lockstep=True)
    for k in range(5):
        lockstep_step(team, k, first=first)
        team.until_done(k + 1)
        assert team.done[-1].node == '/rover/driver' and team.done[-1].step == k
        assert team.state.step == k
        assert team.commands[-1].header.stamp == stamp_to_ros(k * NANOSECONDS)
        if k == 2:
            team.send_accepted([1.0, 1.0, 0.0], step=k)
            assert_array_equal(team.command, np.zeros(4))
    assert [state.goal_status for state in team.states] == [AgentState.IDLE] * 3 + [
        AgentState.MOVING
    ] * 2
    # A step can come twice: somebody was started again.
    lockstep_step(team, 4, first=first)
    team.until_done(6)
    assert team.states[-1] == team.states[-2] and team.commands[-1] == team.commands[-2]


def test_in_lockstep_a_batch_is_answered_by_the_image_of_the_step(play):
    _, team = play(lockstep=True)
    for k in range(3):
        lockstep_step(team, k)
        team.until_done(k + 1)
        image = rendered(team, [[2.0, 2.0]], team.body.robot_state().pose)
        team.images.publish(stamped(image, k * NANOSECONDS))
        team.ask(k * NANOSECONDS, step=k)
        assert team.answer(k + 1).step == k


def test_in_lockstep_a_robot_that_is_left_out_gives_its_goal_up(play):
    _, team = play(lockstep=True)
    lockstep_step(team, 0)
    team.until_done(1)
    _, result = team.send_accepted([1.0, 1.0, 0.0])
    lockstep_step(team, 1)
    team.until_done(2)
    lockstep_step(team, 2, robots=['other'])
    team.until(result.done)
    assert result.result().result.reason == 'left'
    assert not team.send([1.0, 1.0, 0.0]).accepted
    lockstep_step(team, 3)
    team.until_done(3)
    assert [item.step for item in team.done] == [0, 1, 3]
    assert [item.step for item in team.states] == [0, 1, 3]
    assert team.state.goal_status == AgentState.ABORTED and team.state.reason == 'left'


def test_in_lockstep_bad_odometry_does_not_hold_up_the_others(play):
    driver, team = play(lockstep=True)
    lockstep_step(team, 0)
    team.until_done(1)
    bad = team.odometry_message(NANOSECONDS)
    bad.pose.pose.position.x = math.nan
    team.odometry.publish(bad)
    team.steps.publish(LockstepStep(step=1, stamp=stamp_to_ros(NANOSECONDS), robots=['rover']))
    team.until_done(2)
    assert team.state.step == 1 and driver.dropped['odometry'] == 1
    assert_array_equal(team.command, np.zeros(4))
    assert team.commands[-1].header.stamp == stamp_to_ros(NANOSECONDS)


# ---- readiness, parameters -------------------------------------------------------------------


def test_a_driver_is_ready_once_filter_and_planner_hear_it(play, context):
    _, team = play()
    nodes = {}

    def add(name, *topics):
        node = Node(name, context=context, start_parameter_services=False)
        nodes[name] = node
        team.executor_used.add_node(node)
        for kind, topic in topics:
            node.create_subscription(kind, f'/rover/{topic}', lambda message: None, RELIABLE)

    add('filter_node', (DetectionArray, 'detections'))
    team.move(20)
    assert not team.ready
    add('planner_node', (DetectionArray, 'detections'), (AgentState, 'state'))
    team.until(lambda: team.ready)
    assert team.ready[0].node == '/rover/driver' and team.ready[0].step == 0
    for node in nodes.values():
        node.destroy_node()


@pytest.mark.parametrize('changes', [{'command_type': 'twist'}, {'camera': {'stamp_offset': 0.01}}])
def test_what_lockstep_cannot_wait_for_is_wrong_input(changes):
    with pytest.raises(ValueError, match=r'command_type|stamp_offset'):
        DriverSettings.model_validate(TURTLEBOT | {'lockstep': True} | changes)


# ---- processes -------------------------------------------------------------------------------


@pytest.fixture
def process(context, tmp_path):
    """Return a function that starts a driver as a process of its own."""
    running = []

    def start():
        file = tmp_path / 'parameters.yaml'
        flat = flatten(DriverSettings.model_validate(TURTLEBOT))
        file.write_text(yaml.safe_dump({'/**': {'ros__parameters': flat}}))
        command = [sys.executable, '-m', 'maasi_drivers.turtlebot_driver', '--ros-args']
        command += ['--remap', '__ns:=/rover', '--params-file', str(file)]
        running.append(subprocess.Popen(command, env=os.environ.copy()))
        return running[-1]

    yield start
    for item in running:
        if item.poll() is None:
            item.kill()
        item.wait()


@pytest.fixture
def team(context):
    executor = SingleThreadedExecutor(context=context)
    team = Team(context, TURTLEBOT, executor)
    yield team
    executor.shutdown()
    team.destroy_node()


def test_the_guard_stops_the_robot_when_its_driver_is_killed(context, process, team):
    guard = GuardNode(context=context, namespace='/rover')
    team.executor_used.add_node(guard)
    assert guard.trigger_configure().name == 'SUCCESS'
    assert guard.trigger_activate().name == 'SUCCESS'
    driver = process()
    team.connect()
    team.awaken()
    team.send_accepted([1.5, 1.5, 0.0])
    team.move(20)
    assert np.any(team.command != 0.0)
    assert all(message.header.frame_id for message in team.commands), 'the guard has spoken'
    driver.send_signal(signal.SIGKILL)
    driver.wait()
    known = len(team.commands)
    team.until(lambda: len(team.commands) >= known + 3)
    assert_array_equal([numbers(item) for item in team.commands[known:]], np.zeros((3, 4)))
    assert team.commands[-1].header.stamp == stamp_to_ros(team.step * NANOSECONDS)
    process()
    team.until(lambda: not guard.status()['stopping'])
    team.connect()
    team.states.clear()
    team.awaken()
    known = len(team.commands)
    team.move(20)
    assert len(team.commands) == known + 20
    guard.destroy_node()


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_a_driver_that_is_told_to_end_leaves_zeros(process, team, number):
    driver = process()
    team.connect()
    team.awaken()
    _, result = team.send_accepted([1.5, 1.5, 0.0])
    team.move(20)
    assert np.any(team.command != 0.0)
    driver.send_signal(number)
    team.until(lambda: driver.poll() is not None)
    assert driver.returncode == 0
    team.until(result.done)
    assert result.result().status == GoalStatus.STATUS_ABORTED
    assert result.result().result.reason == 'the driver stops'
    team.until(lambda: not np.any(team.command))
