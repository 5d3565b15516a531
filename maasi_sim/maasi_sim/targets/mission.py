"""A search for targets, as a run sees it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rosbags.typesys.store import Typestore

from maasi_filter.settings import unsuitable_lengths, unused_settings
from maasi_sim.emulators.linked_robots import with_addresses
from maasi_sim.run.node_plan import NodePlan, RunSettings
from maasi_sim.scenario.schema import Scenario
from maasi_sim.scenario.visibility import never_seen
from maasi_sim.targets.found_table import csv_text, found_rows, geojson_text
from maasi_sim.targets.nodes import plan_nodes
from maasi_sim.targets.observer import TargetObserver
from maasi_sim.targets.report import build_report, summary
from maasi_sim.targets.target_record import TargetRecord
from maasi_sim.warm_up import warm_up_search

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class TargetMission:
    """See `Mission`.

    Parameters
    ----------
    name : str
        Of the scenario.
    scenario : Scenario
        With all layers.
    """

    found_word = 'found'

    def __init__(self, name: str, scenario: Scenario) -> None:
        self.name = name
        self.scenario = scenario

    def prepare(self) -> None:
        """See `Mission.prepare`."""
        self.scenario = with_addresses(self.scenario)

    def plan_nodes(self, run: RunSettings) -> list[NodePlan]:
        """See `Mission.plan_nodes`."""
        return plan_nodes(self.scenario, run)

    def warm_up(self) -> None:
        """See `Mission.warm_up`."""
        warm_up_search()

    def cameras(self) -> list[str]:
        """See `Mission.cameras`."""
        robots = self.scenario.robots
        return [name for name in self.scenario.names() if robots[name].camera is not None]

    def taking_off(self) -> list[str]:
        """See `Mission.taking_off`."""
        return [name for name, robot in self.scenario.robots.items() if robot.takes_off]

    def external(self) -> list[str]:
        """See `Mission.external`."""
        return [
            name
            for name, robot in self.scenario.robots.items()
            if robot.external and robot.link != 'topics'
        ]

    def warning(self) -> str:
        """See `Mission.warning`."""
        settings = self.scenario.filter
        lengths = unsuitable_lengths(settings, self.scenario.environment.array())
        warnings = never_seen(self.scenario), lengths, unused_settings(settings)
        return '\n'.join(filter(None, warnings))

    def observer(self, types: Typestore) -> TargetObserver:
        """See `Mission.observer`."""
        return TargetObserver(self.name, self.scenario, self.scenario.seed, types)

    def report(self, record: TargetRecord) -> dict[str, Any]:
        """See `Mission.report`."""
        return build_report(record)

    def tables(self, record: TargetRecord) -> dict[str, str]:
        """See `Mission.tables`."""
        origin = self.scenario.environment.origin
        rows = found_rows(record.found, record.truth, record.scores().match.pairs, origin)
        files = {'found_targets.csv': csv_text(rows, record.scenario.dimension, origin)}
        if origin is not None:
            files['found_targets.geojson'] = geojson_text(rows)
        return files

    def summary(self, report: dict[str, Any]) -> str:
        """See `Mission.summary`."""
        return summary(report)

    def figure(self, record: TargetRecord) -> Figure:
        """See `Mission.figure`."""
        # Deferred: Matplotlib takes long to import.
        from maasi_sim.targets.report_figure import plot_report

        return plot_report(record)
