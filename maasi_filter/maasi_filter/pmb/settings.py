"""Settings specific to the Poisson multi-Bernoulli filter."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field

_CONFIG = ConfigDict(
    extra='forbid', populate_by_name=True, validate_assignment=True, allow_inf_nan=False
)


class OffsetSettings(BaseModel):
    """Errors of the robots' positions that last; both 0: their errors are independent."""

    model_config = _CONFIG

    deviation: float = Field(
        default=0.0, ge=0.0, description='Deviation of a constant offset on each axis [m]'
    )
    drift: float = Field(
        default=0.0,
        ge=0.0,
        description='Deviation of the drift of x and y after one metre; grows with its root [m]',
    )


class PmbSettings(BaseModel):
    """Settings of the Poisson multi-Bernoulli filter."""

    model_config = _CONFIG

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
    offset: OffsetSettings = Field(
        default_factory=OffsetSettings,
        description='Errors of the robots that last, which the filter estimates',
    )
