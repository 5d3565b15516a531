"""Rendering settings of simulated cameras, and objects on the floor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field, model_validator

from maasi_filter.settings import NotNegative, Positive, Settings, Vector3
from maasi_sim.simulation.world import World, noise_stream


class DistractorSettings(Settings):
    """Objects on the floor that are not markers, at random positions in the bounds."""

    sheets: int = Field(0, ge=0, description='Number of pale blue sheets of 10 to 25 cm [1]')
    lines: int = Field(
        0, ge=0, description='Number of blue lines of 20 to 80 cm, 3 to 8 mm wide [1]'
    )
    purple: int = Field(0, ge=0, description="Number of purple discs of the markers' size [1]")
    cyan: int = Field(
        0, ge=0, description="Number of pale greenish-blue discs of the markers' size [1]"
    )
    large: int = Field(
        0, ge=0, description='Number of blue discs of three times the size of markers [1]'
    )


class RenderSettings(Settings):
    """Disturbances of the simulated camera: moderate by default, none with `ideal()`."""

    marker_diameter: Positive = Field(0.03, gt=0, description='Diameter of the markers [m]')
    marker_colour: Vector3 = Field(
        [0.08, 0.17, 0.62], description='Reflectance of the markers in R, G, B, 0 to 1'
    )
    floor_colour: Vector3 = Field(
        [0.47, 0.47, 0.46], description='Reflectance of the floor in R, G, B, 0 to 1'
    )
    floor_texture: float = Field(
        0.03, ge=0, le=1, description='Relative amplitude of the speckle of the floor [-]'
    )
    light_variation: float = Field(
        0.15, ge=0, lt=1, description='Relative amplitude of uneven light over the floor [-]'
    )
    light_wavelength: Positive = Field(
        3.0, gt=0, description='Wavelength of uneven light over the floor [m]'
    )
    vignetting: float = Field(
        0.1, ge=0, lt=1, description='Share of light lost in the corners of the image [-]'
    )
    exposure_drift: float = Field(
        0.08, ge=0, lt=1, description='Relative amplitude of the drift of exposure [-]'
    )
    white_balance_drift: float = Field(
        0.03, ge=0, lt=1, description="Relative amplitude of the drift of each channel's gain [-]"
    )
    drift_period: Positive = Field(20.0, gt=0, description='Approximate period of the drifts [s]')
    shot_noise: NotNegative = Field(
        0.06, ge=0, description='Variance of the noise per grey level of signal [grey level]'
    )
    read_noise: NotNegative = Field(
        1.5, ge=0, description='Deviation of the noise in the dark [grey level]'
    )
    exposure_time: NotNegative = Field(
        0.006, ge=0, description='Exposure time, which causes motion blur [s]'
    )
    blur: NotNegative = Field(0.5, ge=0, description='Deviation of the blur of the lens [px]')
    jpeg_quality: int | None = Field(
        None, ge=1, le=100, description='Quality of JPEG compression; default: no JPEG [1]'
    )
    distractors: DistractorSettings = Field(
        default_factory=DistractorSettings, description='Objects similar to markers'
    )

    @model_validator(mode='after')
    def _colours(self) -> RenderSettings:
        for name in ('marker_colour', 'floor_colour'):
            colour = getattr(self, name)
            if not all(0 <= value <= 1 for value in colour):
                raise ValueError(f'{name}: got {colour}, allowed are numbers from 0 to 1')
        return self


@dataclass(frozen=True)
class Shape:
    """A flat object on the floor."""

    centre: tuple[float, float]  # [m, map]
    half_size: tuple[float, float]  # twice the radius, or half the sides [m]
    colour: Sequence[float]  # reflectance, 0 to 1
    rectangle: bool = False
    angle: float = 0.0  # of the first side from the x axis [rad]


def disc(centre: ArrayLike, radius: float, colour: Sequence[float]) -> Shape:
    """Return a disc on the floor: centre [m, map], radius [m], reflectance."""
    x, y = (float(value) for value in np.asarray(centre, dtype=float)[:2])
    return Shape((x, y), (radius, radius), tuple(colour))


def draw_distractors(
    settings: RenderSettings, world: World, generator: np.random.Generator
) -> list[Shape]:
    """Draw distractors. Only sheets may touch a marker: a partly covered one is not detected."""
    counts = settings.distractors
    low, high = world.bounds[:2, 0], world.bounds[:2, 1]
    radius = 0.5 * settings.marker_diameter
    shapes: list[Shape] = []

    def draw(clear: float, along: ArrayLike = (0.0, 0.0)) -> tuple[float, float] | None:
        """Return a centre at more than `clear` from all markers, or from a line."""
        half = float(np.hypot(*np.asarray(along)))
        axis = np.asarray(along) / (half or 1.0)
        for _ in range(1000):
            centre = generator.uniform(low, high)
            offsets = world.targets[:, :2] - centre
            nearest = np.clip(offsets @ axis, -half, half)[:, None] * axis
            gaps = np.linalg.norm(offsets - nearest, axis=1)
            if gaps.min(initial=np.inf) > clear:
                return float(centre[0]), float(centre[1])
        return None

    for _ in range(counts.sheets):
        centre = draw(-1.0)
        sides = generator.uniform(0.05, 0.125, size=2)
        pale = np.array([0.60, 0.68, 0.80]) * generator.uniform(0.85, 1.15)
        if centre is not None:
            angle = float(generator.uniform(0, np.pi))
            sizes = (float(sides[0]), float(sides[1]))
            shapes.append(Shape(centre, sizes, pale.tolist(), True, angle))
    for _ in range(counts.lines):
        half = float(generator.uniform(0.1, 0.4))
        width = float(generator.uniform(0.0015, 0.004))
        angle = float(generator.uniform(0, np.pi))
        line = draw(2.5 * radius, half * np.array([np.cos(angle), np.sin(angle)]))
        if line is not None:
            shapes.append(Shape(line, (half, width), settings.marker_colour, True, angle))
    for count, size, colour in (
        (counts.purple, 1.0, [0.42, 0.12, 0.50]),
        (counts.cyan, 1.0, [0.35, 0.55, 0.62]),
        (counts.large, 3.0, settings.marker_colour),
    ):
        for _ in range(count):
            centre = draw((size + 2.0) * radius)
            if centre is not None:
                shapes.append(disc(centre, size * radius, colour))
    return shapes


def scene_of(world: World, settings: RenderSettings, seed: int) -> list[Shape]:
    """Return the objects on the floor, bottom first: distractors, obstacles, markers."""
    shapes = draw_distractors(settings, world, noise_stream(seed, purpose='distractors'))
    shapes += [
        disc(centre, radius, (0.25, 0.24, 0.23)) for *centre, radius, _ in world.area.solid.tolist()
    ]
    radius = 0.5 * settings.marker_diameter
    return shapes + [disc(target, radius, settings.marker_colour) for target in world.targets]
