"""Goals of the robots: decisions, paths home, and goals of other clients."""

from collections.abc import Callable, Iterable, Sequence

import numpy as np
from std_msgs.msg import Header

from maasi_filter.arrays import FloatArray
from maasi_filter.ros.conversions import point_to_ros
from maasi_filter.ros.lifecycle_node import LockstepLifecycleNode
from maasi_msgs.action import GoToWaypoint
from maasi_msgs.msg import AgentState
from maasi_planner.coordinator import Coordinator
from maasi_planner.motion import RobotState
from maasi_planner.node.search_modes import Mode, SearchModes
from maasi_planner.node.team_goals import GoalProgress, ReceivedState, TeamGoals
from maasi_planner.node_settings import PlannerNodeSettings


class Orders:
    """Sends goals, and detects which robots accept one."""

    def __init__(
        self,
        node: LockstepLifecycleNode[PlannerNodeSettings],
        coordinator: Coordinator,
        modes: SearchModes,
    ) -> None:
        self._node, self._modes = node, modes
        self.reset(coordinator)

    def reset(self, coordinator: Coordinator) -> None:
        """Reset for a new search."""
        self._coordinator = coordinator
        #: Goal numbers of other clients by robot.
        self.external_goals: dict[str, int] = {}
        # Goal numbers of robots on their path home; 0: arrived, -1: to be sent there as soon
        # as they are free.
        self._homing: dict[str, int] = {}
        # Simulated time from which each goal was refused, and the duration [s].
        self._refused_since: float | None = None
        self.refused_for = 0.0

    def set_up(self, names: Sequence[str], answered: Callable[[], None]) -> TeamGoals:
        """Create the action clients; `answered` is called after each answer to a goal."""
        self._answered = answered
        self.goals = TeamGoals(self._node, names, self._on_answer)
        return self.goals

    def stop(self, names: Iterable[str]) -> None:
        """Cancel the goals of robots, and discard their plans."""
        for name in names:
            self.goals.cancel(name)
            self._coordinator.robots[name].clear_plan()

    def hold(self, names: Iterable[str]) -> None:
        """Stop robots, except on their path home; they receive new goals afterwards."""
        for name in names:
            plan = self._coordinator.robots[name].plan
            if name not in self._homing and (plan.errand is None or plan.staying):
                self.goals.cancel(name)
                plan.staying = True

    def set_homing(self, names: Iterable[str], home: bool) -> None:
        """Send robots to their starts as soon as they are free, or cancel that."""
        for name in names:
            self._homing.pop(name, None)
            if home:
                self._homing[name] = -1
                self._coordinator.homing.release(name)

    def interrupt_homing(self, name: str) -> None:
        """Note that a robot goes elsewhere before its start."""
        if name in self._homing:
            self._homing[name] = -1

    def drop_robot(self, name: str) -> None:
        """Forget the goals of an unavailable robot."""
        self.goals.cancel(name)
        self.external_goals.pop(name, None)
        if name in self._homing:
            self._homing[name] = -1
        self._coordinator.robots[name].clear_plan()

    def send(self, name: str, number: int, waypoint: FloatArray, header: Header) -> None:
        """Send a goal, whose z is above ground, to a robot."""
        waypoint = self._coordinator.area.above_ground(waypoint)
        goal = GoToWaypoint.Goal(goal_id=number, step=self._node.step)
        goal.waypoint.header = header
        goal.waypoint.pose.position = point_to_ros(waypoint)
        goal.waypoint.pose.orientation.w = 1.0
        self.goals.send(name, goal)

    def send_home(self, name: str, state: RobotState, header: Header) -> bool:
        """Send a free robot to its start, if it has to go there and its battery suffices now."""
        plan, homing = self._coordinator.robots[name].plan, self._coordinator.homing
        if name not in self._homing or homing.occupies(name):
            return False
        start, step = np.array(self._node.settings.robots[name].start), self._node.settings.step
        if not homing.may_go(name, state, start, step):
            self._node.warn_throttled(
                f'{name} cannot go home',
                f'{name}: its charge is too low for the path to its start',
            )
            return False
        plan.decision += 1
        number = self._homing[name] = plan.goal_id
        self.send(name, number, start, header)
        return True

    def describe_external(self) -> str:
        """Return robots with their goals of other clients as text."""
        return ', '.join(
            f'{name} (goal {goal})' for name, goal in sorted(self.external_goals.items())
        )

    def warnings(self, names: Iterable[str] | None = None) -> list[str]:
        """Return warnings about robots (default: all) with goals of other clients."""
        goals = self.external_goals
        return [
            f'{name} follows goal {goals[name]} of another client'
            for name in (sorted(goals) if names is None else names)
            if name in goals
        ]

    def _on_answer(self, name: str, number: int, accepted: bool) -> None:
        if not accepted:
            self.refuse(name)
            self._node.warn_throttled(f'{name} refused', f'{name} refused goal {number}')
        self._answered()

    def refuse(self, name: str) -> None:
        """Note that a robot did not accept its goal, and needs another one."""
        now = self._node.step * self._node.settings.step
        if self._refused_since is None:
            self._refused_since = now
        self.refused_for = now - self._refused_since
        self.goals.forget(name)
        self._coordinator.robots[name].plan.staying = True

    def is_free(self, name: str, received: ReceivedState, step: int) -> bool:
        """Return whether a robot has no goal from any client."""
        plan, logger = self._coordinator.robots[name].plan, self._node.get_logger()
        # A staying robot has no goal: its last one has ended.
        if not plan.staying and self.goals.has(name):
            number = plan.goal_id
            if received.goal == number:
                self._refused_since, self.refused_for = None, 0.0
            course = self.goals.course(name, number, received)
            if course is GoalProgress.UNDER_WAY:
                return False
            if course is GoalProgress.ENDED:
                self.goals.forget(name)
                return True
            self.goals.forget(name)
            if course is GoalProgress.LOST:
                logger.warning(f'{name} did not accept goal {number}, or lost it')
                self.refuse(name)
        number = self._homing.get(name, -1)
        if number > 0:
            course = self.goals.course(name, number, received)
            if course is not GoalProgress.UNDER_WAY:
                ended = course is GoalProgress.ENDED and received.status != AgentState.ABORTED
                self._homing[name] = 0 if ended else -1
        if number >= 0:
            return False
        if self.goals.driven(received):
            if not self.goals.ends(name, received):
                self._on_external_goal(name, received, step)
            return False
        if self.external_goals.pop(name, None) is not None:
            logger.info(f'{name} accepts goals of the planner again')
        return True

    def _on_external_goal(self, name: str, received: ReceivedState, step: int) -> None:
        new = self.external_goals.get(name) != received.goal
        self.external_goals[name] = received.goal
        if self._modes.of[name] is Mode.SEARCHING:
            self._coordinator.robots[name].on_external_goal(step)
        if new:
            self._node.get_logger().warning(
                f'{name} follows goal {received.goal} of another client: it measures, but '
                'receives no goals from the planner until that goal has ended'
            )
