"""Settings of all nodes and of the filter node."""

from typing import Annotated, ClassVar

from pydantic import AfterValidator, Field
from typing_extensions import Self

from maasi_filter.geometry.environment import EnvironmentSettings
from maasi_filter.plugins import add_folders
from maasi_filter.settings import FilterSettings, NotNegative, Positive, SensorSettings, Settings

# Time without asserted liveliness after which a guard considers its driver dead [s].
LIVELINESS_LEASE = 0.5


class NodeSettings(Settings):
    """Settings common to all nodes of a search."""

    live: ClassVar[frozenset[str]] = frozenset()  #: parameters that can be set while the node runs

    # First, as names of plugins are checked after it.
    plugin_path: Annotated[list[str], AfterValidator(add_folders)] = Field(
        [], description='Folders with the modules of plugins (module:Class)'
    )
    step: float = Field(0.05, gt=0.0, le=10.0, description='Duration of a step [s]')
    seed: int = Field(1, ge=0, description='Seed of all random numbers')
    lockstep: bool = Field(
        False, description='Whether each step of lockstep/step waits for this node'
    )
    frame: str = Field('map', min_length=1, description='Name of the common map frame')
    largest_message: int = Field(
        200_000,
        gt=0,
        description='Largest message with a list (detections, clusters, found targets) that is '
        'accepted; larger ones are dropped [bytes]',
    )
    autostart: bool = Field(True, description='Whether the node configures and activates itself')

    def resolved(self) -> Self:
        """Return a copy with derived settings filled in."""
        return self


class SensorOfRobot(Settings):
    """Settings of a robot for the filter."""

    sensor: SensorSettings = Field(
        default_factory=SensorSettings, description='Sensor model of the robot'
    )


class FilterNodeSettings(NodeSettings):
    """Settings of the filter node."""

    live: ClassVar[frozenset[str]] = frozenset({'batch_timeout', 'particles_rate', 'markers_rate'})

    environment: EnvironmentSettings = Field(
        description='Search area, keep-outs, obstacles and prior'
    )
    filter: FilterSettings = Field(default_factory=FilterSettings, description='Search filter')
    robots: dict[str, SensorOfRobot] = Field(min_length=1, description='Robots by name')
    share_with: list[str] = Field(
        [],
        description='Robots that run their own filter in their namespace; both filters exchange '
        'found targets',
    )
    batch_timeout: Positive = Field(
        1.0,
        description='Time after which a batch is processed without missing detections; not in '
        'lockstep [s]',
    )
    particles_rate: NotNegative = Field(
        2.0, description='Highest rate of particle messages; 0 disables them [1/s]'
    )
    markers_rate: NotNegative = Field(
        5.0, description='Highest rate of marker messages; 0 disables them [1/s]'
    )
    save_file: str = Field(
        '', description='File in which the state is saved, and from which it is loaded at the start'
    )
    save_period: NotNegative = Field(
        0.0, description='Wall time between saves; 0: save only at the end [s]'
    )
    save_batches: bool = Field(
        False,
        description='Whether the state is saved after each batch, so that a restarted node '
        'resumes the same run; the file then belongs to one run',
    )

    def resolved(self) -> Self:
        """Return a copy with the values of the preset."""
        return self.model_copy(update={'filter': self.filter.resolved()})
