"""What a run needs of its mission: nodes, record, report."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

import numpy as np
from rosbags.typesys.store import Typestore

from maasi_filter.arrays import FloatArray
from maasi_sim.run.topics import STEP, seconds

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    # These need ROS; a search in one process has records, too.
    from maasi_sim.run.node_plan import NodePlan
    from maasi_sim.run.run_options import Options
    from maasi_sim.scenario.preflight import Preflight

UNAVAILABLE = 5  # goal status of `AgentState`


@dataclass(frozen=True)
class RunEnd:
    """How a run ended."""

    reason: str  # a key of `END_REASONS`
    time: float  # simulated [s]
    wall_time: float  # from the first step [s]
    events: list[dict[str, Any]] = field(default_factory=list)


@dataclass
class RunRecord:
    """Data of the reports of all kinds of runs; trajectories are time [s], x, y, z [m], (n, 4)."""

    name: str
    scenario: Any
    seed: int
    trajectories: dict[str, FloatArray] = field(default_factory=dict, kw_only=True)
    events: list[dict[str, Any]] = field(default_factory=list, kw_only=True)
    end_reason: str = field(default='', kw_only=True)
    end_time: float = field(default=0.0, kw_only=True)
    wall_time: float = field(default=0.0, kw_only=True)


class Observer(ABC):
    """Gathers the data of a report from serialised messages, and detects the end of the run."""

    #: Of the needed `topics`, filter updates: added after the messages they refer to.
    update_topics: Sequence[str] = ()
    #: Targets there are; true and false ones found so far; measurements of all robots.
    total = found = false_found = measurements = 0
    explored = 0.0  #: share of the environment explored
    news = False  #: whether something was found since the caller last reset it
    completed: Any = None  #: time and step at which all was found, where the scenario stops then
    settled: str | None = None  #: the reason, once all planners report that nothing is left to gain
    end_step: int | None = None  #: step at which the search ended by itself
    #: Time of the first step [s]: a clock that the run follows may start at any time.
    begin: float | None = None
    robots: list[str] | None = None  #: that take part, as the simulation says

    def __init__(
        self, name: str, scenario: Any, seed: int, types: Typestore, topics: Sequence[str]
    ) -> None:
        self.name, self.scenario, self.seed, self._types = name, scenario, seed, types
        self._events: list[dict[str, Any]] = []
        self._states: dict[str, list[bytes]] = {f'/{name}/state': [] for name in scenario.names()}
        self.topics = [STEP, *topics, *self._states]

    def add(self, topic: str, data: bytes) -> None:
        """Add a serialised message; one of another topic is ignored."""
        if topic in self._states:
            self._states[topic].append(data)
        elif topic == STEP and self.completed is None:
            self._note_step(self.decode(data, 'LockstepStep'))

    def last_steps(self) -> dict[str, int]:
        """Return the step of the last state of each robot that has sent one."""
        return {
            name: int(self.decode(states[-1], 'AgentState').step)
            for name, states in zip(self.scenario.names(), self._states.values())
            if states
        }

    def settle(self) -> None:  # noqa: B027 - missions that evaluate at the end need none
        """Evaluate the messages added since the last call."""

    def rests_on(self, topic: str, data: bytes, last_step: int) -> bool:
        """Return whether an update up to a step used this measurement, which may be later."""
        return False

    def lacking(self, last_step: int) -> list[str]:
        """Return in words the measurements of updates up to a step that have not arrived."""
        return []

    @abstractmethod
    def record(self, end: RunEnd) -> Any:
        """Return the record of the run, up to the step at which all was found."""

    def decode(self, data: bytes, name: str) -> Any:
        """Return a message of `maasi_msgs`."""
        return self._types.deserialize_cdr(data, f'maasi_msgs/msg/{name}')

    def time(self, stamp: Any) -> float:
        """Return the time since the first step [s]."""
        return seconds(stamp) - (self.begin or 0.0)

    def _note_step(self, step: Any) -> None:
        if self.begin is None:
            self.begin = seconds(step.stamp)
        before, self.robots = self.robots, list(step.robots)
        if before is not None:
            now, time = set(self.robots), self.time(step.stamp)
            for word, names in (('lost', set(before) - now), ('joined', now - set(before))):
                for name in sorted(names):
                    self._events.append({'time': time, 'agent': name, 'event': word})

    def _until(self, kind: str, messages: Iterable[bytes], end: float) -> Iterator[Any]:
        """Yield messages up to a time [s]; all at once would take much memory."""
        for data in messages:
            item = self.decode(data, kind)
            if self.time(item.header.stamp) <= end:
                yield item

    def _complete(self, record: RunRecord, end: RunEnd) -> None:
        record.end_reason, record.wall_time = end.reason, end.wall_time
        # Several steps after the end may have been taken.
        own = [event for event in self._events if event['time'] <= record.end_time]
        events = [*record.events, *own]
        for name, messages in zip(self.scenario.names(), self._states.values()):
            way, away = [], False
            for state in self._until('AgentState', messages, record.end_time):
                time, place = self.time(state.header.stamp), state.pose.pose.position
                way.append((time, place.x, place.y, place.z))
                if self.robots is None and (state.goal_status == UNAVAILABLE) != away:
                    away = not away
                    word = 'lost' if away else 'joined'
                    events.append({'time': time, 'agent': name, 'event': word})
                    if away and state.reason:
                        events[-1]['reason'] = state.reason
            record.trajectories[name] = rows(way, 4)
        record.events = sorted([*events, *end.events], key=lambda event: float(event['time']))


def rows(values: list[Any], width: int) -> FloatArray:
    """Return rows as an array, (0, width) without any."""
    return np.array(values, dtype=float).reshape(-1, width)


Record = TypeVar('Record', bound=RunRecord, contravariant=True)


class Mission(Protocol[Record]):
    """A kind of search: scenario, nodes, observer and report."""

    #: Name of the scenario, and the scenario with all layers.
    name: str
    scenario: Any
    found_word: str  #: word for a success in the progress line

    def prepare(self) -> None:
        """Assign addresses on this host to simulated robots."""
        return None

    def plan_nodes(self, options: Options, file: Path) -> list[NodePlan]:
        """Return the nodes to start; `file` is the scenario with all layers."""

    def preflight(self) -> Preflight:
        """Return what the search will take."""

    def warning(self) -> str:
        """Return a warning about the scenario, or an empty text; takes a while."""
        return ''

    def observer(self, types: Typestore) -> Observer:
        """Return the observer of a run."""

    def report(self, record: Record) -> dict[str, Any]:
        """Return the report as plain values."""

    def tables(self, record: Record) -> dict[str, str]:
        """Return further files of the report: their text by name."""
        return {}

    def summary(self, report: dict[str, Any]) -> str:
        """Return a report in a few lines."""

    def figure(self, record: Record) -> Figure:
        """Return the figure of the report."""


@dataclass(frozen=True)
class MissionKind:
    """A kind of mission other than a search for targets: what it is, in words."""

    what: str
    make: Callable[..., Mission[Any]]  #: of a name, a layer of a scenario, and overrides
    warm_up: Callable[[], object]  #: compiles the kernels of its simulation


#: By the name of their planner; each registers itself in its module `<folder>/<name>_mission.py`.
MISSIONS: dict[str, MissionKind] = {}
