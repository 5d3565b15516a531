"""The simulation node: publishes the clock and simulates every robot behind its topics."""

import math
import time
from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar

from builtin_interfaces.msg import Time
from geometry_msgs.msg import TwistStamped
from pydantic import Field
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rosgraph_msgs.msg import Clock

from maasi_filter.ros.conversions import stamp_from_ros, stamp_of_step, stamp_to_ros
from maasi_filter.ros.lifecycle_node import LockstepLifecycleNode, SettingsError
from maasi_filter.ros.node_settings import NodeSettings
from maasi_filter.ros.qos import LATCHED, LATCHED_ALL, RELIABLE, SENSOR, sensor_reader
from maasi_filter.settings import NotNegative, Positive
from maasi_msgs.msg import AgentState, LockstepDone, LockstepStep
from maasi_sim.scenario.loading import load_scenario
from maasi_sim.scenario.schema import Scenario, ScenarioError
from maasi_sim.simulation.emulators.linked_robots import LinkedRobot, linked_robot
from maasi_sim.simulation.robots import Simulation
from maasi_sim.simulation.sim_topics import Connections, ExternalRobot, RobotTopics, publish_truth

RECORDER = 'recorder'

_LOOK_PERIOD = 0.02  # period of checks for nodes that are not ready [s]
# Delay of the first warning about missing nodes, and period of its repetition [s].
_PATIENCE, _REMINDER = 3.0, 15.0
_CONNECTION_PATIENCE = 5.0  # longest wait for the subscriptions of a ready node [s]
# Most steps between recorder and simulation: a port of Fast DDS holds 512 messages before
# resending.
_MOST_AHEAD = 20
_CLOCK_PERIOD = 0.25  # period of the clock in lockstep [s]
_FAREWELL = 1.0  # at shutdown: time that linked robots stay reachable for drivers [s]


class SimNodeSettings(NodeSettings):
    """Settings of the simulation node; the rest is in the scenario file."""

    live: ClassVar[frozenset[str]] = frozenset({'command_age'})

    step: float = Field(
        0.0, ge=0.0, le=10.0, description='Duration of a step; 0: as in the scenario [s]'
    )
    scenario: str = Field(
        min_length=1, description='Scenario file, or the name of one in config/scenarios'
    )
    rate: NotNegative = Field(
        1.0,
        description='Largest ratio of simulated to wall time; 0: unlimited, in lockstep only',
    )
    recorder: bool = Field(False, description='Whether it also waits for the recorder')
    command_age: Positive = Field(
        1.0,
        description='Simulated time after which a command is stale; in lockstep commands belong to '
        'their step [s]',
    )


class SimNode(LockstepLifecycleNode[SimNodeSettings]):
    """Simulate the robots of a scenario and publish the time.

    The time starts when the driver of each robot, the filter, the planner and, with parameter
    `recorder`, the recorder have reported that they are ready. In lockstep a step ends when each
    robot has its command, every planner has reported that it is done, and the recorder is not too
    far behind. The step is republished for a restarted node that reports ready, so that a step can
    be received twice.

    Where another program moves a robot, the time is that of the `/clock` that it publishes, and
    the first step is at the time at which all nodes are ready.

    Publishes
    ---------
    `<robot>/odom` (nav_msgs/Odometry), `<robot>/battery_state` (sensor_msgs/BatteryState), unless
    its link is another one than topics;
    `<robot>/camera/image_raw` (sensor_msgs/Image), `<robot>/camera/camera_info`
    (sensor_msgs/CameraInfo), `<robot>/scan` (sensor_msgs/LaserScan), `<robot>/ranges`
    (maasi_msgs/RangeArray): those that the robot has;
    `/clock` (rosgraph_msgs/Clock), unless another program does, in lockstep four times a second;
    `lockstep/step` (maasi_msgs/LockstepStep), and, latched, `lockstep/robots` where these change;
    `ground_truth/targets` (geometry_msgs/PoseArray), `ground_truth/markers`
    (visualization_msgs/MarkerArray): latched, only for scores and for display

    Subscribes
    ----------
    `<robot>/cmd_vel` (geometry_msgs/TwistStamped); `<robot>/state` (maasi_msgs/AgentState) of
    robots that another program moves; `/clock` then;
    `lockstep/ready`, `lockstep/done` (maasi_msgs/LockstepDone)
    """

    robot_node = 'driver'  #: name of the node that commands each robot
    #: Reader of the scenario, and constructor of its robots.
    load: ClassVar[Any] = staticmethod(load_scenario)
    simulate: ClassVar[Any] = Simulation

    def __init__(self, **options: Any) -> None:
        super().__init__('sim_node', SimNodeSettings, **options)
        self._stamp = 0
        self._linked: dict[str, LinkedRobot] = {}

    def prepare(self) -> None:
        """Load the scenario."""
        settings = self.settings
        if not settings.lockstep and settings.rate == 0.0:
            raise SettingsError('parameter rate: read 0, allowed is above 0 unless in lockstep')
        overrides = {'parameter step': (('step',), settings.step)} if settings.step > 0.0 else {}
        try:
            self.scenario: Scenario = self.load(settings.scenario, overrides)
            rate = None if settings.lockstep else settings.rate
            self.scenario.check_pace(settings.lockstep, rate)
            self.simulation: Simulation = self.simulate(self.scenario, settings.seed)
        except (ScenarioError, ValueError) as error:
            raise SettingsError(str(error)) from error
        self._length = self.scenario.step
        self._period = self._length / settings.rate if settings.rate > 0.0 else 0.0
        self._stamp = 0
        # First step, and last time of an external clock [ns].
        self._first = 0
        self._external_time: int | None = None
        self._repeated = -1  # stamp of the last republished step
        # Topics that each expected node subscribes to.
        self._expected: dict[str, list[str]] = {}
        self._ready: set[str] = set()
        self._returned: dict[str, float] = {}
        self._ready_since: float | None = None
        # In lockstep: nodes that are not done, and command topics without a message.
        self._waiting: set[str] = set()
        self._recorded = 0  # last step that the recorder has received
        # Robots of the previous step.
        self._taking_part: list[str] = []
        self._last_command: dict[str, int] = {}
        self._due = 0.0
        self._said, self._said_at = '', 0.0
        self._wall_start = self._wall_step = time.monotonic()

    def connect(self) -> None:
        """Create publishers and subscriptions in addition to those of robots and time."""

    def on_new_step(self) -> None:
        """Handle a new step of the simulation."""

    # ---- life cycle --------------------------------------------------------------------------

    def set_up(self) -> None:
        """Compile and connect."""
        lockstep = self.settings.lockstep
        self.simulation.warm_up()
        qos = RELIABLE if lockstep else SENSOR
        self._robots = {
            name: RobotTopics(self, self.simulation, name, qos) for name in self.simulation.robots
        }
        self._driver_of = {
            name: self.team_topic(f'{name}/{self.robot_node}') for name in self._robots
        }
        self._robot_of = {node: name for name, node in self._driver_of.items()}
        step_topics = [self.resolve_topic_name('lockstep/step')] if lockstep else []
        self._expected = {
            self._driver_of[name]: topics.needed for name, topics in self._robots.items()
        }
        self._planners = set()
        for namespace in self.scenario.namespaces():
            self._expected[self.team_topic(f'{namespace}/filter_node'.strip('/'))] = []
            planner = self.team_topic(f'{namespace}/planner_node'.strip('/'))
            self._expected[planner] = step_topics
            self._planners.add(planner)
        self._recorder = self.team_topic(RECORDER)
        if self.settings.recorder:
            self._expected[self._recorder] = step_topics
        self._connections = Connections(self, self._expected)
        publish_truth(self, self.simulation.world, self.settings.frame)
        for name, topics in self._robots.items():
            if not topics.linked:
                command = partial(self._on_command, name)
                depth: QoSProfile | int = RELIABLE if lockstep else 10
                self.create_subscription(TwistStamped, f'{name}/cmd_vel', command, depth)
                continue
            robot = linked_robot(name, self.scenario, self.settings.seed)
            self._linked[name] = robot
            self.simulation.robots[name].follow(robot)
            if isinstance(robot, ExternalRobot):
                self.create_subscription(AgentState, f'{name}/state', robot.update, 10)
        self.connect()
        self._robots_publisher = self.create_publisher(LockstepStep, 'lockstep/robots', LATCHED)
        # After all other publishers, which the recorder then knows: it waits for clock and step.
        self._clock_publisher: Publisher | None = None
        if self.scenario.external_clock:
            self.create_subscription(Clock, '/clock', self._on_clock, sensor_reader(False))
        else:
            self._clock_publisher = self.create_publisher(Clock, '/clock', qos)
        self._step_publisher = self.create_publisher(LockstepStep, 'lockstep/step', qos)
        if lockstep:
            self.create_subscription(LockstepDone, 'lockstep/done', self._on_done, RELIABLE)
        self.create_subscription(LockstepDone, 'lockstep/ready', self._on_ready, LATCHED_ALL)
        self._look_timer = self.create_wall_timer(_LOOK_PERIOD, self._look_for_nodes)
        self._look_timer.cancel()
        self._step_timer = self.create_wall_timer(self._period or 1.0, self._on_step_timer)
        self._step_timer.cancel()
        self.create_wall_timer(1.0, self._watch)

    def start(self) -> None:
        """Wait for the nodes, or resume."""
        if self.step < 0:
            self._wall_start = time.monotonic()
            self._look_timer.reset()
        elif self.settings.lockstep:
            self._advance_if_complete()
        elif not self.scenario.external_clock:
            self._step_timer.reset()

    def halt(self) -> None:
        """Stop time."""
        self._step_timer.cancel()
        self._look_timer.cancel()

    def tear_down(self) -> None:
        """Disconnect; the next *configure* begins a new simulation."""
        for robot in self._linked.values():
            robot.close()
        self._linked.clear()

    def destroy_node(self) -> None:
        """Shut down after linked robots have been stopped."""
        until = time.monotonic() + _FAREWELL
        while any(robot.obeys for robot in self._linked.values()) and time.monotonic() < until:
            time.sleep(_LOOK_PERIOD)
        self.tear_down()
        super().destroy_node()

    def stamp_of_diagnostics(self) -> Time:
        """Return the simulated time, as the node's clock is wall time."""
        return stamp_to_ros(self._stamp)

    def status(self) -> dict[str, Any]:
        """Return the state of the simulation."""
        wall = time.monotonic() - self._wall_start
        return {
            'step': self.step,
            'real time factor': f'{self.simulation.time / wall if wall > 0.0 else 0.0:.2f}',
            'waits for': ', '.join(sorted(self._waiting)) if self.step >= 0 else self._missing(),
            'away': ', '.join(sorted(self.simulation.away)),
            'collisions': sum(robot.collisions for robot in self.simulation.robots.values()),
        }

    # ---- presence of nodes -------------------------------------------------------------------

    def _on_ready(self, message: LockstepDone) -> None:
        node = message.node
        if node not in self._expected:
            return
        restarted = self.step >= 0 and self.settings.lockstep and node in self._ready
        if restarted and self._robot_of.get(node) not in self.simulation.away:
            self._await(node)
            self.get_logger().info(f'{node} was restarted: republishing step {self.step}')
            self._returned[node] = time.monotonic()
            if self.active:
                self._look_timer.reset()
        self._ready.add(node)

    def _missing(self) -> str:
        missing = sorted(set(self._expected) - self._ready)
        if self.scenario.external_clock and self._external_time is None:
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
            # A run with a recorder reports this itself.
            if now - self._wall_start > _PATIENCE and not self.settings.recorder:
                self._say_waiting(f'waiting for {missing}', now)
            return
        if self._ready_since is None:
            self._ready_since = now
        lacking = [
            topic for node in self._expected for topic in self._connections.unsubscribed(node)
        ]
        lacking += self._connections.unmatched()
        if lacking and now - self._ready_since < _CONNECTION_PATIENCE:
            return
        for topic in lacking:
            self.get_logger().warning(f'continues without an expected subscription to {topic}')
        self._look_timer.cancel()
        self.get_logger().info(
            f'all nodes are ready: {", ".join(sorted(self._expected))}; starting time'
        )
        self._connections.remember()
        self._wall_start = self._due = now
        if self._external_time is not None:
            self._first = self._step_at(self._external_time)
        self._begin_step()
        if not self.settings.lockstep and not self.scenario.external_clock:
            self._step_timer.reset()

    def _look_for_returned(self) -> None:
        now = time.monotonic()
        for node, since in sorted(self._returned.items()):
            lacking = self._connections.unsubscribed(node)
            connected = not lacking and not self._connections.unmatched()
            if connected or now - since > _CONNECTION_PATIENCE:
                del self._returned[node]
                self._connections.remember()
                self._repeated = self._stamp
                robot = self._robot_of.get(node)
                self._publish([robot] if robot is not None else [])
        if not self._returned:
            self._look_timer.cancel()

    def _watch(self) -> None:
        now = time.monotonic()
        if self._waiting and self.active and now - self._wall_step > _PATIENCE:
            waiting = ', '.join(sorted(self._waiting))
            self._say_waiting(f'step {self.step} is waiting for {waiting}', now)

    def _say_waiting(self, text: str, now: float) -> None:
        """Warn when the text changes, else rarely, as a node may compile for minutes."""
        if text != self._said or now - self._said_at >= _REMINDER:
            self._said, self._said_at = text, now
            self.get_logger().warning(text)

    # ---- the steps ---------------------------------------------------------------------------

    def _await(self, node: str) -> None:
        """Wait for the answer of a node to this step: a command or done."""
        robot = self._robot_of.get(node)
        if robot is not None and robot not in self.simulation.away:
            self._waiting.add(f'{robot}/cmd_vel')
        late = node == self._recorder and self.step - self._recorded > _MOST_AHEAD
        if node in self._planners or late:
            self._waiting.add(node)

    def _begin_step(self) -> None:
        self.step = self._first + self.simulation.step
        self._stamp = stamp_of_step(self.step, self._length)
        self._wall_step = time.monotonic()
        if self.settings.lockstep:
            self._due = max(self._due + self._period, self._wall_step)
            for node in self._expected:
                self._await(node)
        self.on_new_step()
        self._publish(self.simulation.present)

    def _publish(self, robots: list[str]) -> None:
        """Publish the data of some robots, the clock and the step.

        For a republished step, the other robots take no new images.
        """
        stamp = stamp_to_ros(self._stamp)
        present = self.simulation.present
        if present != self._taking_part:
            self._taking_part = present
            message = LockstepStep(step=self.step, stamp=stamp, robots=present)
            self._robots_publisher.publish(message)
        for name in present:
            self._robots[name].publish_odometry(stamp)
        # In lockstep the step gives the time; a clock in addition would cost a tenth.
        every = max(round(_CLOCK_PERIOD / self._length), 1) if self.settings.lockstep else 1
        if self._clock_publisher is not None and self.step % every == 0:
            self._clock_publisher.publish(Clock(clock=stamp))
        again = [name for name in present if name in robots]
        imaging = [name for name in again if self.simulation.images_due(name)]
        self._step_publisher.publish(
            LockstepStep(step=self.step, stamp=stamp, robots=present, imaging=imaging)
        )
        # Last: robots and planners work while images are rendered.
        for name in again:
            self._robots[name].publish_sensors(stamp)

    def check_stamp(self, topic: str, callback: Callable[[Any], None], message: Any) -> None:
        """Pass every message: commands are compared with the step, and zeros always stop."""
        callback(message)

    def _on_done(self, message: LockstepDone) -> None:
        if message.node == self._recorder:
            self._recorded = message.step
            done = self.step - self._recorded <= _MOST_AHEAD
        else:
            done = message.step == self.step
        if done and message.node in self._waiting:
            # A restarted node is awaited after it has received the step.
            if message.node in self._returned:
                return
            self._waiting.discard(message.node)
            self._advance_if_complete()

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
                'bad command', f'{name}/cmd_vel.twist: read {velocity}, allowed are finite numbers'
            )
        if self.settings.lockstep:
            self._waiting.discard(f'{name}/cmd_vel')
            self._advance_if_complete()

    def _is_of_use(self, name: str, velocity: tuple[float, ...], stamp: int) -> bool:
        """Return whether a command is for the current step or time; count it otherwise."""
        stops = not any(velocity)
        if self.settings.lockstep:
            if stamp == self._stamp:
                return True
            if stamp == self._repeated:
                return False  # duplicate: other nodes answer a republished step again
            # Nothing moves while a step waits: a stop command is already fulfilled.
            oldest = newest = self._stamp
        else:
            # A command may belong to the previous step; stamp 0 means now.
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

    def _advance_if_complete(self) -> None:
        """Begin the next step in lockstep if all nodes are done, now or when it is due."""
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
            self._advance_if_complete()
        else:
            self._advance_freely()

    def _advance_freely(self) -> None:
        self.simulation.advance()
        for name, robot in self._linked.items():
            robot.cut(name in self.simulation.away)
        self._begin_step()

    def _step_at(self, time_: int) -> int:
        """Return the last step at or before a time [ns]."""
        step = math.floor(time_ * 1e-9 / self._length)
        return step + 1 if stamp_of_step(step + 1, self._length) <= time_ else step

    def _on_clock(self, message: Clock) -> None:
        """Advance to an external time; pause if a restarted publisher repeats time."""
        self._external_time = stamp_from_ros(message.clock)
        while self.active and 0 <= self.step < self._step_at(self._external_time):
            self._advance_freely()
