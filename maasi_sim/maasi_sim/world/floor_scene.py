"""Objects on the floor: markers, obstacles, and distractors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from maasi_sim.world.noise_streams import noise_stream
from maasi_sim.world.render_settings import RenderSettings
from maasi_sim.world.world import World

Colour = Sequence[float]


@dataclass(frozen=True)
class Shape:
    """
    A flat object on the floor.

    Attributes
    ----------
    centre : (x, y)
        Map frame [m].
    half_size : (a, b)
        Radius twice for a disc, half the sides for a rectangle [m].
    colour : (r, g, b)
        Reflectance, 0 to 1.
    rectangle : bool
        Else it is a disc.
    angle : float
        Of a rectangle's first side from the x axis [rad].

    """

    centre: tuple[float, float]
    half_size: tuple[float, float]
    colour: Colour
    rectangle: bool = False
    angle: float = 0.0


def disc(centre: ArrayLike, radius: float, colour: Colour) -> Shape:
    """Return a disc on the floor: centre [m, map], radius [m], reflectance."""
    x, y = (float(value) for value in np.asarray(centre, dtype=float)[:2])
    return Shape((x, y), (radius, radius), tuple(colour))


def draw_distractors(
    settings: RenderSettings, world: World, generator: np.random.Generator
) -> list[Shape]:
    """
    Draw the distractors of a world.

    Only sheets may touch a marker: one that is partly covered could not be detected.
    """
    counts = settings.distractors
    low, high = world.bounds[:2, 0], world.bounds[:2, 1]
    radius = 0.5 * settings.marker_diameter
    shapes: list[Shape] = []

    def draw(clear: float, along: ArrayLike = (0.0, 0.0)) -> tuple[float, float] | None:
        """Return a centre whose markers are farther than `clear` from it, or from a line."""
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
        colour = np.array([0.60, 0.68, 0.80]) * generator.uniform(0.85, 1.15)
        if centre is not None:
            angle = float(generator.uniform(0, np.pi))
            sizes = (float(sides[0]), float(sides[1]))
            shapes.append(Shape(centre, sizes, colour.tolist(), True, angle))
    for _ in range(counts.lines):
        half = float(generator.uniform(0.1, 0.4))
        width = float(generator.uniform(0.0015, 0.004))
        angle = float(generator.uniform(0, np.pi))
        line = draw(2.5 * radius, half * np.array([np.cos(angle), np.sin(angle)]))
        if line is not None:
            shapes.append(Shape(line, (half, width), settings.marker_colour, True, angle))
    for count, size, colours in (
        (counts.purple, 1.0, [[0.42, 0.12, 0.50]]),
        (counts.cyan, 1.0, [[0.35, 0.55, 0.62]]),
        (counts.large, 3.0, [settings.marker_colour]),
    ):
        for _ in range(count):
            centre = draw((size + 2.0) * radius)
            if centre is not None:
                shapes.append(disc(centre, size * radius, colours[0]))
    return shapes


def scene_of(world: World, settings: RenderSettings, seed: int) -> list[Shape]:
    """Return the objects on the floor, bottom first: distractors, obstacles, markers."""
    shapes = draw_distractors(settings, world, noise_stream(seed, purpose='distractors'))
    shapes += [
        disc(centre, float(radius), (0.25, 0.24, 0.23))
        for centre, radius in zip(world.obstacles.centres, world.obstacles.radii)
    ]
    radius = 0.5 * settings.marker_diameter
    return shapes + [disc(target, radius, settings.marker_colour) for target in world.targets]
