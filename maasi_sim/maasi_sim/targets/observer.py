"""Gathers the data of the report of a search for targets from its messages."""

from __future__ import annotations

from typing import Any

import numpy as np
from rosbags.typesys.store import Typestore

from maasi_filter.models.pose import Pose
from maasi_sim.run.run_record import UNAVAILABLE, Observer, RunEnd, rows
from maasi_sim.run.topics import DECISIONS, FOUND, UPDATE, within
from maasi_sim.scenario.schema import Scenario
from maasi_sim.targets.tally import Tally, TargetRecord


class TargetObserver(Observer):
    """Gathers the data of a report from serialised messages, in the order of arrival.

    Filter updates and found targets are decoded at once, as the end of a run depends on them; the
    rest is decoded by `record`.
    """

    def __init__(self, name: str, scenario: Scenario, seed: int, types: Typestore) -> None:
        spaces = scenario.namespaces()
        # Namespaces of filters and planners, by topic.
        self._updates = {within(space, UPDATE): space for space in spaces}
        self._arrays = {within(space, FOUND): space for space in spaces}
        self._planners = {within(space, DECISIONS): space for space in spaces}
        self._decisions: dict[str, list[bytes]] = {topic: [] for topic in self._planners}
        self._detections: dict[str, list[bytes]] = {
            f'/{name}/detections': [] for name in scenario.names()
        }
        topics = [*self._updates, *self._arrays, *self._decisions, *self._detections]
        super().__init__(name, scenario, seed, types, topics)
        self.update_topics = list(self._updates)
        self.world = scenario.world(seed)
        self.total = len(self.world.targets)
        self._tally = Tally(scenario, self.world, self)
        self._new_updates: list[tuple[str, Any]] = []
        self._new_arrays: dict[str, list[Any]] = {space: [] for space in spaces}
        # Updates of several filters, with the found targets that came with them.
        self._history: list[tuple[str, Any, Any]] = []
        # Planners that expect no further gain: since which step, and why.
        self._settled: dict[str, tuple[int, str]] = {}
        # Step at which all planners were settled.
        self._ending: int | None = None
        self._explored: dict[str, float] = {}

    def add(self, topic: str, data: bytes) -> None:
        """See `Observer.add`."""
        super().add(topic, data)
        if topic in self._decisions:
            self._decisions[topic].append(data)
            decision = self.decode(data, 'PlanDecision')
            self._explored[topic] = float(decision.explored)
            self.explored = max(self._explored.values())
            # Of a planner that is settled.
            if decision.reason and not decision.robots:
                step = int(decision.step)
                self._settled.setdefault(self._planners[topic], (step, decision.reason))
                self._note_ending(step)
        elif topic in self._detections:
            self._detections[topic].append(data)
        elif topic in self._states and self._settled and self.robots is None:
            self._note_ending(int(self.decode(data, 'AgentState').step))
        elif topic in self._updates:
            update = self.decode(data, 'FilterUpdate')
            self._new_updates.append((self._updates[topic], update))
        elif topic in self._arrays:
            array = self.decode(data, 'FoundTargetArray')
            self._new_arrays[self._arrays[topic]].append(array)

    def _note_step(self, step: Any) -> None:
        before = self.robots
        super()._note_step(step)
        if self._settled and self.robots != before:
            self._note_ending(int(step.step))

    def settle(self) -> None:
        """See `Observer.settle`; a filter publishes found targets before their update."""
        updates, self._new_updates = self._new_updates, []
        several = len(self._updates) > 1
        for space, update in updates:
            if self._ending is not None and update.step > self._ending:
                continue
            # Updates of the same step from other filters may still arrive.
            if self.completed and not (several and update.step <= self.completed.step):
                continue
            found, waiting = None, self._new_arrays[space]
            while waiting and waiting[0].batch_id <= update.batch_id:
                found = waiting.pop(0)
            if several:
                self._history.append((space, update, found))
            self.news = self._tally.take(space, update, found) or self.news
            self.found = self._tally.progress[-1].found
            self.measurements = self._tally.progress[-1].measurements
            self.completed = self._tally.completed
            if self.completed is not None:
                self.end_step = self.completed.step

    def _note_ending(self, step: int) -> None:
        """Note the end of the search: all planners that have a robot are settled."""
        if self._ending is not None:
            return
        spaces = self.scenario.namespaces()
        searching = {space for space, names in spaces.items() if any(map(self._takes_part, names))}
        # Without any robot left, the planners that were settled decide.
        if self._settled.keys() >= (searching or spaces.keys()):
            last, self.settled = max(self._settled.values())
            self._ending = max(step, last)
            if self.completed is None:
                self.end_step = self._ending

    def _takes_part(self, name: str) -> bool:
        if self.robots is not None:
            return name in self.robots
        states = self._states[f'/{name}/state']
        return not states or self.decode(states[-1], 'AgentState').goal_status != UNAVAILABLE

    def record(self, end: RunEnd) -> TargetRecord:
        """See `Observer.record`."""
        tally = self._tally
        if self._history:
            # Several filters in the order of steps and names, not in that of arrival.
            tally = Tally(self.scenario, self.world, self)
            self._history.sort(key=lambda item: (item[1].step, item[0], item[1].batch_id))
            for space, update, found in self._history:
                if tally.completed is not None and update.step > tally.completed.step:
                    break
                tally.take(space, update, found)
        end_time = end.time if tally.completed is None else tally.completed.time
        record = TargetRecord(self.name, self.scenario, self.seed, tally, end_time=end_time)
        waypoints: dict[str, list[Any]] = {name: [] for name in self.scenario.names()}
        for messages in self._decisions.values():
            for data in messages:
                decision = self.decode(data, 'PlanDecision')
                if tally.completed is not None and decision.step > tally.completed.step:
                    break
                for robot in decision.robots:
                    if robot.chosen >= 0:
                        waypoints.setdefault(robot.robot, []).append(_point(robot.waypoint))
        record.waypoints = {name: rows(points, 3) for name, points in waypoints.items()}
        for name, messages in zip(self.scenario.names(), self._detections.values()):
            arrays = self._until('DetectionArray', messages, end_time)
            poses = [_pose(item.pose.pose) for item in arrays if item.batch_id]
            record.measured_from[name] = [pose for pose in poses if pose is not None]
        self._complete(record, end)
        return record


def _point(point: Any) -> tuple[float, float, float]:
    return float(point.x), float(point.y), float(point.z)


def _pose(message: Any) -> Pose | None:
    """Return a pose; None if it is invalid."""
    turn = message.orientation
    try:
        return Pose(np.array(_point(message.position)), np.array([turn.w, turn.x, turn.y, turn.z]))
    except ValueError:
        return None
