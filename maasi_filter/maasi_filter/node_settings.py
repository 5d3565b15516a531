"""Settings that nodes share, and those of the filter node."""

from __future__ import annotations

from pydantic import Field

from maasi_filter.settings import EnvironmentSettings, FilterSettings, SensorSettings, Settings


class NodeSettings(Settings):
    """What every node of a search needs to know."""

    step: float = Field(default=0.05, gt=0.0, le=10.0, description='Duration of a step [s]')
    seed: int = Field(default=1, ge=0, description='Of all random numbers')
    lockstep: bool = Field(
        default=False, description='Whether the steps are those of lockstep/step, all awaited'
    )
    frame: str = Field(default='map', min_length=1, description='Name of the common frame')
    autostart: bool = Field(
        default=True, description='Whether the node configures and activates itself'
    )


class SensorOfRobot(Settings):
    """What the filter knows of a robot."""

    sensor: SensorSettings = Field(
        default_factory=SensorSettings, description='Its sensor, as the filter believes'
    )


class FilterNodeSettings(NodeSettings):
    """Settings of the filter node."""

    environment: EnvironmentSettings = Field(description='Where the targets are')
    filter: FilterSettings = Field(default_factory=FilterSettings, description='The filter')
    robots: dict[str, SensorOfRobot] = Field(min_length=1, description='Robots, by name')
    share_with: list[str] = Field(
        default=[],
        description='Robots with filters of their own in their namespaces: what they find is taken '
        'over, and they take over what this one finds',
    )
    batch_timeout: float = Field(
        default=1.0,
        gt=0.0,
        description='Wall time after which a batch goes on without who is missing; not in lockstep '
        '[s]',
    )
    particles_rate: float = Field(
        default=2.0, ge=0.0, description='Most publications of particles; 0: none [1/s]'
    )
    markers_rate: float = Field(
        default=5.0, ge=0.0, description='Most publications of markers; 0: none [1/s]'
    )
    save_file: str = Field(
        default='', description='File that the state is saved to, and loaded from at the start'
    )
    save_period: float = Field(
        default=0.0, ge=0.0, description='Wall time between saves; 0: only at the end [s]'
    )
