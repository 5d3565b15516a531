"""Which nodes a search for targets needs, with their parameters."""

from __future__ import annotations

import subprocess
import sys
from importlib.util import find_spec
from typing import Any

from maasi_drivers.agent.driver_settings import DRIVERS, DriverSettings
from maasi_filter.ros.node_settings import FilterNodeSettings
from maasi_filter.ros.parameters import flatten
from maasi_sim.run.node_plan import SIMULATED, NodePlan, RunSettings, guard_plan, sim_plan
from maasi_sim.run.topics import BATCH, DECISIONS, FOUND, UPDATE, within
from maasi_sim.scenario.layering import ScenarioError
from maasi_sim.scenario.schema import RobotSettings, Scenario, planner_settings


def plan_nodes(scenario: Scenario, run: RunSettings) -> list[NodePlan]:
    """Return the simulation, drivers and guards, filters and planners.

    Raises
    ------
    ScenarioError
        If a link cannot keep this pace.
    """
    scenario.check_pace(run.lockstep, run.rate)
    common = run.common(scenario)
    plans = [sim_plan('sim_node', scenario, run)]
    for name in scenario.names():
        plans += _robot_plans(name, scenario.robots[name], scenario, common)
    for namespace, names in scenario.namespaces().items():
        plans += _team_plans(namespace, names, scenario, common)
    return plans


def _team_plans(
    namespace: str, names: list[str], scenario: Scenario, common: dict[str, Any]
) -> list[NodePlan]:
    """Return filter and planner of robots that share them."""
    others = [name for name in scenario.names() if name not in names]
    filter_settings = FilterNodeSettings.model_validate(
        {
            **common,
            'environment': scenario.environment.of_nodes(),
            'filter': scenario.filter,
            'robots': {name: {'sensor': scenario.robots[name].sensor} for name in names},
            'share_with': others,
        }
    )
    return [
        NodePlan(
            'maasi_filter',
            'filter_node',
            'filter_node',
            namespace,
            {**flatten(filter_settings.resolved()), **SIMULATED},
            topics=(within(namespace, UPDATE), within(namespace, FOUND)),
        ),
        NodePlan(
            'maasi_planner',
            'planner_node',
            'planner_node',
            namespace,
            {**flatten(planner_settings(scenario, names, common)), **SIMULATED},
            topics=(within(namespace, DECISIONS), within(namespace, BATCH)),
            given={'search_on_start': True},
        ),
    ]


def _plugin(name: str, driver: str, scenario: Scenario) -> tuple[str, ...]:
    """Return the arguments of `plugin_driver` for a driver of a user's own.

    Raises
    ------
    ScenarioError
        If it cannot be loaded. Another process tries: rclpy starts threads, and this one forks.
    """
    if driver in DRIVERS.own:
        return ()
    arguments = (driver, *scenario.plugin_path)
    command = [sys.executable, '-m', 'maasi_drivers.plugin_driver', '--check', *arguments]
    tried = subprocess.run(command, capture_output=True, text=True, check=False)
    if tried.returncode:
        lines = tried.stderr.strip().splitlines() or ['it cannot be loaded']
        raise ScenarioError(f'robots.{name}.driver: {lines[-1].removeprefix("error: ")}')
    return arguments


def _robot_plans(
    name: str, robot: RobotSettings, scenario: Scenario, common: dict[str, Any]
) -> list[NodePlan]:
    """Return a robot's driver, and its guard if it has one."""
    settings = DriverSettings.model_validate(
        {
            **common,
            'environment': scenario.environment.of_nodes(),
            'start': robot.start,
            'yaw': robot.yaw,
            'radius': robot.radius,
            'motion': robot.motion,
            'sensor': robot.sensor,
            'camera': robot.camera,
            'battery_unit': robot.battery_unit,
            'link': robot.link,
            'mambo': robot.mambo if robot.link == 'mambo_wifi' else None,
            'mavlink': robot.mavlink if robot.link == 'mavlink' else None,
        }
    )
    topics = ['state', 'detections', 'robot_description']
    if robot.link == 'topics':
        topics.append('cmd_vel')
    # Published by several robots; without its package there are no transforms.
    has_transforms = settings.poses != 'tf' and find_spec('tf2_msgs') is not None
    shared = ('/tf',) if has_transforms else ()
    own = name in scenario.namespaces()
    plans = [
        NodePlan(
            'maasi_drivers',
            robot.driver if robot.driver in DRIVERS.own else 'plugin_driver',
            'driver',
            name,
            {**flatten(settings), **SIMULATED},
            # A robot with its own planner gets its batches from that one.
            remaps={BATCH: within(name, BATCH)} if own else {},
            topics=(*(f'/{name}/{topic}' for topic in topics), *shared),
            drives=True,
            arguments=_plugin(name, robot.driver, scenario),
        )
    ]
    guarded = robot.link == 'topics' if robot.guard is None else robot.guard
    if guarded:
        plans.append(guard_plan(name, common, 0.0))
    return plans
