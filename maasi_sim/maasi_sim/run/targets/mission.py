"""Nodes, observer and report of a search for targets."""

from __future__ import annotations

import subprocess
import sys
from datetime import datetime, timezone
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rosbags.typesys.store import Typestore

from maasi_drivers.settings.driver import DRIVERS, PLATFORM_LINKS, DrivenRobot, DriverSettings
from maasi_filter.ros.node_settings import FilterNodeSettings
from maasi_filter.ros.parameters import flatten
from maasi_filter.settings import unsuitable_lengths, unused_settings
from maasi_sim.run.log import RunLog
from maasi_sim.run.node_plan import SIMULATED, NodePlan, common_parameters, guard_plan, sim_plan
from maasi_sim.run.run_options import Options
from maasi_sim.run.targets.exports import map_files
from maasi_sim.run.targets.observer import TargetObserver
from maasi_sim.run.targets.report import build_report, explored_after, target_summary
from maasi_sim.run.targets.tables import (
    collection,
    csv_text,
    cut_at_180,
    found_geojson,
    found_rows,
    searched,
)
from maasi_sim.run.topics import BATCH, within
from maasi_sim.scenario.checks import never_seen
from maasi_sim.scenario.layering import ScenarioError
from maasi_sim.scenario.preflight import Preflight, preflight
from maasi_sim.scenario.schema import RobotSettings, Scenario, planner_settings
from maasi_sim.simulation.emulators.linked_robots import with_addresses

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_BATCH_TIMEOUT = 3.0  # upper limit: planners hold robots after 4 s without an update [s]
_LOCKSTEP_TF_RATE = 4.0  # of the robots' frames in lockstep, where each message takes time [Hz]


class TargetMission:
    """See `Mission`."""

    found_word = 'found'

    def __init__(self, name: str, scenario: Scenario) -> None:
        self.name, self.scenario = name, scenario

    def prepare(self) -> None:
        """See `Mission.prepare`."""
        self.scenario = with_addresses(self.scenario)

    def plan_nodes(self, options: Options, file: Path) -> list[NodePlan]:
        """Return the simulation, drivers and guards, filters and planners."""
        scenario = self.scenario
        scenario.check_pace(options.lockstep, options.rate)
        common = common_parameters(scenario, options)
        plans = [sim_plan('sim_node', scenario, options, file)]
        state = file.parent / 'state'
        for name in scenario.names():
            plans += _robot_plans(name, scenario.robots[name], scenario, common)
        for namespace, names in scenario.namespaces().items():
            plans += _team_plans(namespace, names, scenario, common, state)
        return plans

    def preflight(self) -> Preflight:
        """See `Mission.preflight`."""
        return preflight(self.scenario)

    def warning(self) -> str:
        """See `Mission.warning`."""
        settings = self.scenario.filter
        lengths = unsuitable_lengths(settings, self.scenario.environment.array())
        return '\n'.join(
            filter(None, (never_seen(self.scenario), lengths, unused_settings(settings)))
        )

    def observer(self, types: Typestore) -> TargetObserver:
        """See `Mission.observer`."""
        return TargetObserver(self.name, self.scenario, self.scenario.seed, types)

    report = staticmethod(build_report)
    summary = staticmethod(target_summary)

    def tables(self, record: RunLog) -> dict[str, str | bytes]:
        """See `Mission.tables`."""
        origin = self.scenario.environment.origin
        rows = found_rows(record.found_targets, record.truth, record.pairs, origin)
        explored = explored_after(record)
        # Deferred: Matplotlib takes long to import.
        from maasi_sim.run.targets.report_sheet import report_pdf

        files: dict[str, str | bytes] = {
            'found_targets.csv': csv_text(rows, record.scenario.dimension, origin),
            'report.pdf': report_pdf(record, explored),
        }
        if origin is not None:
            features = searched(record, explored, origin)
            files['found_targets.geojson'] = found_geojson(rows)
            files['ways.geojson'] = collection(cut_at_180(features))
            now = datetime.now(timezone.utc)
            paths = record.planned_paths()
            made = map_files(self.name, rows, features, paths, explored, origin, now)
            files |= {f'map_files/{name}': content for name, content in made.items()}
        return files

    def figure(self, record: RunLog) -> Figure:
        """See `Mission.figure`."""
        # Deferred: Matplotlib takes long to import.
        from maasi_sim.run.targets.report_figure import plot_report

        return plot_report(record)


def _team_plans(
    namespace: str, names: list[str], scenario: Scenario, common: dict[str, Any], state: Path
) -> list[NodePlan]:
    """Return filter and planner of a team; a restarted filter loads its state."""
    others = [name for name in scenario.names() if name not in names]
    respawns = scenario.on_exit == 'respawn'
    file = state / f'{namespace}_filter_node.maasi'.strip('_')
    # A robot that has just measured answers one period later.
    longest = max(scenario.robots[name].sensor.period for name in names)
    filter_settings = FilterNodeSettings.model_validate(
        {
            **common,
            'environment': scenario.environment,
            'filter': scenario.filter,
            'robots': {name: {'sensor': scenario.robots[name].sensor} for name in names},
            'share_with': others,
            'batch_timeout': min(1.0 + longest, _BATCH_TIMEOUT),
            'save_file': str(file) if respawns else '',
            'save_batches': respawns,
        }
    )
    return [
        NodePlan(
            'maasi_filter',
            'filter_node',
            'filter_node',
            namespace,
            {**flatten(filter_settings.resolved()), **SIMULATED},
        ),
        NodePlan(
            'maasi_planner',
            'planner_node',
            'planner_node',
            namespace,
            {**flatten(planner_settings(scenario, names, common)), **SIMULATED},
            given={'search_on_start': True},
        ),
    ]


def _plugin(name: str, driver: str, scenario: Scenario) -> tuple[str, ...]:
    if driver in DRIVERS.built_in:
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
    """Return a robot's driver, and outside of lockstep its guard if it has one."""
    settings = DriverSettings.model_validate(
        {
            **common,
            'environment': scenario.environment,
            **DrivenRobot.part_of(robot),
            'chargers': robot.endurance.chargers if robot.endurance else [],
            **({'tf_rate': _LOCKSTEP_TF_RATE} if common['lockstep'] else {}),
            'mambo': robot.mambo if robot.link == 'mambo_wifi' else None,
            'mavlink': robot.mavlink if robot.link == 'mavlink' else None,
            'platform': robot.platform if robot.link in PLATFORM_LINKS else None,
        }
    )
    own = name in scenario.namespaces()
    plans = [
        NodePlan(
            'maasi_drivers',
            robot.driver if robot.driver in DRIVERS.built_in else 'plugin_driver',
            'driver',
            name,
            {**flatten(settings), **SIMULATED},
            # A robot with its own planner receives its batches from it.
            remaps={BATCH: within(name, BATCH)} if own else {},
            role='driver',
            arguments=_plugin(name, robot.driver, scenario),
        )
    ]
    guarded = robot.link == 'topics' if robot.guard is None else robot.guard
    if guarded and not common['lockstep']:
        plans.append(guard_plan(name, common, 0.0))
    return plans
