"""Settings that the scenario files of all missions share."""

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

    at: NotNegative = Field(description='Time of the event [s]')
    robot: str = Field(description='Name of the robot')
    do: Literal['leave', 'back'] = Field(description='The robot leaves (and is silent) or returns')


class LimitSettings(Settings):
    """Limits that end a run."""

    time: Positive = Field(600.0, description='Largest simulated time [s]')
    start: Positive = Field(
        180.0, description='Wall time until all nodes must be ready, including compilation [s]'
    )
    silence: Positive = Field(
        30.0, description='Wall time without a step until a node counts as hung [s]'
    )
    heartbeat: float = Field(
        4.5,
        ge=2.0,
        description='Wall time without a heartbeat until a node counts as hung, excluding waits '
        'for a processor; not in lockstep [s]',
    )
    restarts: int = Field(
        3, ge=0, description='Largest number of restarts of a node with on_exit: respawn [1]'
    )


class RecordSettings(Settings):
    """Contents of the recording."""

    images: Literal['jpeg', 'png', 'raw'] = Field(
        'jpeg', description='Format of stored images; png is lossless and slower'
    )


class BaseScenario(Settings):
    """A complete scenario file, all layers merged."""

    version: Literal[1] = Field(description='Version of this format')
    plugin_path: Annotated[list[str], AfterValidator(add_folders)] = Field(
        [],
        description='Folders of plugin modules (module:Class), relative to this file, in addition '
        'to its folder and the current one',
    )
    description: str = Field('', description='Description for --list')
    environment: EnvironmentSettings = Field(description='Search area')
    step: float = Field(0.05, gt=0.0, le=10.0, description='Time step of the simulation [s]')
    seed: int = Field(
        1, ge=0, le=LARGEST, description='Seed of all random numbers, unless --seed is given'
    )
    robots: Mapping[str, Any] = Field(min_length=1, description='Robots by name')
    planner: Any = Field(description='Planner')
    events: list[EventSettings] = Field(default_factory=list, description='Events of robots')
    stop: Literal['all_found', 'planner_done'] = Field(
        'all_found',
        description='Successful end of the run: all true targets are found, or every planner '
        'reports that it expects no further finds',
    )
    on_exit: Literal['end', 'respawn'] = Field(
        'end', description='When a node dies: end the run or restart the node'
    )
    limits: LimitSettings = Field(
        default_factory=LimitSettings, description='Limits that end the run'
    )
    record: RecordSettings = Field(default_factory=RecordSettings, description='Recording')

    @property
    def dimension(self) -> int:
        """2 or 3."""
        return self.environment.dimension

    @property
    def external_clock(self) -> bool:
        """Whether time comes from a program that moves a robot."""
        return False

    def names(self) -> list[str]:
        """Return the robots' names in order."""
        return sorted(self.robots)

    def check_pace(self, lockstep: bool, rate: float | None) -> None:
        """Raise a ScenarioError if it cannot run in lockstep, or at a rate of simulated time."""

    def content(self) -> dict[str, Any]:
        """Return all settings as plain values that read back equal."""
        return self.model_dump(mode='python', by_alias=True)

    def text(self) -> str:
        """Return all settings as a self-contained scenario file."""
        return to_yaml(self.content())
