"""Rendering of simulated cameras: light, noise, blur, and distractors."""

from __future__ import annotations

from pydantic import Field, model_validator

from maasi_filter.settings import Finite, Settings


class DistractorSettings(Settings):
    """Things on the floor that are not markers; drawn at random over the bounds."""

    sheets: int = Field(default=0, ge=0, description='Pale blue sheets of 10 to 25 cm [1]')
    lines: int = Field(default=0, ge=0, description='Blue lines of 20 to 80 cm, 3 to 8 mm wide [1]')
    purple: int = Field(default=0, ge=0, description="Purple discs of the markers' size [1]")
    cyan: int = Field(
        default=0, ge=0, description="Pale greenish-blue discs of the markers' size [1]"
    )
    large: int = Field(
        default=0, ge=0, description='Blue discs of three times the size of markers [1]'
    )


class RenderSettings(Settings):
    """Disturbances of the simulated camera: moderate by default, none with `ideal()`."""

    marker_diameter: float = Field(default=0.03, gt=0, description='Diameter of the markers [m]')
    marker_colour: list[Finite] = Field(
        default_factory=lambda: [0.08, 0.17, 0.62],
        min_length=3,
        max_length=3,
        description='Reflectance of the markers in R, G, B, 0 to 1',
    )
    floor_colour: list[Finite] = Field(
        default_factory=lambda: [0.47, 0.47, 0.46],
        min_length=3,
        max_length=3,
        description='Reflectance of the floor in R, G, B, 0 to 1',
    )
    floor_texture: float = Field(
        default=0.03, ge=0, le=1, description='Relative amplitude of the speckle of the floor [-]'
    )
    light_variation: float = Field(
        default=0.15,
        ge=0,
        lt=1,
        description='Relative amplitude of the light over the floor [-]',
    )
    light_wavelength: float = Field(
        default=3.0, gt=0, description='Wavelength of the light over the floor [m]'
    )
    vignetting: float = Field(
        default=0.1,
        ge=0,
        lt=1,
        description='Part of the light lost in the corners of the image [-]',
    )
    exposure_drift: float = Field(
        default=0.08, ge=0, lt=1, description='Relative amplitude of the drift of exposure [-]'
    )
    white_balance_drift: float = Field(
        default=0.03,
        ge=0,
        lt=1,
        description="Relative amplitude of the drift of each channel's gain [-]",
    )
    drift_period: float = Field(default=20.0, gt=0, description='Period of the drifts, about [s]')
    shot_noise: float = Field(
        default=0.06,
        ge=0,
        description='Variance of the noise for each grey level of signal [grey level]',
    )
    read_noise: float = Field(
        default=1.5, ge=0, description='Deviation of the noise in the dark [grey level]'
    )
    exposure_time: float = Field(
        default=0.006, ge=0, description='Time over which motion blurs the image [s]'
    )
    blur: float = Field(default=0.5, ge=0, description='Deviation of the blur of the lens [px]')
    jpeg_quality: int | None = Field(
        default=None,
        ge=1,
        le=100,
        description='Quality of JPEG compression; none: no JPEG [1]',
    )
    distractors: DistractorSettings = Field(
        default_factory=DistractorSettings, description='Objects like markers'
    )

    @model_validator(mode='after')
    def _colours(self) -> RenderSettings:
        for name in ('marker_colour', 'floor_colour'):
            colour = getattr(self, name)
            if not all(0 <= value <= 1 for value in colour):
                raise ValueError(f'{name}: got {colour}, allowed are numbers from 0 to 1')
        return self

    @classmethod
    def ideal(cls, **changes: object) -> RenderSettings:
        """Return settings without noise, blur, drift or uneven light, but for the changes given."""
        values: dict[str, object] = dict.fromkeys(
            (
                'floor_texture',
                'light_variation',
                'vignetting',
                'exposure_drift',
                'white_balance_drift',
                'shot_noise',
                'read_noise',
                'exposure_time',
                'blur',
            ),
            0.0,
        )
        return cls.model_validate(values | changes)
