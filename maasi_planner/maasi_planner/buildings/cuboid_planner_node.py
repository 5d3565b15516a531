"""The planner node of one robot that searches buildings with others (004)."""

import time
from typing import Any

import numpy as np
from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry, Path
from rclpy.duration import Duration
from rclpy.subscription import Subscription
from std_msgs.msg import Header
from visualization_msgs.msg import MarkerArray

from maasi_filter.models.pose import Pose, compose
from maasi_filter.ros.clocks import JUMP, StampGate
from maasi_filter.ros.conversions import (
    FASTEST,
    MarkerBoard,
    bounded,
    point_to_ros,
    pose_from_ros,
    pose_to_ros,
    stamp_from_ros,
    stamp_of_step,
    stamp_to_ros,
)
from maasi_filter.ros.lifecycle_node import LockstepLifecycleNode, SettingsError
from maasi_filter.ros.qos import LATCHED, LIVELINESS_PERIOD, LIVELY, RELIABLE, sensor_reader
from maasi_msgs.msg import AgentState, CuboidDecision, SearchLink, SearchLinkArray
from maasi_planner.buildings.agent import Activity, Broadcast, SearchAgent, decision_stream
from maasi_planner.buildings.conversions import (
    agent_markers,
    broadcast_from_ros,
    broadcast_to_ros,
    decision_to_ros,
    mission_markers,
    vector_from_ros,
    vector_to_ros,
)
from maasi_planner.buildings.preplanning import plan_mission
from maasi_planner.buildings.settings import CuboidPlannerSettings
from maasi_planner.conversions import path_to_ros
from maasi_planner.node.search_action import offer_services
from maasi_planner.node.search_modes import Mode, SearchModes

_STAMP_TOLERANCE = 1_000_000  # largest difference of the stamps of odometry and step [ns]
# Longest wait until the last command has arrived [s].
_STOP_TIME = Duration(seconds=0.3)
_REASONS = {
    Activity.SEARCHING: '',
    Activity.RETURNING: 'battery failed: flies to its station',
    Activity.RECHARGING: 'recharges',
}
# What the robot does without a new plan, by `Plan.how`.
_FALLBACKS = {'shifted': 'following the rest of the previous plan', 'brake': 'braking'}


class CuboidPlannerNode(LockstepLifecycleNode[CuboidPlannerSettings]):
    """Plan for the robot of this namespace, with the messages of robots in range.

    At each step the node reads the robot's state, sends it, receives messages of others, decides,
    and commands the velocity of its plan. It does not wait for robots out of range. Equations of
    the parameters are those of cuboid search 2023 (docs/cuboid_mpc.md).

    Subscribes
    ----------
    `odom` (nav_msgs/Odometry); `link/rx` (maasi_msgs/SearchLinkArray): messages received at a step

    Publishes
    ---------
    `link/tx` (maasi_msgs/SearchLink): message sent; `cmd_vel` (geometry_msgs/TwistStamped): the
    velocity at the next step; `state` (maasi_msgs/AgentState); `decision`
    (maasi_msgs/CuboidDecision); `plan` (nav_msgs/Path); of the team: `markers`,
    `search_area` (visualization_msgs/MarkerArray)

    Services
    --------
    `search/start`, `pause`, `resume`, `stop` (std_srvs/Trigger); `search/home` is refused
    """

    def __init__(self, **options: Any) -> None:
        super().__init__('cuboid_planner', CuboidPlannerSettings, in_robot=True, **options)

    def prepare(self) -> None:
        """Plan the mission."""
        self.name = self.get_namespace().rpartition('/')[2]
        if not self.name:
            raise SettingsError("namespace: read '', allowed is the name of the robot")
        settings = self.settings
        try:
            self._search = settings.search()
            self._mission = plan_mission(self._search, settings.environment.array())
            self.agent = self._make_agent()
        except ValueError as error:
            raise SettingsError(f'parameter {error}') from error
        self.modes = SearchModes([self.name])
        self._gate = StampGate(max(JUMP, round(3e9 * settings.step)))  # odometry may skip steps
        self._reset_state()

    def _make_agent(self) -> SearchAgent:
        settings = self.settings
        return SearchAgent(self.name, self._search, self._mission, settings, settings.step)

    def _reset_state(self) -> None:
        self._state: tuple[int, Pose, np.ndarray] | None = None
        self._wanted_step = -1
        self._board = MarkerBoard()
        self._sent_step = -1
        # Whether the agent has observed that step, but not decided.
        self._observed = False
        self._decided_step = -1
        self._link: SearchLink | None = None
        self._received: SearchLinkArray | None = None
        self._command: TwistStamped | None = None
        self._sent_at = 0.0
        self._solve_time = 0.0
        # Number of published snapshots of the agent.
        self._published_shots = 0

    def set_up(self) -> None:
        """Compile the kernels, create publishers, subscriptions and services."""
        agent = self._make_agent()
        agent.observe(0, self.settings.start, np.zeros(3))
        agent.decide([], decision_stream(self.settings.seed, self.name, 0))
        lockstep = self.settings.lockstep
        self._command_publisher = self.create_publisher(
            TwistStamped, 'cmd_vel', RELIABLE if lockstep else 10
        )
        self._link_publisher = self.create_publisher(SearchLink, 'link/tx', RELIABLE)
        self.expect_subscribers(self._command_publisher)
        self.expect_subscribers(self._link_publisher)
        self._state_publisher = self.create_publisher(AgentState, 'state', LIVELY)
        self.create_wall_timer(LIVELINESS_PERIOD, self._state_publisher.assert_liveliness)
        self._decision_publisher = self.create_publisher(CuboidDecision, 'decision', RELIABLE)
        self._path_publisher = self.create_publisher(Path, 'plan', 10)
        self._markers_publisher = self.create_publisher(MarkerArray, self.team_topic('markers'), 10)
        self._area_publisher = self.create_publisher(
            MarkerArray, self.team_topic('search_area'), LATCHED
        )
        self._area_publisher.publish(
            mission_markers(self._mission, Header(frame_id=self.settings.frame))
        )
        self._odometry: Subscription = self.create_subscription(
            Odometry, 'odom', self._on_odometry, sensor_reader(lockstep)
        )
        self.create_subscription(SearchLinkArray, 'link/rx', self._on_link, RELIABLE)
        self.expect_publisher(self._odometry.topic_name)
        offer_services(self, [self.name], self._handle_command)
        if not lockstep:
            self.create_wall_timer(0.02, self._check_link)
        for cell, reason in self._mission.lost:
            self.get_logger().warning(
                f'the {cell.face} face of object {cell.target} is only partly searched: {reason}'
            )

    def start(self) -> None:
        """Start the search if `search_on_start`."""
        if self.settings.search_on_start:
            self.modes.command('start')

    def halt(self) -> None:
        """End the search: the robot stops."""
        self.modes.command('stop')
        self._stop_robot()
        # Messages that are not received yet end with the process.
        if self.configured:
            self._command_publisher.wait_for_all_acked(_STOP_TIME)

    def _stop_robot(self) -> None:
        self._observed = False
        if self.active and self._decided_step >= 0:
            self._command_publisher.publish(TwistStamped(header=self._header(self._decided_step)))

    @property
    def _searching(self) -> bool:
        return self.modes.of[self.name] is Mode.SEARCHING

    def _handle_command(self, word: str, _: list[str] | None) -> tuple[bool, str]:
        if not self.active:
            return False, 'the planner is not active'
        if word == 'home':
            return (
                False,
                f'{self.name}: read home, allowed in a search of buildings are pause, stop',
            )
        if not self.modes.command(word):
            return False, f'{self.name}: {self.modes.describe()}; {word} changes nothing'
        if not self._searching and not self.settings.lockstep:
            self._stop_robot()
        answer = f'{word}: {self.name}'
        self.get_logger().info(answer)
        return True, answer

    def reset(self) -> None:
        """Begin a new search."""
        if not self.settings.lockstep:
            self._stop_robot()
        self.agent = self._make_agent()
        self._reset_state()

    def status(self) -> dict[str, Any]:
        """Return the state of the search."""
        return {
            'search': self.modes.describe(),
            'activity': self.agent.activity.name.lower(),
            'visited': f'{int(self.agent.visited.sum())} of {len(self.agent.visited)}',
            'solves without a plan': self.agent.failed,
            'last decision [ms]': f'{1e3 * self._solve_time:.2f}',
        }

    def _on_odometry(self, message: Odometry) -> None:
        if not self.active:
            return
        try:
            self._read_odometry(message)
        except ValueError as error:
            self.drop('bad odometry', f'odom.{error}')
        else:
            self._try_step()

    def _read_odometry(self, message: Odometry) -> None:
        lockstep, duration = self.settings.lockstep, self.settings.step
        stamp = stamp_from_ros(message.header.stamp)
        read = f'header.stamp: read {stamp * 1e-9:.6f} s'
        step = round(stamp * 1e-9 / duration)
        if abs(stamp_of_step(step, duration) - stamp) > _STAMP_TOLERANCE:
            raise ValueError(f'{read}, allowed are multiples of step, {duration} s')
        try:
            reading = pose_from_ros(message.pose.pose)
        except ValueError as error:
            raise ValueError(f'pose.{error}') from None
        velocity = vector_from_ros(message.twist.twist.linear)
        bounded('twist', velocity, FASTEST)
        if not (lockstep or self._gate.accepts(stamp)):
            raise ValueError(
                f'{read}, far from the previous one; allowed once the next one follows it'
            )
        if step < self._decided_step:
            self.get_logger().warning(
                f'odom.header.stamp went back to step {step}: the search starts again'
            )
            self.reset()
        # Odometry is relative to the start.
        pose = compose(Pose.from_yaw(self.settings.start, self.settings.yaw), reading)
        self._state = (step, pose, pose.rotation() @ velocity)
        self._wanted_step = step

    def _on_link(self, message: SearchLinkArray) -> None:
        if not self.active:
            return
        if int(message.step) != self._wanted_step:
            self.drop(
                'stale link', f'link/rx.step: read {message.step}, allowed is {self._wanted_step}'
            )
            return
        self._received = message
        self._try_step()

    def _check_link(self) -> None:
        if not self.active or self._sent_step != self._wanted_step:
            return
        patience = self.settings.link_patience * self.settings.step
        if self._decided_step < self._sent_step and time.monotonic() - self._sent_at > patience:
            self.warn_throttled('link', f'step {self._sent_step}: no message on link/rx')
            self._decide([])

    def _header(self, step: int) -> Header:
        stamp = stamp_to_ros(stamp_of_step(step, self.settings.step))
        return Header(frame_id=self.settings.frame, stamp=stamp)

    def _try_step(self) -> None:
        step = self._wanted_step
        if self._state is None or self._state[0] != step or step < 0:
            return
        if self._sent_step != step:
            self._broadcast(step)
        elif self._decided_step == step and self.settings.lockstep:
            # Duplicate step, after a restart of another node: resend the outputs.
            if self._link is not None and self._command is not None:
                self._link_publisher.publish(self._link)
                self._command_publisher.publish(self._command)
            return
        if (
            self._decided_step != step
            and self._received is not None
            and self._received.step == step
        ):
            self._decide(self._decoded(self._received))

    def _broadcast(self, step: int) -> None:
        assert self._state is not None
        _, pose, velocity = self._state
        self._observed = self._searching
        broadcast = self.agent.observe(step, pose.position, velocity) if self._observed else None
        header = self._header(step)
        if broadcast is not None:
            self._link = broadcast_to_ros(broadcast, header)
        else:
            self._link = SearchLink(header=header, step=step, robot=self.name, silent=True)
            self._link.position = point_to_ros(pose.position)
            self._link.velocity = vector_to_ros(velocity)
        self._sent_step = step
        self._sent_at = time.monotonic()
        self._link_publisher.publish(self._link)

    def _decoded(self, message: SearchLinkArray) -> list[Broadcast]:
        heard = []
        for item in message.messages:
            if item.robot == self.name or int(item.step) != self._sent_step:
                self.drop('stale link', f'link/rx: from {item.robot} of step {item.step}')
                continue
            try:
                heard.append(broadcast_from_ros(item, len(self._mission.cells)))
            except ValueError as error:
                self.drop('bad link', f'link/rx: {item.robot}: {error}')
        return heard

    def _decide(self, heard: list[Broadcast]) -> None:
        step = self._sent_step
        header = self._header(step)
        velocity = np.zeros(3)
        if self._observed:
            agent = self.agent
            begun = time.perf_counter()
            plan = agent.decide(heard, decision_stream(self.settings.seed, self.name, step))
            self._solve_time = time.perf_counter() - begun
            velocity = plan.velocities[1]
            if plan.how in _FALLBACKS:
                text = f'step {step}: no new plan was found: {_FALLBACKS[plan.how]}'
                self.warn_throttled('how', text)
            shots = agent.snapshots[self._published_shots :]
            decision = decision_to_ros(agent, plan, shots, header)
            decision.heard = [message.robot for message in heard]
            decision.solve_time = self._solve_time
            self._decision_publisher.publish(decision)
            self._published_shots = len(agent.snapshots)
            self._path_publisher.publish(path_to_ros(plan.positions, header))
            markers = agent_markers(agent, plan, header, self.settings.team)
            self._markers_publisher.publish(self._board.replace(markers))
        self._decided_step = step
        self._publish_state(step, header)
        assert self._state is not None
        self._command = TwistStamped(header=self._header(step))
        self._command.header.frame_id = f'{self.name}/base_link'
        self._command.twist.linear = vector_to_ros(self._state[1].rotation().T @ velocity)
        self._command_publisher.publish(self._command)

    def _publish_state(self, step: int, header: Header) -> None:
        assert self._state is not None
        _, pose, velocity = self._state
        activity = self.agent.activity
        away = activity is not Activity.SEARCHING
        message = AgentState(
            header=header,
            step=step,
            robot=self.name,
            battery=-1.0,
            goal_status=AgentState.UNAVAILABLE if away else AgentState.MOVING,
            reason=_REASONS[activity],
        )
        if not self._observed:
            message.goal_status, message.reason = AgentState.IDLE, self.modes.describe()
        message.pose.pose = pose_to_ros(pose)
        message.twist.linear = vector_to_ros(velocity)
        self._state_publisher.publish(message)
