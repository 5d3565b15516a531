"""A search of buildings, as a run sees it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rosbags.typesys.store import Typestore

from maasi_sim.buildings.nodes import plan_nodes
from maasi_sim.buildings.observer import CuboidObserver, CuboidRecord
from maasi_sim.buildings.report import build_cuboid_report, cuboid_summary
from maasi_sim.buildings.scenario import CuboidScenario
from maasi_sim.run.node_plan import NodePlan, RunSettings
from maasi_sim.warm_up import warm_up_buildings

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class BuildingMission:
    """See `Mission`.

    Parameters
    ----------
    name : str
        Of the scenario.
    scenario : CuboidScenario
        With all layers.
    """

    found_word = 'visited'

    def __init__(self, name: str, scenario: CuboidScenario) -> None:
        self.name = name
        self.scenario = scenario

    def prepare(self) -> None:
        """Do nothing: all links are topics."""

    def plan_nodes(self, run: RunSettings) -> list[NodePlan]:
        """See `Mission.plan_nodes`."""
        return plan_nodes(self.scenario, run)

    def warm_up(self) -> None:
        """See `Mission.warm_up`."""
        warm_up_buildings()

    def cameras(self) -> list[str]:
        """Return nothing: snapshots are simulated by the planners."""
        return []

    def taking_off(self) -> list[str]:
        """Return nothing: robots are in the air at the start."""
        return []

    def external(self) -> list[str]:
        """Return nothing: all robots are simulated."""
        return []

    def warning(self) -> str:
        """Return nothing."""
        return ''

    def observer(self, types: Typestore) -> CuboidObserver:
        """See `Mission.observer`."""
        return CuboidObserver(self.name, self.scenario, self.scenario.seed, types)

    def report(self, record: CuboidRecord) -> dict[str, Any]:
        """See `Mission.report`."""
        return build_cuboid_report(record)

    def tables(self, record: CuboidRecord) -> dict[str, str]:
        """See `Mission.tables`."""
        return {}

    def summary(self, report: dict[str, Any]) -> str:
        """See `Mission.summary`."""
        return cuboid_summary(report)

    def figure(self, record: CuboidRecord) -> Figure:
        """See `Mission.figure`."""
        # Deferred: Matplotlib takes long to import.
        from maasi_sim.buildings.report_figure import plot_cuboid_report

        return plot_cuboid_report(record)
