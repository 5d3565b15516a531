"""What a run has come to, from its messages: live, or from a recording."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.typesys.store import Typestore

from maasi_sim.bag import Bag
from maasi_sim.scenario import Scenario
from maasi_sim.scoring import Scores, score, scoring_radius

FloatArray = NDArray[np.float64]

UPDATE, FOUND, DECISIONS = '/filter_update', '/found_targets', '/decisions'
BATCH = '/measurement_batch'
STEP = '/lockstep/step'
UNAVAILABLE = 5


def seconds(stamp: Any) -> float:
    """Return a `builtin_interfaces/Time` in seconds."""
    return (int(stamp.sec) * 10**9 + int(stamp.nanosec)) / 1e9


@dataclass(frozen=True)
class Found:
    """A target that the team has found; covariance (d, d) [m^2]."""

    id: int
    position: FloatArray
    covariance: FloatArray
    agent: str
    measurement: int
    time: float


@dataclass(frozen=True)
class Progress:
    """Where a run stood after a filter update."""

    time: float
    step: int
    batch: int
    measurements: int
    found: int
    true_found: int


@dataclass
class RunRecord:
    """All that a report needs of a run.

    Attributes
    ----------
    name : str
        Of the scenario.
    scenario : Scenario
        With all layers.
    seed : int
        Of the run.
    truth : (n, d) array
        True targets [m].
    found : list of Found
        At the end.
    progress : list of Progress
        After each filter update.
    measurements : dict
        Number by robot.
    decisions : int
        Waypoints chosen, of all robots.
    trajectories : dict
        By robot: time [s], x, y, z [m], (n, 4).
    waypoints : dict
        By robot: chosen ones in order, (n, 3) [m].
    measured_at : dict
        By robot: where it measured, (n, 3) [m].
    events : list of dict
        Robots lost and back, nodes restarted or dead.
    end_reason : str
        Why it ended.
    end_time : float
        Simulated time at the end [s].
    wall_time : float
        From the first step to the end [s].
    explored, expected_number : float
        Share of the environment, and targets believed not yet found, at the end.
    """

    name: str
    scenario: Scenario
    seed: int
    truth: FloatArray
    found: list[Found] = field(default_factory=list)
    progress: list[Progress] = field(default_factory=list)
    measurements: dict[str, int] = field(default_factory=dict)
    decisions: int = 0
    trajectories: dict[str, FloatArray] = field(default_factory=dict)
    waypoints: dict[str, FloatArray] = field(default_factory=dict)
    measured_at: dict[str, FloatArray] = field(default_factory=dict)
    events: list[dict[str, Any]] = field(default_factory=list)
    end_reason: str = ''
    end_time: float = 0.0
    wall_time: float = 0.0
    explored: float = 0.0
    expected_number: float = 0.0

    @property
    def radius(self) -> float:
        """Distance within which a found target is true [m]."""
        return scoring_radius(self.scenario, self.truth)

    def scores(self) -> Scores:
        """Return the scores at the end."""
        positions = [target.position for target in self.found]
        return score(positions, self.truth, self.radius, self.scenario.scoring.order)


class RunObserver:
    """Gather what a report needs from serialised messages, in the order in which they come.

    Only filter updates and found targets are read at once, as the end of a run depends on them;
    the rest is kept as it is until `record`.

    Parameters
    ----------
    name : str
        Of the scenario.
    scenario : Scenario
        What is run.
    seed : int
        Of the run.
    types : Typestore
        Message types.
    """

    def __init__(self, name: str, scenario: Scenario, seed: int, types: Typestore) -> None:
        self.name = name
        self.scenario = scenario
        self.seed = seed
        self.truth = np.asarray(scenario.world(seed).targets, dtype=float)
        self.radius = scoring_radius(scenario, self.truth)
        self._types = types
        self._dimension = scenario.dimension
        self._state_topics = {f'/{name}/state': name for name in scenario.names()}
        self._detection_topics = {f'/{name}/detections': name for name in scenario.names()}
        self._kept: dict[str, list[bytes]] = {
            topic: [] for topic in (DECISIONS, *self._state_topics, *self._detection_topics)
        }
        self._found: dict[int, Found] = {}
        self._updates: list[Any] = []
        self._arrays: list[Any] = []
        self._last_scores: Scores | None = None
        self._team: list[str] | None = None
        self.progress: list[Progress] = []
        self.measurements = dict.fromkeys(scenario.names(), 0)
        self.events: list[dict[str, Any]] = []
        self.completed: Progress | None = None
        self.settled: str | None = None
        self._settled_step: int | None = None
        self._explored = 0.0
        self.news = False
        self.expected_number = 0.0

    @property
    def topics(self) -> list[str]:
        """Topics that it wants."""
        return [UPDATE, FOUND, STEP, *self._kept]

    @property
    def end_step(self) -> int | None:
        """Step at which the run came to its end by itself, if it has."""
        if self.completed is not None:
            return self.completed.step
        return self._settled_step

    @property
    def found(self) -> int:
        """Number of targets found so far."""
        return len(self._found)

    @property
    def total_measurements(self) -> int:
        """Number of measurements so far, of all robots."""
        return sum(self.measurements.values())

    @property
    def explored(self) -> float:
        """Share of the environment explored, as of the last decision."""
        return self._explored

    def add(self, topic: str, data: bytes) -> None:
        """Take a serialised message; what is not in `topics` is left alone."""
        if topic in self._kept:
            self._kept[topic].append(data)
            if topic == DECISIONS:
                self._note_decision(self._decode(data, 'PlanDecision'))
        elif self.completed is not None:
            return
        elif topic == UPDATE:
            self._updates.append(self._decode(data, 'FilterUpdate'))
        elif topic == FOUND:
            self._arrays.append(self._decode(data, 'FoundTargetArray'))
        elif topic == STEP:
            self._note_team(self._decode(data, 'LockstepStep'))

    def settle(self) -> None:
        """Take stock after the messages added since the last time.

        The filter publishes found targets before the update that they belong to, so both are there.
        """
        updates, self._updates = self._updates, []
        for update in updates:
            if self.completed is None:
                self._take(update)

    def _take(self, update: Any) -> None:
        changed = self._apply_arrays(int(update.batch_id))
        for item in update.newly_found:
            if int(item.id) not in self._found:
                self._found[int(item.id)] = self._target(item)
                changed = True
        for member in update.members:
            self.measurements[member.robot] = self.measurements.get(member.robot, 0) + 1
        self.expected_number = float(update.expected_number)
        if changed or self._last_scores is None:
            self._last_scores = self._scores()
        scores = self._last_scores
        now = Progress(
            seconds(update.header.stamp),
            int(update.step),
            int(update.batch_id),
            self.total_measurements,
            len(self._found),
            scores.match.true_found,
        )
        self.news = self.news or not self.progress or self.progress[-1].found != now.found
        self.progress.append(now)
        if len(self.truth) and scores.complete and self.scenario.stop == 'all_found':
            self.completed = now

    def _apply_arrays(self, batch: int) -> bool:
        """Take the found targets as they stood after a batch; return whether any came."""
        changed = False
        while self._arrays and self._arrays[0].batch_id <= batch:
            targets = self._arrays.pop(0).targets
            self._found = {int(item.id): self._target(item) for item in targets}
            changed = True
        return changed

    def _scores(self) -> Scores:
        positions = [self._found[key].position for key in sorted(self._found)]
        return score(positions, self.truth, self.radius, self.scenario.scoring.order)

    def _target(self, item: Any) -> Found:
        size = self._dimension
        return Found(
            int(item.id),
            np.array([item.position.x, item.position.y, item.position.z])[:size],
            np.array(item.covariance, dtype=float).reshape(3, 3)[:size, :size],
            item.robot,
            int(item.measurement),
            seconds(item.stamp),
        )

    def _note_decision(self, decision: Any) -> None:
        """Note when the planner says that nothing is left to gain: a reason, and no robots."""
        self._explored = float(decision.explored)
        if decision.reason and not decision.robots and self.settled is None:
            self.settled = decision.reason
            self._settled_step = int(decision.step)

    def _note_team(self, step: Any) -> None:
        team = list(step.robots)
        if self._team is not None and team != self._team:
            time = seconds(step.stamp)
            self._note_changes(self.events, time, self._team, team)
        self._team = team

    @staticmethod
    def _note_changes(
        events: list[dict[str, Any]], time: float, before: list[str], now: list[str]
    ) -> None:
        for name in sorted(set(before) - set(now)):
            events.append({'time': time, 'agent': name, 'event': 'lost'})
        for name in sorted(set(now) - set(before)):
            events.append({'time': time, 'agent': name, 'event': 'joined'})

    def _decode(self, data: bytes, name: str) -> Any:
        return self._types.deserialize_cdr(data, f'maasi_msgs/msg/{name}')

    def record(
        self,
        end_reason: str,
        end_time: float,
        wall_time: float,
        events: list[dict[str, Any]] | None = None,
    ) -> RunRecord:
        """Return the record of the run; one that is complete ends where it became so.

        Parameters
        ----------
        end_reason : str
            Why it ended.
        end_time : float
            Simulated time then [s].
        wall_time : float
            From the first step to the end [s].
        events : list of dict, optional
            Of nodes: restarted, dead.
        """
        last_step = None
        if self.completed is not None:
            end_time, last_step = self.completed.time, self.completed.step
        record = RunRecord(
            self.name,
            self.scenario,
            self.seed,
            self.truth,
            found=[self._found[key] for key in sorted(self._found)],
            progress=list(self.progress),
            measurements={name: self.measurements[name] for name in sorted(self.measurements)},
            end_reason=end_reason,
            end_time=end_time,
            wall_time=wall_time,
            expected_number=self.expected_number,
        )
        self._add_decisions(record, last_step)
        lost: list[dict[str, Any]] = []
        for topic, name in self._state_topics.items():
            states = [self._decode(data, 'AgentState') for data in self._kept[topic]]
            states = [state for state in states if seconds(state.header.stamp) <= end_time]
            record.trajectories[name] = _rows(
                [(seconds(s.header.stamp), *_point(s.pose.pose.position)) for s in states], 4
            )
            if self._team is None:
                lost += _absences(name, states)
        for topic, name in self._detection_topics.items():
            arrays = [self._decode(data, 'DetectionArray') for data in self._kept[topic]]
            record.measured_at[name] = _rows(
                [
                    _point(item.pose.pose.position)
                    for item in arrays
                    if item.batch_id and seconds(item.header.stamp) <= end_time
                ],
                3,
            )
        record.events = sorted(
            self.events + lost + (events or []), key=lambda event: float(event['time'])
        )
        return record

    def _add_decisions(self, record: RunRecord, last_step: int | None) -> None:
        waypoints: dict[str, list[tuple[float, float, float]]] = {
            name: [] for name in self.scenario.names()
        }
        for data in self._kept[DECISIONS]:
            decision = self._decode(data, 'PlanDecision')
            if last_step is not None and decision.step > last_step:
                break
            record.explored = float(decision.explored)
            for robot in decision.robots:
                if robot.chosen >= 0:
                    record.decisions += 1
                    waypoints.setdefault(robot.robot, []).append(_point(robot.waypoint))
        record.waypoints = {name: _rows(points, 3) for name, points in waypoints.items()}


def observe_bag(bag: Bag, name: str, scenario: Scenario, seed: int) -> RunObserver:
    """Return the observer of a recorded run, having seen all of it."""
    observer = RunObserver(name, scenario, seed, bag.store)
    for topic, _, _, data in bag.raw(observer.topics):
        observer.add(topic, data)
        if topic == UPDATE:
            observer.settle()
    return observer


def _point(point: Any) -> tuple[float, float, float]:
    return float(point.x), float(point.y), float(point.z)


def _rows(rows: list[Any], width: int) -> FloatArray:
    return np.array(rows, dtype=float).reshape(-1, width)


def _absences(name: str, states: list[Any]) -> list[dict[str, Any]]:
    """Return when a robot said that it cannot go on, and when it could again."""
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
