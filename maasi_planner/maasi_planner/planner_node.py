"""The planner node: waypoints and measurements of each robot."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Iterable
from functools import partial
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PointStamped
from nav_msgs.msg import OccupancyGrid, Path
from numpy.typing import NDArray
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header
from visualization_msgs.msg import MarkerArray

from maasi_filter.models.pose import Pose
from maasi_filter.records import Cluster
from maasi_filter.ros.conversions import (
    cluster_from_ros,
    particles_to_ros,
    point_to_ros,
    pose_from_ros,
    stamp_from_ros,
    stamp_of_step,
    stamp_to_ros,
)
from maasi_filter.ros.lifecycle_node import LockstepLifecycleNode, run
from maasi_filter.ros.marker_board import MarkerBoard
from maasi_filter.ros.qos import LATCHED, RELIABLE, UPDATES
from maasi_filter.ros.silence import Silence
from maasi_filter.ros.stamps import LAST_STAMP, StampGate, batch_id_limit
from maasi_msgs.action import GoToWaypoint, SearchTargets
from maasi_msgs.msg import (
    AgentState,
    BatchMember,
    DetectionArray,
    FilterUpdate,
    LockstepStep,
    MeasurementBatch,
    PlanDecision,
)
from maasi_planner import warm_up
from maasi_planner.conversions import (
    decision_to_ros,
    exploration_to_ros,
    path_to_ros,
    planner_markers,
    robot_state_from_ros,
)
from maasi_planner.coordinator import Coordinator, PresentRobot
from maasi_planner.filter_watch import FilterWatch
from maasi_planner.found_keeper import FoundKeeper
from maasi_planner.node_settings import PlannerNodeSettings
from maasi_planner.planners.base import check_clusters
from maasi_planner.search_control.search_action import Progress, SearchAction
from maasi_planner.search_control.search_modes import Mode, SearchModes
from maasi_planner.search_control.search_services import offer_services
from maasi_planner.search_control.team_goals import Course, HeardState, TeamGoals

FloatArray = NDArray[np.float64]

_LOOK_PERIOD = 0.1
# A longer gap between two checks means that the planner itself was suspended [s].
_LONGEST_LOOK = 1.0
# At shutdown: executor rounds for sending results.
_LAST_TASKS = 5
# Period of republishing a batch without an update [s].
_ANSWER_PATIENCE = 1.0
# Capacity of the buffer of measurement poses for late updates.
_POSES_KEPT = 1000


class PlannerNode(LockstepLifecycleNode[PlannerNodeSettings]):
    """Plans for the whole team (000, algorithms 1 and 2), or independently for one robot.

    In the namespace of its only robot it plans for that robot alone (002, section 4, independent
    planner), and exchanges destinations with the planners of the other robots. At each step they
    plan in the order of names, each with the destinations of the earlier ones.

    Subscribes
    ----------
    `<robot>/state` (maasi_msgs/AgentState), `<robot>/detections` (maasi_msgs/DetectionArray),
    `filter_update` (maasi_msgs/FilterUpdate);
    `<robot>/destination` (geometry_msgs/PointStamped) of robots that plan for themselves

    Publishes
    ---------
    `measurement_batch` (maasi_msgs/MeasurementBatch): M_k;
    `decisions` (maasi_msgs/PlanDecision): every candidate with its terms;
    `<robot>/plan` (nav_msgs/Path); `exploration` (latched; 2D: nav_msgs/OccupancyGrid, 3D:
    sensor_msgs/PointCloud2); `markers` (visualization_msgs/MarkerArray);
    `<robot>/destination` (geometry_msgs/PointStamped), each step, where others plan for themselves

    Actions
    -------
    `<robot>/go_to` (maasi_msgs/GoToWaypoint), client; `search` (maasi_msgs/SearchTargets), server

    Services
    --------
    `search/start`, `pause`, `resume`, `home`, `stop` (std_srvs/Trigger) for the team, and the same
    below `<robot>/search/` for one robot
    """

    def __init__(self, **options: Any) -> None:
        super().__init__('planner_node', PlannerNodeSettings, **options)

    def prepare(self) -> None:
        """Make the planner."""
        bounds = self.settings.environment.array()
        self._size = 0.02 * float((bounds[:, 1] - bounds[:, 0]).max())
        self._dimension = self.settings.environment.dimension
        self.modes = SearchModes(self.settings.robots)
        # Smallest difference of steps between states of a robot that counts as a jump.
        longest = max(1.0, 2.0 * self.settings.state_timeout)
        self._jump = round(longest / self.settings.step)
        self._begin_anew()

    def _begin_anew(self) -> None:
        self.coordinator = Coordinator(self.settings)
        self._heard: dict[str, HeardState] = {}
        self._gates: dict[str, StampGate] = {}
        self._away: set[str] = set(self.coordinator.names)
        self._poses: dict[tuple[str, int], Pose] = {}
        self._poses_order: deque[tuple[str, int]] = deque()
        # Measurements whose updates have been processed.
        self._used: set[tuple[str, int]] = set()
        self._used_order: deque[tuple[str, int]] = deque()
        self._updates: deque[tuple[FilterUpdate, list[Cluster], Silence]] = deque()
        self._taken_step = -1
        self._expected: LockstepStep | None = None
        # Robots that follow a goal of another client, with its number.
        self._lent: dict[str, int] = {}
        # Robots on their way to their start, with the number of that goal; 0: arrived.
        self._homing: dict[str, int] = {}
        self._waiting_batch = 0
        self._batch_message = MeasurementBatch()
        self._batch_at = time.monotonic()
        self._batch = 0
        self._batch_before = 0
        self._used_batch = 0
        self._found = 0
        self._expected_number = 0.0
        self._measurements = 0
        self._decisions = 0
        # Free running: why the robots are held; empty if they are not.
        self._held = ''
        self._filter_watch = FilterWatch(self.settings.filter_timeout)
        self._filter_names: set[str] = set()
        self._names_at = -math.inf
        self._looked_at = time.monotonic()
        self._views_at = -math.inf
        self._board = MarkerBoard()
        self._planning_time = 0.0
        others = self.settings.others
        # Destinations of robots with their own planner, by step: the last two received.
        self._destinations: dict[str, dict[int, FloatArray]] = {
            name: {-1: np.array(others[name].start)} for name in sorted(others)
        }
        self._others_silence: dict[str, Silence] = {}
        self._others_before: set[str] = set()

    # ---- life cycle --------------------------------------------------------------------------

    def set_up(self) -> None:
        """Compile and connect."""
        warm_up()
        names = self.coordinator.names
        # Before the publisher of batches: a filter with batches must discover the kept targets.
        self._keeper = FoundKeeper(self)
        self._batch_publisher = self.create_publisher(
            MeasurementBatch, 'measurement_batch', RELIABLE
        )
        self.expect_subscribers(self._batch_publisher, 1 + len(names))
        self._decision_publisher = self.create_publisher(PlanDecision, 'decisions', RELIABLE)
        self._markers_publisher = self.create_publisher(MarkerArray, 'markers', 10)
        kind = OccupancyGrid if self._dimension == 2 else PointCloud2
        self._exploration_publisher = self.create_publisher(kind, 'exploration', LATCHED)
        self._path_publishers = {}
        self._destination_publishers = {}
        for name in names:
            self._path_publishers[name] = self.create_publisher(
                Path, self.team_topic(f'{name}/plan'), 10
            )
            self.create_subscription(
                AgentState,
                self.team_topic(f'{name}/state'),
                partial(self._on_state, name),
                RELIABLE,
            )
            self.create_subscription(
                DetectionArray,
                self.team_topic(f'{name}/detections'),
                partial(self._on_detections, name),
                RELIABLE,
            )
            if self.settings.others:
                publisher = self.create_publisher(
                    PointStamped, self.team_topic(f'{name}/destination'), RELIABLE
                )
                self.expect_subscribers(publisher, len(self.settings.others))
                self._destination_publishers[name] = publisher
        for name in sorted(self.settings.others):
            topic = self.team_topic(f'{name}/destination')
            self.create_subscription(
                PointStamped, topic, partial(self._on_destination, name), RELIABLE
            )
            self.expect_publisher(topic)
        self.create_subscription(FilterUpdate, 'filter_update', self._on_update, UPDATES)
        if not self.settings.lockstep and self.settings.filter_timeout:
            self.create_subscription(DiagnosticArray, '/diagnostics', self._on_diagnostics, 10)
        self._goals = TeamGoals(
            self,
            {name: self.team_topic(f'{name}/go_to') for name in names},
            self.settings.lockstep,
            self._on_goal_answer,
        )
        for client in self._goals.clients.values():
            self.expect(client.server_is_ready)
        self._action = SearchAction(
            self,
            lambda: '' if self.active else 'the planner is not active',
            lambda: self._command('start', None),
            self._stand,
            self.drop,
        )
        offer_services(self, names, self.team_topic, self._command)
        self.create_wall_timer(_LOOK_PERIOD, self._look_around)

    def start(self) -> None:
        """Start the search, unless it has to wait for a command."""
        if self.settings.search_on_start:
            self.modes.command('start')

    def halt(self) -> None:
        """End the search: the robots stop."""
        self._action.stop('the planner stops')
        self._stand()

    def _stand(self) -> None:
        self.modes.command('stop')
        self._homing.clear()
        self._stop_robots(self.coordinator.names)

    def _stop_robots(self, names: Iterable[str]) -> None:
        """Cancel the goals of robots, and discard their plans."""
        for name in names:
            self._goals.cancel(name)
            self.coordinator.leave(name)

    def destroy_node(self) -> None:
        """Send the result of the search to its client, and shut down."""
        self.active = False
        if self.configured and self.executor is not None:
            for _ in range(_LAST_TASKS):
                self.executor.spin_once(timeout_sec=0.0)
        super().destroy_node()

    def reset(self) -> None:
        """Begin a new search."""
        for name in self.coordinator.names:
            self._goals.cancel(name)
        self._goals.waiting.clear()
        self._begin_anew()
        self._keeper.forget()

    def fault(self) -> str:
        """Return why the robots are held."""
        return f'robots are held: {self._held}' if self._held else ''

    def _command(self, word: str, names: list[str] | None) -> tuple[bool, str]:
        """Execute a command for robots (None: all); return acceptance and an answer as text."""
        if not self.active:
            return False, 'the planner is not active'
        asked = self.coordinator.names if names is None else names
        follow = self.modes.command(word, names)
        if not follow:
            modes = self.modes.describe(asked)
            return False, f'{", ".join(asked)}: {modes}; {word} changes nothing'
        if word == 'start' and self.coordinator.finished is not None:
            self.coordinator.begin_again()
        if word in ('pause', 'stop', 'home'):
            self._stop_robots(follow)
        for name in follow:
            self._homing.pop(name, None)
        if word == 'home':
            self._homing.update(dict.fromkeys(follow, -1))
        if not self.modes.under_way:
            self._action.stop('stopped by search/stop')
        answer = f'{word}: {", ".join(follow)}'
        for name in follow:
            if name in self._away:
                heard = self._heard.get(name)
                why = heard.reason if heard is not None else f'no {name}/state yet'
                answer += f'; {name} does not take part now: {why or "it is silent"}'
            if name in self._lent:
                goal = self._lent[name]
                answer += f'; {name} follows goal {goal} of another client, which goes on'
        self.get_logger().info(answer)
        return True, answer

    def status(self) -> dict[str, Any]:
        """Return the state of the search."""
        return {
            'search': self.modes.describe(),
            'finished': self.coordinator.finished or '',
            'goals of other clients': ', '.join(
                f'{name} (goal {goal})' for name, goal in sorted(self._lent.items())
            ),
            'robots': ', '.join(name for name in self.coordinator.names if name not in self._away),
            'decisions': self._decisions,
            'batches': self._batch,
            'explored': f'{self.coordinator.exploration.explored_fraction():.3f}',
            'last planning [ms]': f'{1e3 * self._planning_time:.2f}',
        }

    def warnings(self) -> list[str]:
        """Return the robots that follow goals of other clients."""
        return [
            f'{name} follows goal {goal} of another client'
            for name, goal in sorted(self._lent.items())
        ]

    # ---- input -------------------------------------------------------------------------------

    def on_step(self, message: LockstepStep) -> None:
        """Plan when all states of this step have arrived.

        A step is republished for a restarted node: resend the messages that it may have missed.
        """
        before = self._expected
        if before is None and message.step == self._taken_step:
            self._repeat_step()
            return
        if before is not None and message.step == before.step:
            message.imaging = sorted({*before.imaging, *message.imaging})
        self._expected = message
        self._try_step()

    def _ask_again(self) -> None:
        """Republish the pending batch; receivers ignore duplicates."""
        if self._waiting_batch:
            self._batch_at = time.monotonic()
            self._batch_publisher.publish(self._batch_message)

    def _repeat_step(self) -> None:
        self._ask_again()
        # If such a robot does answer later, it gets a new goal.
        for name, _ in sorted(self._goals.waiting):
            self._refuse(name)
        self._goals.waiting.clear()
        self._try_done()

    def _in_frame(self, reason: str, topic: str, header: Header) -> bool:
        """Return whether a message is in the frame `map`; drop it otherwise."""
        if header.frame_id == self.settings.frame:
            return True
        self.drop(
            reason,
            f'{topic}.header.frame_id: read {header.frame_id!r}, allowed is '
            f'{self.settings.frame!r}',
        )
        return False

    def _on_state(self, name: str, message: AgentState) -> None:
        if not self.active:
            return
        if message.robot != name:
            self.drop(
                'bad state', f'{name}/state.robot: read {message.robot!r}, allowed is {name!r}'
            )
            return
        if not self._in_frame('bad state', f'{name}/state', message.header):
            return
        try:
            state = robot_state_from_ros(message)
        except ValueError as error:
            self.drop('bad state', f'{name}/state.{error}')
            return
        if message.step * self.settings.step >= LAST_STAMP:
            self.drop(
                'bad state',
                f'{name}/state.step: read {message.step}, allowed are steps whose time is a stamp',
            )
            return
        gate = self._gates.setdefault(name, StampGate(self._jump))
        if not (self.settings.lockstep or gate.accepts(int(message.step))):
            self.drop(
                'bad state',
                f'{name}/state.step: read {message.step}, which is far from the one before; '
                'allowed if the next one follows it',
            )
            return
        before = self._heard.get(name)
        if before is not None and message.step < before.step:
            if not self.settings.lockstep and before.step - message.step > 1.0 / self.settings.step:
                self.get_logger().warning(
                    f'{name}/state.step went back from {before.step} to {message.step}: '
                    'starting anew'
                )
                self.reset()
            else:
                self.drop('old state', f'{name}/state.step: read {message.step}, had {before.step}')
                return
        self._heard[name] = HeardState(
            int(message.step),
            state,
            int(message.goal_id),
            int(message.goal_status),
            message.reason,
            Silence(self),
        )
        if self.settings.lockstep:
            self._try_step()
        else:
            self._join_or_leave(name, message.goal_status, message.reason)
            self._try_free_step()

    def _on_detections(self, name: str, message: DetectionArray) -> None:
        if not self.active:
            return
        if message.robot != name:
            self.drop(
                'bad detections',
                f'{name}/detections.robot: read {message.robot!r}, allowed is {name!r}',
            )
            return
        if not self._in_frame('bad detections', f'{name}/detections', message.header):
            return
        try:
            pose = pose_from_ros(message.pose.pose)
        except ValueError as error:
            self.drop('bad detections', f'{name}/detections.pose.{error}')
            return
        key = (name, int(message.measurement))
        if key not in self._poses:
            self._poses_order.append(key)
            if len(self._poses_order) > _POSES_KEPT:
                self._poses.pop(self._poses_order.popleft(), None)
        self._poses[key] = pose
        self._take_updates()

    def _on_destination(self, name: str, message: PointStamped) -> None:
        if not self.active:
            return
        point = np.array([message.point.x, message.point.y, message.point.z])
        frame = message.header.frame_id
        if frame != self.settings.frame or not np.isfinite(point).all():
            self.drop(
                'bad destination',
                f'{name}/destination: read {point.tolist()} in {frame!r}, allowed are finite '
                f'numbers in {self.settings.frame!r}',
            )
            return
        known = self._destinations[name]
        known[round(stamp_from_ros(message.header.stamp) * 1e-9 / self.settings.step)] = point
        while len(known) > 2:
            del known[min(known)]
        self._others_silence[name] = Silence(self)
        if self.settings.lockstep:
            self._try_step()

    def _unheard(self, step: int, robots: list[str]) -> bool:
        """Return whether destinations of other planners are missing.

        Needed are those of this step from planners earlier by name, and of the previous step from
        later ones.
        """
        own = self.coordinator.names[0]
        for name, known in self._destinations.items():
            if name not in robots:
                continue
            if name < own:
                if max(known) < step:
                    return True
            elif name in self._others_before and max(known) < step - 1:
                return True
        return False

    def _taken(self, step: int, robots: list[str] | None) -> list[tuple[FloatArray, float]]:
        """Return the known destinations of robots with their own planner, and their radii."""
        own = self.coordinator.names[0]
        taken = []
        for name, known in self._destinations.items():
            if robots is None:
                silence = self._others_silence.get(name)
                there = silence is None or silence.length <= self.settings.state_timeout
                last = max(known)
            else:
                there = name in robots
                last = max((k for k in known if k < step or name < own), default=max(known))
            if there:
                taken.append((known[last], self.settings.others[name].radius))
        return taken

    def _on_update(self, message: FilterUpdate) -> None:
        if not self.active:
            return
        if not self._in_frame('bad update', 'filter_update', message.header):
            return
        try:
            clusters = [cluster_from_ros(item, self._dimension) for item in message.clusters]
            strangers = {item.robot for item in message.members} - set(self.coordinator.names)
            if strangers:
                raise ValueError(
                    f'members: read {sorted(strangers)}, allowed are {self.coordinator.names}'
                )
            check_clusters(clusters)
            self._check_numbers(message)
        except ValueError as error:
            self.drop('bad update', f'filter_update.{error}')
            return
        if int(message.batch_id) > self._batch:
            self._batch = self._batch_before = int(message.batch_id)
        if int(message.batch_id) <= self._batch_before:
            # An update of an earlier planner process: continue after its indices.
            for member in message.members:
                self.coordinator.skip_measurements(member.robot, int(member.measurement) + 1)
            return
        self._filter_watch.answered(int(message.batch_id))
        self._updates.append((message, clusters, Silence(self)))
        self._take_updates()

    def _check_numbers(self, message: FilterUpdate) -> None:
        """Refuse ids and indices so large that the planner could not continue from them."""
        limit = batch_id_limit(self._batch)
        if message.batch_id > limit:
            raise ValueError(f'batch_id: read {message.batch_id}, allowed is up to {limit}')
        limit = batch_id_limit(0)
        for member in message.members:
            if member.measurement > limit:
                raise ValueError(
                    f'members: {member.robot}: measurement: read {member.measurement}, allowed is '
                    f'up to {limit}'
                )

    def _take_updates(self) -> None:
        """Process in order the updates whose detections have arrived as well."""
        while self._updates:
            update, clusters, silence = self._updates[0]
            keys = [(member.robot, int(member.measurement)) for member in update.members]
            if keys and all(key in self._used for key in keys):
                # Duplicate: a restarted filter republishes its last update.
                self._updates.popleft()
                continue
            unknown = [key for key in keys if key not in self._poses]
            if unknown:
                if self.settings.lockstep or silence.length < self.settings.state_timeout:
                    return
                # It must not block later updates.
                self._updates.popleft()
                self.drop(
                    'bad update',
                    f'filter_update.members: read {unknown}, allowed are measurements whose '
                    f'detections come as well: none for {silence.length:.1f} s',
                )
                continue
            self._updates.popleft()
            self.coordinator.absorb(
                {name: self._poses.pop((name, index)) for name, index in keys}, clusters
            )
            self._used.update(keys)
            self._used_order.extend(keys)
            while len(self._used_order) > _POSES_KEPT:
                self._used.discard(self._used_order.popleft())
            self._used_batch = max(self._used_batch, int(update.batch_id))
            self._found = int(update.found)
            self._expected_number = float(update.expected_number)
            self._measurements += len(keys)
            if int(update.batch_id) == self._waiting_batch:
                self._waiting_batch = 0
                self._try_done()

    # ---- availability of robots and filter ---------------------------------------------------

    def _join_or_leave(self, name: str, status: int, reason: str) -> None:
        if status == AgentState.UNAVAILABLE:
            self._leave(name, reason)
        elif name in self._away:
            self._away.discard(name)
            self.get_logger().info(f'{name} takes part')

    def _leave(self, name: str, reason: str) -> None:
        if name in self._away:
            return
        self._away.add(name)
        self._goals.cancel(name)
        self._lent.pop(name, None)
        if name in self._homing:
            self._homing[name] = -1
        self.coordinator.leave(name)
        self.get_logger().warning(f'{name} does not take part any more: {reason}')

    def _look_around(self) -> None:
        """Remove silent robots from planning; check filter and action."""
        if not self.active:
            return
        if not self.settings.lockstep:
            now = time.monotonic()
            for name in sorted(self._heard):
                silent = self._heard[name].silence.length
                if silent > self.settings.state_timeout:
                    self._leave(name, f'no {name}/state for {silent:.1f} s')
            self._take_updates()
            self._watch_filter(now)
            self._try_free_step()
        elif time.monotonic() - self._batch_at > _ANSWER_PATIENCE:
            self._ask_again()
        self._look_at_search()

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        if any(status.name in self._filter_names for status in message.status):
            self._filter_watch.beat(time.monotonic())

    def _watch_filter(self, now: float) -> None:
        """Hold the robots while the filter is silent."""
        since, self._looked_at = now - self._looked_at, now
        if since > _LONGEST_LOOK:
            self._filter_watch.stalled(since)
        if now - self._names_at >= 1.0:
            self._names_at = now
            self._filter_names |= {
                f'{info.node_namespace.rstrip("/")}/{info.node_name}'
                for info in self.get_publishers_info_by_topic('filter_update')
            }
        problem = self._filter_watch.problem(now)
        if problem and not self._held:
            self.get_logger().error(f'{problem}: all robots are held')
            self._hold()
        elif self._held and not problem:
            self.get_logger().warning('the filter answers again: the search goes on')
        self._held = problem
        if problem and now - self._batch_at > _ANSWER_PATIENCE:
            self._ask_again()

    def _hold(self) -> None:
        """Stop all robots where they are; later decisions give them new goals."""
        for name in self.coordinator.names:
            if name not in self._homing:
                self._goals.cancel(name)
                self.coordinator.refuse(name)

    # ---- a step ------------------------------------------------------------------------------

    def _try_step(self) -> None:
        """In lockstep: plan once the states of all participating robots have arrived."""
        expected = self._expected
        if expected is None:
            return
        step = int(expected.step)
        names = [name for name in expected.robots if name in self.coordinator.names]
        if any(name not in self._heard or self._heard[name].step != step for name in names):
            return
        if self._destinations and names and self._unheard(step, expected.robots):
            return
        self._expected = None
        for name in self.coordinator.names:
            if name not in names:
                self._leave(name, 'it left')
        for name in names:
            self._join_or_leave(name, self._heard[name].status, self._heard[name].reason)
        self._plan_step(
            step,
            stamp_from_ros(expected.stamp),
            set(expected.imaging),
            self._taken(step, expected.robots),
        )
        self._others_before = set(expected.robots)
        self._try_done()

    def _try_free_step(self) -> None:
        """Free running: plan once all participating robots have reached a new step."""
        present = [name for name in self.coordinator.names if name not in self._away]
        if not present:
            return
        step = min(self._heard[name].step for name in present)
        if step > self._taken_step:
            self._plan_step(
                step, stamp_of_step(step, self.settings.step), None, self._taken(step, None)
            )

    def _plan_step(
        self,
        step: int,
        stamp: int,
        imaging: set[str] | None,
        taken: list[tuple[FloatArray, float]],
    ) -> None:
        self._taken_step = step
        self.step = step
        robots = {}
        for name in self.coordinator.names:
            if name in self._away:
                continue
            heard = self._heard[name]
            free = self._is_free(name, heard, step)
            if free and name in self._homing:
                self._send_home(name, stamp)
            robots[name] = PresentRobot(heard.state, free and self.modes.of[name] is Mode.SEARCHING)
        header = Header(stamp=stamp_to_ros(stamp), frame_id=self.settings.frame)
        if not self.modes.searching or self._held:
            self._publish_destinations(header, robots)
            return
        begin = time.perf_counter()
        decision = self.coordinator.plan(step, robots, taken)
        if decision is not None:
            self._planning_time = time.perf_counter() - begin
        self._publish_destinations(header, robots)
        if decision is not None:
            self._announce(decision, header)
        members = self.coordinator.measuring(step, robots, imaging)
        if members:
            self._batch += 1
            self._waiting_batch = self._batch
            self._batch_message = MeasurementBatch(
                id=self._batch,
                step=step,
                stamp=header.stamp,
                members=[
                    BatchMember(
                        robot=item.robot, decision=item.decision, measurement=item.measurement
                    )
                    for item in members
                ],
            )
            self._batch_at = time.monotonic()
            self._filter_watch.asked(self._batch, self._batch_at)
            self._batch_publisher.publish(self._batch_message)
        self._publish_views(header, stamp * 1e-9, robots)

    def _publish_destinations(self, header: Header, robots: dict[str, PresentRobot]) -> None:
        for name, publisher in self._destination_publishers.items():
            if name in robots:
                point = point_to_ros(self.coordinator.destination(name, robots[name].state))
                publisher.publish(PointStamped(header=header, point=point))

    def _announce(self, decision: Any, header: Header) -> None:
        """Publish a decision and send the goals."""
        self._decisions += 1
        indices = {name: self.coordinator.decision_index(name) for name in decision.robots}
        self._decision_publisher.publish(
            decision_to_ros(
                decision,
                indices,
                self.settings.planner.name,
                self._used_batch,
                self.coordinator.exploration.explored_fraction(),
                header,
            )
        )
        if self.coordinator.finished is not None:
            self.get_logger().info(f'nothing is left to gain: {self.coordinator.finished}')
        for name in sorted(decision.robots):
            robot = decision.robots[name]
            if robot.stays:
                self.warn_throttled(f'{name} stays', f'{name} stays: {robot.reason}')
                continue
            self._send(name, indices[name] + 1, robot.waypoint, header)
            self._path_publishers[name].publish(path_to_ros(robot.positions, header))

    def _send(self, name: str, number: int, waypoint: FloatArray, header: Header) -> None:
        goal = GoToWaypoint.Goal(goal_id=number, step=self._taken_step)
        goal.waypoint.header = header
        goal.waypoint.pose.position = point_to_ros(waypoint)
        goal.waypoint.pose.orientation.w = 1.0
        self._goals.send(name, goal)

    def _is_free(self, name: str, heard: HeardState, step: int) -> bool:
        """Return whether a robot can take a goal: it has none, from any client."""
        coordinator = self.coordinator
        if not coordinator.is_idle(name):
            number = coordinator.decision_index(name) + 1
            course = self._goals.course(name, number, heard)
            if course is Course.UNDER_WAY:
                return False
            if course is Course.ENDED:
                self._goals.forget(name)
                return True
            self._goals.forget(name)
            if course is Course.LOST:
                self.get_logger().warning(f'{name} has not taken goal {number}, or lost it')
                self._refuse(name)
        number = self._homing.get(name, -1)
        if number > 0:
            course = self._goals.course(name, number, heard)
            if course is Course.REPLACED:
                self._homing[name] = -1
            elif course is not Course.UNDER_WAY:
                self._homing[name] = 0
        if number >= 0:
            return False
        if self._goals.driven(heard):
            if not self._goals.ends(name, heard):
                self._lend(name, heard, step)
            return False
        if self._lent.pop(name, None) is not None:
            self.get_logger().info(f'{name} takes goals of the planner again')
        return True

    def _lend(self, name: str, heard: HeardState, step: int) -> None:
        new = self._lent.get(name) != heard.goal
        self._lent[name] = heard.goal
        if self.modes.of[name] is Mode.SEARCHING and self.coordinator.destined(name):
            self.coordinator.lend(name, step)
        if not new:
            return
        self.get_logger().warning(
            f'{name} follows goal {heard.goal} of another client: it measures, and gets no goal '
            'of the planner until that one has ended'
        )

    def _send_home(self, name: str, stamp: int) -> None:
        number = self._homing[name] = self.coordinator.next_number(name)
        header = Header(stamp=stamp_to_ros(stamp), frame_id=self.settings.frame)
        self._send(name, number, np.array(self.settings.robots[name].start), header)

    def _on_goal_answer(self, name: str, number: int, accepted: bool) -> None:
        if not accepted:
            self._refuse(name)
            self.warn_throttled(f'{name} refused', f'{name} refused goal {number}')
        self._try_done()

    def _refuse(self, name: str) -> None:
        self._goals.forget(name)
        self.coordinator.refuse(name)

    def _try_done(self) -> None:
        if (
            self.settings.lockstep
            and self._expected is None
            and self._taken_step >= 0
            and not self._goals.waiting
            and not self._waiting_batch
        ):
            self.done(self._taken_step)

    # ---- the action --------------------------------------------------------------------------

    def _look_at_search(self) -> None:
        self._action.look(
            Progress(
                time=max(self._taken_step, 0) * self.settings.step,
                feedback=SearchTargets.Feedback(
                    found=self._found,
                    measurements=self._measurements,
                    decisions=self._decisions,
                    expected_number=self._expected_number,
                    explored=self.coordinator.exploration.explored_fraction(),
                ),
                finished=self.coordinator.finished or '',
                robots=not self._heard or len(self._away) < len(self.coordinator.names),
            )
        )

    # ---- visualization -----------------------------------------------------------------------

    def _publish_views(self, header: Header, now: float, robots: dict[str, PresentRobot]) -> None:
        rate = self.settings.views_rate
        if rate <= 0.0 or abs(now - self._views_at) < 1.0 / rate:
            return
        self._views_at = now
        exploration = self.coordinator.exploration
        if self._dimension == 2:
            self._exploration_publisher.publish(exploration_to_ros(exploration, header))
        else:
            self._exploration_publisher.publish(
                particles_to_ros(exploration.nodes(), np.ravel(exploration.values), header)
            )
        shown = {}
        for name, robot in robots.items():
            path = self.coordinator.path(name)
            place = np.asarray(robot.state.pose.position)
            shown[name] = (place, path[-1] if len(path) else place, path)
        markers = planner_markers(shown, header, self._size)
        self._markers_publisher.publish(self._board.replace(markers))


def main(arguments: list[str] | None = None) -> int:
    """Run the planner node."""
    return run(PlannerNode, arguments)


if __name__ == '__main__':
    raise SystemExit(main())
