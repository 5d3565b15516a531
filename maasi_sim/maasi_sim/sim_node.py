"""The simulation node: the clock, and the far end of every robot's topics."""

from __future__ import annotations

import array
import math
import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseArray, TwistStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import BatteryState, CameraInfo, Image, LaserScan
from std_msgs.msg import Header
from visualization_msgs.msg import Marker, MarkerArray

from maasi_drivers.vision.camera_model import Camera
from maasi_drivers.vision.camera_settings import CameraSettings
from maasi_filter.models.pose import Pose
from maasi_filter.ros.conversions import (
    colour,
    point_to_ros,
    pose_to_ros,
    sphere_marker,
    stamp_from_ros,
    stamp_of_step,
    stamp_to_ros,
)
from maasi_filter.ros.lifecycle_node import LockstepLifecycleNode, SettingsError, run
from maasi_filter.ros.marker_board import MarkerBoard
from maasi_filter.ros.qos import LATCHED, LATCHED_ALL, RELIABLE, sensor_reader, sensor_writer
from maasi_msgs.msg import AgentState, LockstepDone, LockstepStep, RangeArray, RangeMeasurement
from maasi_sim.emulators.linked_robots import LinkedRobot, linked_robot
from maasi_sim.scenario.layering import Key
from maasi_sim.scenario.loading import load_scenario
from maasi_sim.scenario.schema import (
    Scenario,
    ScenarioError,
    steps_of,
)
from maasi_sim.sim_settings import SimNodeSettings
from maasi_sim.world.external_robot import ExternalRobot
from maasi_sim.world.laser_scan import LaserSettings
from maasi_sim.world.robots import SimulatedRobot
from maasi_sim.world.simulation import Simulation

RECORDER = 'recorder'

# Between two looks at who is there [s].
_LOOK_PERIOD = 0.02
# After so long it says whom it waits for, and again for the same ones [s].
_PATIENCE, _REMINDER = 3.0, 15.0
# Longest wait for the subscriptions of a node that says that it is ready [s].
_CONNECTION_PATIENCE = 5.0
# Of simulated time, between two messages on a battery [s].
_BATTERY_PERIOD = 1.0
_LEAST_VARIANCE = 1e-12
# At the end: how long robots with a link of their own are there for drivers that stop them [s].
_FAREWELL = 1.0


class RobotTopics:
    """
    What one robot publishes; its messages are filled anew each time, as making them takes longer.

    Parameters
    ----------
    node : Node
        Whose publishers they are.
    simulation : Simulation
        Where the robot is.
    name : str
        Of the robot.
    qos : QoSProfile
        Of all topics.
    """

    def __init__(self, node: Node, simulation: Simulation, name: str, qos: QoSProfile) -> None:
        self.name = name
        self.simulation = simulation
        self.robot: SimulatedRobot = simulation.robots[name]
        self._battery_steps = steps_of(_BATTERY_PERIOD, simulation.scenario.step)
        self.publishers: list[Publisher] = []

        def publisher(kind: type, topic: str) -> Publisher:
            made = node.create_publisher(kind, f'{name}/{topic}', qos)
            self.publishers.append(made)
            return made

        equipment = self.robot.equipment
        # One that is moved by something else says where it is by itself.
        robot = simulation.scenario.robots[name]
        self.linked = robot.link != 'topics' or robot.external
        self._odometry_publisher = None if self.linked else publisher(Odometry, 'odom')
        self._odometry = Odometry(child_frame_id=f'{name}/base_link')
        self._odometry.header.frame_id = f'{name}/odom'
        linear = max(equipment.odometry.velocity_noise**2, _LEAST_VARIANCE)
        angular = max(equipment.odometry.heading_noise**2, _LEAST_VARIANCE)
        self._odometry.twist.covariance[::7] = [linear] * 3 + [angular] * 3
        self._battery_publisher = None if self.linked else publisher(BatteryState, 'battery_state')
        self._battery = BatteryState(
            **dict.fromkeys(('voltage', 'temperature', 'current', 'charge', 'capacity'), math.nan),
            design_capacity=math.nan,
            power_supply_status=BatteryState.POWER_SUPPLY_STATUS_DISCHARGING,
            present=True,
        )
        self._battery.header.frame_id = f'{name}/base_link'
        #: Topic that a driver cannot do without, beside its odometry.
        self.sensor_topic = ''
        if equipment.camera is not None:
            self._image_publisher = publisher(Image, 'camera/image_raw')
            self._info_publisher = publisher(CameraInfo, 'camera/camera_info')
            self._image, self._info = camera_messages(equipment.camera, f'{name}/camera_optical')
            self.sensor_topic = self._image_publisher.topic_name
        elif equipment.sensor is not None:
            self._ranges_publisher = publisher(RangeArray, 'ranges')
            self._ranges = RangeArray(header=Header(frame_id=f'{name}/base_link'))
            self.sensor_topic = self._ranges_publisher.topic_name
        # Who moves a robot on topics has its scan as well.
        self._scans = equipment.laser is not None and robot.body == 'simulated'
        if equipment.laser is not None and self._scans:
            self._scan_publisher = publisher(LaserScan, 'scan')
            self._scan = scan_message(equipment.laser, f'{name}/base_scan')

    @property
    def odometry_topic(self) -> str:
        """Full name of its odometry's topic; empty where it has none."""
        return '' if self._odometry_publisher is None else self._odometry_publisher.topic_name

    def publish(self, stamp: Time) -> bool:
        """Publish what is due; return whether camera or ranging sensor had something."""
        simulation, robot, name = self.simulation, self.robot, self.name
        if self._odometry_publisher is not None:
            self._publish_odometry(stamp, self._odometry_publisher)
        imaging = simulation.images_due(name)
        if imaging and robot.camera is not None:
            image = robot.image(simulation.step, simulation.time)
            self._info.header.stamp = stamp
            self._info_publisher.publish(self._info)
            self._image.header.stamp = stamp
            # An array is copied as a whole, numbers of an ndarray one by one.
            self._image.data = array.array('B', image.tobytes())
            self._image_publisher.publish(self._image)
        elif imaging and robot.ranging is not None:
            self._ranges.header.stamp = stamp
            self._ranges.ranges = [
                RangeMeasurement(
                    range=values[0],
                    bearing=values[1],
                    elevation=values[2] if len(values) == 3 else 0.0,
                )
                for values in robot.ranges(simulation.step).tolist()
            ]
            self._ranges_publisher.publish(self._ranges)
        if self._scans and simulation.scan_due(name):
            self._scan.header.stamp = stamp
            self._scan.ranges = array.array('f', simulation.scan(name).tobytes())
            self._scan_publisher.publish(self._scan)
        if self._battery_publisher is not None and simulation.step % self._battery_steps == 0:
            self._battery.header.stamp = stamp
            self._battery.percentage = robot.battery.charge
            self._battery_publisher.publish(self._battery)
        return imaging

    def _publish_odometry(self, stamp: Time, publisher: Publisher) -> None:
        reading, message = self.robot.odometry, self._odometry
        message.header.stamp = stamp
        place, turn = message.pose.pose.position, message.pose.pose.orientation
        place.x, place.y, place.z = reading.pose.position.tolist()
        turn.w, turn.x, turn.y, turn.z = reading.pose.orientation.tolist()
        message.pose.covariance = reading.covariance.reshape(36)
        linear, angular = message.twist.twist.linear, message.twist.twist.angular
        linear.x, linear.y, linear.z = reading.velocity.tolist()
        angular.x, angular.y, angular.z = reading.angular_velocity.tolist()
        publisher.publish(message)


def camera_messages(settings: CameraSettings, frame: str) -> tuple[Image, CameraInfo]:
    """Return a camera's image without its data, and its calibration."""
    image = Image(
        height=settings.height,
        width=settings.width,
        encoding='rgb8',
        is_bigendian=0,
        step=3 * settings.width,
    )
    camera = Camera.from_settings(settings)
    (fx, _, cx), (_, fy, cy), _ = camera.matrix.tolist()
    info = CameraInfo(
        height=settings.height,
        width=settings.width,
        distortion_model='plumb_bob',
        d=camera.distortion.tolist(),
        k=[fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0],
        r=[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        p=[fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
    )
    image.header.frame_id = info.header.frame_id = frame
    return image, info


def scan_message(settings: LaserSettings, frame: str) -> LaserScan:
    """Return a laser scan without its ranges: a turn in no time, from straight ahead."""
    increment = 2.0 * math.pi / settings.beams
    return LaserScan(
        header=Header(frame_id=frame),
        angle_min=0.0,
        angle_max=increment * (settings.beams - 1),
        angle_increment=increment,
        time_increment=0.0,
        scan_time=1.0 / settings.rate,
        range_min=settings.minimum_range,
        range_max=settings.maximum_range,
    )


class SimNode(LockstepLifecycleNode[SimNodeSettings]):
    """
    Plays the robots of a scenario, and the time.

    The time starts when the driver of each robot, the filter, the planner and, if it is to be
    awaited, the recorder have said that they are ready. In lockstep a step ends when all of them
    have said that they are done with it and each robot has its command; a node that says again
    that it is ready gets the step anew, so that a step can come twice.

    With `follow_clock`, or where another program moves a robot, the time is that of a `/clock` that
    somebody else publishes: the robots stand until all are ready, and the first step is that of the
    time then.

    Publishes
    ---------
    `<robot>/odom` (nav_msgs/Odometry), `<robot>/battery_state` (sensor_msgs/BatteryState), unless
    its link is another one than topics;
    `<robot>/camera/image_raw` (sensor_msgs/Image), `<robot>/camera/camera_info`
    (sensor_msgs/CameraInfo), `<robot>/scan` (sensor_msgs/LaserScan), `<robot>/ranges`
    (maasi_msgs/RangeArray): those that the robot has;
    `/clock` (rosgraph_msgs/Clock), unless it follows one; `lockstep/step`
    (maasi_msgs/LockstepStep);
    `ground_truth/targets` (geometry_msgs/PoseArray), `ground_truth/markers`
    (visualization_msgs/MarkerArray): latched, only for scoring and for the eye

    Subscribes
    ----------
    `<robot>/cmd_vel` (geometry_msgs/TwistStamped); `<robot>/state` (maasi_msgs/AgentState) of
    robots that another program moves; `/clock`, if it follows one;
    `lockstep/ready`, `lockstep/done` (maasi_msgs/LockstepDone)
    """

    #: Name of the node of each robot that commands it.
    robot_node = 'driver'

    def __init__(self, **options: Any) -> None:
        super().__init__('sim_node', SimNodeSettings, lockstep_member=False, **options)
        self._stamp = 0
        self._first = 0
        self._linked: dict[str, LinkedRobot] = {}

    def prepare(self) -> None:
        """Load the scenario."""
        settings = self.settings
        if not settings.lockstep and settings.rate == 0.0:
            raise SettingsError('parameter rate: read 0, allowed is above 0 unless in lockstep')
        if settings.lockstep and settings.follow_clock:
            raise SettingsError('parameter follow_clock: read true, allowed is false in lockstep')
        overrides = {'parameter step': (('step',), settings.step)} if settings.step > 0.0 else {}
        try:
            self.scenario = self.load(settings.scenario, overrides)
            rate = None if settings.lockstep else settings.rate
            self.scenario.check_pace(settings.lockstep, rate)
            self.simulation = self.simulate()
        except (ScenarioError, ValueError) as error:
            raise SettingsError(str(error)) from error
        self._follows = settings.follow_clock or self.scenario.external_clock
        self._length = self.scenario.step
        self._period = self._length / settings.rate if settings.rate > 0.0 else 0.0
        self._entities: list[Any] = []
        self._stamp = 0
        # Of the time at which it begins, and the last time of a clock that it follows [ns].
        self._first = 0
        self._followed: int | None = None
        # Of the last step that was published anew.
        self._repeated = -1
        # Topics on which each expected node listens.
        self._expected: dict[str, list[str]] = {}
        self._ready: set[str] = set()
        self._endpoints: dict[tuple[str, str], set[bytes]] = {}
        self._returned: dict[str, float] = {}
        self._ready_since: float | None = None
        # In lockstep: nodes that are not done, and topics of commands that have not come.
        self._waiting: set[str] = set()
        self._last_command: dict[str, int] = {}
        self._due = 0.0
        self._said, self._said_at = '', 0.0
        self._wall_start = self._wall_step = time.monotonic()

    def load(self, path: str, overrides: Mapping[str, tuple[Key, Any]]) -> Scenario:
        """Return the scenario of a file."""
        return load_scenario(path, overrides)

    def simulate(self) -> Simulation:
        """Return the robots at the start."""
        return Simulation(self.scenario, self.settings.seed)

    def connect(self) -> list[Any]:
        """Return publishers and subscriptions beside those of all robots, and of the time."""
        return []

    def on_new_step(self) -> None:
        """Note that the simulation has come to another step."""

    # ---- life cycle --------------------------------------------------------------------------

    def set_up(self) -> None:
        """Compile and connect."""
        lockstep = self.settings.lockstep
        self.simulation.warm_up()
        qos = sensor_writer(lockstep)
        self._clock_publisher: Publisher | None = None
        if self._follows:
            self.create_subscription(Clock, '/clock', self._on_clock, sensor_reader(False))
        else:
            self._clock_publisher = self.create_publisher(Clock, '/clock', qos)
            self._entities.append(self._clock_publisher)
        self._step_publisher = self.create_publisher(LockstepStep, 'lockstep/step', qos)
        self._entities.append(self._step_publisher)
        self._robots = {
            name: RobotTopics(self, self.simulation, name, qos) for name in self.simulation.robots
        }
        for topics in self._robots.values():
            self._entities += topics.publishers
        self._driver_of = {
            name: self.team_topic(f'{name}/{self.robot_node}') for name in self._robots
        }
        self._robot_of = {node: name for name, node in self._driver_of.items()}
        step_topics = [self._step_publisher.topic_name] if lockstep else []
        self._expected = {
            self._driver_of[name]: [
                *step_topics,
                *filter(None, (topics.odometry_topic, topics.sensor_topic)),
            ]
            for name, topics in self._robots.items()
        }
        for namespace in self.scenario.namespaces():
            for node in ('filter_node', 'planner_node'):
                self._expected[self.team_topic(f'{namespace}/{node}'.strip('/'))] = step_topics
        if self.settings.recorder:
            self._expected[self.team_topic(RECORDER)] = step_topics
        self._publish_truth()
        for name, topics in self._robots.items():
            if topics.linked:
                robot = linked_robot(name, self.scenario.robots[name], self.settings.seed)
                self._linked[name] = robot
                self.simulation.robots[name].follow(robot)
                if isinstance(robot, ExternalRobot):
                    topic = f'{name}/state'
                    self._entities.append(
                        self.create_subscription(AgentState, topic, robot.take, 10)
                    )
                continue
            self._entities.append(
                self.create_subscription(
                    TwistStamped,
                    f'{name}/cmd_vel',
                    partial(self._on_command, name),
                    RELIABLE if lockstep else 10,
                )
            )
        self._entities += self.connect()
        if lockstep:
            self._entities.append(
                self.create_subscription(LockstepDone, 'lockstep/done', self._on_done, RELIABLE)
            )
        self._entities.append(
            self.create_subscription(LockstepDone, 'lockstep/ready', self._on_ready, LATCHED_ALL)
        )
        self._look_timer = self.create_wall_timer(_LOOK_PERIOD, self._look_for_nodes)
        self._look_timer.cancel()
        self._step_timer = self.create_wall_timer(self._period or 1.0, self._on_step_timer)
        self._step_timer.cancel()
        self.create_wall_timer(1.0, self._watch)

    def start(self) -> None:
        """Wait for the nodes, or go on where it was stopped."""
        if self.step < 0:
            self._wall_start = time.monotonic()
            self._look_timer.reset()
        elif self.settings.lockstep:
            self._go_on_if_complete()
        elif not self._follows:
            self._step_timer.reset()

    def halt(self) -> None:
        """Stop the time."""
        self._step_timer.cancel()
        self._look_timer.cancel()

    def tear_down(self) -> None:
        """Disconnect; the next *configure* begins a new simulation."""
        self._close_links()

    def destroy_node(self) -> None:
        """Leave, once robots with a link of their own have been told to stop."""
        until = time.monotonic() + _FAREWELL
        while any(robot.obeys for robot in self._linked.values()) and time.monotonic() < until:
            time.sleep(_LOOK_PERIOD)
        self._close_links()
        super().destroy_node()

    def _close_links(self) -> None:
        for robot in self._linked.values():
            robot.close()
        self._linked.clear()

    def stamp_of_diagnostics(self) -> Time:
        """Return the time that it publishes: its own clock is that of the wall."""
        return stamp_to_ros(self._stamp)

    def status(self) -> dict[str, Any]:
        """Return where the simulation stands."""
        wall = time.monotonic() - self._wall_start
        return {
            'step': self.step,
            'real time factor': f'{self.simulation.time / wall if wall > 0.0 else 0.0:.2f}',
            'waits for': ', '.join(sorted(self._waiting)) if self.step >= 0 else self._missing(),
            'away': ', '.join(sorted(self.simulation.away)),
            'collisions': sum(robot.collisions for robot in self.simulation.robots.values()),
        }

    # ---- who is there ------------------------------------------------------------------------

    def _on_ready(self, message: LockstepDone) -> None:
        node = message.node
        if node not in self._expected:
            return
        if self.step >= 0 and self.settings.lockstep and node in self._ready:
            robot = self._robot_of.get(node)
            if robot is None or robot not in self.simulation.away:
                self.get_logger().info(f'{node} was started again: step {self.step} anew')
                self._returned[node] = time.monotonic()
                self._await(node)
                if self.active:
                    self._look_timer.reset()
        self._ready.add(node)

    def _missing(self) -> str:
        missing = sorted(set(self._expected) - self._ready)
        if self._follows and self._followed is None:
            missing.append('/clock')
        return ', '.join(missing)

    def _look_for_nodes(self) -> None:
        if not self.active:
            return
        if self.step >= 0:
            self._look_for_returned()
            return
        now = time.monotonic()
        missing = self._missing()
        if missing:
            if now - self._wall_start > _PATIENCE:
                self._say_waiting(f'waits for {missing}', now)
            return
        if self._ready_since is None:
            self._ready_since = now
        unheard = [topic for node in self._expected for topic in self._unheard(node)]
        unheard += self._unmatched()
        if unheard and now - self._ready_since < _CONNECTION_PATIENCE:
            return
        for topic in unheard:
            self.get_logger().warning(f'goes on, though nobody expected listens on {topic}')
        self._look_timer.cancel()
        self.get_logger().info(
            f'all are there: {", ".join(sorted(self._expected))}; the time starts'
        )
        self._remember_endpoints()
        self._wall_start = self._due = now
        if self._followed is not None:
            self._first = self._step_at(self._followed)
        self._begin_step()
        if not self.settings.lockstep and not self._follows:
            self._step_timer.reset()

    def _look_for_returned(self) -> None:
        now = time.monotonic()
        for node, since in sorted(self._returned.items()):
            connected = not self._unheard(node) and not self._unmatched()
            if connected or now - since > _CONNECTION_PATIENCE:
                del self._returned[node]
                self._remember_endpoints()
                self._repeated = self._stamp
                robot = self._robot_of.get(node)
                self._publish([robot] if robot is not None else [])
        if not self._returned:
            self._look_timer.cancel()

    def _listeners(self, node: str, topic: str) -> set[bytes]:
        """Return the subscriptions of a node to a topic."""
        return {
            bytes(info.endpoint_gid)
            for info in self.get_subscriptions_info_by_topic(topic)
            if f'{info.node_namespace.rstrip("/")}/{info.node_name}' == node
        }

    def _unheard(self, node: str) -> list[str]:
        """Return the topics that a node does not listen on, or only by what it was before."""
        return [
            topic
            for topic in self._expected[node]
            if not self._listeners(node, topic) - self._endpoints.get((node, topic), set())
        ]

    def _unmatched(self) -> list[str]:
        """Return the topics with a subscription that is known but would miss a message sent now."""
        return [
            publisher.topic_name
            for publisher in self._entities
            if isinstance(publisher, Publisher)
            and publisher.get_subscription_count()
            < len(self.get_subscriptions_info_by_topic(publisher.topic_name))
        ]

    def _remember_endpoints(self) -> None:
        for node, topics in self._expected.items():
            for topic in topics:
                self._endpoints[node, topic] = self._listeners(node, topic)

    def _watch(self) -> None:
        """Say whom a step waits for when it takes long."""
        now = time.monotonic()
        if self._waiting and self.active and now - self._wall_step > _PATIENCE:
            waiting = ', '.join(sorted(self._waiting))
            self._say_waiting(f'step {self.step} waits for {waiting}', now)

    def _say_waiting(self, text: str, now: float) -> None:
        """Warn of what is waited for when it changes, else seldom: compiling takes its time."""
        if text != self._said or now - self._said_at >= _REMINDER:
            self._said, self._said_at = text, now
            self.get_logger().warning(text)

    # ---- the steps ---------------------------------------------------------------------------

    def _await(self, node: str) -> None:
        self._waiting.add(node)
        robot = self._robot_of.get(node)
        if robot is not None:
            self._waiting.add(f'{robot}/cmd_vel')

    def _begin_step(self) -> None:
        """Publish the step that the simulation has come to."""
        self.step = self._first + self.simulation.step
        self._stamp = stamp_of_step(self.step, self._length)
        self._wall_step = time.monotonic()
        present = self.simulation.present
        if self.settings.lockstep:
            self._due = max(self._due + self._period, self._wall_step)
            for node in self._expected:
                robot = self._robot_of.get(node)
                if robot is None or robot not in self.simulation.away:
                    self._await(node)
        self.on_new_step()
        self._publish(present)

    def _publish(self, robots: list[str]) -> None:
        """Publish what some robots have at this step, the clock, and that the step is there.

        Where a step comes twice, images of the other robots have been taken the first time.
        """
        stamp = stamp_to_ros(self._stamp)
        for name in robots:
            self._robots[name].publish(stamp)
        if self._clock_publisher is not None:
            self._clock_publisher.publish(Clock(clock=stamp))
        present = self.simulation.present
        self._step_publisher.publish(
            LockstepStep(
                step=self.step,
                stamp=stamp,
                robots=present,
                imaging=[name for name in robots if self.simulation.images_due(name)],
            )
        )

    def check_stamp(self, topic: str, callback: Callable[[Any], None], message: Any) -> None:
        """Pass everything on: commands are compared with the step, and zeros always stop."""
        callback(message)

    def _on_done(self, message: LockstepDone) -> None:
        if message.step == self.step and message.node in self._waiting:
            # One that was started again is awaited until it has got the step.
            if message.node in self._returned:
                return
            self._waiting.discard(message.node)
            self._go_on_if_complete()

    def _on_command(self, name: str, message: TwistStamped) -> None:
        if self.step < 0 or name in self.simulation.away:
            return
        linear = message.twist.linear
        velocity = (linear.x, linear.y, linear.z, message.twist.angular.z)
        stamp = stamp_from_ros(message.header.stamp)
        if not self._is_of_use(name, velocity, stamp):
            return
        if all(math.isfinite(value) for value in velocity):
            self.simulation.robots[name].command(velocity)
        else:
            self.drop(
                'bad command',
                f'{name}/cmd_vel.twist: read {velocity}, allowed are finite numbers',
            )
        if self.settings.lockstep:
            self._waiting.discard(f'{name}/cmd_vel')
            self._go_on_if_complete()

    def _is_of_use(self, name: str, velocity: tuple[float, ...], stamp: int) -> bool:
        """Return whether a command is of now; count it otherwise."""
        stops = not any(velocity)
        if self.settings.lockstep:
            if stamp == self._stamp:
                return True
            if stamp == self._repeated:
                # The others answer a step that comes twice twice.
                return False
            # Nothing moves while a step waits: those who stop a robot are right already.
            oldest = newest = self._stamp
        else:
            # The last one may be of the step before; none at all means now.
            stamp = stamp or self._stamp
            newest = self._stamp + round(self._length * 1e9)
            oldest = max(
                self._stamp - round(self.settings.command_age * 1e9),
                self._last_command.get(name, 0),
            )
            if oldest <= stamp <= newest:
                self._last_command[name] = stamp
                return True
            if stops:
                return True
        if not stops:
            self.drop(
                'stale command',
                f'{name}/cmd_vel.header.stamp: read {stamp * 1e-9:.6f} s, allowed is '
                f'{oldest * 1e-9:.6f} to {newest * 1e-9:.6f} s',
            )
        return False

    def _go_on_if_complete(self) -> None:
        """Go on to the next step in lockstep if all are done, now or when it is time."""
        if self._waiting or not self.active or self.step < 0:
            return
        left = self._due - time.monotonic() if self._period > 0.0 else 0.0
        if left > 0.0:
            self._step_timer.timer_period_ns = max(round(left * 1e9), 1)
            self._step_timer.reset()
            return
        self.simulation.advance()
        self._begin_step()

    def _on_step_timer(self) -> None:
        if not self.active or self.step < 0:
            return
        if self.settings.lockstep:
            self._step_timer.cancel()
            self._go_on_if_complete()
        else:
            self._advance_freely()

    def _advance_freely(self) -> None:
        self.simulation.advance()
        for name, robot in self._linked.items():
            robot.cut(name in self.simulation.away)
        self._begin_step()

    def _step_at(self, time_: int) -> int:
        """Return the last step that has come at a time [ns]."""
        step = math.floor(time_ * 1e-9 / self._length)
        return step + 1 if stamp_of_step(step + 1, self._length) <= time_ else step

    def _on_clock(self, message: Clock) -> None:
        """Follow a clock; time that comes again, as its publisher was started anew, stands."""
        self._followed = stamp_from_ros(message.clock)
        while self.active and 0 <= self.step < self._step_at(self._followed):
            self._advance_freely()

    # ---- the truth ---------------------------------------------------------------------------

    def _publish_truth(self) -> None:
        header = Header(frame_id=self.settings.frame)
        world = self.simulation.world
        targets = self.create_publisher(PoseArray, 'ground_truth/targets', LATCHED)
        markers = self.create_publisher(MarkerArray, 'ground_truth/markers', LATCHED)
        self._entities += [targets, markers]
        targets.publish(
            PoseArray(
                header=header, poses=[pose_to_ros(Pose(target)) for target in world.targets_3d]
            )
        )
        size = 0.01 * float((world.bounds[:, 1] - world.bounds[:, 0]).max())
        shapes = [
            sphere_marker(header, 'truth', number, target, size, colour(0.0, 0.3, 1.0, 0.7))
            for number, target in enumerate(world.targets_3d, start=1)
        ]
        obstacles = world.obstacles
        for number, (centre, radius, sphere) in enumerate(
            zip(obstacles.centres, obstacles.radii, obstacles.spheres), start=1
        ):
            shape = sphere_marker(
                header, 'obstacles', number, centre, 2.0 * float(radius), colour(0.3, 0.3, 0.3)
            )
            if not sphere:
                shape.type = Marker.CYLINDER
                low, high = world.bounds[2] if world.dimension == 3 else (0.0, float(radius))
                shape.pose.position = point_to_ros([*centre[:2], 0.5 * (low + high)])
                shape.scale.z = float(high - low)
            shapes.append(shape)
        markers.publish(MarkerBoard().replace(MarkerArray(markers=shapes)))


def main(arguments: list[str] | None = None) -> int:
    """Run the simulation node."""
    return run(SimNode, arguments)


if __name__ == '__main__':
    raise SystemExit(main())
