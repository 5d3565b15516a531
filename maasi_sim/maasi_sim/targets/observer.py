"""Gathers the data of the report of a search for targets from its messages."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
from rosbags.typesys.store import Typestore

from maasi_filter.models.pose import Pose
from maasi_sim.run.run_record import RunEnd, TeamLog, rows
from maasi_sim.run.topics import DECISIONS, FOUND, STEP, UPDATE, seconds, within
from maasi_sim.scenario.schema import Scenario
from maasi_sim.targets.tally import FoundCount, Tally, TargetRecord, Update

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
        self.truth = np.asarray(self.world.targets, dtype=float)
        spaces = list(scenario.namespaces())
        self._update_topics = {within(space, UPDATE): space for space in spaces}
        self._found_topics = {within(space, FOUND): space for space in spaces}
        self._decision_topics = {within(space, DECISIONS): space for space in spaces}
        self._state_topics = {f'/{name}/state': name for name in scenario.names()}
        self._detection_topics = {f'/{name}/detections': name for name in scenario.names()}
        self._kept: dict[str, list[bytes]] = {
            topic: []
            for topic in (*self._decision_topics, *self._state_topics, *self._detection_topics)
        }
        self._team = TeamLog(types)
        self._tally = Tally(scenario, self.world, 0.0)
        self._updates: list[tuple[str, Any]] = []
        self._arrays: dict[str, list[Any]] = {space: [] for space in spaces}
        self._history: list[Update] = []
        # Planners that expect no further gain: since which step, and why.
        self._settled: dict[str, tuple[int, str]] = {}
        self._robots_of = {
            within(space, DECISIONS): names for space, names in scenario.namespaces().items()
        }
        # Step at which all planners were settled, and the reason of the last one.
        self._ending: tuple[int, str] | None = None
        self._explored: dict[str, float] = {}
        self.news = False
        #: Number of true targets.
        self.total = len(self.truth)
        #: Topics of the filters' updates, and all that it needs.
        self.update_topics = list(self._update_topics)
        self.topics = [*self.update_topics, *self._found_topics, STEP, *self._kept]

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
        if topic in self._kept:
            self._kept[topic].append(data)
            if topic in self._decision_topics:
                self._note_decision(topic, self._team.decode(data, 'PlanDecision'))
            elif topic in self._state_topics and self._settled and self._team.robots is None:
                self._note_ending(int(self._team.decode(data, 'AgentState').step))
        elif topic in self._update_topics:
            update = self._team.decode(data, 'FilterUpdate')
            self._updates.append((self._update_topics[topic], update))
        elif topic in self._found_topics:
            array = self._team.decode(data, 'FoundTargetArray')
            self._arrays[self._found_topics[topic]].append(array)
        elif topic == STEP and self.completed is None:
            self._note_team(self._team.decode(data, 'LockstepStep'))

    def settle(self) -> None:
        """Evaluate the messages added since the last call.

        The filter publishes found targets before the update that they belong to.
        """
        updates, self._updates = self._updates, []
        for namespace, message in updates:
            if self._ending is not None and message.step > self._ending[0]:
                continue
            # Updates of the same step from other filters may still arrive.
            if self.completed is not None and (
                len(self._update_topics) == 1 or message.step > self.completed.step
            ):
                continue
            arrays, waiting = [], self._arrays[namespace]
            while waiting and waiting[0].batch_id <= message.batch_id:
                arrays.append(waiting.pop(0))
            update = Update(namespace, message, arrays)
            if len(self._update_topics) > 1:
                self._history.append(update)
            self.news = self._tally.take(update) or self.news

    def _final_tally(self) -> Tally:
        """Return the tally with the updates of several filters in the order of steps and names."""
        if not self._history:
            return self._tally
        tally = Tally(self.scenario, self.world, self._team.begin or 0.0)
        for update in sorted(
            self._history,
            key=lambda item: (item.message.step, item.namespace, item.message.batch_id),
        ):
            if tally.completed is not None and update.message.step > tally.completed.step:
                break
            tally.take(update)
        return tally

    def _note_decision(self, topic: str, decision: Any) -> None:
        """Note a planner that is settled: its decision has a reason and no robots."""
        self._explored[topic] = float(decision.explored)
        if decision.reason and not decision.robots:
            self._settled.setdefault(topic, (int(decision.step), decision.reason))
            self._note_ending(int(decision.step))

    def _note_ending(self, step: int) -> None:
        """Note the end of the search: all planners that have a robot are settled."""
        if self._ending is not None:
            return
        searching = {
            topic
            for topic, names in self._robots_of.items()
            if any(self._takes_part(name) for name in names)
        }
        # Without any robot left, the planners that were settled decide.
        if self._settled.keys() >= (searching or self._robots_of.keys()):
            last, reason = max(self._settled.values())
            self._ending = max(step, last), reason

    def _takes_part(self, name: str) -> bool:
        if self._team.robots is not None:
            return name in self._team.robots
        states = self._kept[f'/{name}/state']
        return not states or self._team.decode(states[-1], 'AgentState').goal_status != UNAVAILABLE

    def _note_team(self, step: Any) -> None:
        changed = self._team.note(step)
        self._tally.begin = self._team.begin or 0.0
        if changed and self._settled:
            self._note_ending(int(step.step))

    def record(self, end: RunEnd) -> TargetRecord:
        """Return the record of the run, up to the step at which it was complete."""
        tally = self._final_tally()
        end_time, last_step = end.time, None
        if tally.completed is not None:
            end_time, last_step = tally.completed.time, tally.completed.step
        record = TargetRecord(
            self.name,
            self.scenario,
            self.seed,
            tally.truth,
            found=tally.found,
            progress=list(tally.progress),
            measurements={name: tally.measurements[name] for name in sorted(tally.measurements)},
            end_reason=end.reason,
            end_time=end_time,
            wall_time=end.wall_time,
            expected_number=tally.expected_number,
        )
        self._add_decisions(record, last_step)
        lost: list[dict[str, Any]] = []
        for topic, name in self._state_topics.items():
            kind = 'AgentState'
            record.trajectories[name] = self._team.trajectory(self._until(topic, kind, end_time))
            if self._team.robots is None:
                lost += _absences(name, self._until(topic, kind, end_time))
        for topic, name in self._detection_topics.items():
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

    def _add_decisions(self, record: TargetRecord, last_step: int | None) -> None:
        waypoints: dict[str, list[tuple[float, float, float]]] = {
            name: [] for name in self.scenario.names()
        }
        for topic in self._decision_topics:
            explored = 0.0
            for data in self._kept[topic]:
                decision = self._team.decode(data, 'PlanDecision')
                if last_step is not None and decision.step > last_step:
                    break
                explored = float(decision.explored)
                for robot in decision.robots:
                    if robot.chosen >= 0:
                        record.decisions += 1
                        waypoints.setdefault(robot.robot, []).append(_point(robot.waypoint))
            record.explored = max(record.explored, explored)
        record.waypoints = {name: rows(points, 3) for name, points in waypoints.items()}


def _point(point: Any) -> tuple[float, float, float]:
    return float(point.x), float(point.y), float(point.z)


def _pose(message: Any) -> Pose | None:
    """Return a pose; None if it is invalid."""
    turn = message.orientation
    try:
        return Pose(np.array(_point(message.position)), np.array([turn.w, turn.x, turn.y, turn.z]))
    except ValueError:
        return None


def _absences(name: str, states: Iterable[Any]) -> list[dict[str, Any]]:
    """Return the events of a robot that became unavailable and available again."""
    events: list[dict[str, Any]] = []
    away = False
    for state in states:
        if (state.goal_status == UNAVAILABLE) != away:
            away = not away
            event: dict[str, Any] = {
                'time': seconds(state.header.stamp),
                'agent': name,
                'event': 'lost' if away else 'joined',
            }
            if away and state.reason:
                event['reason'] = state.reason
            events.append(event)
    return events
