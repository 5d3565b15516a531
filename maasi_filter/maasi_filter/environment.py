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
from shapely.geometry import MultiPolygon, Polygon, shape

from maasi_filter.arrays import FloatArray
from maasi_filter.geodesy import OriginSettings, to_map
from maasi_filter.settings import Finite, Positive, Settings, Vector2

_NUMBER = '-+.0123456789'  # with which a number begins
_MOST_PIXELS = 25_000_000  # of maps and rasters, as 5000 x 5000: 200 MB as numbers
# Of files that an environment names.
FILES = ('.geojson', '.json', '.npy', '.png', '.jpg', '.jpeg', '.pgm', '.yaml', '.tif', '.tiff')


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


def read_shape(value: Any, project: Callable[[FloatArray], FloatArray] | None = None) -> Any:
    """Return the polygons of a value: rings [m], well-known text, GeoJSON, or a file of it.

    project: from longitudes and latitudes (n, 2) [degrees] to the map [m]; ValueError where
    GeoJSON has to do without it, or what is read is no valid polygon.
    """
    if isinstance(value, str) and value.lstrip().upper().startswith(('POLYGON', 'MULTIPOLYGON')):
        found = shapely.from_wkt(value)
    elif isinstance(value, str) and value.endswith('.yaml'):
        found = read_map(value)
    elif isinstance(value, (list, tuple)):
        rings = value if value and np.ndim(value[0][0]) else [value]
        found = Polygon(rings[0], rings[1:])
    else:
        features = features_of(value)
        found = shapely.union_all([_geometry(feature) for feature in features])
        if not all(_facts(feature).get('unit') == 'm' for feature in features):
            if project is None:
                raise ValueError('GeoJSON needs environment.origin')
            found = shapely.transform(found, project)
    if not isinstance(found, (Polygon, MultiPolygon)) or found.is_empty:
        raise ValueError(f'got {str(value)[:60]}, allowed are polygons')
    if not found.is_valid:
        raise ValueError(f'got {str(value)[:60]}, {shapely.is_valid_reason(found)}')
    return found


def features_of(value: Any) -> list[dict[str, Any]]:
    """Return the features of GeoJSON, given as values, as text or as the name of a file."""
    try:
        if isinstance(value, str) and value.startswith('{'):
            value = json.loads(value)
        elif isinstance(value, str) and _is_geojson(value):
            value = json.loads(Path(value).read_text(encoding='utf-8'))
    except OSError as error:
        raise ValueError(f'{value}: {error.strerror}') from None
    except ValueError as error:
        raise ValueError(f'{value[:60]}: is not JSON: {error}') from None
    if not isinstance(value, Mapping):
        raise ValueError(f'got {str(value)[:60]}, allowed is GeoJSON')
    one = value if value.get('type') == 'Feature' else {'type': 'Feature', 'geometry': value}
    features = value.get('features') if value.get('type') == 'FeatureCollection' else [one]
    if not isinstance(features, list) or not all(isinstance(one, Mapping) for one in features):
        raise ValueError(f'features: got {str(features)[:60]}, allowed is a list of features')
    return features


def _facts(feature: Mapping[str, Any]) -> Mapping[str, Any]:
    return feature.get('properties') or {}


def _geometry(feature: Mapping[str, Any]) -> Any:
    try:
        return shape(feature['geometry'])
    except (KeyError, TypeError, ValueError, AttributeError, IndexError, shapely.GEOSException):
        raise ValueError(f'got {str(feature)[:60]}, allowed are features with geometry') from None


def read_image(path: str) -> FloatArray:
    """Return the grey values of an image, 0 to 255 (rows, columns)."""
    # Deferred: only maps and priors that are images need it.
    from PIL import Image

    try:
        with warnings.catch_warnings():
            # Sizes are checked here.
            warnings.simplefilter('ignore', Image.DecompressionBombWarning)
            with Image.open(path) as image:
                check_pixels((image.height, image.width))
                return np.asarray(image.convert('L'), dtype=float)
    except Image.DecompressionBombError:
        raise ValueError(f'is larger than {_MOST_PIXELS} pixels: scale it down') from None


def check_pixels(shape: Sequence[int]) -> None:
    """Raise ValueError if a raster has more cells than what needs them can hold."""
    if math.prod(shape) > _MOST_PIXELS:
        raise ValueError(
            f'got {" x ".join(map(str, shape))} cells, allowed are at most {_MOST_PIXELS} in all: '
            'scale it down'
        )


def read_map(path: str) -> Any:
    """Return the occupied cells of a map of Nav2 (YAML and PGM or PNG) as polygons [m, map]."""
    import yaml

    try:
        facts = yaml.safe_load(Path(path).read_text(encoding='utf-8'))
        cell, (west, south, yaw) = float(facts['resolution']), map(float, facts['origin'])
        grey = read_image(str(Path(path).parent / facts['image'])) / 255.0
        occupied = (grey if facts['negate'] else 1.0 - grey) > float(facts['occupied_thresh'])
    except (OSError, KeyError, TypeError, ValueError, yaml.YAMLError) as error:
        raise ValueError(f'{path}: is no map of Nav2: {error}') from None
    if yaw != 0.0:
        raise ValueError(f'{path}: origin: got a yaw of {yaw}, allowed is 0')
    # A box for each run of cells in a row, as one for each cell takes seconds.
    ends = np.diff(np.pad(occupied, ((0, 0), (1, 1))).astype(np.int8), axis=1)
    row, first = np.nonzero(ends == 1)
    last = np.nonzero(ends == -1)[1]
    x, y = west + cell * np.array([first, last]), south + cell * (len(occupied) - row)
    lower = south + cell * (len(occupied) - 1 - row)
    cells = shapely.union_all(shapely.box(x[0], lower, x[1], y))
    # Slanted walls are stairs of cells; the result covers them.
    return cells.buffer(0.5 * cell, join_style='mitre').simplify(0.5 * cell)


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
    roles: dict[str, list[dict[str, Any]]] = {'area': [], 'keep_out': [], 'prior': []}
    area, origin, prior = values.get('area'), values.get('origin'), values.get('prior')
    if _is_geojson(area):
        with _at(area, 'area'):
            for feature in features_of(area):
                role = _facts(feature).get('role', 'area')
                if role not in roles:
                    raise ValueError(f'got role {role}, allowed are area, keep_out, prior')
                roles[role].append(feature)
            facts = [_facts(item) for item in roles['area']]
            # That of the run on whose page it was drawn.
            said = [item['origin'] for item in facts if item.get('origin')]
            origin = origin or next(iter(said), None)
            if not origin and any(item.get('unit') != 'm' for item in facts):
                whole = shapely.union_all([_geometry(item) for item in roles['area']])
                west, south, east, north = whole.bounds
                origin = {'latitude': 0.5 * (south + north), 'longitude': 0.5 * (west + east)}
        area = {'type': 'FeatureCollection', 'features': roles['area']}
    if origin:
        with _at(origin, 'origin'):
            values['origin'] = OriginSettings.model_validate(origin)

    def project(degrees: FloatArray) -> FloatArray:
        return to_map(degrees, values['origin'])

    def text(value: Any, *key: str | int) -> str:
        with _at(value, *key):
            found = read_shape(value, project if origin else None)
        rounded = str(shapely.to_wkt(found, rounding_precision=4))
        if not shapely.from_wkt(rounded).is_valid:
            # Corners that touch, as those of cells of a map, may cross where they are rounded.
            rounded = str(shapely.to_wkt(shapely.set_precision(found, 1e-4), rounding_precision=4))
        return rounded

    def zone(item: Any, *key: str | int) -> Any:
        round_one = isinstance(item, Zone) or (isinstance(item, Mapping) and 'centre' in item)
        row = isinstance(item, str) and Path(item).suffix not in FILES and item[:1] in _NUMBER
        if round_one or row:
            return item
        inner = item['polygon'] if isinstance(item, Mapping) and 'polygon' in item else item
        return {'polygon': text(inner, *key)}

    if area:
        values['area'] = text(area, 'area')
        west, south, east, north = shapely.from_wkt(values['area']).bounds
        values['bounds'] = [[west, east], [south, north]]
        if values.get('altitude') is not None:
            values['bounds'].append(values['altitude'])
    elif values.get('altitude') is not None:
        with _at(values['altitude'], 'altitude'):
            raise ValueError('allowed with area; bounds have the heights themselves')
    for key, role in (('keep_outs', 'keep_out'), ('obstacles', 'obstacle')):
        items, more = values.get(key) or [], roles.get(role, [])
        if isinstance(items, (list, tuple)):
            values[key] = [zone(item, key, index) for index, item in enumerate(items)]
            values[key] += [zone(item, 'area') for item in more]
    parts = [('area', item) for item in roles['prior']]
    if isinstance(prior, list) or _is_geojson(prior):
        with _at(prior, 'prior'):
            items = prior if isinstance(prior, list) else [prior]
            parts += [('prior', part) for item in items for part in features_of(item)]
        prior = {}
    elif isinstance(prior, str):
        prior = {'raster': prior}
    if isinstance(prior, Mapping) or parts:
        prior = dict(prior or {})
        polygons = [
            {**item, 'polygon': text(item['polygon'], 'prior', 'polygons', index, 'polygon')}
            if isinstance(item, Mapping) and 'polygon' in item
            else item
            for index, item in enumerate(prior.get('polygons') or [])
        ]
        for key, item in parts:
            weight = _facts(item).get('weight', 1.0)
            polygons.append({'polygon': text(item, key), 'weight': weight})
        values['prior'] = {**prior, 'polygons': polygons}
    return values


def _is_geojson(value: Any) -> bool:
    if isinstance(value, str):
        return Path(value).suffix in ('.json', '.geojson')
    return isinstance(value, Mapping) and 'type' in value
