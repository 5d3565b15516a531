"""The interface between a run and its mission: a search for targets, or of buildings."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol, TypeVar

from rosbags.typesys.store import Typestore

from maasi_sim.run.node_plan import NodePlan, RunSettings
from maasi_sim.run.run_record import Observer, RunRecord

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Record = TypeVar('Record', bound=RunRecord, contravariant=True)


class Mission(Protocol[Record]):
    """A kind of search: scenario, nodes, observer and report."""

    #: Name of the scenario, and the scenario with all layers.
    name: str
    scenario: Any
    #: Word for a success in the progress line.
    found_word: str

    def prepare(self) -> None:
        """Assign addresses on this host to simulated robots."""
        return None

    def plan_nodes(self, run: RunSettings) -> list[NodePlan]:
        """Return the nodes to start."""

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
