"""Which nodes a scenario needs, with their parameters."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from maasi_drivers.settings.driver import GuardSettings
from maasi_filter.ros.node_settings import LIVELINESS_LEASE
from maasi_filter.ros.parameters import flatten
from maasi_sim.run.processes import NodeProcess, find_executable
from maasi_sim.run.run_folder import write_text
from maasi_sim.run.run_options import Options
from maasi_sim.run.topics import within
from maasi_sim.scenario.base import BaseScenario
from maasi_sim.scenario.layering import to_yaml

SIMULATED = {'use_sim_time': True}  # time of the simulation


@dataclass(frozen=True)
class NodePlan:
    """A node to start; its parameters are flat, with dots."""

    #: As for `ros2 run`.
    package: str
    executable: str
    #: Of the node; the namespace without slashes, empty for none, and below that of the team.
    name: str
    namespace: str = ''
    parameters: Mapping[str, Any] = field(default_factory=dict)
    #: A clock publishes the time. A driver commands a robot, which is stopped when the node dies.
    #: There are no guards in lockstep, where nothing moves while a step waits.
    role: Literal['clock', 'driver', 'guard', 'other'] = 'other'
    remaps: Mapping[str, str] = field(default_factory=dict)
    #: Parameters on the command line, as the file must not start a search on real robots.
    given: Mapping[str, Any] = field(default_factory=dict)
    arguments: tuple[str, ...] = ()  #: before those of ROS

    @property
    def full_name(self) -> str:
        """Name with namespace, from that of the team."""
        return within(self.namespace, f'/{self.name}')

    def parameter_text(self) -> str:
        """Return its parameter file."""
        return to_yaml({'/**': {'ros__parameters': dict(self.parameters)}})

    def process(self, folder: Path, team: str = '', log_level: str | None = None) -> NodeProcess:
        """Write its parameter file, and return its process, not started yet, with its log there."""
        name = within(team, self.full_name)
        file = name.strip('/').replace('/', '_')
        parameters = folder / 'parameters' / f'{file}.yaml'
        write_text(parameters, self.parameter_text())
        executable = find_executable(self.package, self.executable)
        namespace = within(team, f'/{self.namespace}').rstrip('/') or '/'
        remaps = {'__node': self.name, '__ns': namespace}
        remaps |= {within(team, old): within(team, new) for old, new in self.remaps.items()}
        words = [str(executable), *self.arguments, '--ros-args', '--disable-external-lib-logs']
        for before, after in remaps.items():
            words += ['--remap', f'{before}:={after}']
        words += ['--params-file', str(parameters)]
        for key, value in self.given.items():
            words += ['--param', f'{key}:={json.dumps(value)}']
        if log_level:
            words += ['--log-level', log_level]
        return NodeProcess(name, words, folder / f'{file}.log')


def common_parameters(scenario: BaseScenario, options: Options) -> dict[str, Any]:
    """Return the parameters that all nodes have."""
    return {
        'plugin_path': scenario.plugin_path,
        'step': scenario.step,
        'seed': scenario.seed,
        'lockstep': options.lockstep,
    }


def sim_plan(executable: str, scenario: BaseScenario, options: Options, file: Path) -> NodePlan:
    """Return the simulation node; it publishes the clock, unless robots bring theirs."""
    pace = options.rate if options.rate is not None else 0.0 if options.lockstep else 1.0
    parameters: dict[str, Any] = {
        'scenario': str(file),
        'seed': scenario.seed,
        'lockstep': options.lockstep,
        'rate': pace,
        'recorder': True,
        **(SIMULATED if scenario.external_clock else {}),
    }
    return NodePlan('maasi_sim', executable, 'sim_node', parameters=parameters, role='clock')


def guard_plan(robot: str, common: Mapping[str, Any], period: float) -> NodePlan:
    """Return the guard of a robot whose driver may be busy for `period` seconds."""
    lease = max(LIVELINESS_LEASE, period)
    settings = GuardSettings.model_validate({**common, 'lease': lease})
    parameters = {**flatten(settings), **SIMULATED}
    return NodePlan('maasi_drivers', 'guard_node', 'guard', robot, parameters, role='guard')
