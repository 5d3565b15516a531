"""The action and the services that start, pause and end a search."""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, TypeAlias

from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.task import Future

from maasi_filter.ros.lifecycle_node import LockstepLifecycleNode
from maasi_filter.wording import counted
from maasi_msgs.action import SearchTargets
from maasi_planner.node.search_modes import COMMANDS

Result: TypeAlias = SearchTargets.Result


class SearchAction:
    """Server of `search`, which starts a search or takes over a running one from its last goal."""

    def __init__(
        self,
        node: LockstepLifecycleNode[Any],
        on_begin: Callable[[], object],
        on_end: Callable[[], None],
    ) -> None:
        self._node, self._on_begin, self._on_end = node, on_begin, on_end
        self._goal: Any = None
        self._outcome: Future | None = None
        self._feedback = SearchTargets.Feedback()
        self._began: float | None = None
        server = node.permanent(
            'search',
            lambda: ActionServer(
                node,
                SearchTargets,
                'search',
                execute_callback=lambda _: Result(),
                cancel_callback=lambda _: CancelResponse.ACCEPT,
            ),
        )
        server.register_goal_callback(self._check_goal)
        server.register_handle_accepted_callback(self._accept)

    def update(
        self, time: float, feedback: SearchTargets.Feedback, finished: str, robots: bool
    ) -> None:
        """Publish feedback, and conclude the goal if the search has ended."""
        goal = self._goal
        if goal is None:
            return
        if self._began is None:
            self._began = time
        request, self._feedback = goal.request, feedback
        if goal.is_cancel_requested:
            end = Result.CANCELED, 'cancelled'
        elif request.targets and feedback.found >= request.targets:
            end = Result.TARGETS_FOUND, f'{counted(feedback.found, "target")} found'
        elif finished:
            end = Result.DONE, finished
        elif 0.0 < request.time_limit <= time - self._began:
            end = Result.TIME_LIMIT, f'the time limit of {request.time_limit:g} s is reached'
        elif not robots:
            end = Result.NO_ROBOT, 'no robot is available'
        else:
            goal.publish_feedback(feedback)
            return
        self._conclude(*end)
        self._on_end()

    def stop(self, reason: str) -> None:
        """Conclude the goal because the robots are stopped."""
        if self._goal is not None:
            self._conclude(Result.CANCELED, reason)

    def _check_goal(self, goal: SearchTargets.Goal) -> GoalResponse:
        problem = '' if self._node.active else 'the planner is not active'
        if not (math.isfinite(goal.time_limit) and goal.time_limit >= 0.0):
            problem = f'time_limit: read {goal.time_limit}, allowed are finite numbers from 0 [s]'
        if problem:
            self._node.drop('bad goal', f'search: {problem}')
            return GoalResponse.REJECT
        return GoalResponse.ACCEPT

    def _accept(self, handle: Any) -> None:
        if self._goal is not None:
            self._conclude(Result.CANCELED, 'replaced by another goal')
        self._goal, self._outcome, self._began = handle, Future(), None
        self._on_begin()
        # The goal is EXECUTING until it is concluded.
        handle.execute(partial(_conclusion, self._outcome))

    def _conclude(self, reason: int, text: str) -> None:
        self._goal, outcome = None, self._outcome
        self._node.get_logger().info(f'search ended: {text}')
        assert outcome is not None
        outcome.set_result(
            Result(
                end_reason=reason,
                message=text,
                found=self._feedback.found,
                measurements=self._feedback.measurements,
            )
        )


async def _conclusion(outcome: Future, handle: Any) -> Result:
    result: Result = await outcome
    if handle.is_cancel_requested:
        handle.canceled()
    elif result.end_reason in (Result.CANCELED, Result.NO_ROBOT):
        handle.abort()
    else:
        handle.succeed()
    return result


# Takes a command and robots (None: all); returns whether it was accepted, and a text.
Commander = Callable[[str, 'list[str] | None'], 'tuple[bool, str]']


def offer_services(
    node: LockstepLifecycleNode[Any], names: Sequence[str], commander: Commander
) -> None:
    """Offer `search/<command>` for the team and `<robot>/search/<command>` for each robot."""
    services: dict[str, list[str] | None] = {}
    for word in COMMANDS:
        for name in names:
            services[node.team_topic(f'{name}/search/{word}')] = [name]
        # In the namespace of its only robot, the team is that robot.
        services.setdefault(node.resolve_service_name(f'search/{word}'), None)
    for service, robots in services.items():
        word = service.rpartition('/')[2]

        def serve(_: Any, word: str = word, robots: list[str] | None = robots) -> tuple[bool, str]:
            return commander(word, robots)

        node.offer_service(service, serve)
