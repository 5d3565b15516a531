"""Nodes, observer and report of a search of buildings."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from rosbags.typesys.store import Typestore

from maasi_filter.ros.parameters import flatten
from maasi_filter.wording import counted, number, point
from maasi_planner.buildings.settings import CuboidPlannerSettings
from maasi_sim.run.buildings.observer import (
    CuboidObserver,
    CuboidRecord,
    build_cuboid_report,
    cuboid_summary,
)
from maasi_sim.run.buildings.scenario import (
    NAME,
    CuboidScenario,
    check_cuboid_scenario,
)
from maasi_sim.run.mission import MISSIONS, Mission, MissionKind
from maasi_sim.run.node_plan import SIMULATED, NodePlan, common_parameters, guard_plan, sim_plan
from maasi_sim.run.run_options import Options
from maasi_sim.scenario.preflight import Preflight

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class BuildingMission(Mission[CuboidRecord]):
    """See `Mission`. All links are topics, and planners simulate the snapshots."""

    found_word = 'visited'

    def __init__(self, name: str, scenario: CuboidScenario) -> None:
        self.name, self.scenario = name, scenario

    def preflight(self) -> Preflight:
        """See `Mission.preflight`."""
        scenario = self.scenario
        sides = (scenario.environment.array() @ [-1.0, 1.0]).tolist()
        starts = [
            f'{name}: starts at {point(robot.start)} m' for name, robot in scenario.robots.items()
        ]
        cuboids = len(scenario.mission().cells)
        return Preflight(
            [
                f'space: {" x ".join(map(number, sides))} m, {counted(cuboids, "cuboid")} to visit',
                *starts,
                f'the time limit is {number(scenario.limits.time)} s',
            ]
        )

    def plan_nodes(self, options: Options, file: Path) -> list[NodePlan]:
        """Return the simulation and a planner for each robot, outside of lockstep also a guard."""
        scenario = self.scenario
        common = common_parameters(scenario, options)
        plans = [sim_plan('cuboid_sim_node', scenario, options, file)]
        for name in scenario.names():
            plans.append(_planner_plan(name, scenario, common))
            if not options.lockstep:
                # It plans once per step, and a command is valid for one step.
                plans.append(guard_plan(name, common, scenario.step))
        return plans

    def observer(self, types: Typestore) -> CuboidObserver:
        """See `Mission.observer`."""
        return CuboidObserver(self.name, self.scenario, self.scenario.seed, types)

    report = staticmethod(build_cuboid_report)
    summary = staticmethod(cuboid_summary)

    def figure(self, record: CuboidRecord) -> Figure:
        """See `Mission.figure`."""
        # Deferred: Matplotlib takes long to import.
        from maasi_sim.run.buildings.report_figure import plot_cuboid_report

        return plot_cuboid_report(record)


MISSIONS[NAME] = MissionKind(
    'a search of buildings',
    lambda name, *values: BuildingMission(name, check_cuboid_scenario(*values)),
)


def _planner_plan(name: str, scenario: CuboidScenario, common: dict[str, Any]) -> NodePlan:
    robot, search = scenario.robots[name], scenario.planner
    floor = float(scenario.environment.array()[2, 0])
    settings = CuboidPlannerSettings.model_validate(
        {
            **common,
            'environment': scenario.environment,
            'team': scenario.names(),
            'start': robot.start,
            'yaw': robot.yaw,
            'dynamics': robot.dynamics,
            'hazard': robot.hazard,
            'planner': search.model_dump(exclude={'name', 'objects', 'obstacles'}),
            'objects': [item.numbers(floor) for item in search.objects],
            'faces': [' '.join(item.faces) for item in search.objects],
            'obstacles': [item.numbers(floor) for item in search.obstacles],
        }
    )
    return NodePlan(
        'maasi_planner',
        'cuboid_planner_node',
        'cuboid_planner',
        name,
        {**flatten(settings), **SIMULATED},
        given={'search_on_start': True},
        role='driver',
    )
