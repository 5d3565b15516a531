"""A search of buildings, as a run sees it: its nodes, observer and report."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rosbags.typesys.store import Typestore

from maasi_filter.ros.parameters import flatten
from maasi_planner.buildings.settings import CuboidPlannerSettings, box_numbers, face_words
from maasi_sim.buildings.observer import CuboidObserver, CuboidRecord
from maasi_sim.buildings.report import build_cuboid_report, cuboid_summary
from maasi_sim.buildings.scenario import CuboidScenario
from maasi_sim.run.node_plan import SIMULATED, NodePlan, RunSettings, guard_plan, sim_plan

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class BuildingMission:
    """See `Mission`."""

    found_word = 'visited'

    def __init__(self, name: str, scenario: CuboidScenario) -> None:
        self.name = name
        self.scenario = scenario

    def prepare(self) -> None:
        """Do nothing: all links are topics."""

    def plan_nodes(self, run: RunSettings) -> list[NodePlan]:
        """See `Mission.plan_nodes`."""
        return plan_nodes(self.scenario, run)

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


def plan_nodes(scenario: CuboidScenario, run: RunSettings) -> list[NodePlan]:
    """Return the simulation, and for each robot a planner and a guard."""
    common = run.common(scenario)
    plans = [sim_plan('cuboid_sim_node', scenario, run)]
    for name in scenario.names():
        plans.append(_planner_plan(name, scenario, common))
        # It plans once per step, and a command is valid for one step.
        plans.append(guard_plan(name, common, scenario.step))
    return plans


def _planner_plan(name: str, scenario: CuboidScenario, common: dict[str, Any]) -> NodePlan:
    """Return the planner of a robot that searches buildings for itself."""
    robot, search = scenario.robots[name], scenario.planner
    floor = float(scenario.environment.array()[2, 0])
    settings = CuboidPlannerSettings.model_validate(
        {
            **common,
            'environment': scenario.environment.of_nodes(),
            'start': robot.start,
            'yaw': robot.yaw,
            'dynamics': robot.dynamics,
            'hazard': robot.hazard,
            'planner': search.model_dump(exclude={'name', 'objects', 'obstacles'}),
            'objects': [box_numbers(item, floor) for item in search.objects],
            'faces': [face_words(item) for item in search.objects],
            'obstacles': [box_numbers(item, floor) for item in search.obstacles],
        }
    )
    return NodePlan(
        'maasi_planner',
        'cuboid_planner_node',
        'cuboid_planner',
        name,
        {**flatten(settings), **SIMULATED},
        given={'search_on_start': True},
        drives=True,
    )
