"""The planner node: where each robot goes, and when it measures."""

from __future__ import annotations

import math
import time
from collections import deque
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from geometry_msgs.msg import PointStamped
from nav_msgs.msg import OccupancyGrid, Path
from numpy.typing import NDArray
from rclpy.action import ActionClient, ActionServer, CancelResponse, GoalResponse
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header
from visualization_msgs.msg import MarkerArray

from maasi_filter.clusters import Cluster
from maasi_filter.conversions import (
    cluster_from_ros,
    particles_to_ros,
    point_to_ros,
    pose_from_ros,
    stamp_from_ros,
    stamp_of_step,
    stamp_to_ros,
)
from maasi_filter.pose import Pose
from maasi_filter.qos import RELIABLE, UPDATES
from maasi_filter.search_node import SearchNode, run
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
from maasi_planner.motion import RobotState
from maasi_planner.node_settings import PlannerNodeSettings
from maasi_planner.planners.base import check_clusters

FloatArray = NDArray[np.float64]

_ENDED = (AgentState.IDLE, AgentState.REACHED, AgentState.CANCELED, AgentState.ABORTED)
_LOOK_PERIOD = 0.1
# In lockstep: longest wait for an update until its batch is published once more [s].
_ANSWER_PATIENCE = 1.0
# Poses of measurements that are kept for updates that come late.
_POSES_KEPT = 1000


@dataclass
class HeardState:
    """The last state heard of a robot."""

    step: int
    state: RobotState
    goal: int
    status: int
    reason: str
    heard_at: float


class PlannerNode(SearchNode[PlannerNodeSettings]):
    """Plans for the whole team (000, algorithms 1 and 2), or for one robot of several by itself.

    In the namespace of its only robot it is that robot's own (002, section 4, independent
    planner): beside others of the kind that tell each other where their robots go. Who comes
    later by name knows where those before go at the same step.

    Subscribes
    ----------
    `<robot>/state` (maasi_msgs/AgentState), `<robot>/detections` (maasi_msgs/DetectionArray),
    `filter_update` (maasi_msgs/FilterUpdate);
    `<robot>/destination` (geometry_msgs/PointStamped) of robots that plan for themselves

    Publishes
    ---------
    `measurement_batch` (maasi_msgs/MeasurementBatch): M_k;
    `decisions` (maasi_msgs/PlanDecision): every candidate with its terms;
    `<robot>/plan` (nav_msgs/Path); `exploration` (2D: nav_msgs/OccupancyGrid, 3D:
    sensor_msgs/PointCloud2); `markers` (visualization_msgs/MarkerArray);
    `<robot>/destination` (geometry_msgs/PointStamped), each step, where others plan for themselves

    Actions
    -------
    `<robot>/go_to` (maasi_msgs/GoToWaypoint), client; `search` (maasi_msgs/SearchTargets), server
    """

    def __init__(self, **options: Any) -> None:
        super().__init__('planner_node', PlannerNodeSettings, **options)
        bounds = self.settings.environment.array()
        self._size = 0.02 * float((bounds[:, 1] - bounds[:, 0]).max())
        self._dimension = self.settings.environment.dimension
        self.searching = False
        self._search_goal: Any = None
        self._begin_anew()

    def _begin_anew(self) -> None:
        self.coordinator = Coordinator(self.settings)
        self._heard: dict[str, HeardState] = {}
        self._away: set[str] = set(self.coordinator.names)
        self._poses: dict[tuple[str, int], Pose] = {}
        self._poses_order: deque[tuple[str, int]] = deque()
        self._updates: deque[tuple[FilterUpdate, list[Cluster]]] = deque()
        self._taken_step = -1
        self._expected: LockstepStep | None = None
        self._waiting_goals: set[tuple[str, int]] = set()
        self._goal_handles: dict[str, Any] = {}
        self._refused: dict[str, int] = {}
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
        self._views_at = -math.inf
        self._planning_time = 0.0
        others = self.settings.others
        # Where they will stand, by step: the last two that were heard of.
        self._destinations: dict[str, dict[int, FloatArray]] = {
            name: {-1: np.array(others[name].start)} for name in sorted(others)
        }
        self._others_at: dict[str, float] = {}
        self._others_before: set[str] = set()

    # ---- life cycle --------------------------------------------------------------------------

    def set_up(self) -> None:
        """Compile and connect."""
        warm_up()
        names = self.coordinator.names
        self._batch_publisher = self.create_publisher(
            MeasurementBatch, 'measurement_batch', RELIABLE
        )
        self.expect_subscribers(self._batch_publisher, 1 + len(names))
        self._decision_publisher = self.create_publisher(PlanDecision, 'decisions', RELIABLE)
        self._markers_publisher = self.create_publisher(MarkerArray, 'markers', 10)
        kind = OccupancyGrid if self._dimension == 2 else PointCloud2
        self._exploration_publisher = self.create_publisher(kind, 'exploration', 2)
        self._path_publishers = {}
        self._destination_publishers = {}
        self._go_to: dict[str, ActionClient] = {}
        for name in names:
            self._path_publishers[name] = self.create_publisher(
                Path, self.team_topic(f'{name}/plan'), 10
            )
            client = ActionClient(self, GoToWaypoint, self.team_topic(f'{name}/go_to'))
            self._go_to[name] = client
            self.expect(client.server_is_ready)
            self.hurry(
                self.create_subscription(
                    AgentState,
                    self.team_topic(f'{name}/state'),
                    partial(self._on_state, name),
                    RELIABLE,
                )
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
            self.hurry(
                self.create_subscription(
                    PointStamped, topic, partial(self._on_destination, name), RELIABLE
                )
            )
            self.expect_publisher(topic)
        self.hurry(
            self.create_subscription(FilterUpdate, 'filter_update', self._on_update, UPDATES)
        )
        self._search_server = ActionServer(
            self,
            SearchTargets,
            'search',
            execute_callback=self._finish_search,
            goal_callback=self._on_search_goal,
            handle_accepted_callback=self._on_search_accepted,
            cancel_callback=self._on_search_cancel,
        )
        self.create_wall_timer(_LOOK_PERIOD, self._look_around)

    def start(self) -> None:
        """Begin to search, unless it waits for the action."""
        self.searching = self.settings.search_on_start

    def halt(self) -> None:
        """Cancel all goals: the robots stop."""
        self.searching = False
        for name in sorted(self._goal_handles):
            self._goal_handles[name].cancel_goal_async()
        self._goal_handles.clear()

    def reset(self) -> None:
        """Begin a new search."""
        for name in sorted(self._goal_handles):
            self._goal_handles[name].cancel_goal_async()
        self._begin_anew()

    def status(self) -> dict[str, Any]:
        """Return the state of the search."""
        return {
            'searching': self.searching,
            'robots': ', '.join(name for name in self.coordinator.names if name not in self._away),
            'decisions': self._decisions,
            'batches': self._batch,
            'explored': f'{self.coordinator.exploration.explored_fraction():.3f}',
            'last planning [ms]': f'{1e3 * self._planning_time:.2f}',
        }

    # ---- what comes in -----------------------------------------------------------------------

    def on_step(self, message: LockstepStep) -> None:
        """Plan when the states of this step are all there.

        A step comes again when a node was started anew: what it may have missed is said again.
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
        """Publish the batch that is waited for once more; who has it already does nothing."""
        if self._waiting_batch:
            self._batch_at = time.monotonic()
            self._batch_publisher.publish(self._batch_message)

    def _repeat_step(self) -> None:
        self._ask_again()
        # Whoever is asked and answers after all is sent elsewhere.
        for key in sorted(self._waiting_goals):
            self._refuse(*key)
        self._waiting_goals.clear()
        self._try_done()

    def _in_frame(self, reason: str, topic: str, header: Header) -> bool:
        """Return whether a message is in the frame of the map; drop it otherwise."""
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
            time.monotonic(),
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
        self._others_at[name] = time.monotonic()
        if self.settings.lockstep:
            self._try_step()

    def _unheard(self, step: int, robots: list[str]) -> bool:
        """Return whether another planner has still to say where its robot goes.

        One with a name before says so for this step first, one after for the step before.
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
        """Return where robots that plan for themselves will stand, as far as it is known."""
        own = self.coordinator.names[0]
        now = time.monotonic()
        taken = []
        for name, known in self._destinations.items():
            if robots is None:
                heard = self._others_at.get(name)
                there = heard is None or now - heard <= self.settings.state_timeout
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
        except ValueError as error:
            self.drop('bad update', f'filter_update.{error}')
            return
        if int(message.batch_id) > self._batch:
            self._batch = self._batch_before = int(message.batch_id)
        if int(message.batch_id) <= self._batch_before:
            # Of a planner before this one: go on after its batches.
            for member in message.members:
                self.coordinator.skip_measurements(member.robot, int(member.measurement) + 1)
            return
        self._updates.append((message, clusters))
        self._take_updates()

    def _take_updates(self) -> None:
        """Take in the updates whose measurements have been heard as well, in their order."""
        while self._updates:
            update, clusters = self._updates[0]
            keys = [(member.robot, int(member.measurement)) for member in update.members]
            if not all(key in self._poses for key in keys):
                return
            self._updates.popleft()
            self.coordinator.absorb(
                {name: self._poses.pop((name, index)) for name, index in keys}, clusters
            )
            self._used_batch = max(self._used_batch, int(update.batch_id))
            self._found = int(update.found)
            self._expected_number = float(update.expected_number)
            self._measurements += len(keys)
            if int(update.batch_id) == self._waiting_batch:
                self._waiting_batch = 0
                self._try_done()

    # ---- who is there ------------------------------------------------------------------------

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
        self._goal_handles.pop(name, None)
        self._refused.pop(name, None)
        self.coordinator.leave(name)
        self.get_logger().warning(f'{name} does not take part any more: {reason}')

    def _look_around(self) -> None:
        """Plan without robots that have fallen silent; look after the action."""
        if not self.active:
            return
        if not self.settings.lockstep:
            now = time.monotonic()
            for name in sorted(self._heard):
                silent = now - self._heard[name].heard_at
                if silent > self.settings.state_timeout:
                    self._leave(name, f'no {name}/state for {silent:.1f} s')
            self._try_free_step()
        elif time.monotonic() - self._batch_at > _ANSWER_PATIENCE:
            self._ask_again()
        self._look_at_search()

    # ---- a step ------------------------------------------------------------------------------

    def _try_step(self) -> None:
        """In lockstep: plan once the states of all robots that take part are there."""
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
        """Free running: plan once all robots that take part have come to a new step."""
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
            goal = self.coordinator.decision_index(name) + 1
            free = self.coordinator.is_idle(name) or self._refused.get(name) == goal
            if self.settings.lockstep and not free and heard.goal < goal:
                self.get_logger().warning(f'{name} knows nothing of goal {goal} any more')
                self._refuse(name, goal)
                free = True
            free = free or (heard.goal == goal and heard.status in _ENDED)
            robots[name] = PresentRobot(heard.state, free)
        header = Header(stamp=stamp_to_ros(stamp), frame_id=self.settings.frame)
        if not self.searching:
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
            self._batch_publisher.publish(self._batch_message)
        self._publish_views(header, stamp * 1e-9, robots)

    def _publish_destinations(self, header: Header, robots: dict[str, PresentRobot]) -> None:
        for name, publisher in self._destination_publishers.items():
            if name in robots:
                point = point_to_ros(self.coordinator.destination(name, robots[name].state))
                publisher.publish(PointStamped(header=header, point=point))

    def _announce(self, decision: Any, header: Header) -> None:
        """Publish a decision and send the robots on their way."""
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
            goal = GoToWaypoint.Goal(goal_id=indices[name] + 1, step=decision.step)
            goal.waypoint.header = header
            goal.waypoint.pose.position = point_to_ros(robot.waypoint)
            goal.waypoint.pose.orientation.w = 1.0
            key = (name, indices[name] + 1)
            self._waiting_goals.add(key)
            future = self._go_to[name].send_goal_async(goal)
            future.add_done_callback(partial(self._on_goal_answer, key))
            self._path_publishers[name].publish(path_to_ros(robot.positions, header))

    def _on_goal_answer(self, key: tuple[str, int], future: Any) -> None:
        name, number = key
        self._waiting_goals.discard(key)
        handle = future.result()
        if handle is None or not handle.accepted:
            self._refuse(name, number)
            self.warn_throttled(f'{name} refused', f'{name} refused goal {number}')
        elif self.searching:
            self._goal_handles[name] = handle
        else:
            handle.cancel_goal_async()
        self._try_done()

    def _refuse(self, name: str, number: int) -> None:
        self._refused[name] = number
        self.coordinator.refuse(name)

    def _try_done(self) -> None:
        if (
            self.settings.lockstep
            and self._expected is None
            and self._taken_step >= 0
            and not self._waiting_goals
            and not self._waiting_batch
        ):
            self.done(self._taken_step)

    # ---- the action --------------------------------------------------------------------------

    def _on_search_goal(self, goal: SearchTargets.Goal) -> GoalResponse:
        if not (math.isfinite(goal.time_limit) and goal.time_limit >= 0.0):
            self.drop(
                'bad goal',
                f'search.time_limit: read {goal.time_limit}, allowed are finite numbers from 0 [s]',
            )
            return GoalResponse.REJECT
        if self._search_goal is not None or not self.active:
            self.get_logger().warning('search: refused, one is under way or the node is not active')
            return GoalResponse.REJECT
        return GoalResponse.ACCEPT

    def _on_search_accepted(self, handle: Any) -> None:
        self._search_goal = handle
        self._search_began = self._taken_step
        self.searching = True

    def _on_search_cancel(self, handle: Any) -> CancelResponse:
        return CancelResponse.ACCEPT

    def _look_at_search(self) -> None:
        """Give feedback on the action, and end it when it is time."""
        handle = self._search_goal
        if handle is None:
            return
        request = handle.request
        gone = (self._taken_step - max(self._search_began, 0)) * self.settings.step
        result = SearchTargets.Result
        if handle.is_cancel_requested:
            self._end_search(result.CANCELED, 'cancelled')
        elif self.coordinator.finished is not None:
            self._end_search(result.DONE, self.coordinator.finished)
        elif request.targets and self._found >= request.targets:
            self._end_search(result.TARGETS_FOUND, f'{self._found} targets are found')
        elif request.time_limit > 0.0 and gone >= request.time_limit:
            self._end_search(result.TIME_LIMIT, f'{request.time_limit:g} s are over')
        elif self._heard and len(self._away) == len(self.coordinator.names):
            self._end_search(result.NO_ROBOT, 'no robot can go on')
        else:
            handle.publish_feedback(
                SearchTargets.Feedback(
                    found=self._found,
                    measurements=self._measurements,
                    decisions=self._decisions,
                    expected_number=self._expected_number,
                    explored=self.coordinator.exploration.explored_fraction(),
                )
            )

    def _end_search(self, reason: int, text: str) -> None:
        self.halt()
        self._search_outcome = (reason, text)
        handle, self._search_goal = self._search_goal, None
        handle.execute()

    def _finish_search(self, handle: Any) -> SearchTargets.Result:
        reason, text = self._search_outcome
        if reason == SearchTargets.Result.CANCELED:
            handle.canceled()
        elif reason == SearchTargets.Result.NO_ROBOT:
            handle.abort()
        else:
            handle.succeed()
        self.get_logger().info(f'search ended: {text}')
        return SearchTargets.Result(
            end_reason=reason, message=text, found=self._found, measurements=self._measurements
        )

    # ---- views -------------------------------------------------------------------------------

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
        self._markers_publisher.publish(planner_markers(shown, header, self._size))


def main(arguments: list[str] | None = None) -> int:
    """Run the planner node."""
    return run(PlannerNode, arguments)


if __name__ == '__main__':
    raise SystemExit(main())
