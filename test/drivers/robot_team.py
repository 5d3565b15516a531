"""A robot and a team that the tests of the drivers play, over real topics."""

import math

import numpy as np
from action_msgs.msg import GoalStatus
from geometry_msgs.msg import Twist, TwistStamped
from marker_view import one_image
from nav_msgs.msg import Odometry
from rclpy.action import ActionClient
from rclpy.node import Node
from rclpy.parameter import Parameter
from sensor_msgs.msg import BatteryState, CameraInfo, Image
from std_srvs.srv import Trigger
from waiting import wait_until

from maasi_drivers.drivers import MamboDriver, RangingDriver, TurtlebotDriver
from maasi_drivers.settings.driver import DriverSettings
from maasi_filter.models.pose import Pose, compose, inverse
from maasi_filter.ros.conversions import pose_to_ros, stamp_to_ros
from maasi_filter.ros.parameters import flatten
from maasi_filter.ros.qos import LATCHED_ALL, RELIABLE
from maasi_msgs.action import GoToWaypoint
from maasi_msgs.msg import (
    AgentState,
    BatchMember,
    DetectionArray,
    LockstepDone,
    LockstepStep,
    MeasurementBatch,
    RangeArray,
)
from maasi_planner.motion import RobotState, make_motion

STEP = 0.05
NANOSECONDS = round(STEP * 1e9)
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


class Team(Node):
    """The robot, its camera, and whoever the driver talks to."""

    def __init__(self, context, settings, executor, wants=None, deaf=False):
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
        kind = wants or (Twist if self.settings.command_type == 'twist' else TwistStamped)
        # Whether commands do not reach it.
        self.deaf = deaf
        self.odometry_frame = 'odom'
        self.create_subscription(AgentState, 'state', self.states.append, RELIABLE)
        self.create_subscription(kind, 'cmd_vel', self.commands.append, RELIABLE)
        self.create_subscription(DetectionArray, 'detections', self.detections.append, RELIABLE)
        self.create_subscription(LockstepDone, '/lockstep/ready', self.ready.append, LATCHED_ALL)
        self.odometry = self.create_publisher(Odometry, 'odom', RELIABLE)
        self.battery = self.create_publisher(BatteryState, 'battery_state', RELIABLE)
        self.batches = self.create_publisher(MeasurementBatch, '/measurement_batch', RELIABLE)
        self.images = self.create_publisher(Image, 'camera/image_raw', RELIABLE)
        self.calibrations = self.create_publisher(CameraInfo, 'camera/camera_info', RELIABLE)
        self.ranges = self.create_publisher(RangeArray, 'ranges', RELIABLE)
        self.used = [self.batches, *([] if deaf else [self.battery])]
        if not deaf and self.settings.poses == 'odometry':
            self.used.append(self.odometry)
        topic = self.settings.image_source == 'topic'
        self.used += [self.images] * topic if self.settings.camera else [self.ranges]
        if lockstep:
            self.steps = self.create_publisher(LockstepStep, '/lockstep/step', RELIABLE)
            self.create_subscription(LockstepDone, '/lockstep/done', self.done.append, RELIABLE)
            self.used.append(self.steps)
        self.go_to = ActionClient(self, GoToWaypoint, 'go_to')
        self.batch = 0

    def until(self, condition, *what):
        wait_until(condition, lambda: self.executor_used.spin_once(timeout_sec=0.02), *what)

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
                and (self.deaf or self.count_publishers('cmd_vel'))
            ),
            'no driver',
        )

    # ---- what the robot says -----------------------------------------------------------------

    def odometry_message(self, stamp=None):
        state = self.body.robot_state()
        message = Odometry()
        message.header.frame_id = self.odometry_frame
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

    def refused(self, *arguments, **options):
        """Send a goal that is aborted at once; return the reason that its client reads."""
        _, result = self.send_accepted(*arguments, **options)
        self.until(result.done, 'the goal is not refused')
        assert result.result().status == GoalStatus.STATUS_ABORTED
        assert result.result().result.reason
        return result.result().result.reason

    def takes(self, *arguments, live=lambda: None):
        """Return whether the robot sets out for a goal."""
        _, result = self.send_accepted(*arguments)
        self.until(
            lambda: live() or result.done() or self.state.goal_status == AgentState.MOVING,
            'the goal is not answered',
        )
        return not result.done() or result.result().status != GoalStatus.STATUS_ABORTED

    def call(self, name, until=None):
        """Call a service of the driver, and return its answer; `until` waits as `Team.until`."""
        until = until or self.until
        client = self.create_client(Trigger, name)
        until(client.service_is_ready, f'no service {name}')
        future = client.call_async(Trigger.Request())
        until(future.done, f'no answer of {name}')
        self.destroy_client(client)
        return future.result()

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


def rendered(team, targets, pose):
    """Return what the robot's camera sees, as an image message without its stamp."""
    return image_message(one_image(team.settings.camera, targets, pose))


def image_message(image, stamp=0):
    height, width, _ = image.shape
    message = Image(height=height, width=width, encoding='rgb8', step=3 * width)
    message.data = image.tobytes()
    message.header.stamp = stamp_to_ros(stamp)
    return message


def stamped(message, stamp):
    message.header.stamp = stamp_to_ros(stamp)
    return message


def lockstep_step(team, k, robots=('rover',), first='odom'):
    team.step = k
    message = LockstepStep(step=k, stamp=stamp_to_ros(k * NANOSECONDS), robots=robots)
    if first == 'odom' and 'rover' in robots:
        team.odometry.publish(team.odometry_message())
    team.steps.publish(message)
    if first != 'odom':
        team.odometry.publish(team.odometry_message())
