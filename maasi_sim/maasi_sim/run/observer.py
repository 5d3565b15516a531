"""What a run has come to, from its messages: live, or from a recording."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.typesys.store import Typestore

from maasi_sim.run.bag import Bag
from maasi_sim.run.scoring import Scores, score, scoring_radius
from maasi_sim.scenario.schema import Scenario
from maasi_sim.world.world import World

FloatArray = NDArray[np.float64]

UPDATE, FOUND, DECISIONS = '/filter_update', '/found_targets', '/decisions'
BATCH = '/measurement_batch'
STEP = '/lockstep/step'
UNAVAILABLE = 5


def within(namespace: str, topic: str) -> str:
    """Return the full name of a topic in a namespace; an empty one is the root."""
    return f'/{namespace}{topic}' if namespace else topic


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


@dataclass
class _Update:
    """An update of a filter, in a namespace, with the found targets as they were changed by it."""

    namespace: str
    message: Any
    arrays: list[Any]


class _Tally:
    """Counts what the filters have found, update by update."""

    def __init__(self, scenario: Scenario, world: World, begin: float) -> None:
        self.scenario = scenario
        self.world = world
        self.truth = np.asarray(world.targets, dtype=float)
        self.begin = begin
        self.radius = scoring_radius(scenario, self.truth)
        self.measurements = dict.fromkeys(scenario.names(), 0)
        self.progress: list[Progress] = []
        self.completed: Progress | None = None
        self.expected_number = 0.0
        self._shared = len(scenario.namespaces()) > 1
        # By the namespace of the filter.
        self._found: dict[str, dict[int, Found]] = {name: {} for name in scenario.namespaces()}
        self._expected: dict[str, float] = {}
        self._last_scores: Scores | None = None
        self._counted: set[tuple[str, str, int]] = set()

    @property
    def found(self) -> list[Found]:
        """Targets found so far; those of several filters are numbered in their order."""
        if not self._shared:
            (found,) = self._found.values()
            return [found[key] for key in sorted(found)]
        every = [item for found in self._found.values() for item in found.values()]
        every.sort(key=lambda item: (item.time, item.agent, item.id))
        return [replace(item, id=number) for number, item in enumerate(every, start=1)]

    def take(self, update: _Update) -> bool:
        """Take an update; return whether the number of found targets is another one."""
        message = update.message
        before = self._found[update.namespace]
        changed = bool(update.arrays)
        for array in update.arrays:
            before = {int(item.id): self._target(item) for item in self._own(update, array.targets)}
        for item in self._own(update, message.newly_found):
            if int(item.id) not in before:
                before[int(item.id)] = self._target(item)
                changed = True
        self._found[update.namespace] = before
        for member in message.members:
            # A restarted filter publishes its last update again.
            key = (update.namespace, member.robot, int(member.measurement))
            if key not in self._counted:
                self._counted.add(key)
                self.measurements[member.robot] = self.measurements.get(member.robot, 0) + 1
        # All filters believe in the same targets.
        self._expected[update.namespace] = float(message.expected_number)
        self.expected_number = max(self._expected.values())
        if self.world.walk > 0.0:
            self.truth = self.world.targets_at(int(message.step))
            changed = True
        if changed or self._last_scores is None:
            self._last_scores = self._scores()
        now = Progress(
            seconds(message.header.stamp) - self.begin,
            int(message.step),
            int(message.batch_id),
            sum(self.measurements.values()),
            sum(len(found) for found in self._found.values()),
            self._last_scores.match.true_found,
        )
        news = not self.progress or self.progress[-1].found != now.found
        self.progress.append(now)
        if (
            self.completed is None
            and len(self.truth)
            and self._last_scores.complete
            and self.scenario.stop == 'all_found'
        ):
            self.completed = now
        return news

    def _own(self, update: _Update, targets: Any) -> list[Any]:
        """Return the targets that the filter found itself."""
        if not self._shared:
            return list(targets)
        return [item for item in targets if item.robot == update.namespace]

    def _scores(self) -> Scores:
        positions = [item.position for item in self.found]
        return score(positions, self.truth, self.radius, self.scenario.scoring.order)

    def _target(self, item: Any) -> Found:
        size = self.scenario.dimension
        return Found(
            int(item.id),
            np.array([item.position.x, item.position.y, item.position.z])[:size],
            np.array(item.covariance, dtype=float).reshape(3, 3)[:size, :size],
            item.robot,
            int(item.measurement),
            seconds(item.stamp) - self.begin,
        )


class RunObserver:
    """Gather what a report needs from serialised messages, in the order in which they come.

    Times are those since the first step. Only filter updates and found targets are read at once, as
    the end of a run depends on them; the rest is kept as it is until `record`.

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
        self.world = scenario.world(seed)
        self.truth = np.asarray(self.world.targets, dtype=float)
        self._types = types
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
        # When it began [s]: the time of a clock that it follows has no beginning.
        self._begin: float | None = None
        self._tally = _Tally(scenario, self.world, 0.0)
        self._updates: list[tuple[str, Any]] = []
        self._arrays: dict[str, list[Any]] = {space: [] for space in spaces}
        self._history: list[_Update] = []
        self._team: list[str] | None = None
        self.events: list[dict[str, Any]] = []
        # Which planners think that nothing is left, since which step, and why.
        self._settled: dict[str, tuple[int, str]] = {}
        self._robots_of = {
            within(space, DECISIONS): names for space, names in scenario.namespaces().items()
        }
        # Step at which all had come to that, and the last one's reason.
        self._ending: tuple[int, str] | None = None
        self._explored: dict[str, float] = {}
        self.news = False

    @property
    def update_topics(self) -> list[str]:
        """Topics of the filters' updates."""
        return list(self._update_topics)

    @property
    def result_topics(self) -> list[str]:
        """Topics of the filters' updates and found targets."""
        return [*self._update_topics, *self._found_topics]

    @property
    def topics(self) -> list[str]:
        """Topics that it wants."""
        return [*self.result_topics, STEP, *self._kept]

    @property
    def progress(self) -> list[Progress]:
        """Where the run stood after each filter update."""
        return self._tally.progress

    @property
    def completed(self) -> Progress | None:
        """Where the run stood when all was found."""
        return self._tally.completed

    @property
    def settled(self) -> str | None:
        """Why nothing is left to gain, once every planner says so that has a robot."""
        return None if self._ending is None else self._ending[1]

    @property
    def end_step(self) -> int | None:
        """Step at which the run came to its end by itself, if it has."""
        if self.completed is not None:
            return self.completed.step
        return None if self._ending is None else self._ending[0]

    @property
    def found(self) -> int:
        """Number of targets found so far."""
        return self.progress[-1].found if self.progress else 0

    @property
    def measurements(self) -> dict[str, int]:
        """Number of measurements so far, by robot."""
        return self._tally.measurements

    @property
    def total_measurements(self) -> int:
        """Number of measurements so far, of all robots."""
        return sum(self.measurements.values())

    @property
    def explored(self) -> float:
        """Share of the environment explored, as of the last decisions; the largest of several."""
        return max(self._explored.values(), default=0.0)

    @property
    def expected_number(self) -> float:
        """Targets believed not yet found; the most that any filter believes."""
        return self._tally.expected_number

    def add(self, topic: str, data: bytes) -> None:
        """Take a serialised message; what is not in `topics` is left alone."""
        if topic in self._kept:
            self._kept[topic].append(data)
            if topic in self._decision_topics:
                self._note_decision(topic, self._decode(data, 'PlanDecision'))
            elif topic in self._state_topics and self._settled and self._team is None:
                self._note_ending(int(self._decode(data, 'AgentState').step))
        elif topic in self._update_topics:
            self._updates.append((self._update_topics[topic], self._decode(data, 'FilterUpdate')))
        elif topic in self._found_topics:
            self._arrays[self._found_topics[topic]].append(self._decode(data, 'FoundTargetArray'))
        elif topic == STEP and self.completed is None:
            self._note_team(self._decode(data, 'LockstepStep'))

    def settle(self) -> None:
        """Take stock after the messages added since the last time.

        The filter publishes found targets before the update that they belong to, so both are there.
        """
        updates, self._updates = self._updates, []
        for namespace, message in updates:
            # Of several filters the others may still have to say what they found at that step.
            if self.completed is not None and (
                len(self._update_topics) == 1 or message.step > self.completed.step
            ):
                continue
            arrays, waiting = [], self._arrays[namespace]
            while waiting and waiting[0].batch_id <= message.batch_id:
                arrays.append(waiting.pop(0))
            update = _Update(namespace, message, arrays)
            if len(self._update_topics) > 1:
                self._history.append(update)
            self.news = self._tally.take(update) or self.news

    def _final_tally(self) -> _Tally:
        """Return the tally with the updates of several filters in the order of steps and names."""
        if not self._history:
            return self._tally
        tally = _Tally(self.scenario, self.world, self._begin or 0.0)
        for update in sorted(
            self._history,
            key=lambda item: (item.message.step, item.namespace, item.message.batch_id),
        ):
            if tally.completed is not None and update.message.step > tally.completed.step:
                break
            tally.take(update)
        return tally

    def _note_decision(self, topic: str, decision: Any) -> None:
        """Note when a planner says that nothing is left to gain: a reason, and no robots."""
        self._explored[topic] = float(decision.explored)
        if decision.reason and not decision.robots:
            self._settled.setdefault(topic, (int(decision.step), decision.reason))
            self._note_ending(int(decision.step))

    def _note_ending(self, step: int) -> None:
        """Note the end of the search: of the planners with a robot, all see nothing left."""
        if self._ending is not None:
            return
        searching = {
            topic
            for topic, names in self._robots_of.items()
            if any(self._takes_part(name) for name in names)
        }
        # When all robots are gone, nobody says any more that the rest of the search is in vain.
        if self._settled.keys() >= (searching or self._robots_of.keys()):
            last, reason = max(self._settled.values())
            self._ending = max(step, last), reason

    def _takes_part(self, name: str) -> bool:
        if self._team is not None:
            return name in self._team
        states = self._kept[f'/{name}/state']
        return not states or self._decode(states[-1], 'AgentState').goal_status != UNAVAILABLE

    def _time(self, stamp: Any) -> float:
        return seconds(stamp) - (self._begin or 0.0)

    def _note_team(self, step: Any) -> None:
        if self._begin is None:
            self._begin = self._tally.begin = seconds(step.stamp)
        team = list(step.robots)
        if self._team is not None and team != self._team:
            time = self._time(step.stamp)
            self._note_changes(self.events, time, self._team, team)
        changed = team != self._team
        self._team = team
        if changed and self._settled:
            self._note_ending(int(step.step))

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
        tally = self._final_tally()
        last_step = None
        if tally.completed is not None:
            end_time, last_step = tally.completed.time, tally.completed.step
        record = RunRecord(
            self.name,
            self.scenario,
            self.seed,
            tally.truth,
            found=tally.found,
            progress=list(tally.progress),
            measurements={name: tally.measurements[name] for name in sorted(tally.measurements)},
            end_reason=end_reason,
            end_time=end_time,
            wall_time=wall_time,
            expected_number=tally.expected_number,
        )
        self._add_decisions(record, last_step)
        lost: list[dict[str, Any]] = []
        for topic, name in self._state_topics.items():
            states = [self._decode(data, 'AgentState') for data in self._kept[topic]]
            states = [state for state in states if self._time(state.header.stamp) <= end_time]
            record.trajectories[name] = _rows(
                [(self._time(s.header.stamp), *_point(s.pose.pose.position)) for s in states], 4
            )
            if self._team is None:
                lost += _absences(name, states)
        for topic, name in self._detection_topics.items():
            arrays = [self._decode(data, 'DetectionArray') for data in self._kept[topic]]
            record.measured_at[name] = _rows(
                [
                    _point(item.pose.pose.position)
                    for item in arrays
                    if item.batch_id and self._time(item.header.stamp) <= end_time
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
        for topic in self._decision_topics:
            explored = 0.0
            for data in self._kept[topic]:
                decision = self._decode(data, 'PlanDecision')
                if last_step is not None and decision.step > last_step:
                    break
                explored = float(decision.explored)
                for robot in decision.robots:
                    if robot.chosen >= 0:
                        record.decisions += 1
                        waypoints.setdefault(robot.robot, []).append(_point(robot.waypoint))
            record.explored = max(record.explored, explored)
        record.waypoints = {name: _rows(points, 3) for name, points in waypoints.items()}


def observe_bag(bag: Bag, name: str, scenario: Scenario, seed: int) -> RunObserver:
    """Return the observer of a recorded run, having seen all of it."""
    observer = RunObserver(name, scenario, seed, bag.store)
    for topic, _, _, data in bag.raw(observer.topics):
        observer.add(topic, data)
        if topic in observer.update_topics:
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
