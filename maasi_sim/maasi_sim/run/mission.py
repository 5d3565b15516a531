"""What a run needs of its mission: nodes, record, report."""

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

    # These need ROS; a search in one process has records, too.
    from maasi_sim.run.node_plan import NodePlan
    from maasi_sim.run.run_options import Options
    from maasi_sim.scenario.preflight import Preflight


class Observer:
    """Writes the record of a run from serialised messages, and detects the end of the run.

    Topics are those of `kinds`, by their type; further ones are not needed.
    """

    #: Of the needed `topics`, filter updates: added after the messages they refer to.
    update_topics: Sequence[str] = ()
    #: Targets there are; true and false ones found so far; measurements of all robots.
    total = found = false_found = measurements = 0
    explored = 0.0  #: share of the environment explored
    news = False  #: whether something was found since the caller last reset it
    completed: Any = None  #: time and step at which all was found, where the scenario stops then
    settled: str | None = None  #: the reason, once all planners report that nothing is left to gain
    end_step: int | None = None  #: step at which the search ended by itself

    def __init__(self, log: RunRecord, types: Typestore, kinds: Mapping[str, str]) -> None:
        self.log, self._types = log, types
        scenario = log.scenario
        states = {f'/{name}/state': 'AgentState' for name in scenario.names()}
        self._kinds = {
            topic: f'maasi_msgs/msg/{kind}'
            for topic, kind in {STEP: 'LockstepStep', **kinds, **states}.items()
        }
        self.topics = list(self._kinds)
        self.complaints: list[str] = []  #: messages that were dropped, in words
        self._facts = MessageFacts(True, scenario.names(), len(scenario.environment.array()))

    def kind(self, topic: str) -> str:
        """Return the type of the messages of a topic."""
        return self._kinds[topic]

    def add(self, topic: str, data: bytes) -> None:
        """Add a serialised message; one of another topic is ignored."""
        if topic in self._kinds:
            kind = self._kinds[topic]
            try:
                message = self._types.deserialize_cdr(data, kind)
            except SerdeError:
                facts = self._facts.drop(topic, f'it is no {kind}')
            else:
                facts = self._facts.of(topic, kind, message)
            for fact in facts:
                if isinstance(fact, Said) and fact.level == 'warning':
                    self.complaints.append(f'{fact.source}: {fact.text}')
                self.handle(fact)

    def handle(self, fact: Fact) -> None:
        """Take a fact of a message."""
        self.log.add(fact)

    def settle(self) -> None:
        """Evaluate the messages added since the last call."""

    def rests_on(self, topic: str, data: bytes, last_step: int) -> bool:
        """Return whether an update up to a step used this measurement, which may be later."""
        return False

    def lacking(self, last_step: int) -> list[str]:
        """Return in words the measurements of updates up to a step that have not arrived."""
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


#: By the name of their planner; each registers itself in its module `<folder>/<name>_mission.py`.
MISSIONS: dict[str, MissionKind] = {}
