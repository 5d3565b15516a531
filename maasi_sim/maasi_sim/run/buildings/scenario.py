"""Scenario files of searches of buildings (paper 004): `planner: {name: cuboid_mpc}`."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, Literal

from pydantic import Field

from maasi_filter.geometry.environment import EnvironmentSettings
from maasi_planner.buildings.agent import SearchAgent
from maasi_planner.buildings.preplanning import CoveragePlan, plan_mission
from maasi_planner.buildings.settings import CuboidSettings, DynamicsSettings, SearcherSettings
from maasi_sim.run.buildings.mission import CuboidMission
from maasi_sim.scenario.base import BaseScenario
from maasi_sim.scenario.checks import Problems, event_problems, name_problems
from maasi_sim.scenario.layering import Key, Layer, ScenarioError
from maasi_sim.scenario.loading import checked, read_scenario
from maasi_sim.scenario.schema import BatterySettings
from maasi_sim.simulation.odometry import OdometrySettings
from maasi_sim.simulation.world import TargetSettings, World

NAME = 'cuboid_mpc'


class SearchRobotSettings(SearcherSettings):
    """A robot: the settings of its type, overridden by the scenario's."""

    type: str = Field(description='Name of the type: a file in config/robots')
    description: str = Field('', description='Text that describes the robot')
    link: Literal['topics'] = Field(
        'topics', description='How its planner connects to it; the robot is simulated'
    )
    dynamics: DynamicsSettings = Field(description='Mass, force and speed of the robot')
    odometry: OdometrySettings = Field(
        default_factory=OdometrySettings, description='Errors of its simulated odometry'
    )
    battery: BatterySettings = Field(
        default_factory=BatterySettings, description='Its simulated battery, for display'
    )

    # Simulated, and in flight from the start.
    battery_unit: ClassVar[str] = 'fraction'
    external: ClassVar[bool] = False
    measurements: ClassVar[str] = 'simulated'
    takes_off: ClassVar[bool] = False


class CuboidPlanner(CuboidSettings):
    """The planner of each robot, and the buildings."""

    name: Literal['cuboid_mpc'] = Field(description='Planner')


class CuboidScenario(BaseScenario):
    """A scenario of a search of buildings, with all layers merged."""

    environment: EnvironmentSettings = Field(description='Where robots may be, in 3D')
    step: float = Field(1.0, gt=0.0, le=10.0, description='dT [s]')
    robots: dict[str, SearchRobotSettings] = Field(min_length=1, description='Robots by name')
    planner: CuboidPlanner = Field(description='Planner of each robot, and the buildings')

    def namespaces(self) -> dict[str, list[str]]:
        """Return nothing: there is no filter, and no planner of the team."""
        return {}

    def mission(self) -> CoveragePlan:
        """Return the mission."""
        return plan_mission(self.planner, self.environment.array())

    def world(self, seed: int) -> World:
        """Return the true world of a run, without targets."""
        return World.from_settings(self.environment, TargetSettings(count=0), seed)


def is_cuboid_scenario(layer: Layer) -> bool:
    """Return whether a tree of values is a scenario of a search of buildings."""
    planner = layer.data.get('planner')
    return isinstance(planner, dict) and planner.get('name') == NAME


def check_cuboid_scenario(
    layer: Layer, overrides: Mapping[str, tuple[Key, Any]] | None = None
) -> CuboidScenario:
    """Return the scenario of a tree of values with all layers merged."""
    return checked(CuboidScenario, layer, overrides, _problems)


def load_cuboid_scenario(
    path: str | Path, overrides: Mapping[str, tuple[Key, Any]] | None = None
) -> CuboidScenario:
    """Read a scenario file of a search of buildings, as `load_scenario` does."""
    layer = read_scenario(path)
    if not is_cuboid_scenario(layer):
        raise ScenarioError(f"{path}: planner.name: allowed is '{NAME}'")
    return check_cuboid_scenario(layer, overrides)


def _problems(scenario: CuboidScenario) -> Problems:
    if scenario.dimension != 3:
        yield (
            f'environment.bounds: read {scenario.dimension} axes, allowed are three: this search '
            'is in 3D'
        )
        return
    if scenario.environment.obstacles:
        yield ('environment.obstacles: read some, allowed are none; use planner.obstacles')
    yield from name_problems(scenario)
    yield from event_problems(scenario)
    try:
        mission = scenario.mission()
    except ValueError as error:
        yield f'planner.{error}'
        return
    for name, robot in scenario.robots.items():
        try:
            SearchAgent(name, scenario.planner, mission, robot, scenario.step)
        except ValueError as error:
            yield f'robots.{str(error).replace(": ", ".", 1)}'  # text begins with `name: key: `


def mission_of(scenario: CuboidScenario) -> CuboidMission:
    """Return a search of buildings in this process, as its nodes run it."""
    area = scenario.environment.array()
    return CuboidMission(scenario.planner, area, scenario.robots, scenario.step, scenario.seed)


def warm_up() -> None:
    """Compile, or load from the cache, the kernels of a search of buildings."""
    mission_of(load_cuboid_scenario('buildings_four')).run(1)
