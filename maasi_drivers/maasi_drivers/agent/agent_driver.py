"""What every driver shares: odometry, goals, commands, and the answers to measurement batches."""

from __future__ import annotations

import math
import time
from abc import ABC, abstractmethod
from collections import Counter
from dataclasses import dataclass
from functools import partial
from typing import Any, Generic, TypeVar

import numpy as np
from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from rclpy.action.server import ActionServer, CancelResponse, ServerGoalHandle
from sensor_msgs.msg import BatteryState

from maasi_drivers.agent.battery_gauge import BatteryGauge, BatteryReadings
from maasi_drivers.agent.driver_settings import DriverSettings
from maasi_drivers.agent.measurement_queue import Frame, MeasurementQueue, MeasurementRequest
from maasi_drivers.agent.odometry import MapOdometry, PoseHistory, StampedPose
from maasi_drivers.agent.pose_speed import PoseSpeed
from maasi_drivers.agent.pose_topic import PoseTopic
from maasi_drivers.agent.robot_frames import RobotFrames
from maasi_drivers.agent.robot_stop import STOPPED, RobotStop
from maasi_drivers.agent.waypoint_follower import Goal, GoalStatus, WaypointFollower
from maasi_drivers.links.command_publisher import CommandPublisher
from maasi_filter.models.pose import Pose
from maasi_filter.ros.conversions import (
    FARTHEST,
    FASTEST,
    MOST_DETECTIONS,
    bounded,
    detections_to_ros,
    pose_from_ros,
    pose_to_ros,
    stamp_from_ros,
    stamp_to_ros,
)
from maasi_filter.ros.lifecycle_node import LockstepLifecycleNode, SettingsError
from maasi_filter.ros.qos import LIVELINESS_PERIOD, LIVELY, RELIABLE, sensor_reader
from maasi_filter.ros.silence import Silence
from maasi_filter.ros.stamps import JUMP, StampGate, batch_id_limit
from maasi_msgs.action import GoToWaypoint
from maasi_msgs.msg import AgentState, DetectionArray, LockstepStep, MeasurementBatch
from maasi_planner.motion import MotionModel, RobotState, make_motion
from maasi_planner.obstacles import Obstacles

FloatArray = NDArray[np.float64]
DataT = TypeVar('DataT')

_WATCH_PERIOD = 0.1
# Of those, from one state of a robot that has no odometry to the next.
_WATCHES_PER_STATE = 2
_PATIENCE = 3.0
# Without a charge for so long it warns that `battery_minimum` cannot act [s].
_BATTERY_PATIENCE = 10.0
# A robot whose odometry is silent for so much longer than its timeout, in wall time, is told to
# stand, though its goal goes on: a simulated clock may be slow [s].
_CLOCK_PATIENCE = 0.5
# How far image or batch stamps may be ahead of the odometry [ns].
_AHEAD = 2_000_000_000
_FEEDBACK_PERIOD = 500_000_000
# Longest wait for the last command and the last results to arrive [s].
_FAREWELL = 0.3
_STOP_COMMANDS = 3
_LAST_TASKS = 5
# Commands below these are not expected to change the pose [m/s, rad/s].
_LEAST_SPEED, _LEAST_TURN = 0.02, 0.05
# Kinds of trouble.
ODOMETRY, _FROZEN_POSE, _SENSOR, BATTERY = 'odometry', 'frozen pose', 'sensor', 'battery'
STOP = 'stop'


@dataclass(frozen=True)
class Sighting:
    """
    What a sensor saw at one instant.

    Attributes
    ----------
    values : ndarray, shape (m, d)
        Range [m], bearing and, in 3D, elevation [rad].
    covariances : ndarray, shape (m, d, d), or None
        Of the values; none: the sensor's preset.
    positions : ndarray, shape (m, d)
        Where the targets are by that [m, map].
    dropped : dict
        What was left out: reason to count.

    """

    values: FloatArray
    covariances: FloatArray | None
    positions: FloatArray
    dropped: dict[str, int]


class AgentDriver(LockstepLifecycleNode[DriverSettings], Generic[DataT], ABC):
    """
    The driver of a robot, in the robot's namespace.

    It reaches the robot by topics; one with a link of its own overrides `connect_robot`,
    `disconnect_robot`, `send_command`, `stop_robot` and `watch_robot`, and hands what comes in to
    `take_pose` and `take_charge`.

    Subscribes
    ----------
    `odom` (nav_msgs/Odometry), or what `PoseTopic` or `RobotFrames` do;
    `battery_state` (sensor_msgs/BatteryState);
    `measurement_batch` of the team (maasi_msgs/MeasurementBatch)

    Publishes
    ---------
    `state` (maasi_msgs/AgentState), with each odometry;
    `cmd_vel` (geometry_msgs/TwistStamped or Twist, as the robot listens), with each odometry, and
    zeros when it cannot go on and at the end;
    `detections` (maasi_msgs/DetectionArray), for each batch that this robot is in;
    what `RobotFrames` publishes

    Actions
    -------
    `go_to` (maasi_msgs/GoToWaypoint): the newest goal replaces the one before; one that cannot be
    taken is aborted at once, with the reason in its result

    Services
    --------
    `stop`, `release` (std_srvs/Trigger): it stands, and takes no goals until it is released
    """

    # What its sensor delivers, in words.
    sensed = 'sweep'
    # Of the parameter `link`, those that it has.
    links: tuple[str, ...] = ('topics',)

    def __init__(self, **options: Any) -> None:
        super().__init__('driver', DriverSettings, in_robot=True, **options)
        self._namespace = self.get_namespace().strip('/')
        self.robot = self._namespace.rpartition('/')[2]
        self._ended: dict[bytes, Goal] = {}
        self._command_publisher: CommandPublisher | None = None
        self._stop_latch = RobotStop(self.stop_by_service, self._release)

    def prepare(self) -> None:
        """Make controller and sensor."""
        settings = self.settings
        if settings.link not in self.links:
            raise SettingsError(
                f'parameter link: read {settings.link!r}, allowed with this driver is '
                + ' or '.join(self.links)
            )
        self.dimension = settings.environment.dimension
        self.sensor = settings.sensor.build(self.robot, self.dimension)
        self.offset = 0
        self._bounds = settings.environment.array()
        self._motion = self.make_motion()
        self._start = Pose.from_yaw(settings.start, settings.yaw)
        self._history = PoseHistory()
        # Robots whose odometry is rare are no exception.
        self._gate = StampGate(max(JUMP, round(2e9 * settings.odometry_timeout)))
        self._odometry: MapOdometry | None = None
        self._frames = RobotFrames(self, self.robot, partial(self._take_placed, 'tf'))
        self._pose_speed = PoseSpeed()
        self._posed = {'odometry': 'odometry', 'tf': 'pose on tf', 'pose': 'pose'}[settings.poses]
        self._follower = WaypointFollower(self._motion)
        self._queue: MeasurementQueue[DataT] = MeasurementQueue(self._history)
        self._unseen: Counter[str] = Counter()
        self._answer: DetectionArray | None = None
        self._battery = -1.0
        # Why the robot cannot go on, by kind; empty where it can.
        self._troubles: dict[str, str] = {STOP: STOPPED} if self._stop_latch.latched else {}
        self._gauge = BatteryGauge()
        self._charged_at = time.monotonic()
        self._readings = BatteryReadings()
        self._battery_subscription: Any = None
        self._moving = False
        self._changed_at = 0
        self._sensed_at: int | None = None
        self._silence = Silence(self)
        self._watched_at = time.monotonic()
        self._stalled = False
        self._watches = 0
        self._feedback_at = 0
        self._awaited: int | None = None
        self._answered: int | None = None
        self._unusable: int | None = None
        self._away = False
        self._state = AgentState(robot=self.robot, battery=-1.0)
        self._state.header.frame_id = settings.frame
        self._state.pose.pose = pose_to_ros(self._start)
        self._command = TwistStamped()
        self._command.header.frame_id = f'{self.robot}/base_link'

    # ---- what a robot's own driver adds ------------------------------------------------------

    @abstractmethod
    def set_up_sensor(self) -> None:
        """Compile what the sensor needs, and subscribe to it."""

    @abstractmethod
    def look(self, data: DataT, pose: StampedPose) -> Sighting:
        """
        Return what an image or sweep shows.

        Raises
        ------
        ValueError
            If it cannot be used: the next one takes its place.

        """

    def make_motion(self) -> MotionModel:
        """Return the controller."""
        settings = self.settings
        obstacles = Obstacles.from_settings(settings.environment.obstacles)
        return make_motion(settings.motion, obstacles, settings.radius)

    def steer(self, robot: RobotState, step: int | None) -> tuple[FloatArray, Goal | None]:
        """Return the command (4,), and the goal that is reached; see `WaypointFollower.update`."""
        return self._follower.update(robot, step)

    def is_moving(self, placed: StampedPose, command: FloatArray) -> bool:
        """Return whether pose and images have to change; see `steer` for the command."""
        return bool(math.hypot(*command[:3]) > _LEAST_SPEED or abs(command[3]) > _LEAST_TURN)

    # ---- the robot's link: topics, unless overridden -----------------------------------------

    def connect_robot(self) -> None:
        """Reach the robot, in *configure*."""
        settings = self.settings
        commands = CommandPublisher(self, 'cmd_vel', settings.command_type, settings.lockstep)
        self._command_publisher = commands
        quality = sensor_reader(settings.lockstep)
        if settings.poses == 'odometry':
            self.create_subscription(Odometry, 'odom', self._on_odometry, quality)
        self._battery_subscription = self.create_subscription(
            BatteryState, 'battery_state', self._on_battery, quality
        )
        self.expect_subscribers(lambda: commands.publisher)

    def disconnect_robot(self) -> None:
        """Undo `connect_robot`; ROS entities go by themselves."""
        if self._command_publisher is not None:
            self._command_publisher.destroy()
            self._command_publisher = None

    def send_command(self, placed: StampedPose, command: list[float]) -> None:
        """
        Have the robot move.

        Parameters
        ----------
        placed : StampedPose
            Where it is.
        command : list of float
            vx, vy, vz [m/s, axes turned by the heading], yaw rate [rad/s].

        """
        self._publish_command(command)

    def stop_robot(self) -> None:
        """Stop the robot because the driver ends; it has no goal any more."""
        if self._command_publisher is None:
            return
        for _ in range(_STOP_COMMANDS):
            self._publish_command([0.0, 0.0, 0.0, 0.0])
        self._command_publisher.wait(_FAREWELL)

    def hold_robot(self) -> None:
        """Stop the robot now, as its goal was cancelled or its pose is not known."""
        self._publish_command([0.0, 0.0, 0.0, 0.0])

    def arm_problem(self) -> str:
        """Return why a robot that flies must not take off; empty where nothing is known."""
        if not self.active:
            return 'the driver is not active'
        return self._troubles.get(STOP) or self._troubles.get(BATTERY) or ''

    def awaits_pose(self) -> bool:
        """Return whether a first pose that does not come is worth a warning."""
        return True

    def watch_robot(self) -> None:
        """Look after the link, ten times a second on wall time."""
        if self._command_publisher is not None:
            self._command_publisher.look()
            if problem := self._command_publisher.problem():
                self.warn_throttled('cmd_vel', problem)

    # ---- life cycle --------------------------------------------------------------------------

    def set_up(self) -> None:
        """Compile and connect."""
        settings = self.settings
        ahead = self._start.position + np.array([0.1, 0.1, 0.0])
        self._motion.command(RobotState(self._start), ahead)
        nowhere = np.zeros((1, self.dimension))
        self.sensor.detection.probability(nowhere, self._start)
        self._queue.offset = self.offset
        self._state_publisher = self.create_publisher(AgentState, 'state', LIVELY)
        self._detections_publisher = self.create_publisher(DetectionArray, 'detections', RELIABLE)
        self.create_subscription(
            MeasurementBatch, self.team_topic('measurement_batch'), self._on_batch, RELIABLE
        )
        self.connect_robot()
        ActionServer(
            self,
            GoToWaypoint,
            'go_to',
            self._conclude,
            # The protocol has no reason in a rejection: a goal that cannot be taken is accepted and
            # aborted, with the reason in its result.
            handle_accepted_callback=self._answer_goal,
            cancel_callback=self._cancel_goal,
        )
        self._stop_latch.offer(self)
        self._frames.set_up()
        if settings.poses == 'pose':
            PoseTopic(self, partial(self._take_placed, 'pose'))
        self.set_up_sensor()
        self.create_wall_timer(LIVELINESS_PERIOD, self._state_publisher.assert_liveliness)
        if not settings.lockstep:
            self.create_wall_timer(_WATCH_PERIOD, self._watch)
        self.expect_subscribers(self._state_publisher, names={'planner_node'})
        self.expect_subscribers(self._detections_publisher, names={'filter_node', 'planner_node'})

    def start(self) -> None:
        """Begin to work."""
        self._silence.end()

    def halt(self) -> None:
        """Give the goal up, and stop the robot."""
        if not self.configured:
            return
        self._end_goal(GoalStatus.ABORTED, 'the driver stops')
        self.stop_robot()

    def tear_down(self) -> None:
        """Disconnect."""
        # Results have been sent since *deactivate*; what is left goes with the server.
        self._ended.clear()
        self.disconnect_robot()

    def destroy_node(self) -> None:
        """Let those who wait for a goal know how it ended, and leave."""
        self.active = False
        deadline = time.monotonic() + _FAREWELL
        if self._ended and self.executor is not None:
            while self._ended and time.monotonic() < deadline:
                self.executor.spin_once(timeout_sec=0.01)
            # What was concluded is sent by tasks that come after.
            for _ in range(_LAST_TASKS):
                self.executor.spin_once(timeout_sec=0.0)
        super().destroy_node()

    def reset(self) -> None:
        """Forget where the robot was."""
        self._end_goal(GoalStatus.ABORTED, 'the time jumped back')
        if not self.settings.lockstep:
            # Where it is now is not known: it stands until a new pose comes.
            self.hold_robot()
            self.begin_trouble(ODOMETRY, f'no {self._posed} since the time jumped back')
        self._begin_anew()

    def _begin_anew(self) -> None:
        self._history.clear()
        self._frames.clear()
        self._queue.clear()
        self._answer = None
        self._follower = WaypointFollower(self._motion)
        self._awaited = self._answered = self._unusable = None
        self._sensed_at = None
        self._moving = False
        if self.settings.odometry_origin == 'first':
            self._odometry = None

    def status(self) -> dict[str, Any]:
        """Return what the robot does."""
        return {
            'goal': f'{self._state.goal_id}: {self._follower.status.name}',
            'trouble': self.trouble,
            'battery': f'{self._battery:.2f}',
            'open batches': len(self._queue),
            **{f'detections left out: {key}': number for key, number in self._unseen.items()},
        }

    # ---- odometry and the control step -------------------------------------------------------

    def _on_odometry(self, message: Odometry) -> None:
        if not self.active:
            return
        stamp = stamp_from_ros(message.header.stamp)
        if not self._is_new('odom.header.stamp', stamp):
            return
        try:
            placed = self._place(stamp, message)
        except ValueError as error:
            self.drop('odometry', f'odom: {error}')
            self._unusable = stamp
            self._answer_step()
            return
        self.take_pose(placed)

    def _is_new(self, what: str, stamp: int) -> bool:
        """Return whether a stamp [ns] of odometry is of use; one far back begins another time."""
        if not (self.settings.lockstep or self._gate.accepts(stamp)):
            self.drop(
                'odometry stamp',
                f'{what}: read {stamp} ns, which is far from the one before; allowed if the next '
                'one follows it',
            )
            return False
        latest = self._history.latest
        if latest is None or stamp > latest.stamp:
            return True
        if latest.stamp - stamp <= JUMP:
            if stamp < latest.stamp or not self.settings.lockstep:
                self.drop(
                    'odometry stamp',
                    f'{what}: read {stamp} ns, allowed are stamps after {latest.stamp} ns',
                )
            return False
        self.get_logger().warning(
            f'{what} jumped back by {1e-9 * (latest.stamp - stamp):.3f} s: starting anew'
        )
        self.reset()
        return True

    def _take_placed(self, topic: str, stamp: int, pose: Pose) -> None:
        if self.active and self._is_new(topic, stamp):
            self.take_pose(self._pose_speed.place(stamp, pose))

    def take_pose(self, placed: StampedPose) -> None:
        """Take where the robot is, later than all before."""
        self._silence.end()
        if self.end_trouble(ODOMETRY):
            self.get_logger().info(f'{self._posed} is back')
            # The sensor may have been silent with it.
            self._sensed_at = None
        if not self.settings.lockstep:
            self._watch_pose(placed)
            self._watch_sensor(placed)
        self._history.add(placed)
        if not self.settings.lockstep:
            self._control(placed)
            self._serve()
        else:
            self._answer_step()

    def _place(self, stamp: int, message: Odometry) -> StampedPose:
        settings, frame = self.settings, message.header.frame_id.lstrip('/')
        in_map = settings.odometry_origin == 'map'
        wanted = settings.odometry_frame or (settings.frame if in_map else '')
        space = frame.rpartition('/')[0]
        if (frame != wanted) if wanted else (space not in ('', self.robot, self._namespace)):
            raise ValueError(
                f'header.frame_id: read {frame!r}, allowed is '
                + (repr(wanted) if wanted else f"'odom' or '{self.robot}/odom' (odometry_frame)")
            )
        pose = pose_from_ros(message.pose.pose)
        covariance = np.asarray(message.pose.covariance)
        if self._odometry is None:
            origin = pose if settings.odometry_origin == 'first' else None
            self._odometry = MapOdometry(Pose(np.zeros(3)) if in_map else self._start, origin)
        linear, angular = message.twist.twist.linear, message.twist.twist.angular
        bounded('twist.linear', (linear.x, linear.y, linear.z), FASTEST)
        bounded('twist.angular', (angular.x, angular.y, angular.z), FASTEST)
        bounded('pose.covariance', covariance, FARTHEST**2)
        # A negative variance in the first place stands for an unknown covariance.
        known = covariance.any() and covariance[0] >= 0.0
        return self._odometry.apply(
            stamp,
            pose,
            covariance.reshape(6, 6) if known else None,
            (linear.x, linear.y, linear.z),
            (angular.x, angular.y, angular.z),
        )

    def _step_of(self, stamp: int) -> int:
        return round(stamp * 1e-9 / self.settings.step)

    def _control(self, placed: StampedPose) -> None:
        """Judge the goal, and publish state and command."""
        follower = self._follower
        step = self._step_of(placed.stamp)
        robot = RobotState(placed.pose, placed.velocity, placed.angular_velocity)
        command, reached = self.steer(robot, step if self.settings.lockstep else None)
        if _FROZEN_POSE in self._troubles:
            # Nothing can be controlled by such a pose.
            command = np.zeros(4)
        self._moving = self.is_moving(placed, command)
        if reached is not None:
            self._finish(reached)
        self._fill_state(placed, step)
        self._state_publisher.publish(self._state)
        origin = self._start if self._odometry is None else self._odometry.map_from_odom
        self._frames.publish(placed, origin)
        self.send_command(placed, command.tolist())
        if (
            follower.status == GoalStatus.MOVING
            and placed.stamp - self._feedback_at >= _FEEDBACK_PERIOD
            and follower.goal is not None
        ):
            self._feedback_at = placed.stamp
            distance = follower.distance(placed.pose.position)
            follower.goal.handle.publish_feedback(GoToWaypoint.Feedback(distance=distance))

    def _fill_state(self, placed: StampedPose, step: int) -> None:
        state = self._state
        state.header.stamp = self._command.header.stamp = stamp_to_ros(placed.stamp)
        state.step = step
        position, orientation = state.pose.pose.position, state.pose.pose.orientation
        position.x, position.y, position.z = placed.pose.position.tolist()
        orientation.w, orientation.x, orientation.y, orientation.z = (
            placed.pose.orientation.tolist()
        )
        state.pose.covariance = placed.covariance.ravel()
        linear, angular = state.twist.linear, state.twist.angular
        linear.x, linear.y, linear.z = placed.velocity.tolist()
        angular.x, angular.y, angular.z = placed.angular_velocity.tolist()
        self._fill_status()

    def _fill_status(self) -> None:
        state, goal = self._state, self._follower.goal
        state.battery = self._battery
        state.goal_id = 0 if goal is None else goal.id
        state.goal_status = int(self._follower.status)
        state.reason = '' if goal is None else goal.reason
        if self.trouble:
            state.goal_status = AgentState.UNAVAILABLE
            state.reason = self.trouble

    def _publish_command(self, command: list[float]) -> None:
        twist = self._command.twist
        twist.linear.x, twist.linear.y, twist.linear.z, twist.angular.z = command
        if self._command_publisher is not None:
            self._command_publisher.publish(self._command)

    # ---- lockstep ----------------------------------------------------------------------------

    def on_step(self, message: LockstepStep) -> None:
        """Do the control step of step k once its odometry is there."""
        self._away = self.robot not in message.robots
        if self._away:
            # The sim does not wait for a robot that is gone.
            self._end_goal(GoalStatus.ABORTED, 'left')
            self._follower.let_go()
            return
        self._awaited = stamp_from_ros(message.stamp)
        self._answer_step()

    def _answer_step(self) -> None:
        stamp = self._awaited
        if stamp is None:
            return
        latest = self._history.latest
        if stamp == self._answered:
            # Said again for somebody who was started again.
            self._state_publisher.publish(self._state)
            if self._command_publisher is not None:
                self._command_publisher.publish(self._command)
        elif latest is not None and latest.stamp == stamp:
            self._take_readings(stamp)
            self._control(latest)
        elif stamp == self._unusable:
            self._state.header.stamp = self._command.header.stamp = stamp_to_ros(stamp)
            self._state.step = self.step
            self._fill_status()
            self._state_publisher.publish(self._state)
            self._publish_command([0.0, 0.0, 0.0, 0.0])
        else:
            return
        self._awaited, self._answered = None, stamp
        self.done(self.step)
        self._serve()

    # ---- goals -------------------------------------------------------------------------------

    def _answer_goal(self, handle: ServerGoalHandle) -> None:
        """Take a goal, or abort it with the reason."""
        problem = self._problem(handle.request)
        if problem is None:
            self._take_goal(handle)
            return
        self.drop('goal', f'go_to: {problem}')
        refused = _goal_of(handle)
        refused.status, refused.reason = GoalStatus.ABORTED, problem
        self._finish(refused)

    def _problem(self, request: GoToWaypoint.Goal) -> str | None:
        """Return what is wrong with a goal: field, what was read, what is allowed."""
        if not self.active:
            return 'the driver is not active'
        if self._away:
            return 'the robot has left'
        if self.trouble:
            return f'the robot cannot go on: {self.trouble}'
        latest = self._history.latest
        now = self.get_clock().now().nanoseconds if latest is None else latest.stamp
        if problem := self._frames.to_map(request.waypoint, now):
            return problem
        point = request.waypoint.pose.position
        position = np.array([point.x, point.y, point.z])
        if not np.isfinite(position).all():
            return (
                f'waypoint.pose.position: read {position.tolist()}, allowed are finite numbers [m]'
            )
        margin = self.settings.radius
        for axis, (low, high) in enumerate(self._bounds.tolist()):
            if not low - margin <= position[axis] <= high + margin:
                return (
                    f'waypoint.pose.position.{"xyz"[axis]}: read {position[axis]}, '
                    f'allowed is {low - margin:g} to {high + margin:g} [m]'
                )
        if not (np.isfinite(request.tolerance) and request.tolerance >= 0.0):
            return f'tolerance: read {request.tolerance}, allowed are finite numbers from 0 [m]'
        return None

    def _take_goal(self, handle: ServerGoalHandle) -> None:
        replaced = self._follower.take(_goal_of(handle))
        if replaced is not None:
            self._finish(replaced)

    def _cancel_goal(self, handle: ServerGoalHandle) -> CancelResponse:
        goal = self._follower.current
        if goal is None or goal.handle is not handle:
            # It has ended, or been replaced: there is nothing to cancel.
            return CancelResponse.REJECT
        self._end_goal(GoalStatus.CANCELED, 'cancelled')
        if not self.settings.lockstep:
            self.hold_robot()
        return CancelResponse.ACCEPT

    def _end_goal(self, status: GoalStatus, reason: str) -> None:
        goal = self._follower.end(status, reason)
        if goal is not None:
            self._finish(goal)

    def _finish(self, goal: Goal) -> None:
        """Have the goal's result sent; the executor calls `_conclude` for it."""
        self._ended[bytes(goal.handle.goal_id.uuid)] = goal
        goal.handle.execute()

    def _conclude(self, handle: ServerGoalHandle) -> GoToWaypoint.Result:
        goal = self._ended.pop(bytes(handle.goal_id.uuid), None)
        if goal is None:
            return GoToWaypoint.Result(reason='the driver was cleaned up')
        if goal.status == GoalStatus.REACHED:
            handle.succeed()
        elif goal.status == GoalStatus.CANCELED and handle.is_cancel_requested:
            handle.canceled()
        else:
            handle.abort()
        result = GoToWaypoint.Result(reached=goal.status == GoalStatus.REACHED, reason=goal.reason)
        latest = self._history.latest
        result.pose = pose_to_ros(self._start if latest is None else latest.pose)
        return result

    # ---- when it cannot go on ----------------------------------------------------------------

    def stop_by_service(self) -> None:
        """Stop the robot until `release`, whichever client has a goal."""
        if not self.configured:
            return
        if self.begin_trouble(STOP, STOPPED):
            self.get_logger().warning(STOPPED)
        if self.active and not self.settings.lockstep:
            self.hold_robot()

    def _release(self) -> None:
        if self.configured and self.end_trouble(STOP):
            self.get_logger().info('released: it takes goals')

    @property
    def trouble(self) -> str:
        """Why the robot cannot go on; empty where it can."""
        return '; '.join(self._troubles.values())

    def begin_trouble(self, kind: str, text: str) -> bool:
        """
        Note that the robot cannot go on; return whether that is new: then its goal ends.

        Parameters
        ----------
        kind : str
            To end it by.
        text : str
            Why, for the planner.

        """
        new = kind not in self._troubles
        self._troubles[kind] = text
        if new:
            self._end_goal(GoalStatus.ABORTED, text)
            self._follower.let_go()
        return new

    def end_trouble(self, kind: str) -> bool:
        """Note that this is over; return whether it was there."""
        return self._troubles.pop(kind, None) is not None

    def _watch(self) -> None:
        """Stop a robot without odometry; looked at on wall time, as the clock may stand still."""
        if not self.active:
            return
        self._watches += 1
        now, before = time.monotonic(), self._watched_at
        self._watched_at = now
        self._stalled = now - before > 2.0 * _WATCH_PERIOD and not self._stalled
        if self._stalled:
            # It was this process that stood still: the odometry may be waiting to be read.
            return
        self.watch_robot()
        unknown = now - self._charged_at
        if self.settings.battery_minimum and unknown > _BATTERY_PATIENCE:
            self.warn_throttled(
                'battery',
                f'no charge of the battery for {unknown:.0f} s: battery_minimum cannot act',
            )
        age, timeout = self._silence.length, self.settings.odometry_timeout
        if self._history.latest is None and ODOMETRY not in self._troubles:
            wall = self._silence.wall
            if wall > _PATIENCE and self.awaits_pose():
                self.warn_throttled('no odometry', f'no {self._posed} yet, for {wall:.0f} s')
        elif age > timeout or ODOMETRY in self._troubles:
            text = f'no {self._posed} for {age:.1f} s'
            if self.begin_trouble(ODOMETRY, text):
                self.get_logger().warning(f'{text}: the robot is told to stop')
                self._watches = 0
            self.hold_robot()
            if self._watches % _WATCHES_PER_STATE == 0:
                self._fill_status()
                self._state_publisher.publish(self._state)
        elif self._silence.wall > timeout + _CLOCK_PATIENCE:
            # The simulated clock is slow or stands, which real robots do not.
            self.hold_robot()

    def _watch_pose(self, placed: StampedPose) -> None:
        """Stop a robot whose pose stays the same to the bit while it is told to move."""
        timeout, before = self.settings.frozen_pose_timeout, self._history.latest
        same = before is not None and placed.pose == before.pose
        if not same and self.end_trouble(_FROZEN_POSE):
            self.get_logger().info('the pose changes again')
        if not timeout or not same or not self._moving:
            self._changed_at = placed.stamp
            return
        age = 1e-9 * (placed.stamp - self._changed_at)
        if age > timeout:
            text = f'the pose has not changed for {age:.1f} s'
            if self.begin_trouble(_FROZEN_POSE, text):
                self.get_logger().warning(f'odom: {text}: the robot is told to stop')

    def _watch_sensor(self, placed: StampedPose) -> None:
        """Stop a robot whose sensor is silent."""
        timeout = self.settings.sensor_patience
        if self._sensed_at is None:
            self._sensed_at = placed.stamp
        age = 1e-9 * (placed.stamp - self._sensed_at)
        if timeout and age > timeout:
            text = f'no new {self.sensed} for {age:.1f} s'
            if self.begin_trouble(_SENSOR, text):
                self.get_logger().warning(f'{text}: the robot is told to stop')

    def _on_battery(self, message: BatteryState) -> None:
        if self.settings.lockstep:
            self._readings.add(stamp_from_ros(message.header.stamp), message.percentage)
        else:
            self.take_charge(self._gauge.charge(message.percentage))

    def _take_readings(self, stamp: int) -> None:
        """In lockstep: take the readings of the steps before the one at `stamp` [ns]."""
        if self._battery_subscription is not None:
            handle = self._battery_subscription.handle
            while (taken := handle.take_message(BatteryState, False)) is not None:
                self._on_battery(taken[0])
        for reading in self._readings.before(stamp):
            self.take_charge(self._gauge.charge(reading))

    def take_charge(self, charge: float) -> None:
        """Take how full the battery is, 0 to 1; anything else is unknown."""
        self._battery = charge if 0.0 <= charge <= 1.0 else -1.0
        minimum = self.settings.battery_minimum
        if self._battery < 0.0:
            # What is not known changes nothing about what was.
            return
        self._charged_at = time.monotonic()
        if not minimum:
            return
        if self._battery >= minimum:
            self.end_trouble(BATTERY)
            return
        text = f'battery at {self._battery:.2f}, below {minimum:.2f}'
        if self.begin_trouble(BATTERY, text):
            self.get_logger().warning(f'{text}: the robot goes nowhere any more')

    # ---- measurements ------------------------------------------------------------------------

    def _on_batch(self, message: MeasurementBatch) -> None:
        if not self.active:
            return
        stamp = stamp_from_ros(message.stamp)
        if message.id > batch_id_limit(0):
            self.drop('batch', f'measurement_batch.id: read {message.id}, allowed are small ones')
            return
        if self._is_ahead('batch', 'measurement_batch.stamp', stamp):
            return
        answer = self._answer
        if (
            answer is not None
            and answer.batch_id == message.id
            and stamp_from_ros(answer.header.stamp) >= stamp
        ):
            # It comes again where somebody may have missed it, and so may the answer have been.
            self._detections_publisher.publish(answer)
            return
        for member in message.members:
            if member.robot == self.robot:
                request = MeasurementRequest(int(message.id), stamp, int(member.measurement))
                for old in self._queue.add_request(request):
                    self.drop('batch', f'batch {old.batch}: no image for it, too many newer ones')
                self._serve()
                return

    def _is_ahead(self, reason: str, what: str, stamp: int) -> bool:
        """Return whether a stamp [ns] is far ahead of the odometry, and drop it then.

        In lockstep the step decides, and nothing is ahead of it.
        """
        latest = self._history.latest
        if self.settings.lockstep or latest is None or stamp <= latest.stamp + _AHEAD:
            return False
        self.drop(
            reason,
            f'{what}: read {stamp} ns, allowed is up to {_AHEAD * 1e-9:g} s after the odometry, '
            f'{latest.stamp + _AHEAD} ns',
        )
        return True

    def take_frame(self, topic: str, stamp: int, data: DataT, *, repeated: bool = False) -> None:
        """
        Take an image or sweep.

        Parameters
        ----------
        topic : str
            Where it came from.
        stamp : int
            [ns].
        data : object
            For `look`.
        repeated : bool
            Whether it is the one before over again, as of a sensor that hangs.
        """
        if not self.active or self._is_ahead('image stamp', f'{topic}.header.stamp', stamp):
            return
        latest = self._queue.latest
        if latest is not None and stamp <= latest:
            if latest - stamp <= JUMP:
                self.drop(
                    'image stamp',
                    f'{topic}.header.stamp: read {stamp} ns, allowed are stamps after {latest} ns',
                )
                return
            self.get_logger().warning(
                f'{topic}.header.stamp jumped back by {1e-9 * (latest - stamp):.3f} s'
            )
            self._queue.clear()
        # A robot that stands may see the same twice; what hung is trusted once that changes.
        if self._history.latest is not None and (
            not repeated or not (self._moving or _SENSOR in self._troubles)
        ):
            self._sensed_at = self._history.latest.stamp
            if self.end_trouble(_SENSOR):
                self.get_logger().info(f'{topic}: it is back')
        self._queue.add_frame(Frame(stamp, data))
        self._serve()

    def _serve(self) -> None:
        """Answer the batches for which image and pose are there."""
        while (found := self._queue.next()) is not None:
            request, frame, pose = found
            try:
                seen = self.look(frame.data, pose)
            except ValueError as error:
                # Not seeing is information: the next image answers instead of an empty answer.
                self.drop('image', str(error))
                continue
            self._queue.answered()
            self._publish_sighting(request, frame.stamp, pose, seen)

    def _publish_sighting(
        self, request: MeasurementRequest, stamp: int, pose: StampedPose, seen: Sighting
    ) -> None:
        values, covariances = seen.values, seen.covariances
        dropped = sum(seen.dropped.values())
        self._unseen.update(seen.dropped)
        if len(values):
            inside = self.sensor.detection.probability(seen.positions, pose.pose) > 0.0
            inside &= values[:, 0] <= self.sensor.maximum_range
            outside = int(np.count_nonzero(~inside))
            if outside:
                values = values[inside]
                covariances = None if covariances is None else covariances[inside]
                dropped += outside
                self._unseen['outside the field of view'] += outside
        beyond = len(values) - MOST_DETECTIONS
        if beyond > 0:
            self.drop(
                'too many detections',
                f'{self.sensed}: {len(values)} detections, allowed are {MOST_DETECTIONS}',
                beyond,
            )
            values = values[:MOST_DETECTIONS]
            covariances = None if covariances is None else covariances[:MOST_DETECTIONS]
            dropped += beyond
        answer = DetectionArray(
            batch_id=request.batch,
            step=self._step_of(stamp),
            robot=self.robot,
            measurement=request.measurement,
            sensor=self.sensor.name,
            detections=detections_to_ros(values, covariances),
            dropped=dropped,
        )
        answer.header.stamp = stamp_to_ros(stamp)
        answer.header.frame_id = self.settings.frame
        answer.pose.pose = pose_to_ros(pose.pose)
        answer.pose.covariance = pose.covariance.ravel()
        self._detections_publisher.publish(answer)
        self._answer = answer


def _goal_of(handle: ServerGoalHandle) -> Goal:
    request = handle.request
    point = request.waypoint.pose.position
    return Goal(
        id=int(request.goal_id),
        step=int(request.step),
        waypoint=np.array([point.x, point.y, point.z]),
        tolerance=float(request.tolerance),
        handle=handle,
    )
