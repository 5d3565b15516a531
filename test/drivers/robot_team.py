"""A robot and a team that the tests of the drivers play, over real topics."""

import math

import numpy as np
from action_msgs.msg import GoalStatus
from geometry_msgs.msg import TransformStamped, Twist, TwistStamped
from marker_view import one_image
from nav_msgs.msg import Odometry
from player import parameters
from rclpy.action import ActionClient
from rclpy.node import Node
from sensor_msgs.msg import BatteryState, CameraInfo, Image
from std_srvs.srv import Trigger
from waiting import wait_until

from maasi_drivers.drivers import MamboDriver, RangingDriver, TurtlebotDriver
from maasi_drivers.settings.driver import DriverSettings
from maasi_filter.models.pose import Pose, compose, inverse
from maasi_filter.ros.conversions import point_to_ros, pose_from_ros, pose_to_ros, stamp_to_ros
from maasi_filter.ros.qos import LATCHED, LATCHED_ALL, RELIABLE
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

# After a fault a robot has been stopped, and the planner has received the reason, by then [s].
LATEST = 1.5
STEP = 0.05
NANOSECONDS = round(STEP * 1e9)
TURTLEBOT = {
    'step': STEP,
    'environment': {'bounds': [[-0.3, 2.4], [-0.3, 2.4]]},
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
    """The robot, its camera and the driver's peers; `deaf`: it receives no commands."""

    def __init__(self, context, settings, executor, wants=None, deaf=False):
        super().__init__('robot', context=context, namespace='/rover')
        self.settings = settings = DriverSettings.model_validate(settings)
        self.start = Pose.from_yaw(settings.start, settings.yaw)
        self.motion = make_motion(settings.motion, radius=settings.radius)
        self.body = self.motion.body(RobotState(self.start))
        self.executor_used = executor
        executor.add_node(self)
        self.step, self.batch = -1, 0
        self.deaf = deaf
        self.odometry_frame = 'odom'
        self.states, self.commands, self.detections = [], [], []
        self.ready = []
        kind = wants or (Twist if settings.command_type == 'twist' else TwistStamped)
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
        self.present = self.create_publisher(LockstepStep, '/lockstep/robots', LATCHED)
        # What a driver with these settings listens to.
        self.used = [
            self.batches,
            *[self.battery] * (not deaf),
            *[self.present] * settings.lockstep,
        ]
        self.used += [self.odometry] * (not deaf and settings.poses == 'odometry')
        topic = settings.image_source == 'topic'
        self.used += [self.images] * topic if settings.camera else [self.ranges]
        self.go_to = ActionClient(self, GoToWaypoint, 'go_to')

    def until(self, condition, *what):
        wait_until(condition, lambda: self.executor_used.spin_once(timeout_sec=0.02), *what)

    def until_done(self, steps):
        self.until(
            lambda: all(len(messages) == steps for messages in (self.states, self.commands)),
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
        linear, angular = message.twist.twist.linear, message.twist.twist.angular
        linear.x, linear.y, linear.z = (state.pose.rotation().T @ state.velocity).tolist()
        angular.x, angular.y, angular.z = state.angular_velocity.tolist()
        return message

    def say(self):
        self.step += 1
        self.odometry.publish(self.odometry_message())

    def move(self, steps=1):
        """Go on in time: odometry, and the command for it."""
        for _ in range(steps):
            known = len(self.commands)
            if self.settings.lockstep:
                self.begin_step(self.step + 1)
                self.until_done(len(self.states) + 1)
            else:
                self.say()
                self.until(lambda known=known: len(self.commands) > known, 'no command')
                self.until(lambda: self.states and self.state.step == self.step, 'no state')
            self.body.step(self.command, STEP)

    def begin_step(self, k, robots=('rover',)):
        """Begin a step in lockstep."""
        self.step = k
        self.present.publish(LockstepStep(step=k, robots=robots))
        if 'rover' in robots:
            self.odometry.publish(self.odometry_message())

    def awaken(self):
        """Send odometry until the driver receives it: whether it does is not known from here."""
        self.until(lambda: self.say() or (self.states and self.commands), 'no driver')
        self.until(lambda: self.state.step == self.step, 'no state')

    @property
    def state(self):
        return self.states[-1]

    @property
    def command(self):
        return numbers(self.commands[-1])

    @property
    def position(self):
        return self.body.robot_state().pose.position

    # ---- what the team says ------------------------------------------------------------------

    def goal(self, position, number=1, frame='map', tolerance=0.0, step=0):
        goal = GoToWaypoint.Goal(goal_id=number, step=step, tolerance=tolerance)
        goal.waypoint.header.frame_id = frame
        goal.waypoint.pose.position = point_to_ros(position)
        return goal

    def send(self, *arguments, live=lambda: None, **options):
        """Send a goal, and return its handle; `live` is called meanwhile."""
        future = self.go_to.send_goal_async(self.goal(*arguments, **options))
        self.until(lambda: live() or future.done(), 'no answer to the goal')
        return future.result()

    def send_accepted(self, *arguments, **options):
        handle = self.send(*arguments, **options)
        assert handle.accepted
        return handle, handle.get_result_async()

    def ended(self, result, live=lambda: None):
        """Wait for the end of a goal; return its status and reason."""
        self.until(lambda: live() or result.done(), 'the goal does not end')
        return result.result().status, result.result().result.reason

    def aborted(self, result, live=lambda: None):
        """Wait until a goal is aborted; return the reason that its client reads."""
        status, reason = self.ended(result, live)
        assert status == GoalStatus.STATUS_ABORTED and reason
        return reason

    def refused(self, *arguments, **options):
        """Send a goal that is aborted at once; return the reason."""
        return self.aborted(self.send_accepted(*arguments, **options)[1])

    def accepts(self, *arguments, live=None):
        """Return whether the robot sets out for a goal; it moves on meanwhile."""
        live, moving = live or ((lambda: None) if self.deaf else self.move), AgentState.MOVING
        _, result = self.send_accepted(*arguments)
        self.until(lambda: live() or result.done() or self.state.goal_status == moving, 'no answer')
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
        number = self.batch + 6
        members = [BatchMember(robot=name, decision=3, measurement=number) for name in robots]
        batch = MeasurementBatch(id=self.batch, step=step, stamp=stamp_to_ros(stamp))
        batch.members = members
        self.batches.publish(batch)

    def answer(self, number=1):
        self.until(lambda: len(self.detections) >= number, 'no detections')
        return self.detections[number - 1]

    def seen_at(self):
        """Return the position on the floor of the one detection of the first answer."""
        (seen,) = self.answer().detections
        pose = pose_from_ros(self.answer().pose.pose)
        offset = seen.range * np.array([math.cos(seen.bearing), math.sin(seen.bearing)])
        return pose.position[:2] + offset


def numbers(message):
    twist = message.twist if isinstance(message, TwistStamped) else message
    return np.array([twist.linear.x, twist.linear.y, twist.linear.z, twist.angular.z])


def parameters_of(settings):
    return parameters(DriverSettings.model_validate(settings))


def rendered(team, targets, pose):
    """Return what the robot's camera sees, as an image message without its stamp."""
    return image_message(one_image(team.settings.camera, targets, pose))


def image_message(image, stamp=0):
    height, width, _ = image.shape
    message = Image(height=height, width=width, encoding='rgb8', step=3 * width)
    message.data = image.tobytes()
    return stamped(message, stamp)


def stamped(message, stamp):
    message.header.stamp = stamp_to_ros(stamp)
    return message


def transform(parent, child, pose, stamp=0):
    message = TransformStamped(child_frame_id=child)
    message.header.frame_id = parent
    message.header.stamp = stamp_to_ros(stamp)
    translation, turn = message.transform.translation, message.transform.rotation
    translation.x, translation.y, translation.z = pose.position.tolist()
    turn.w, turn.x, turn.y, turn.z = pose.orientation.tolist()
    return message
