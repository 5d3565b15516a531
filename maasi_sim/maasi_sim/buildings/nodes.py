"""Which nodes a search of buildings needs, with their parameters."""

from __future__ import annotations

from typing import Any

from maasi_filter.ros.parameters import flatten
from maasi_planner.buildings.node_settings import CuboidPlannerSettings, box_numbers, face_words
from maasi_sim.buildings.scenario import CuboidScenario
from maasi_sim.run.node_plan import SIMULATED, NodePlan, RunSettings, guard_plan, sim_plan


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
        topics=tuple(f'/{name}/{topic}' for topic in ('state', 'decision', 'cmd_vel', 'link/tx')),
        given={'search_on_start': True},
        drives=True,
    )
