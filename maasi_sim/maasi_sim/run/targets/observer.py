"""Gathers the data of the report of a search for targets from its messages."""

import contextlib
import math
from collections.abc import Iterable
from typing import Any

import numpy as np
from rosbags.typesys.store import Typestore

from maasi_filter.models.pose import Pose
from maasi_filter.records import FoundTarget
from maasi_sim.run.log import RunLog, Updated
from maasi_sim.run.mission import UNAVAILABLE, Observer, RunEnd, rows
from maasi_sim.run.targets.record import TargetRecord, found_target
from maasi_sim.run.topics import DECISIONS, FOUND, UPDATE, point, within
from maasi_sim.scenario.schema import Scenario


class TargetObserver(Observer):
    """Gathers the data of a report; messages on which the end depends are decoded at once."""

    def __init__(self, name: str, scenario: Scenario, seed: int, types: Typestore) -> None:
        spaces = scenario.namespaces()
        # Namespaces of filters and planners, by topic.
        self._updates = {within(space, UPDATE): space for space in spaces}
        self._arrays = {within(space, FOUND): space for space in spaces}
        self._planners = {within(space, DECISIONS): space for space in spaces}
        # Step, robot and place of each.
        self._waypoints: list[tuple[int, str, tuple[float, float, float]]] = []
        self._detections: dict[str, list[bytes]] = {
            f'/{name}/detections': [] for name in scenario.names()
        }
        topics = [*self._updates, *self._arrays, *self._planners, *self._detections]
        super().__init__(name, scenario, seed, types, topics)
        self.update_topics = list(self._updates)
        self.world = scenario.world(seed)
        self.total = len(self.world.targets)
        self._log = self._new_log()
        self._new_updates: list[tuple[str, Any]] = []
        self._new_arrays: dict[str, list[Any]] = {space: [] for space in spaces}
        # Updates of several filters, with the found targets that came with them.
        self._history: list[tuple[str, Any, Any]] = []
        # Planners that expect no further gain: since which step, and why.
        self._settled: dict[str, tuple[int, str]] = {}
        # Step at which all planners were settled.
        self._ending: int | None = None
        self._explored: dict[str, float] = {}
        # Robot and index of each measurement that has arrived; of each that an update used, its
        # step.
        self._arrived: set[tuple[str, int]] = set()
        self._used: dict[tuple[str, int], int] = {}

    def add(self, topic: str, data: bytes) -> None:
        """See `Observer.add`."""
        super().add(topic, data)
        if topic in self._planners:
            decision = self.decode(data, 'PlanDecision')
            self._waypoints += [
                (int(decision.step), item.robot, point(item.waypoint))
                for item in decision.robots
                if item.chosen >= 0
            ]
            self._explored[topic] = float(decision.explored)
            self.explored = max(self._explored.values())
            # Of a planner that is settled.
            if decision.reason and not decision.robots:
                step = int(decision.step)
                self._settled.setdefault(self._planners[topic], (step, decision.reason))
                self._note_ending(step)
        elif topic in self._detections:
            self._detections[topic].append(data)
            self._arrived.add(self._key(topic, data))
        elif topic in self._states and self._settled and self.robots is None:
            self._note_ending(int(self.decode(data, 'AgentState').step))
        elif topic in self._updates:
            update = self.decode(data, 'FilterUpdate')
            self._new_updates.append((self._updates[topic], update))
            for member in update.members:
                key = member.robot, int(member.measurement)
                self._used.setdefault(key, int(update.step))
        elif topic in self._arrays:
            array = self.decode(data, 'FoundTargetArray')
            self._new_arrays[self._arrays[topic]].append(array)

    def _key(self, topic: str, data: bytes) -> tuple[str, int]:
        return topic.split('/')[1], int(self.decode(data, 'DetectionArray').measurement)

    def rests_on(self, topic: str, data: bytes, last_step: int) -> bool:
        """See `Observer.rests_on`."""
        if topic not in self._detections:
            return False
        return self._used.get(self._key(topic, data), last_step + 1) <= last_step

    def lacking(self, last_step: int) -> list[str]:
        """See `Observer.lacking`."""
        used = {key for key, step in self._used.items() if step <= last_step}
        return [f'measurement {index} of {name}' for name, index in sorted(used - self._arrived)]

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
            self._count(self._log, space, update, found)
            now = self._log.progress[-1]
            first = len(self._log.progress) == 1
            self.news |= first or now.found != self.found + self.false_found
            self.found, self.false_found = now.true_found, now.found - now.true_found
            self.measurements = now.measurements
            self.completed = self._log.completed
            if self.completed is not None:
                self.end_step = self.completed.step

    def _new_log(self) -> RunLog:
        return RunLog(self.scenario, self.seed, self.world, keeps=False)

    def _count(self, log: RunLog, space: str, update: Any, array: Any) -> None:
        """Add an update to a log; `array` has all found targets, None if they have not changed."""
        before = log.found_by(space) if array is None else self._own(space, array.targets)
        known = {item.id for item in before}
        new = [item for item in self._own(space, update.newly_found) if item.id not in known]
        found = [*before, *new] if new or array is not None else None
        if found is not None:
            found = sorted(found, key=lambda item: item.id)
        members = [(item.robot, int(item.measurement)) for item in update.members]
        time, step = self.time(update.header.stamp), int(update.step)
        log.add(Updated(time, step, space, members, found))

    def _own(self, space: str, targets: Iterable[Any]) -> list[FoundTarget]:
        """Return the targets that a filter found itself, not those that others told it."""
        begin, dimension = self.begin or 0.0, self.scenario.dimension
        return [
            found_target(item, begin, dimension)
            for item in targets
            if len(self._updates) == 1 or item.robot == space
        ]

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
        log = self._log
        if self._history:
            # Several filters in the order of steps and names, not in that of arrival.
            log = self._new_log()
            self._history.sort(key=lambda item: (item[1].step, item[0], item[1].batch_id))
            for space, update, found in self._history:
                if log.completed is not None and update.step > log.completed.step:
                    break
                self._count(log, space, update, found)
        end_time, last = end.time, math.inf
        if log.completed is not None:
            end_time, last = log.completed.time, log.completed.step
        record = TargetRecord(self.name, self.scenario, self.seed, log, end_time=end_time)
        for name, messages in zip(self.scenario.names(), self._detections.values()):
            ways = [at for step, who, at in self._waypoints if who == name and step <= last]
            record.waypoints[name] = rows(ways, 3)
            record.measured_from[name] = []
            for item in self._until('DetectionArray', messages, end_time):
                place, turn = point(item.pose.pose.position), item.pose.pose.orientation
                # An invalid pose is left out.
                with contextlib.suppress(ValueError):
                    pose = Pose(np.array(place), np.array([turn.w, turn.x, turn.y, turn.z]))
                    record.measured_from[name] += [pose] if item.batch_id else []
        self._complete(record, end)
        return record
