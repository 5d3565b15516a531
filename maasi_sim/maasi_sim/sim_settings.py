"""Settings of the simulation node."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from maasi_filter.ros.node_settings import NodeSettings


class SimNodeSettings(NodeSettings):
    """Settings of the simulation node; all else is in the scenario file."""

    live: ClassVar[frozenset[str]] = frozenset({'command_age'})

    step: float = Field(
        default=0.0, ge=0.0, le=10.0, description="Duration of a step; 0: the scenario's [s]"
    )
    scenario: str = Field(
        min_length=1, description='Scenario file, or the name of one in config/scenarios'
    )
    rate: float = Field(
        default=1.0,
        ge=0.0,
        description='Simulated over wall time, at most; 0: as fast as possible, in lockstep only',
    )
    follow_clock: bool = Field(
        default=False,
        description='Whether its time is a /clock that somebody else publishes; not in lockstep, '
        'and `rate` does not count',
    )
    recorder: bool = Field(default=False, description='Whether it waits for the recorder, too')
    command_age: float = Field(
        default=1.0,
        gt=0.0,
        description='Simulated time after which a command is too old; in lockstep each is for its '
        'step [s]',
    )
