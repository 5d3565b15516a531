"""The settings of where a search takes place: area, keep-outs, obstacles, prior, position on earth.

Shapes are given in metres of the map, as GeoJSON (degrees, RFC 7946), or as well-known text.
"""

from __future__ import annotations

import json
import math
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from pydantic import Field, ValidationError, field_validator, model_validator
from shapely.geometry.base import BaseGeometry

from maasi_filter.arrays import FloatArray
from maasi_filter.geometry.geodesy import OriginSettings
from maasi_filter.geometry.shapes import (
    Feature,
    InputWarning,
    centre_of,
    check_size,
    features_of,
    is_geojson,
    polygons_of,
    read_shape,
    short,
)
from maasi_filter.settings import Finite, Positive, Settings, Vector2

_NUMBER = '-+.0123456789'  # with which a number begins
# Of files that an environment names.
_IMAGES = ('.npy', '.png', '.jpg', '.jpeg', '.pgm', '.tif', '.tiff')
FILES = ('.geojson', '.json', '.yaml', '.yml', *_IMAGES)
_ROLES = ('area', 'keep_out', 'prior')  # of features of GeoJSON
_ROLE_OF = {'keep_outs': 'keep_out', 'obstacles': 'keep_out', 'prior': 'prior'}  # by key
_DEGREES = 0.1  # an area that is shorter is not in metres, but in degrees [m]
_FARTHEST = 100e3  # of an area from the origin of its map, which is flat [m]


class Zone(Settings):
    """A zone: a polygon, a cylinder (2D: a disc) or, with three coordinates, a sphere."""

    centre: list[Finite] | None = Field(
        None, min_length=2, max_length=3, description='Centre of a round one [m, map]'
    )
    radius: Positive | None = Field(None, description='Radius of a round one [m]')
    polygon: str | None = Field(
        None,
        description='Corners [m, map], GeoJSON or the name of its file; kept as well-known text',
    )

    @model_validator(mode='before')
    @classmethod
    def _from_text(cls, value: Any) -> Any:
        if not isinstance(value, str):
            return value
        if value[:1].isalpha():
            return {'polygon': value}
        words = value.split()
        if len(words) not in (3, 4):
            raise ValueError(f'got {value!r}, allowed are x y radius, x y z radius, or a polygon')
        *centre, radius = map(float, words)
        return {'centre': centre, 'radius': radius}

    @model_validator(mode='after')
    def _one_kind(self) -> Zone:
        round_one = self.centre is not None and self.radius is not None
        if (self.polygon is None) != round_one or (self.centre is None) != (self.radius is None):
            raise ValueError('allowed are centre and radius, or polygon')
        return self

    def __str__(self) -> str:
        if self.polygon is not None:
            return self.polygon
        return ' '.join(map(repr, [*(self.centre or []), self.radius]))


class PriorPart(Settings):
    """A polygon in which targets are more or less likely than elsewhere."""

    polygon: str = Field(description='As of a zone')
    weight: float = Field(ge=0.0, description='How likely, against 1 outside of all polygons [1]')

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
    """Where targets are likely: polygons with weights, or a raster, not normalised."""

    polygons: list[PriorPart] = Field(default_factory=list, description='Polygons with weights')
    raster: str | None = Field(
        None, description='File of densities: .npy or an image, first row north; or GeoTIFF'
    )
    band: str | None = Field(
        None,
        description='What of the raster counts: grey, red, green, blue or alpha of an image, or '
        'the number of a band of a GeoTIFF; none: grey, the first band',
    )
    extent: list[Vector2] | None = Field(
        None,
        min_length=2,
        max_length=2,
        description='Lower and upper bound of the raster on x and y; none: of the area; GeoTIFF '
        'has its own [m, map]',
    )
    floor: float = Field(
        0.02,
        ge=0.0,
        le=1.0,
        description='Share of the targets that may be anywhere, whatever the prior promises [1]',
    )

    @field_validator('extent')
    @classmethod
    def _ordered(cls, value: list[list[float]] | None) -> list[list[float]] | None:
        return value if value is None else _ascending(value)


class BackgroundSettings(Settings):
    """A picture that is shown under the map; nothing is planned or filtered with it."""

    file: str | None = Field(
        None, description='GeoTIFF, or an image with a world file or an extent; none: no picture'
    )
    extent: list[Vector2] | None = Field(
        None,
        min_length=2,
        max_length=2,
        description='Lower and upper bound of an image on x and y; none: by its file [m, map]',
    )

    @model_validator(mode='before')
    @classmethod
    def _from_text(cls, value: Any) -> Any:
        return {'file': value} if isinstance(value, str) else value

    @field_validator('extent')
    @classmethod
    def _ordered(cls, value: list[list[float]] | None) -> list[list[float]] | None:
        return value if value is None else _ascending(value)


class EnvironmentSettings(Settings):
    """Where the targets are, and where robots may go: `bounds`, or an `area` with its altitudes."""

    bounds: list[Vector2] = Field(
        min_length=2, max_length=3, description='Lower and upper bound on each map axis [m]'
    )
    area: str | None = Field(
        None,
        description='Polygons in place of bounds: corners or rings [m, map], GeoJSON or its file; '
        'kept as well-known text',
    )
    altitude: Vector2 | None = Field(
        None, description='With area: lowest and highest z of targets; none: 2D [m]'
    )
    keep_outs: list[Zone] = Field(
        default_factory=list, description='No target is expected there, and no robot goes there'
    )
    obstacles: list[Zone] = Field(
        default_factory=list,
        description='Solid things in the way; also names of maps of Nav2 (YAML), in a list',
    )
    prior: PriorSettings = Field(
        default_factory=PriorSettings, description='Where targets are likely'
    )
    expected_targets: float = Field(
        12.0, gt=0.0, description='N0, targets expected in all before the search [1]'
    )
    origin: OriginSettings | None = Field(
        None, description='Of the map on the earth; with GeoJSON, none: amid its area'
    )

    background: BackgroundSettings = Field(
        default_factory=BackgroundSettings, description='Picture under the map'
    )

    @model_validator(mode='before')
    @classmethod
    def _in_metres(cls, value: Any) -> Any:
        """Turn all shapes into well-known text in the map, and derive the bounds of an area."""
        return _in_metres(value) if isinstance(value, Mapping) else value

    @field_validator('bounds')
    @classmethod
    def _ordered(cls, value: list[list[float]]) -> list[list[float]]:
        return _ascending(value)

    @model_validator(mode='after')
    def _fitting(self) -> EnvironmentSettings:
        for key in ('keep_outs', 'obstacles'):
            most = 2 if key == 'keep_outs' else self.dimension
            for index, zone in enumerate(getattr(self, key)):
                with _at(zone.centre, key, index, 'centre'):
                    if len(zone.centre or ()) > most:
                        raise ValueError(f'got {zone.centre}, allowed are {most} coordinates')
        return self

    def without_keep_outs(self) -> EnvironmentSettings:
        """Return the settings without what changes while a search runs."""
        return self.model_copy(update={'keep_outs': []})

    @property
    def dimension(self) -> int:
        """2 or 3."""
        return len(self.bounds)

    def array(self) -> FloatArray:
        """Return the bounds, (d, 2)."""
        return np.array(self.bounds, dtype=float)


def _ascending(bounds: list[list[float]]) -> list[list[float]]:
    for axis, pair in enumerate(bounds):
        if not pair[0] < pair[1]:
            raise ValueError(f'axis {axis}: got {pair}, allowed is [lower, upper], lower < upper')
    return bounds


def shapes_of_texts(zones: Iterable[str]) -> list[Any]:
    """Return zones that were received as texts; ValueError if one could name a file of this host.

    Allowed are `x y radius`, well-known text, GeoJSON, and rings as JSON.
    """
    shapes: list[Any] = []
    for index, zone in enumerate(zones):
        text = zone.strip()
        shape: Any = text
        if text.startswith(('{', '[')):
            try:
                shape = json.loads(text)
            except (ValueError, RecursionError):
                raise ValueError(f'keep_outs: {index}: got {text[:60]!r}, is no JSON') from None
            known = isinstance(shape, list) or 'polygon' not in shape
        elif text and text[0] in _NUMBER:
            known = len(text.split()) in (3, 4)
        else:
            known = text.upper().startswith(('POLYGON', 'MULTIPOLYGON'))
        if not known:
            raise ValueError(
                f'keep_outs: {index}: got {text[:60]!r}, allowed are x y radius, '
                'POLYGON ((x y, ...)), GeoJSON and [[x, y], ...], as text'
            )
        shapes.append(shape)
    return shapes


@contextmanager
def _at(value: Any, *key: str | int) -> Iterator[None]:
    """Make what is wrong with a value an error at its key."""
    problems: list[Any]
    try:
        yield
    except ValidationError as error:
        problems = [{**item, 'loc': (*key, *item['loc'])} for item in error.errors()]
    except (ValueError, TypeError, LookupError, OSError, shapely.errors.ShapelyError) as error:
        wrong = ValueError(str(error))
        problems = [{'type': 'value_error', 'loc': key, 'input': value, 'ctx': {'error': wrong}}]
    else:
        return
    raise ValidationError.from_exception_data('environment', problems) from None


def _in_metres(given: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of an environment with all shapes as well-known text in the map."""
    values = dict(given)
    roles: dict[str, list[Feature]] = {role: [] for role in _ROLES}
    area, origin, prior = values.get('area'), values.get('origin'), values.get('prior')
    drawn = is_geojson(area)
    if drawn:
        with _at(area, 'area'):
            for feature in features_of(area):
                roles[_role(feature)].append(feature)
            if not roles['area']:
                raise ValueError(
                    f'{short(area)}: no polygon has the role area; keep-outs alone belong under '
                    'environment.keep_outs'
                )
            # That of the run on whose page it was drawn.
            said = (item.properties.get('origin') for item in roles['area'])
            # Other programs have other things under that name.
            drawn_at = (item for item in said if isinstance(item, Mapping) and 'latitude' in item)
            origin = origin or next(drawn_at, None)
            if not origin and not all(item.in_metres for item in roles['area']):
                origin = centre_of(roles['area'])
    if origin:
        with _at(origin, 'origin'):
            values['origin'] = OriginSettings.model_validate(origin)
    on_earth = values['origin'] if origin else None

    def text(value: Any, *key: str | int) -> str:
        with _at(value, *key):
            if isinstance(value, Feature):
                found = polygons_of([value], on_earth)
            elif is_geojson(value) and key[0] in _ROLE_OF:
                found = polygons_of(_belonging(features_of(value), str(key[0])), on_earth)
            else:
                found = read_shape(value, on_earth)
        return _text(found)

    def zone(item: Any, *key: str | int) -> Any:
        round_one = isinstance(item, Zone) or (isinstance(item, Mapping) and 'centre' in item)
        row = isinstance(item, str) and Path(item).suffix.lower() not in FILES
        if round_one or (row and item[:1] in _NUMBER):
            return item
        inner = item['polygon'] if isinstance(item, Mapping) and 'polygon' in item else item
        return {'polygon': text(inner, *key)}

    if drawn:
        with _at(area, 'area'):
            found = polygons_of(roles['area'], on_earth)
            _check_distance(found, given.get('origin'))
            check_size(found)
        values['area'] = _text(found)
    elif area:
        values['area'] = text(area, 'area')
        with _at(area, 'area'):
            _check_metres(shapely.from_wkt(values['area']))
    if area:
        west, south, east, north = shapely.from_wkt(values['area']).bounds
        values['bounds'] = [[west, east], [south, north]]
        if values.get('altitude') is not None:
            values['bounds'].append(values['altitude'])
    elif values.get('altitude') is not None:
        with _at(values['altitude'], 'altitude'):
            raise ValueError('allowed with area; bounds have the heights themselves')
    for key, role in (('keep_outs', 'keep_out'), ('obstacles', 'obstacle')):
        items, more = values.get(key) or [], roles.get(role, [])
        if is_geojson(items) or (isinstance(items, str) and Path(items).suffix.lower() in FILES):
            items = [items]
        if isinstance(items, (list, tuple)):
            values[key] = [zone(item, key, index) for index, item in enumerate(items)]
            for item in more:
                values[key].append({'polygon': text(item, 'area')})
                if found.disjoint(shapely.from_wkt(values[key][-1]['polygon'])):
                    index = len(values[key]) - 1
                    warnings.warn(
                        f'{item.name}: role {role}: as environment.{key}[{index}] it touches '
                        'nothing of the area',
                        InputWarning,
                        stacklevel=2,
                    )
    _give_prior(values, prior, roles['prior'], text)
    return values


def _give_prior(
    values: dict[str, Any],
    prior: Any,
    parts: Sequence[Feature],
    text: Callable[..., str],
) -> None:
    """Give an environment its prior with polygons as text; parts: those in the file of the area."""
    found = [('area', item) for item in parts]
    if isinstance(prior, list) or is_geojson(prior):
        with _at(prior, 'prior'):
            items = prior if isinstance(prior, list) else [prior]
            parts_of = (_belonging(features_of(item), 'prior') for item in items)
            found += [('prior', part) for some in parts_of for part in some]
        prior = {}
    elif isinstance(prior, str):
        prior = {'raster': prior}
    if not isinstance(prior, Mapping) and not found:
        return
    prior = dict(prior or {})
    polygons = [
        {**item, 'polygon': text(item['polygon'], 'prior', 'polygons', index, 'polygon')}
        if isinstance(item, Mapping) and 'polygon' in item
        else item
        for index, item in enumerate(prior.get('polygons') or [])
    ]
    for key, item in found:
        with _at(item, key):
            weight = _weight(item)
        polygons.append({'polygon': text(item, key), 'weight': weight})
    values['prior'] = {**prior, 'polygons': polygons}


def _text(found: BaseGeometry) -> str:
    """Return polygons as well-known text, to a tenth of a millimetre where that is valid."""
    rounded = str(shapely.to_wkt(found, rounding_precision=4))
    exact = not shapely.from_wkt(rounded).is_valid
    return str(shapely.to_wkt(found, rounding_precision=-1)) if exact else rounded


def _check_distance(area: BaseGeometry, origin: Any) -> None:
    """Raise ValueError if an origin that was given lies far from an area [m]."""
    gap = area.distance(shapely.Point(0.0, 0.0))
    if origin and gap > _FARTHEST:
        raise ValueError(
            f'lies {gap / 1e3:,.0f} km from environment.origin, allowed are {_FARTHEST / 1e3:g}: '
            'is the latitude first in one of them? GeoJSON has the longitude first'
        )


def _check_metres(area: BaseGeometry) -> None:
    """Raise ValueError if an area in metres is so small that it is in degrees."""
    west, south, east, north = area.bounds
    if max(east - west, north - south) < _DEGREES:
        raise ValueError(
            f'is {max(east - west, north - south):.2g} m long, and corners are in metres of the '
            'map: are these degrees? Write them as GeoJSON'
        )


def _belonging(features: Sequence[Feature], key: str) -> list[Feature]:
    """Return those of a file under a key; a role that belongs elsewhere is left out, by name."""
    wanted = _ROLE_OF[key]
    others = [item for item in features if item.properties.get('role') in _ROLES]
    others = [item for item in others if item.properties['role'] != wanted]
    words = '; '.join(f'{item.name}: role {item.properties["role"]}' for item in others[:5])
    if len(others) == len(features):
        raise ValueError(f'{words}; allowed under environment.{key} is role {wanted}, or none')
    if others:
        warnings.warn(
            f'environment.{key}: left out, as these have another role: {words}',
            InputWarning,
            stacklevel=2,
        )
    return [item for item in features if item not in others]


def _role(feature: Feature) -> str:
    """Return the role of a feature; programs write null or nothing for none."""
    role = feature.properties.get('role')
    if role in (None, ''):
        return 'area'
    if role not in _ROLES:
        raise ValueError(f'{feature.name}: role: read {role}, allowed are {", ".join(_ROLES)}')
    return str(role)


def _weight(feature: Feature) -> float:
    """Return the weight of a polygon of the prior; null or nothing is 1."""
    weight = feature.properties.get('weight')
    if weight in (None, ''):
        return 1.0
    try:
        number = float(weight)
    except (TypeError, ValueError):
        number = math.nan
    if isinstance(weight, bool) or not 0.0 <= number < math.inf:
        raise ValueError(
            f'{feature.name}: weight: read {short(weight)}, allowed are numbers from 0'
        )
    return number
