"""Which nodes a scenario needs, with their parameters."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from maasi_sim.buildings.scenario import AnyScenario, CuboidScenario
from maasi_sim.run.observer import BATCH, DECISIONS, FOUND, STEP, UPDATE, within
from maasi_sim.scenario.layering import to_yaml
from maasi_sim.scenario.schema import (
    RobotSettings,
    Scenario,
    planner_settings,
)

CLOCK = '/clock'
# The time is that of the sim.
_SIMULATED = {'use_sim_time': True}


@dataclass(frozen=True)
class NodePlan:
    """A node to start.

    Attributes
    ----------
    package, executable : str
        As for `ros2 run`.
    name, namespace : str
        Of the node; the namespace without slashes, empty for none.
    parameters : dict
        Flat, with dots.
    topics : tuple of str
        That it publishes, and that the run cannot do without.
    says_ready : bool
        Whether it says so on `lockstep/ready`, and is waited for.
    says_done : bool
        Whether it takes part in lockstep.
    is_clock : bool
        Whether the time is its.
    remaps : dict
        Names of topics that are called otherwise.
    given : dict
        Parameters that are not in its file: what must not be taken over with it to real robots.
    """

    package: str
    executable: str
    name: str
    namespace: str = ''
    parameters: Mapping[str, Any] = field(default_factory=dict)
    topics: tuple[str, ...] = ()
    says_ready: bool = True
    says_done: bool = True
    is_clock: bool = False
    remaps: Mapping[str, str] = field(default_factory=dict)
    given: Mapping[str, Any] = field(default_factory=dict)

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
        content = {'/**': {'ros__parameters': dict(self.parameters)}}
        return to_yaml(content)

    def command(
        self, executable: Path, parameter_file: Path, log_level: str | None = None
    ) -> list[str]:
        """Return the command line of its process; what it says goes to its standard output."""
        return [
            str(executable),
            '--ros-args',
            '--disable-external-lib-logs',
            '--remap',
            f'__node:={self.name}',
            '--remap',
            f'__ns:=/{self.namespace}',
            *(
                word
                for before, after in self.remaps.items()
                for word in ('--remap', f'{before}:={after}')
            ),
            '--params-file',
            str(parameter_file),
            *(
                word
                for name, value in self.given.items()
                for word in ('--param', f'{name}:={json.dumps(value)}')
            ),
            *(('--log-level', log_level) if log_level else ()),
        ]


def plan_nodes(
    scenario: AnyScenario,
    *,
    seed: int,
    lockstep: bool,
    rate: float | None,
    recorder: bool,
    file: Path,
) -> list[NodePlan]:
    """Return the nodes that a scenario needs: sim, drivers and guards, filter, planner.

    In a search of buildings: sim, and for each robot a planner and a guard.

    Parameters
    ----------
    scenario : Scenario
        With all layers.
    seed : int
        Of the run.
    lockstep : bool
        Step by step, or free running.
    rate : float, optional
        Simulated over wall time; None: as fast as it goes in lockstep, else 1.
    recorder : bool
        Whether the sim waits for a recorder.
    file : Path
        Scenario file with all layers, for the sim.

    Raises
    ------
    ScenarioError
        If a link cannot keep this pace.
    """
    scenario.check_pace(lockstep, rate)
    common = {'step': scenario.step, 'seed': seed, 'lockstep': lockstep}
    simulation: dict[str, Any] = {
        'scenario': str(file),
        'seed': seed,
        'lockstep': lockstep,
        'rate': rate if rate is not None else 0.0 if lockstep else 1.0,
        'recorder': recorder,
    }
    alone = isinstance(scenario, CuboidScenario)
    plans = [
        NodePlan(
            'maasi_sim',
            'cuboid_sim_node' if alone else 'sim_node',
            'sim_node',
            parameters={**simulation, **(_SIMULATED if scenario.external_clock else {})},
            topics=(CLOCK, STEP) if lockstep else (CLOCK,),
            says_ready=False,
            says_done=False,
            is_clock=True,
        )
    ]
    if isinstance(scenario, CuboidScenario):
        for name in scenario.names():
            plans.append(_cuboid_plan(name, scenario, common))
            # It decides once a step, and its commands are for one step.
            plans.append(_guard_plan(name, common, scenario.step))
        return plans
    for name in scenario.names():
        plans += _robot_plans(name, scenario.robots[name], scenario, common)
    for namespace, names in scenario.namespaces().items():
        plans += _team_plans(namespace, names, scenario, common)
    return plans


def in_team(plan: NodePlan, team: str) -> NodePlan:
    """Return the plan of a node below the namespace of a team; the clock is everybody's."""
    if not team:
        return plan
    return replace(
        plan,
        namespace=f'{team}/{plan.namespace}' if plan.namespace else team,
        topics=tuple(topic if topic == CLOCK else within(team, topic) for topic in plan.topics),
        remaps={within(team, key): within(team, value) for key, value in plan.remaps.items()},
    )


def with_followed_clock(plan: NodePlan) -> NodePlan:
    """Return the plan of a node of a run whose clock is another one's."""
    if not plan.is_clock:
        return plan
    return replace(plan, parameters={**plan.parameters, **_SIMULATED, 'follow_clock': True})


def with_saved_state(plan: NodePlan, folder: Path) -> NodePlan:
    """Return the plan of a node that goes on where it was when it is started again."""
    if plan.executable != 'filter_node':
        return plan
    file = str(folder / f'{plan.file_name}.maasi')
    parameters = {**plan.parameters, 'save_file': file, 'save_batches': True}
    return replace(plan, parameters=parameters)


def _cuboid_plan(name: str, scenario: CuboidScenario, common: dict[str, Any]) -> NodePlan:
    """Return the planner of a robot that searches buildings for itself."""
    from maasi_filter.ros.parameters import flatten
    from maasi_planner.buildings.node_settings import (
        CuboidPlannerSettings,
        box_numbers,
        face_words,
    )

    robot, search = scenario.robots[name], scenario.planner
    floor = float(scenario.environment.array()[2, 0])
    settings = CuboidPlannerSettings.model_validate(
        {
            **common,
            'environment': scenario.environment,
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
        {**flatten(settings), **_SIMULATED},
        topics=tuple(f'/{name}/{topic}' for topic in ('state', 'decision', 'cmd_vel', 'link/tx')),
        given={'search_on_start': True},
    )


def _team_plans(
    namespace: str, names: list[str], scenario: Scenario, common: dict[str, Any]
) -> list[NodePlan]:
    """Return filter and planner of robots that share them."""
    from maasi_filter.ros.node_settings import FilterNodeSettings
    from maasi_filter.ros.parameters import flatten

    others = [name for name in scenario.names() if name not in names]
    filter_settings = FilterNodeSettings.model_validate(
        {
            **common,
            'environment': scenario.environment,
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
            {**flatten(filter_settings.resolved()), **_SIMULATED},
            topics=(within(namespace, UPDATE), within(namespace, FOUND)),
        ),
        NodePlan(
            'maasi_planner',
            'planner_node',
            'planner_node',
            namespace,
            {**flatten(planner_settings(scenario, names, common)), **_SIMULATED},
            topics=(within(namespace, DECISIONS), within(namespace, BATCH)),
            given={'search_on_start': True},
        ),
    ]


def _robot_plans(
    name: str, robot: RobotSettings, scenario: Scenario, common: dict[str, Any]
) -> list[NodePlan]:
    """Return a robot's driver, and its guard if it has one."""
    from maasi_drivers.agent.driver_settings import DriverSettings
    from maasi_filter.ros.parameters import flatten

    settings = DriverSettings.model_validate(
        {
            **common,
            'environment': scenario.environment,
            'start': robot.start,
            'yaw': robot.yaw,
            'radius': robot.radius,
            'motion': robot.motion,
            'sensor': robot.sensor,
            'camera': robot.camera,
            'link': robot.link,
            'mambo': robot.mambo if robot.link == 'mambo_wifi' else None,
            'mavlink': robot.mavlink if robot.link == 'mavlink' else None,
        }
    )
    topics = ['state', 'detections', 'robot_description']
    if robot.link == 'topics':
        topics.append('cmd_vel')
    own = name in scenario.namespaces()
    plans = [
        NodePlan(
            'maasi_drivers',
            robot.driver,
            'driver',
            name,
            {**flatten(settings), **_SIMULATED},
            # Its batches are those of its own planner, if it has one.
            remaps={BATCH: within(name, BATCH)} if own else {},
            topics=tuple(f'/{name}/{topic}' for topic in topics),
        )
    ]
    guarded = robot.link == 'topics' if robot.guard is None else robot.guard
    if guarded:
        plans.append(_guard_plan(name, common, 0.0))
    return plans


def _guard_plan(name: str, common: dict[str, Any], period: float) -> NodePlan:
    """Return the guard of a robot whose executor may be busy for `period` seconds."""
    from maasi_drivers.agent.driver_settings import GuardSettings
    from maasi_filter.ros.node_settings import LIVELINESS_LEASE
    from maasi_filter.ros.parameters import flatten

    lease = max(LIVELINESS_LEASE, period)
    return NodePlan(
        'maasi_drivers',
        'guard_node',
        'guard',
        name,
        {**flatten(GuardSettings.model_validate({**common, 'lease': lease})), **_SIMULATED},
        says_ready=False,
        says_done=False,
    )
