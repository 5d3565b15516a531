"""The driver of a robot: a node that joins a link, a sensor, goals and batch answers."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from std_srvs.srv import Trigger

from maasi_drivers.agent.goal_server import GoalServer
from maasi_drivers.agent.measurement_responder import MeasurementResponder
from maasi_drivers.agent.odometry import PoseSpeed, StampedPose
from maasi_drivers.agent.robot_frames import RobotFrames
from maasi_drivers.agent.robot_node import AREA, FROZEN_POSE, ODOMETRY, STOP, RobotNode
from maasi_drivers.agent.robot_topics import PoseTopic
from maasi_drivers.agent.sensor_input import SensorInput
from maasi_drivers.agent.watchdog import PERIOD, StatePublisher, Watchdog
from maasi_drivers.agent.waypoint_follower import GoalStatus, WaypointFollower
from maasi_drivers.links.robot_link import RobotLink
from maasi_drivers.settings.driver import TERRAIN_LINKS
from maasi_filter.geometry.area import Area
from maasi_filter.geometry.operating_volume import MARGIN
from maasi_filter.models.pose import Pose
from maasi_filter.ros.keep_outs import KeepOutTopic
from maasi_filter.ros.lifecycle_node import SettingsError
from maasi_filter.ros.qos import LATCHED
from maasi_filter.ros.run_node import run as run_node
from maasi_filter.wording import number
from maasi_msgs.msg import LockstepStep
from maasi_planner.motion import RobotState

# Reason in `state` while the service has stopped the robot.
STOPPED = 'stopped by the service stop; call the service release'

MakeLink = Callable[[RobotNode], RobotLink]
MakeSensor = Callable[[RobotNode], SensorInput]


class AgentDriver(RobotNode):
    """Join a robot to a search; run one driver for each robot, in the robot's namespace.

    Subscribes
    ----------
    `/measurement_batch` (maasi_msgs/MeasurementBatch), `/tf` and `/tf_static` (tf2_msgs/TFMessage)
    of the team; what link and sensor need: `odom` (nav_msgs/Odometry), `battery_state`
    (sensor_msgs/BatteryState), `camera/image_raw`, `camera/camera_info`, `scan`
    (sensor_msgs/LaserScan) or `ranges` (maasi_msgs/RangeArray); `pose`
    (geometry_msgs/PoseStamped, in the map) where the parameter `pose_source` says so; in lockstep
    `lockstep/robots` (maasi_msgs/LockstepStep, latched)

    Publishes
    ---------
    `state` (maasi_msgs/AgentState), `detections` (maasi_msgs/DetectionArray), `/tf`, `/tf_static`,
    `robot_description`; with link topics `cmd_vel`

    Actions
    -------
    `go_to` (maasi_msgs/GoToWaypoint): moves to a waypoint

    Services
    --------
    `stop`, `release` (std_srvs/Trigger): the robot stops, and accepts no goals until `release`

    Notes
    -----
    A driver is composed of a link to the robot, a sensor, and parts with one concern each:
    `GoalServer`, `MeasurementResponder`, `StatePublisher`, `Watchdog`, `RobotFrames`.

    Parameters
    ----------
    links : dict
        What makes the link, for each allowed value of the parameter `link`.
    make_sensor : callable
        Makes the sensor.
    """

    link: RobotLink
    sensor_input: SensorInput
    goals: GoalServer

    def __init__(
        self, links: Mapping[str, MakeLink], make_sensor: MakeSensor, **options: Any
    ) -> None:
        super().__init__(**options)
        self._links, self._make_sensor = links, make_sensor
        self._opened: list[RobotLink | SensorInput] = []  # parts to close
        self._stop_latched = False  # outlives *cleanup* and *configure*

    def prepare(self) -> None:
        """Make link, sensor and controller."""
        settings = self.settings
        if settings.link not in self._links:
            raise SettingsError(
                f'parameter link: read {settings.link!r}, allowed with this driver is '
                + ' or '.join(self._links)
            )
        super().prepare()
        if self.volume.area.terrain is not None and settings.link not in TERRAIN_LINKS:
            raise SettingsError(
                f'parameter environment.terrain.file: read {settings.environment.terrain.file}, '
                f'allowed with link {settings.link} is none: the driver does not control its height'
            )
        self.link = self._links[settings.link](self)
        self.sensor_input = self._make_sensor(self)
        self._opened = [self.sensor_input]
        self.link.prepare()
        self.sensor_input.prepare()
        self._motion = self.link.make_motion()
        self.follower = WaypointFollower(self._motion)
        self._pose_speed = PoseSpeed()

    def set_up(self) -> None:
        """Compile kernels, make the parts and connect."""
        settings = self.settings
        ahead = self.start_pose.position + np.array([0.1, 0.1, 0.0])
        self._motion.command(RobotState(self.start_pose), ahead)
        nowhere = np.zeros((1, self.dimension))
        self.sensor.detection.probability(nowhere, self.start_pose)
        self._state = StatePublisher(self)
        self._watchdog = Watchdog(self, self.link, self.sensor_input, self._state)
        self._responder = MeasurementResponder(self, self.sensor_input, self._watchdog)
        self.frames = RobotFrames(self, self.robot, partial(self._handle_localised, 'tf'))
        self.goals = GoalServer(self, self.link)
        KeepOutTopic(self, self._adopt_area, keep=False)
        if self._stop_latched:
            self.health.begin(STOP, STOPPED)
        self._opened.append(self.link)
        self.link.connect()
        self.offer_service('stop', self._on_stop)
        self.offer_service('release', self._on_release)
        if settings.poses == 'pose':
            PoseTopic(self, partial(self._handle_localised, 'pose'))
        self.sensor_input.set_up()
        if settings.lockstep:
            topic = self.team_topic('lockstep/robots')
            self.create_subscription(LockstepStep, topic, self._on_robots, LATCHED)
        else:
            self.create_wall_timer(PERIOD, self._watchdog.check)

    def start(self) -> None:
        """Start working."""
        self.silence.end()
        self.link.activate()

    def halt(self) -> None:
        """Abort the goal and stop the robot."""
        if not self.configured:
            return
        self.end_goal(GoalStatus.ABORTED, 'the driver stops')
        self.link.stop()

    def tear_down(self) -> None:
        """Disconnect."""
        for part in self._opened:
            part.close()
        self._opened = []

    def destroy_node(self) -> None:
        """Send the last results and destroy the node."""
        self.active = False
        if hasattr(self, 'goals'):
            self.goals.settle()
        super().destroy_node()
        self.tear_down()

    def reset(self) -> None:
        """Discard data from before a jump back in time."""
        self.restart('time jumped back')

    def restart(self, reason: str) -> None:
        """See `RobotNode.restart`."""
        self.end_goal(GoalStatus.ABORTED, reason)
        if not self.settings.lockstep:
            # Its pose is unknown: it stays stopped until a new one arrives.
            self.link.hold()
            self.health.begin(ODOMETRY, f'no {self.pose_name} since {reason}')
        self.history.clear()
        self.frames.clear()
        self._responder.reset()
        self._watchdog.reset()
        self.follower = WaypointFollower(self._motion)
        if self.settings.odometry_origin == 'first':
            self.map_odometry = None
        self.link.reset()

    def status(self) -> dict[str, Any]:
        """Return goal, fault and counts for the diagnostics."""
        left_out, goal = self._responder.left_out, self.follower.goal
        return {
            'goal': f'{0 if goal is None else goal.id}: {self.follower.status.name}',
            'fault': self.health.text,
            'battery': f'{self._state.charge:.2f}',
            'open batches': len(self._responder.queue),
            **{f'dropped detections: {key}': number for key, number in left_out.items()},
            **self.link.status(),
        }

    def take_pose(self, placed: StampedPose) -> None:
        """Handle the robot's pose with a control step.

        Parameters
        ----------
        placed : StampedPose
            Pose in frame `map` [m], velocity [m/s], and the time [ns] at which they were true.
        """
        area = self.volume.area
        if area.terrain is not None and self.follower.on_ground:
            # Odometry of ground robots is that of a plane.
            x, y, _ = placed.pose.position.tolist()
            level = area.above_ground([x, y, self.settings.start[2]])
            placed = replace(placed, pose=Pose(level, placed.pose.orientation))
        self.link.observe(placed)
        self.silence.end()
        outside, allowed = self.volume.beyond_border(placed.pose.position)
        if outside > allowed + MARGIN:
            self.health.begin(AREA, f'{number(outside)} m outside of the area')
        elif outside <= allowed:
            self.health.end(AREA, 'inside the area again')
        self._watchdog.watch_charge(placed.stamp)
        if self.health.end(ODOMETRY, f'{self.pose_name}: received again'):
            self._watchdog.sensed_at = (
                None  # battery messages may have been missing together with odometry
            )
        if self.settings.lockstep:
            self.link.begin_step(placed.stamp)
        else:
            self._watchdog.note_pose(placed)
        self.history.add(placed)
        self._control(placed)
        self._responder.serve()

    def refuse_pose(self, stamp: int) -> None:
        """In lockstep, stop the robot: the step of a stamp [ns] awaits a command."""
        if self.settings.lockstep:
            self._state.publish_status(stamp, self.step_of(stamp))
            self.link.hold_step(stamp)

    def answer_again(self) -> None:
        """See `RobotNode.answer_again`."""
        self._state.repeat()
        self.link.repeat()

    def _handle_localised(self, topic: str, stamp: int, pose: Pose) -> None:
        if self.active and self.is_new_pose(topic, stamp):
            self.take_pose(self._pose_speed.with_velocity(stamp, pose))

    def _adopt_area(self, area: Area) -> None:
        """Adopt keep-out zones; abort a goal whose path, from outside of all zones, enters one."""
        self.volume.area, motion, latest = area, self._motion, self.history.latest
        goal, paths = self.follower.current, None
        if goal is not None and latest is not None:
            state = RobotState(latest.pose, latest.velocity, latest.angular_velocity)
            paths = motion.predict(state, goal.waypoint[None, :], 0.2).positions
        motion.adopt_area(area, self.settings.radius)
        if paths is not None:
            free = [motion.keep_out.is_free(position) for position in paths[0]]
            if not all(free[free.index(True) if True in free else 0 :]):
                self.end_goal(GoalStatus.ABORTED, 'path blocked by a keep-out zone')

    def take_charge(self, charge: float) -> None:
        """Update the battery charge.

        Parameters
        ----------
        charge : float
            Share of a full battery, 0 to 1; other values count as unknown.
        """
        self._watchdog.update_charge(charge)

    def receive_frame(self, topic: str, stamp: int, data: Any, *, repeated: bool = False) -> None:
        """Handle an image or sweep; see `RobotNode.receive_frame`."""
        self._responder.receive_frame(topic, stamp, data, repeated)

    def end_goal(self, status: GoalStatus, reason: str) -> None:
        """End the current goal, if any."""
        goal = self.follower.end(status, reason)
        if goal is not None:
            self.goals.finish(goal)

    def publish_fault(self) -> None:
        """Publish `state` with the fault of a robot without a pose."""
        if self.health.text and self.history.latest is None:
            self._state.publish_status(self.get_clock().now().nanoseconds)

    def _control(self, placed: StampedPose) -> None:
        step = self.step_of(placed.stamp)
        robot = RobotState(placed.pose, placed.velocity, placed.angular_velocity)
        command, reached = self.link.steer(robot, step if self.settings.lockstep else None)
        if FROZEN_POSE in self.health:
            command = np.zeros(4)  # such a pose cannot be used for control
        self._watchdog.moving = self.link.is_moving(placed, command)
        if reached is not None:
            self.goals.finish(reached)
        self._state.publish(placed, step)
        odometry = self.map_odometry
        origin = self.start_pose if odometry is None else odometry.map_from_odom
        self.frames.publish(placed, origin)
        self.link.send(placed, command.tolist())
        self.goals.publish_feedback(placed)

    def _on_robots(self, message: LockstepStep) -> None:
        self.goals.away = self.robot not in message.robots
        if self.goals.away and self.active:
            self.end_goal(GoalStatus.ABORTED, 'left')
            self.follower.let_go()

    def _on_stop(self, _: Trigger.Request) -> tuple[bool, str]:
        self._stop_latched = True
        if self.configured:
            self.health.begin(STOP, STOPPED)
            if self.active and not self.settings.lockstep:
                self.link.hold()
            self.link.latch_stop()
        return True, 'robot stopped; goals are refused until release'

    def _on_release(self, _: Trigger.Request) -> tuple[bool, str]:
        was, self._stop_latched = self._stop_latched, False
        if self.configured:
            self.health.end(STOP, 'released: goals are accepted')
        return True, 'robot released' if was else 'the robot was not stopped'


def run(
    link: MakeLink | Mapping[str, MakeLink], sensor: MakeSensor, arguments: list[str] | None = None
) -> int:
    """Run the driver of a robot until it is asked to end; return the exit code.

    Parameters
    ----------
    link : callable or dict
        What makes the link, or one for each allowed value of the parameter `link`.
    sensor : callable
        What makes the sensor, as `CameraInput`.
    arguments : list of str, optional
        Of the command line.

    Returns
    -------
    int
        0: ended as asked, 1: failed, 2: wrong parameters.
    """
    links = link if isinstance(link, Mapping) else {'topics': link}
    return run_node(lambda: AgentDriver(links, sensor), arguments, AgentDriver)
