"""What a run needs of a mission: nodes, record, report."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

from rosbags.serde import SerdeError
from rosbags.typesys.store import Typestore

from maasi_sim.run.facts import Fact, Said
from maasi_sim.run.log import RunEnd, RunRecord
from maasi_sim.run.message_facts import MessageFacts
from maasi_sim.run.topics import STEP

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    # These need ROS; a search in one process does not.
    from maasi_sim.run.node_plan import NodePlan
    from maasi_sim.run.run_options import Options
    from maasi_sim.scenario.preflight import Preflight


class Observer:
    """Builds the record of a run from serialised messages and detects its end."""

    #: Topics of filter updates, which are added after the messages they refer to.
    update_topics: Sequence[str] = ()
    #: Number of targets; true and false finds; measurements of all robots.
    total = found = false_found = measurements = 0
    explored = 0.0  #: share of the environment explored
    news = False  # whether targets were found since the caller reset it
    completed: Any = None  # time and step of the last find, if the scenario stops then
    settled: str | None = None  # the reason, after all planners have finished
    end_step: int | None = None  # step at which the search ended by itself

    def __init__(self, log: RunRecord, types: Typestore, kinds: Mapping[str, str]) -> None:
        self.log, self._types = log, types
        scenario = log.scenario
        states = {f'/{name}/state': 'AgentState' for name in scenario.names()}
        self._kinds = {
            topic: f'maasi_msgs/msg/{kind}'
            for topic, kind in {STEP: 'LockstepStep', **kinds, **states}.items()
        }
        self.topics = list(self._kinds)
        self.complaints: list[str] = []  # reasons of dropped messages
        self._facts = MessageFacts(True, scenario.names(), len(scenario.environment.array()))

    def kind(self, topic: str) -> str:
        """Return the type of the messages of a topic."""
        return self._kinds[topic]

    def add(self, topic: str, data: bytes) -> None:
        """Add a serialised message, if its topic is one of `topics`."""
        if topic in self._kinds:
            kind = self._kinds[topic]
            try:
                message = self._types.deserialize_cdr(data, kind)
            except SerdeError:
                facts = self._facts.drop(topic, f'it is not a {kind}')
            else:
                facts = self._facts.of(topic, kind, message)
            for fact in facts:
                if isinstance(fact, Said) and fact.level == 'warning':
                    self.complaints.append(f'{fact.source}: {fact.text}')
                self.handle(fact)

    def handle(self, fact: Fact) -> None:
        """Add a fact of a message."""
        self.log.add(fact)

    def settle(self) -> None:
        """Evaluate the messages added since the last call."""

    def rests_on(self, topic: str, data: bytes, last_step: int) -> bool:
        """Return whether an update up to a step used this measurement, even if it arrives later."""
        return False

    def lacking(self, last_step: int) -> list[str]:
        """Return the missing measurements of updates up to a step, as text."""
        return []

    def record(self, end: RunEnd) -> RunRecord:
        """Return the record of the run, up to the step at which all was found."""
        self.log.close(end, end.time)
        return self.log


Record = TypeVar('Record', bound=RunRecord, contravariant=True)


class Mission(Protocol[Record]):
    """A kind of search: scenario, nodes, observer and report."""

    #: Name of the scenario, and the scenario with all layers.
    name: str
    scenario: Any
    found_word: str  # past participle for the progress line

    def prepare(self) -> None:
        """Assign addresses on this host to simulated robots."""
        return None

    def plan_nodes(self, options: Options, file: Path) -> list[NodePlan]:
        """Return the nodes to start; `file` is the scenario with all layers."""

    def preflight(self) -> Preflight:
        """Return the estimate of the search."""

    def warning(self) -> str:
        """Return a warning about the scenario, or an empty text; slow."""
        return ''

    def observer(self, types: Typestore) -> Observer:
        """Return the observer of a run."""

    def report(self, record: Record) -> dict[str, Any]:
        """Return the report as plain values."""

    def tables(self, record: Record) -> dict[str, str | bytes]:
        """Return the contents of further report files, by name."""
        return {}

    def summary(self, report: dict[str, Any]) -> str:
        """Return a report in a few lines."""

    def figure(self, record: Record) -> Figure:
        """Return the figure of the report."""


@dataclass(frozen=True)
class MissionKind:
    """A kind of mission other than a target search."""

    what: str
    make: Callable[..., Mission[Any]]  # from a name, a scenario layer and overrides


#: By planner name; each registers itself in its module `<folder>/<name>_mission.py`.
MISSIONS: dict[str, MissionKind] = {}
