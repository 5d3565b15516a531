"""Which nodes a scenario needs, with their parameters."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from maasi_drivers.settings.driver import GuardSettings
from maasi_filter.ros.node_settings import LIVELINESS_LEASE
from maasi_filter.ros.parameters import flatten
from maasi_sim.run.processes import NodeProcess, find_executable
from maasi_sim.run.run_folder import write_text
from maasi_sim.run.run_options import Options
from maasi_sim.run.topics import within
from maasi_sim.scenario.base import BaseScenario
from maasi_sim.scenario.layering import to_yaml

# Time of the simulation.
SIMULATED = {'use_sim_time': True}


@dataclass(frozen=True)
class NodePlan:
    """A node to start; its parameters are flat, with dots."""

    #: As for `ros2 run`.
    package: str
    executable: str
    #: Of the node; the namespace without slashes, empty for none.
    name: str
    namespace: str = ''
    parameters: Mapping[str, Any] = field(default_factory=dict)
    #: Whether it reports on `lockstep/ready`, and is awaited; whether it takes part in lockstep.
    says_ready: bool = True
    says_done: bool = True
    #: Whether it publishes the time.
    is_clock: bool = False
    #: Whether it commands a robot, which is stopped when the node dies.
    drives: bool = False
    remaps: Mapping[str, str] = field(default_factory=dict)
    #: Parameters on the command line, as the file must not start a search on real robots.
    given: Mapping[str, Any] = field(default_factory=dict)
    #: Before those of ROS.
    arguments: tuple[str, ...] = ()

    @property
    def full_name(self) -> str:
        """Name with namespace, from the root."""
        return f'/{self.namespace}/{self.name}' if self.namespace else f'/{self.name}'

    @property
    def file_name(self) -> str:
        """What its log and parameter file are called, without ending."""
        return self.full_name.strip('/').replace('/', '_')

    def parameter_text(self) -> str:
        """Return its parameter file."""
        return to_yaml({'/**': {'ros__parameters': dict(self.parameters)}})

    def process(self, folder: Path, log_level: str | None = None) -> NodeProcess:
        """Write its parameter file, and return its process, not started yet, with its log there."""
        path = folder / 'parameters' / f'{self.file_name}.yaml'
        write_text(path, self.parameter_text())
        command = self.command(find_executable(self.package, self.executable), path, log_level)
        log = folder / f'{self.file_name}.log'
        return NodeProcess(self.full_name, command, log, self.package)

    def command(
        self, executable: Path, parameter_file: Path, log_level: str | None = None
    ) -> list[str]:
        """Return the command line of its process."""
        remaps = {'__node': self.name, '__ns': f'/{self.namespace}', **self.remaps}
        level = ['--log-level', log_level] if log_level else []
        words = [str(executable), *self.arguments, '--ros-args', '--disable-external-lib-logs']
        for before, after in remaps.items():
            words += ['--remap', f'{before}:={after}']
        words += ['--params-file', str(parameter_file)]
        for name, value in self.given.items():
            words += ['--param', f'{name}:={json.dumps(value)}']
        return words + level


def plan_in_run(plan: NodePlan, options: Options, state: Path | None) -> NodePlan:
    """Return the plan of a node in the namespace of a run; topics of others are not remapped.

    The clock may be that of another run. With a folder for its state, a filter resumes after a
    restart.
    """
    team, parameters = options.namespace, dict(plan.parameters)
    if options.follow_clock and plan.is_clock:
        parameters |= SIMULATED | {'follow_clock': True}
    plan = replace(
        plan,
        namespace='/'.join(filter(None, (team, plan.namespace))),
        remaps={within(team, key): within(team, value) for key, value in plan.remaps.items()},
        parameters=parameters,
    )
    if state is not None and plan.executable == 'filter_node':
        saved = {'save_file': str(state / f'{plan.file_name}.maasi'), 'save_batches': True}
        plan = replace(plan, parameters=parameters | saved)
    return plan


def common_parameters(scenario: BaseScenario, options: Options) -> dict[str, Any]:
    """Return the parameters that all nodes have."""
    return {
        'plugin_path': scenario.plugin_path,
        'step': scenario.step,
        'seed': scenario.seed,
        'lockstep': options.lockstep,
    }


def sim_plan(executable: str, scenario: BaseScenario, options: Options, file: Path) -> NodePlan:
    """Return the simulation node, whose clock is that of the run."""
    pace = options.rate if options.rate is not None else 0.0 if options.lockstep else 1.0
    parameters: dict[str, Any] = {
        'scenario': str(file),
        'seed': scenario.seed,
        'lockstep': options.lockstep,
        'rate': pace,
        'recorder': True,
        **(SIMULATED if scenario.external_clock else {}),
    }
    return NodePlan(
        'maasi_sim',
        executable,
        'sim_node',
        parameters=parameters,
        says_done=False,
        is_clock=True,
    )


def guard_plan(robot: str, common: Mapping[str, Any], period: float) -> NodePlan:
    """Return the guard of a robot whose driver may be busy for `period` seconds."""
    lease = max(LIVELINESS_LEASE, period)
    settings = GuardSettings.model_validate({**common, 'lease': lease})
    return NodePlan(
        'maasi_drivers',
        'guard_node',
        'guard',
        robot,
        {**flatten(settings), **SIMULATED},
        says_ready=False,
        says_done=False,
    )
