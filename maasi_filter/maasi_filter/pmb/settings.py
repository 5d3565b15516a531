"""Settings specific to the Poisson multi-Bernoulli filter."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field


class PmbSettings(BaseModel):
    """Settings of the Poisson multi-Bernoulli filter."""

    model_config = ConfigDict(
        extra='forbid', populate_by_name=True, validate_assignment=True, allow_inf_nan=False
    )

    particles: int = Field(
        default=300, ge=50, le=100_000, description='Particles of each potential target [1]'
    )
    found_probability: float = Field(
        default=0.99,
        gt=0.5,
        lt=1.0,
        description='Existence probability above which a target can be found [1]',
    )
    withdrawn_probability: float = Field(
        default=0.5,
        ge=0.0,
        le=0.5,
        description='Existence probability below which a found target is withdrawn [1]',
    )
    walk: float = Field(
        default=0.0,
        ge=0.0,
        description='Standard deviation of a random walk of the targets on each axis after one '
        'second; 0: they stand still [m/sqrt(s)]',
    )
