"""Goals of the robots of a team, and detection of goals of other clients."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from enum import Enum
from functools import partial
from typing import Any

from action_msgs.msg import GoalStatus
from rclpy.action import ActionClient

from maasi_filter.ros.clocks import Silence
from maasi_filter.ros.lifecycle_node import LockstepLifecycleNode
from maasi_msgs.action import GoToWaypoint
from maasi_msgs.msg import AgentState
from maasi_planner.motion import RobotState

ENDED = (AgentState.IDLE, AgentState.REACHED, AgentState.CANCELED, AgentState.ABORTED)
REPLACED = 'replaced'  # reason in the result of a preempted goal, set by the driver
_DRIVER_STOPS = 'the driver stops'  # reason of a driver that shuts down
# Time after acceptance after which a state with another goal means a lost goal [s].
_PATIENCE = 1.0


@dataclass
class ReceivedState:
    """Last received state of a robot."""

    step: int
    state: RobotState
    goal: int
    status: int
    reason: str
    silence: Silence
    charge: float  # of the battery, 0 to 1; otherwise unknown
    received_at: float = field(default_factory=time.monotonic)


class GoalProgress(Enum):
    """Progress of a goal."""

    UNDER_WAY = 0
    ENDED = 1
    LOST = 2  #: the robot does not have it, or refused it
    REPLACED = 3  #: it was preempted by a goal of another client


@dataclass
class _Sent:
    number: int
    handle: Any = None
    accepted_at: float | None = None
    # From the result.
    status: int | None = None
    reason: str = ''
    ended_at: float = math.inf
    # The replaced goal, which the robot retains if it refuses this one.
    before: _Sent | None = None

    def cancel(self) -> None:
        if self.handle is not None and self.status is None:
            self.handle.cancel_goal_async()


class TeamGoals:
    """Clients of the action `go_to` of all robots; in lockstep only states of robots count."""

    def __init__(
        self,
        node: LockstepLifecycleNode[Any],
        names: Sequence[str],
        on_answer: Callable[[str, int, bool], None],
    ) -> None:
        self._warn = node.warn_throttled
        self._lockstep = node.settings.lockstep
        self._on_answer = on_answer
        self.clients = {}
        for name in names:
            topic = node.team_topic(f'{name}/go_to')
            self.clients[name] = node.permanent(
                topic, partial(ActionClient, node, GoToWaypoint, topic)
            )
            node.expect(self.clients[name].server_is_ready)
        self._sent: dict[str, _Sent] = {}
        # Numbers of the last cancelled goals, with wall time.
        self._cancelled: dict[str, tuple[set[int], float]] = {}
        #: Unanswered goals: robot and number.
        self.waiting: set[tuple[str, int]] = set()

    def send(self, name: str, goal: GoToWaypoint.Goal) -> None:
        """Send a goal to a robot, which replaces its present one."""
        sent = _Sent(int(goal.goal_id), before=self._sent.get(name))
        if sent.before is not None:
            sent.before.before = None
        self._sent[name] = sent
        self.waiting.add((name, sent.number))
        future = self.clients[name].send_goal_async(goal)
        future.add_done_callback(partial(self._answered, name, sent))

    def cancel(self, name: str) -> None:
        """Cancel the goal of a robot, also before it is answered: the robot stops."""
        sent = self._sent.pop(name, None)
        if sent is None:
            return
        goals = [sent] if sent.before is None else [sent, sent.before]
        self._cancelled[name] = ({goal.number for goal in goals}, time.monotonic())
        for goal in goals:
            goal.cancel()

    def forget(self, name: str) -> None:
        """Discard the goal of a robot without cancelling it."""
        self._sent.pop(name, None)

    def has(self, name: str) -> bool:
        """Return whether a robot has a goal of ours whose end was not observed yet."""
        return name in self._sent

    def course(self, name: str, number: int, received: ReceivedState) -> GoalProgress:
        """Return the progress of goal `number` of a robot, by its last received state."""
        sent = self._sent.get(name)
        if sent is None or sent.number != number:
            return GoalProgress.LOST
        same = received.goal == number
        if self._lockstep:
            if same:
                return GoalProgress.ENDED if received.status in ENDED else GoalProgress.UNDER_WAY
            return self._other(name, sent, received)
        if sent.accepted_at is None:
            return GoalProgress.UNDER_WAY
        if sent.status == GoalStatus.STATUS_ABORTED and sent.reason == REPLACED:
            # The last state before the result shows the preempted goal.
            return (
                GoalProgress.REPLACED
                if received.received_at > sent.ended_at
                else GoalProgress.UNDER_WAY
            )
        after = received.received_at > sent.accepted_at
        if same and after and received.status in ENDED:
            return GoalProgress.ENDED
        if sent.status == GoalStatus.STATUS_ABORTED and not same:
            # Apparently refused: it was never the goal of the robot.
            return self._other(name, sent, received, after)
        if sent.status is not None:
            if received.status == AgentState.MOVING:
                # A state from before the end, or with a goal of another client.
                return GoalProgress.UNDER_WAY if same or not after else GoalProgress.REPLACED
            return GoalProgress.ENDED
        if same or time.monotonic() - sent.accepted_at < _PATIENCE:
            return GoalProgress.UNDER_WAY
        return self._other(name, sent, received)

    def _other(
        self, name: str, sent: _Sent, received: ReceivedState, after: bool = True
    ) -> GoalProgress:
        """Return the progress of a goal that a robot does not have, by a state after its answer."""
        if received.status != AgentState.MOVING:
            return GoalProgress.LOST
        before = sent.before
        if before is not None and received.goal == before.number:
            # The robot refused this goal, and continues to the one before.
            self._cancelled[name] = ({before.number}, time.monotonic())
            before.cancel()
            return GoalProgress.LOST
        return GoalProgress.REPLACED if after else GoalProgress.LOST

    @staticmethod
    def driven(received: ReceivedState) -> bool:
        """Return whether a robot without a goal of the planner follows one of another client."""
        return received.status == AgentState.MOVING or received.reason == REPLACED

    def ends(self, name: str, received: ReceivedState) -> bool:
        """Return whether a robot still moves to a goal that was just cancelled."""
        numbers, at = self._cancelled.get(name, (set(), -math.inf))
        return received.goal in numbers and time.monotonic() - at < _PATIENCE

    def _answered(self, name: str, sent: _Sent, future: Any) -> None:
        self.waiting.discard((name, sent.number))
        handle = future.result()
        accepted = handle is not None and bool(handle.accepted)
        if accepted:
            sent.accepted_at = time.monotonic()
            if self._sent.get(name) is sent:
                sent.handle = handle
                handle.get_result_async().add_done_callback(partial(self._ended, name, sent))
            else:
                handle.cancel_goal_async()  # cancelled before it was answered
        self._on_answer(name, sent.number, accepted)

    def _ended(self, name: str, sent: _Sent, future: Any) -> None:
        answer = future.result()
        if answer is None:
            return
        sent.status, sent.reason = int(answer.status), str(answer.result.reason)
        sent.ended_at = time.monotonic()
        aborted = sent.status == GoalStatus.STATUS_ABORTED and self._sent.get(name) is sent
        # The states of a driver that shuts down report it.
        if aborted and sent.reason != _DRIVER_STOPS:
            text = f'{name}: goal {sent.number} was aborted: {sent.reason}'
            self._warn(f'{name}: {sent.reason}', text)
