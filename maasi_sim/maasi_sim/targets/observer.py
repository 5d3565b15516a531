"""Gathers the data of the report of a search for targets from its messages."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
from rosbags.typesys.store import Typestore

from maasi_filter.models.pose import Pose
from maasi_sim.run.run_record import RunEnd, TeamLog, rows
from maasi_sim.run.topics import DECISIONS, FOUND, STEP, UPDATE, within
from maasi_sim.scenario.schema import Scenario
from maasi_sim.targets.tally import FoundCount, Tally, TargetRecord

UNAVAILABLE = 5


class TargetObserver:
    """Gathers the data of a report from serialised messages, in the order of arrival.

    Times are those since the first step. Filter updates and found targets are decoded at once, as
    the end of a run depends on them; the rest is decoded by `record`.
    """

    def __init__(self, name: str, scenario: Scenario, seed: int, types: Typestore) -> None:
        self.name = name
        self.scenario = scenario
        self.seed = seed
        self.world = scenario.world(seed)
        spaces = scenario.namespaces()
        # Namespaces of filters and planners, and robots, by topic.
        self._updates = {within(space, UPDATE): space for space in spaces}
        self._arrays = {within(space, FOUND): space for space in spaces}
        self._decisions = {within(space, DECISIONS): space for space in spaces}
        self._states = {f'/{name}/state': name for name in scenario.names()}
        self._detections = {f'/{name}/detections': name for name in scenario.names()}
        self._kept: dict[str, list[bytes]] = {
            topic: [] for topic in (*self._decisions, *self._states, *self._detections)
        }
        self._team = TeamLog(types)
        self._tally = Tally(scenario, self.world, self._team)
        self._new_updates: list[tuple[str, Any]] = []
        self._new_arrays: dict[str, list[Any]] = {space: [] for space in spaces}
        # Updates of several filters, with the found targets that came with them.
        self._history: list[tuple[str, Any, Any]] = []
        # Planners that expect no further gain: since which step, and why.
        self._settled: dict[str, tuple[int, str]] = {}
        # Step at which all planners were settled, and the reason of the last one.
        self._ending: tuple[int, str] | None = None
        self._explored: dict[str, float] = {}
        self.news = False
        #: Number of true targets.
        self.total = len(self.world.targets)
        #: Topics of the filters' updates, and all that it needs.
        self.update_topics = list(self._updates)
        self.topics = [*self._updates, *self._arrays, STEP, *self._kept]

    @property
    def progress(self) -> list[FoundCount]:
        """State of the run after each filter update."""
        return self._tally.progress

    @property
    def completed(self) -> FoundCount | None:
        """State of the run when all targets were found."""
        return self._tally.completed

    @property
    def settled(self) -> str | None:
        """The reason, once all planners with robots report that nothing is left to gain."""
        return None if self._ending is None else self._ending[1]

    @property
    def end_step(self) -> int | None:
        """Step at which the search ended by itself, if it has."""
        if self.completed is not None:
            return self.completed.step
        return None if self._ending is None else self._ending[0]

    @property
    def found(self) -> int:
        """Number of targets found so far."""
        return self.progress[-1].found if self.progress else 0

    @property
    def measurements(self) -> int:
        """Number of measurements so far, of all robots."""
        return sum(self._tally.measurements.values())

    @property
    def explored(self) -> float:
        """Share of the environment explored, as of the last decisions; the largest of several."""
        return max(self._explored.values(), default=0.0)

    def add(self, topic: str, data: bytes) -> None:
        """Add a serialised message; one of another topic is ignored."""
        decode = self._team.decode
        if topic in self._kept:
            self._kept[topic].append(data)
        if topic in self._decisions:
            self._note_decision(self._decisions[topic], decode(data, 'PlanDecision'))
        elif topic in self._states and self._settled and self._team.robots is None:
            self._note_ending(int(decode(data, 'AgentState').step))
        elif topic in self._updates:
            self._new_updates.append((self._updates[topic], decode(data, 'FilterUpdate')))
        elif topic in self._arrays:
            self._new_arrays[self._arrays[topic]].append(decode(data, 'FoundTargetArray'))
        elif topic == STEP and self.completed is None:
            step = decode(data, 'LockstepStep')
            if self._team.note(step) and self._settled:
                self._note_ending(int(step.step))

    def settle(self) -> None:
        """Evaluate the messages added since the last call.

        The filter publishes found targets before the update that they belong to.
        """
        updates, self._new_updates = self._new_updates, []
        several = len(self._updates) > 1
        for space, update in updates:
            if self._ending is not None and update.step > self._ending[0]:
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

    def _note_decision(self, space: str, decision: Any) -> None:
        """Note a planner that is settled: its decision has a reason and no robots."""
        self._explored[space] = float(decision.explored)
        if decision.reason and not decision.robots:
            self._settled.setdefault(space, (int(decision.step), decision.reason))
            self._note_ending(int(decision.step))

    def _note_ending(self, step: int) -> None:
        """Note the end of the search: all planners that have a robot are settled."""
        if self._ending is not None:
            return
        spaces = self.scenario.namespaces()
        searching = {space for space, names in spaces.items() if any(map(self._takes_part, names))}
        # Without any robot left, the planners that were settled decide.
        if self._settled.keys() >= (searching or spaces.keys()):
            last, reason = max(self._settled.values())
            self._ending = max(step, last), reason

    def _takes_part(self, name: str) -> bool:
        if self._team.robots is not None:
            return name in self._team.robots
        states = self._kept[f'/{name}/state']
        return not states or self._team.decode(states[-1], 'AgentState').goal_status != UNAVAILABLE

    def record(self, end: RunEnd) -> TargetRecord:
        """Return the record of the run, up to the step at which it was complete."""
        tally = self._tally
        if self._history:
            # Several filters in the order of steps and names, whoever spoke first.
            tally = Tally(self.scenario, self.world, self._team)
            self._history.sort(key=lambda item: (item[1].step, item[0], item[1].batch_id))
            for space, update, found in self._history:
                if tally.completed is not None and update.step > tally.completed.step:
                    break
                tally.take(space, update, found)
        end_time = end.time if tally.completed is None else tally.completed.time
        record = TargetRecord(
            self.name,
            self.scenario,
            self.seed,
            tally.truth,
            found=tally.found,
            progress=list(tally.progress),
            measurements=dict(sorted(tally.measurements.items())),
            end_reason=end.reason,
            end_time=end_time,
            wall_time=end.wall_time,
        )
        waypoints: dict[str, list[Any]] = {name: [] for name in self.scenario.names()}
        for topic in self._decisions:
            for data in self._kept[topic]:
                decision = self._team.decode(data, 'PlanDecision')
                if tally.completed is not None and decision.step > tally.completed.step:
                    break
                for robot in decision.robots:
                    if robot.chosen >= 0:
                        waypoints.setdefault(robot.robot, []).append(_point(robot.waypoint))
        record.decisions = sum(map(len, waypoints.values()))
        record.waypoints = {name: rows(points, 3) for name, points in waypoints.items()}
        lost: list[dict[str, Any]] = []
        for topic, name in self._states.items():
            kind = 'AgentState'
            record.trajectories[name] = self._team.trajectory(self._until(topic, kind, end_time))
            if self._team.robots is None:
                lost += self._absences(name, self._until(topic, kind, end_time))
        for topic, name in self._detections.items():
            arrays = self._until(topic, 'DetectionArray', end_time)
            poses = [_pose(item.pose.pose) for item in arrays if item.batch_id]
            record.measured_from[name] = [pose for pose in poses if pose is not None]
        record.add_events(self._team.events, lost, end.events)
        return record

    def _until(self, topic: str, kind: str, end_time: float) -> Iterator[Any]:
        """Yield the messages of a topic up to a time [s]; all at once would take much memory."""
        for data in self._kept[topic]:
            item = self._team.decode(data, kind)
            if self._team.time(item.header.stamp) <= end_time:
                yield item

    def _absences(self, name: str, states: Iterable[Any]) -> list[dict[str, Any]]:
        """Return the events of a robot that became unavailable and available again."""
        events: list[dict[str, Any]] = []
        away = False
        for state in states:
            if (state.goal_status == UNAVAILABLE) != away:
                away = not away
                time, word = self._team.time(state.header.stamp), 'lost' if away else 'joined'
                events.append({'time': time, 'agent': name, 'event': word})
                if away and state.reason:
                    events[-1]['reason'] = state.reason
        return events


def _point(point: Any) -> tuple[float, float, float]:
    return float(point.x), float(point.y), float(point.z)


def _pose(message: Any) -> Pose | None:
    """Return a pose; None if it is invalid."""
    turn = message.orientation
    try:
        return Pose(np.array(_point(message.position)), np.array([turn.w, turn.x, turn.y, turn.z]))
    except ValueError:
        return None
