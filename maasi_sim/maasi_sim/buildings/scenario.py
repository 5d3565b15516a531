"""Scenario files of searches of buildings (004): `planner: {name: cuboid_mpc}`."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from maasi_filter.settings import EnvironmentSettings, Finite, Settings
from maasi_planner.buildings import (
    CuboidSettings,
    Dynamics,
    DynamicsSettings,
    HazardSettings,
    Mission,
    SearchAgent,
    plan_mission,
)
from maasi_sim.buildings.mission import CuboidMission, SearchRobot
from maasi_sim.scenario.checks import check_names, event_problems
from maasi_sim.scenario.layering import Key, Layer, ScenarioError, dotted, to_yaml, validate
from maasi_sim.scenario.loading import check_scenario, read_scenario
from maasi_sim.scenario.schema import (
    EventSettings,
    LimitSettings,
    RecordSettings,
    Scenario,
)
from maasi_sim.world.odometry import OdometrySettings
from maasi_sim.world.robots import BatterySettings
from maasi_sim.world.world import TargetSettings, World

NAME = 'cuboid_mpc'


class SearchRobotSettings(Settings):
    """One robot: its type's settings with the scenario's own on top."""

    type: str = Field(description='Name of the type: a file in config/robots')
    description: str = Field(default='', description='What it is, in words')
    link: Literal['topics'] = Field(
        default='topics', description='How its planner reaches it; the sim plays the other end'
    )
    start: Annotated[list[Finite], Field(min_length=3, max_length=3)] = Field(
        description='Position at the start, and of its station, x y z [m, map]'
    )
    yaw: Finite = Field(default=0.0, description='Heading at the start [rad]')
    dynamics: DynamicsSettings = Field(description='Its body')
    hazard: HazardSettings = Field(
        default_factory=HazardSettings, description='How its battery fails'
    )
    odometry: OdometrySettings = Field(
        default_factory=OdometrySettings, description='How good its odometry is, simulated'
    )
    battery: BatterySettings = Field(
        default_factory=BatterySettings, description='Its battery as it is shown, simulated'
    )

    @property
    def external(self) -> bool:
        """False: the sim moves it."""
        return False


class CuboidPlanner(CuboidSettings):
    """The planner of each robot, and what is searched."""

    name: Literal['cuboid_mpc'] = Field(description='Planner')


class CuboidScenario(Settings):
    """A whole scenario file of a search of buildings, all layers merged."""

    version: Literal[1] = Field(description='Of this format')
    description: str = Field(default='', description='What it shows, in words')
    environment: EnvironmentSettings = Field(description='Where robots may be, in 3D')
    step: float = Field(default=1.0, gt=0.0, le=10.0, description='dT [s]')
    seed: int = Field(default=1, ge=0, description='Of all random numbers, unless given otherwise')
    robots: dict[str, SearchRobotSettings] = Field(min_length=1, description='Robots by name')
    planner: CuboidPlanner = Field(description='Planner of each robot, and what is searched')
    events: list[EventSettings] = Field(default_factory=list, description='What happens to robots')
    stop: Literal['all_found', 'planner_done'] = Field(
        default='all_found',
        description='When the run ends well: the team has visited all cuboids, or every planner '
        'knows that',
    )
    on_exit: Literal['end', 'respawn'] = Field(
        default='end', description='A node that dies ends the run, or is started again'
    )
    limits: LimitSettings = Field(default_factory=LimitSettings, description='When to give up')
    record: RecordSettings = Field(default_factory=RecordSettings, description='Recording')

    @property
    def dimension(self) -> int:
        """3."""
        return self.environment.dimension

    @property
    def external_clock(self) -> bool:
        """False: no other program moves these robots."""
        return False

    def names(self) -> list[str]:
        """Return the robots' names in order."""
        return sorted(self.robots)

    def namespaces(self) -> dict[str, list[str]]:
        """Return nothing: there is no filter, and no planner of the team."""
        return {}

    def check_pace(self, lockstep: bool, rate: float | None) -> None:
        """Do nothing: links that are topics keep any pace."""

    def mission(self) -> Mission:
        """Return what is searched."""
        return plan_mission(self.planner, self.environment.array())

    def world(self, seed: int) -> World:
        """Return the true world of a run: there are no targets."""
        return World.from_settings(self.environment, TargetSettings(count=0), seed)

    def content(self) -> dict[str, Any]:
        """Return all settings as plain values."""
        return self.model_dump(mode='python', by_alias=True)

    def text(self) -> str:
        """Return all settings as a scenario file that needs no other layer."""
        return to_yaml(self.content())


AnyScenario = Scenario | CuboidScenario


def load_any_scenario(
    path: str | Path, overrides: Mapping[str, tuple[Key, Any]] | None = None
) -> AnyScenario:
    """Read a scenario file of either kind, as `load_scenario` does.

    Raises
    ------
    ScenarioError
        With file, line, key, what was read and what is allowed.
    """
    return any_scenario(read_scenario(path, overrides))


def any_scenario_from_content(content: dict[str, Any], origin: str) -> AnyScenario:
    """Return the scenario of values with all layers merged.

    Raises
    ------
    ScenarioError
        As `load_any_scenario`.
    """
    return any_scenario(Layer(content, {(): origin}))


def any_scenario(layer: Layer) -> AnyScenario:
    """Return the scenario of a tree of values with all layers merged."""
    planner = layer.data.get('planner')
    if not (isinstance(planner, dict) and planner.get('name') == NAME):
        return check_scenario(layer)
    scenario = validate(CuboidScenario, layer)
    problems = list(_problems(scenario))
    if problems:
        raise ScenarioError(
            '\n'.join(
                f'{layer.origin(problem)}: {dotted(problem)}: {text}' for problem, text in problems
            )
        )
    return scenario


def _problems(scenario: CuboidScenario) -> Iterator[tuple[Key, str]]:
    """Yield what is wrong between the keys: key and text."""
    if scenario.dimension != 3:
        yield (
            ('environment', 'bounds'),
            f'read {scenario.dimension} axes, allowed are three: buildings are searched in 3D',
        )
        return
    if scenario.environment.obstacles:
        yield (
            ('environment', 'obstacles'),
            'read some, allowed is none: those of this planner are boxes, planner.obstacles',
        )
    for name in scenario.names():
        for text in check_names(name):
            yield ('robots', name), text
    yield from event_problems(scenario.events, scenario.names(), scenario.limits)
    try:
        mission = scenario.mission()
    except ValueError as error:
        yield _split(('planner',), str(error))
        return
    for name, robot in scenario.robots.items():
        try:
            dynamics = Dynamics.from_settings(robot.dynamics, scenario.step)
        except ValueError as error:
            yield _split(('robots', name, 'dynamics'), str(error))
            continue
        try:
            SearchAgent(name, scenario.planner, mission, dynamics, robot.hazard, robot.start)
        except ValueError as error:
            yield _split(('robots',), str(error).replace(': ', '.', 1))


def _split(head: Key, text: str) -> tuple[Key, str]:
    """Return the key that a message begins with, and what is left of it."""
    key, _, rest = text.partition(': ')
    parts = tuple(int(part) if part.isdigit() else part for part in re.findall(r'\w+', key))
    return ((*head, *parts), rest) if rest else (head, text)


def mission_of(scenario: CuboidScenario) -> CuboidMission:
    """Return a search of buildings in this process, as its nodes carry it out."""
    robots = {
        name: SearchRobot(np.array(robot.start), robot.dynamics, robot.hazard)
        for name, robot in scenario.robots.items()
    }
    return CuboidMission(
        scenario.planner, scenario.environment.array(), robots, scenario.step, scenario.seed
    )
