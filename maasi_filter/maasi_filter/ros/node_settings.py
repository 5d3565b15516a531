"""Settings that nodes share, and those of the filter node."""

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

    # First: what names a class of a plugin is checked after it.
    plugin_path: Annotated[list[str], AfterValidator(add_folders)] = Field(
        [], description='Folders in which the modules of plugins (module:Class) are'
    )
    step: float = Field(0.05, gt=0.0, le=10.0, description='Duration of a step [s]')
    seed: int = Field(1, ge=0, description='Of all random numbers')
    lockstep: bool = Field(
        False, description='Whether each step of lockstep/step waits for its nodes'
    )
    frame: str = Field('map', min_length=1, description='Name of the common frame')
    largest_message: int = Field(
        200_000,
        gt=0,
        description='Largest message with a list (detections, clusters, found targets) that is '
        'read; larger ones are dropped [bytes]',
    )
    autostart: bool = Field(True, description='Whether the node configures and activates itself')

    def resolved(self) -> Self:
        """Return a copy with derived settings filled in."""
        return self


class SensorOfRobot(Settings):
    """Settings of a robot for the filter."""

    sensor: SensorSettings = Field(
        default_factory=SensorSettings, description='Its sensor, as the filter believes'
    )


class FilterNodeSettings(NodeSettings):
    """Settings of the filter node."""

    live: ClassVar[frozenset[str]] = frozenset({'batch_timeout', 'particles_rate', 'markers_rate'})

    environment: EnvironmentSettings = Field(description='Where the targets are')
    filter: FilterSettings = Field(default_factory=FilterSettings, description='The filter')
    robots: dict[str, SensorOfRobot] = Field(min_length=1, description='Robots, by name')
    share_with: list[str] = Field(
        [],
        description='Robots with filters of their own in their namespaces: what they find is taken '
        'over, and they take over what this one finds',
    )
    batch_timeout: Positive = Field(
        1.0,
        description='Time after which a batch goes on without who is missing; not in lockstep [s]',
    )
    particles_rate: NotNegative = Field(
        2.0, description='Most publications of particles; 0: none [1/s]'
    )
    markers_rate: NotNegative = Field(
        5.0, description='Most publications of markers; 0: none [1/s]'
    )
    save_file: str = Field(
        '', description='File that the state is saved to, and loaded from at the start'
    )
    save_period: NotNegative = Field(
        0.0, description='Wall time between saves; 0: only at the end [s]'
    )
    save_batches: bool = Field(
        False,
        description='Whether the state is saved after each batch, with the place in the run, where '
        'a restarted node goes on; the file belongs to one run then',
    )

    def resolved(self) -> Self:
        """Return a copy with the values of the preset."""
        return self.model_copy(update={'filter': self.filter.resolved()})
