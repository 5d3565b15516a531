"""Settings of the search area: keep-outs, obstacles, prior and geographic origin.

Shapes are given in metres of the map, as GeoJSON (degrees, RFC 7946), or as well-known text.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
from pydantic import Field, model_validator

from maasi_filter.arrays import FloatArray
from maasi_filter.geometry.geodesy import OriginSettings
from maasi_filter.geometry.readers import Shape, environment_in_metres, errors_at
from maasi_filter.settings import Finite, Intervals, Positive, Settings, Vector2


class Zone(Settings):
    """A zone: a polygon, a cylinder (2D: a disc) or, with three coordinates, a sphere."""

    centre: list[Finite] | None = Field(
        None, min_length=2, max_length=3, description='Centre of a round zone [m, map]'
    )
    radius: Positive | None = Field(None, description='Radius of a round zone [m]')
    polygon: Shape | None = Field(
        None,
        description='Corners [m, map], GeoJSON or a file as for area; stored as well-known text',
    )

    @model_validator(mode='before')
    @classmethod
    def _from_text(cls, value: Any) -> Any:
        if not isinstance(value, str):
            return value
        if value[:1].isalpha():
            return {'polygon': value}
        try:
            *centre, radius = map(float, value.split())
        except ValueError:
            centre, radius = [], 0.0
        if len(centre) not in (2, 3):
            raise ValueError(f'got {value!r}, allowed are x y radius, x y z radius, or a polygon')
        return {'centre': centre, 'radius': radius}

    @model_validator(mode='after')
    def _one_kind(self) -> Zone:
        round_one = self.centre is not None and self.radius is not None
        if (self.polygon is None) != round_one or (self.centre is None) != (self.radius is None):
            raise ValueError('allowed are centre and radius, or polygon')
        return self

    def __str__(self) -> str:
        if self.polygon is not None:
            return str(self.polygon)
        return ' '.join(map(repr, [*(self.centre or []), self.radius]))


class PriorPart(Settings):
    """A polygon with another density of targets than elsewhere."""

    polygon: Shape = Field(description='Corners [m, map], GeoJSON or a file as for area')
    weight: float = Field(
        ge=0.0, description='Density of targets inside, relative to 1 outside of all polygons [1]'
    )

    @model_validator(mode='before')
    @classmethod
    def _from_text(cls, value: Any) -> Any:
        if not isinstance(value, str):
            return value
        weight, polygon = value.split(maxsplit=1)
        return {'polygon': polygon, 'weight': float(weight)}

    def __str__(self) -> str:
        return f'{self.weight!r} {self.polygon}'


class PriorSettings(Settings):
    """Density of targets, not normalised: polygons with weights, or a raster."""

    polygons: list[PriorPart] = Field(default_factory=list, description='Polygons with weights')
    raster: str | None = Field(
        None,
        description='File of target densities: .npy or an image, first row in the north; or '
        'GeoTIFF',
    )
    band: str | None = Field(
        None,
        description='Band of the raster that holds the densities: grey, red, green, blue or alpha '
        'of an image, or the number of a GeoTIFF band; default: grey, the first band',
    )
    extent: Intervals | None = Field(
        None,
        min_length=2,
        max_length=2,
        description='Lower and upper bound of the raster on x and y; default: those of the area; '
        'a GeoTIFF has its own [m, map]',
    )
    floor: float = Field(
        0.02,
        ge=0.0,
        le=1.0,
        description='Share of the targets that is spread evenly over the area, whatever the prior '
        'says [1]',
    )


class BackgroundSettings(Settings):
    """A picture below the map, which planning and filtering ignore."""

    file: str | None = Field(
        None, description='GeoTIFF, or an image with a world file or an extent; default: no picture'
    )
    extent: Intervals | None = Field(
        None,
        min_length=2,
        max_length=2,
        description='Lower and upper bound of an image on x and y; default: those of its world '
        'file [m, map]',
    )

    @model_validator(mode='before')
    @classmethod
    def _from_text(cls, value: Any) -> Any:
        return {'file': value} if isinstance(value, str) else value


class TerrainSettings(Settings):
    """Ground that is not flat."""

    file: str | None = Field(
        None,
        description='Heights: an Esri ASCII grid (.asc) in metres of the map, or a GeoTIFF; '
        'default: flat ground at z = 0',
    )
    unit: Literal['m', 'ft', 'us-ft'] | None = Field(
        None, description='Unit of the heights; default: that of the file, or metres'
    )
    zero: Finite | None = Field(
        None,
        description='Height in the file at which z = 0; default: 0 in a file without coordinate '
        'system, else the ground at x = y = 0 [m]',
    )

    @model_validator(mode='before')
    @classmethod
    def _from_text(cls, value: Any) -> Any:
        return {'file': value} if isinstance(value, str) else value


class EnvironmentSettings(Settings):
    """The search area: `bounds`, or an `area` with its altitudes."""

    bounds: Intervals = Field(
        min_length=2, max_length=3, description='Lower and upper bound on each map axis [m]'
    )
    area: Shape | None = Field(
        None,
        description='Polygons in place of bounds: corners or rings [m, map], GeoJSON, or a file: '
        '.geojson, .kml, .kmz, .gpx, .plan, .waypoints, .poly, .shp, .gpkg; stored as well-known '
        'text',
    )
    altitude: Vector2 | None = Field(
        None, description='With area: lowest and highest z of targets; default: 2D [m]'
    )
    keep_outs: list[Zone] = Field(
        default_factory=list,
        description='Zones that hold no targets and that robots must not enter',
    )
    obstacles: list[Zone] = Field(
        default_factory=list,
        description='Solid obstacles; the list may contain names of Nav2 maps (YAML)',
    )
    prior: PriorSettings = Field(
        default_factory=PriorSettings, description='Where targets are likely'
    )
    expected_targets: float = Field(
        12.0, gt=0.0, description='N0, expected number of targets before the search [1]'
    )
    origin: OriginSettings | None = Field(
        None,
        description="Geographic position of the map's origin; default with an area in degrees: "
        'its centre',
    )

    background: BackgroundSettings = Field(
        default_factory=BackgroundSettings, description='Picture below the map'
    )
    terrain: TerrainSettings = Field(
        default_factory=TerrainSettings,
        description='Heights of the ground: targets stand on it, hills hide them, and heights of '
        'robots are above it',
    )

    @model_validator(mode='before')
    @classmethod
    def _in_metres(cls, value: Any) -> Any:
        return environment_in_metres(value) if isinstance(value, Mapping) else value

    @model_validator(mode='after')
    def _fitting(self) -> EnvironmentSettings:
        for key in ('keep_outs', 'obstacles'):
            most = 2 if key == 'keep_outs' else self.dimension
            for index, zone in enumerate(getattr(self, key)):
                with errors_at(zone.centre, key, index, 'centre'):
                    if len(zone.centre or ()) > most:
                        raise ValueError(f'got {zone.centre}, allowed are {most} coordinates')
        if self.terrain.file is not None and self.dimension == 3:
            with errors_at(self.terrain, 'terrain'):
                raise ValueError('allowed with two axes only: targets stand on the ground')
        return self

    def without_keep_outs(self) -> EnvironmentSettings:
        """Return the settings without keep-outs, which can change during a search."""
        return self.model_copy(update={'keep_outs': []})

    @property
    def dimension(self) -> int:
        """2 or 3."""
        return len(self.bounds)

    def array(self) -> FloatArray:
        """Return the bounds, (d, 2)."""
        return np.array(self.bounds, dtype=float)
