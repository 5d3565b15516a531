"""The true world: area, targets, and streams of random numbers."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal
from zlib import crc32

import numpy as np
from pydantic import Field, model_validator

from maasi_filter.arrays import FloatArray
from maasi_filter.geometry.area import Area
from maasi_filter.geometry.environment import EnvironmentSettings
from maasi_filter.records import Label
from maasi_filter.settings import Finite, NotNegative, Settings


def noise_stream(
    seed: int, robot: str = '', step: int = 0, purpose: str = ''
) -> np.random.Generator:
    """Return the generator of a robot's noise for one purpose, e.g. 'camera', at one step.

    Independent for different keys and equal for equal keys, in every process. Noise of the
    world has no robot.
    """
    key = (seed, crc32(robot.encode()), step, crc32(purpose.encode()))
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(key)))


# Attempts for one target, and for a whole set, before the space counts as full.
_ATTEMPTS, _RESTARTS = 1000, 10


class TargetSettings(Settings):
    """True targets: random or given."""

    count: int | None = Field(None, ge=0, le=100_000, description='Number of random targets [1]')
    distribution: Literal['uniform', 'prior', 'clustered'] = Field(
        'uniform',
        description="Distribution of random targets: uniform, by the environment's prior, or "
        'around random centres',
    )
    positions: list[list[Finite]] | None = Field(
        None, description='Given positions instead of random ones [m, map]'
    )
    separation: NotNegative = Field(0.0, description='Smallest distance between two targets [m]')
    margin: NotNegative = Field(0.0, description='Smallest distance from the bounds [m]')
    clusters: int = Field(3, ge=1, description='Clustered: number of centres [1]')
    spread: float | None = Field(
        None,
        gt=0.0,
        description="Clustered: deviation around the centres; default: 1/15 of the space's size "
        '[m]',
    )
    walk: NotNegative = Field(
        0.0,
        description='Deviation of a random walk per axis after one second; ranging sensors only '
        '[m/sqrt(s)]',
    )
    identified: bool = Field(
        False,
        description='Whether sensors read the identity of each target, as from a transponder; '
        'ranging sensors only',
    )
    classes: list[Annotated[str, Field(min_length=1)]] = Field(
        default_factory=list,
        description='Classes that sensors report, assigned to the targets in turn; ranging '
        'sensors only',
    )

    @model_validator(mode='after')
    def _one_of_count_and_positions(self) -> TargetSettings:
        if (self.count is None) == (self.positions is None):
            raise ValueError('targets: give either count or positions')
        return self


@dataclass(frozen=True)
class World:
    """The true world: area and targets (n, d) [m, map].

    `walk`: deviation of the targets' random walk per axis and step [m]; `seed`: of the walk;
    `labels`: reported labels of the targets, empty: none.
    """

    area: Area
    targets: FloatArray
    walk: float = 0.0
    seed: int = 0
    labels: tuple[Label, ...] = ()
    _trajectory: list[FloatArray] = field(default_factory=list, compare=False, repr=False)

    @property
    def bounds(self) -> FloatArray:
        """Bounds of the area, (d, 2) [m]."""
        return self.area.bounds

    @property
    def dimension(self) -> int:
        """2 or 3."""
        return len(self.bounds)

    def targets_at(self, step: int) -> FloatArray:
        """Return target positions at a discrete step, (n, d) [m], reflected at the bounds."""
        if self.walk == 0.0:
            return self.targets
        if not self._trajectory:
            self._trajectory.append(self.targets)
        low, high = self.bounds[:, 0], self.bounds[:, 1]
        while len(self._trajectory) <= step:
            generator = noise_stream(self.seed, step=len(self._trajectory), purpose='walk')
            moved = self._trajectory[-1] + self.walk * generator.standard_normal(self.targets.shape)
            moved = np.where(moved < low, 2.0 * low - moved, moved)
            self._trajectory.append(np.where(moved > high, 2.0 * high - moved, moved))
        return self._trajectory[step]

    def targets_3d_at(self, step: int) -> FloatArray:
        """Return the same with three coordinates, (n, 3); in 2D on the terrain, or at z = 0."""
        if self.area.terrain is not None:
            return self.area.terrain.on_ground(self.targets_at(step))
        return np.pad(self.targets_at(step), ((0, 0), (0, 3 - self.dimension)))

    @classmethod
    def from_settings(
        cls, environment: EnvironmentSettings, targets: TargetSettings, seed: int, step: float = 1.0
    ) -> World:
        """Create the world of a run, equal for equal seeds; `step`: its length [s]."""
        area = Area(environment)
        bounds = area.bounds
        if targets.positions is not None:
            positions = np.empty((len(targets.positions), len(bounds)))
            for index, row in enumerate(targets.positions):
                if len(row) != len(bounds):
                    raise ValueError(
                        f'targets.positions[{index}]: got {len(row)} coordinates, allowed '
                        f'{len(bounds)}'
                    )
                if not area.inside([row])[0]:
                    raise ValueError(
                        f'targets.positions[{index}]: got {row}, allowed inside the area, within '
                        f'the bounds {bounds.tolist()}'
                    )
                positions[index] = row
                same = (positions[:index] == positions[index]).all(axis=1).nonzero()[0]
                if len(same):
                    raise ValueError(
                        f'targets.positions[{index}]: got {row}, which '
                        f'targets.positions[{same[0]}] is as well; allowed is one target '
                        'at each position'
                    )
        else:
            positions = draw_targets(targets, area, noise_stream(seed, purpose='targets'))
        labels = tuple(
            Label(
                targets.classes[i % len(targets.classes)] if targets.classes else '',
                1.0 if targets.classes else 0.0,
                f'target_{i + 1}' if targets.identified else '',
            )
            for i in range(len(positions) if targets.identified or targets.classes else 0)
        )
        return cls(area, positions, targets.walk * step**0.5, seed, labels)


def draw_targets(
    settings: TargetSettings, area: Area, generator: np.random.Generator
) -> FloatArray:
    """Draw target positions (count, d) [m], at least ``margin`` outside of all obstacles."""
    count, bounds = settings.count or 0, area.bounds
    low, high = bounds[:, 0] + settings.margin, bounds[:, 1] - settings.margin
    if np.any(low > high):
        raise ValueError(
            f'targets.margin: got {settings.margin}, allowed at most half the smallest side, '
            f'{0.5 * float((bounds[:, 1] - bounds[:, 0]).min()):g}'
        )
    for _ in range(_RESTARTS):
        drawn = _draw(settings, area, low, high, generator)
        if drawn is not None:
            return drawn
    raise ValueError(
        f'targets: got count {count} with separation {settings.separation} and margin '
        f'{settings.margin}, which do not fit into the bounds {bounds.tolist()}'
    )


def _draw(
    settings: TargetSettings,
    area: Area,
    low: FloatArray,
    high: FloatArray,
    generator: np.random.Generator,
) -> FloatArray | None:
    count = settings.count or 0
    centres = np.empty((0, len(low)))
    spread = settings.spread or float((high - low).mean()) / 15.0
    if settings.distribution == 'clustered':
        centres = generator.uniform(low, high, size=(settings.clusters, len(low)))
    drawn = np.empty((count, len(low)))
    for index in range(count):
        for _ in range(_ATTEMPTS):
            if settings.distribution == 'clustered':
                # Centres in turn, so that each has targets.
                position = generator.normal(centres[index % len(centres)], spread)
                if np.any((position < low) | (position > high)):
                    continue
                if not area.inside(position[None, :])[0]:
                    continue
            else:
                by_prior = settings.distribution == 'prior'
                place = area.draw(generator, low, high, by_prior)
                if place is None:
                    continue
                position = place
            if index and np.linalg.norm(drawn[:index] - position, axis=1).min() < (
                settings.separation
            ):
                continue
            solid = area.distances(np.pad(position, (0, 3 - len(position))))
            if solid.min(initial=np.inf) < settings.margin:
                continue
            drawn[index] = position
            break
        else:
            return None
    return drawn
