"""The common part of scenario files of all missions."""

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field

from maasi_filter.geometry.environment import EnvironmentSettings
from maasi_filter.plugins import add_folders
from maasi_filter.settings import NotNegative, Positive, Settings
from maasi_sim.arguments import LARGEST
from maasi_sim.scenario.layering import to_yaml


class EventSettings(Settings):
    """An event of a robot."""

    at: NotNegative = Field(description='When [s]')
    robot: str = Field(description='Of which robot')
    do: Literal['leave', 'back'] = Field(description='It leaves and is silent, or returns')


class LimitSettings(Settings):
    """When a run is given up."""

    time: Positive = Field(600.0, description='Simulated time [s]')
    start: Positive = Field(
        180.0, description='Wall time until all nodes are ready; they may have to compile [s]'
    )
    silence: Positive = Field(
        30.0, description='Wall time without a step until a node counts as hung [s]'
    )
    heartbeat: float = Field(
        4.5,
        ge=2.0,
        description='Wall time without a sign of life of a node, while it does not wait for a '
        'processor, until it counts as hung; free running [s]',
    )
    restarts: int = Field(3, ge=0, description='Restarts of one node with on_exit: respawn [1]')


class RecordSettings(Settings):
    """What the recording holds."""

    images: Literal['jpeg', 'png', 'raw'] = Field(
        'jpeg', description='How images are stored; png is lossless and slower'
    )


class BaseScenario(Settings):
    """A whole scenario file, all layers merged."""

    version: Literal[1] = Field(description='Of this format')
    plugin_path: Annotated[list[str], AfterValidator(add_folders)] = Field(
        [],
        description='Folders in which the modules of plugins (module:Class) are, relative to this '
        'file; its own folder and the current one need not be named',
    )
    description: str = Field('', description='What it shows, in words')
    environment: EnvironmentSettings = Field(description='Where the search takes place')
    step: float = Field(0.05, gt=0.0, le=10.0, description='Between what nodes see [s]')
    seed: int = Field(
        1, ge=0, le=LARGEST, description='Of all random numbers, unless given otherwise'
    )
    robots: Mapping[str, Any] = Field(min_length=1, description='Robots by name')
    planner: Any = Field(description='Planner')
    events: list[EventSettings] = Field(default_factory=list, description='Events of robots')
    stop: Literal['all_found', 'planner_done'] = Field(
        'all_found',
        description='When the run ends well: all true targets are found, or every planner reports '
        'that nothing is left to gain',
    )
    on_exit: Literal['end', 'respawn'] = Field(
        'end', description='A node that dies ends the run, or is restarted'
    )
    limits: LimitSettings = Field(default_factory=LimitSettings, description='When to give up')
    record: RecordSettings = Field(default_factory=RecordSettings, description='Recording')

    @property
    def dimension(self) -> int:
        """2 or 3."""
        return self.environment.dimension

    @property
    def external_clock(self) -> bool:
        """Whether the time is that of a program that moves a robot."""
        return False

    def names(self) -> list[str]:
        """Return the robots' names in order."""
        return sorted(self.robots)

    def check_pace(self, lockstep: bool, rate: float | None) -> None:
        """Raise a ScenarioError if it cannot run in lockstep, or at a rate of simulated time."""

    def content(self) -> dict[str, Any]:
        """Return all settings as plain values, that are read back the same."""
        return self.model_dump(mode='python', by_alias=True)

    def text(self) -> str:
        """Return all settings as a scenario file that needs no other layer."""
        return to_yaml(self.content())
