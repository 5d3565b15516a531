"""Readers of the shapes of an environment, into polygons in metres of the map."""

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import shapely
from pydantic import PlainSerializer, PlainValidator, ValidationError
from shapely.geometry.base import BaseGeometry

from maasi_filter.geometry.geodesy import OriginSettings
from maasi_filter.geometry.geojson import FILES as FEATURE_FILES
from maasi_filter.geometry.geojson import (
    Feature,
    by_role,
    features_of,
    is_geojson,
    origin_of,
    polygons_of,
    weight_of,
    with_role,
)
from maasi_filter.geometry.occupancy_map import read_map
from maasi_filter.geometry.polygons import is_wkt, of_rings, of_text, warn, with_few_corners
from maasi_filter.settings import Settings

_NUMBER = '-+.0123456789'  # first characters of numbers
_MAPS = ('.yaml', '.yml')
_IMAGES = ('.npy', '.png', '.jpg', '.jpeg', '.pgm', '.tif', '.tiff')
FILES = (*FEATURE_FILES, *_MAPS, *_IMAGES, '.asc')
_ROLE_OF = {'keep_outs': 'keep_out', 'obstacles': 'keep_out', 'prior': 'prior'}  # by key
DEGREES = 0.1  #: shorter shapes are in degrees [m]
_LARGEST = 10e9  # of an area in degrees [m^2]
_FARTHEST = 100e3  # of an area from the origin of its map, which is flat [m]


def read_shape(value: Any, origin: OriginSettings | None = None) -> BaseGeometry:
    """Return the polygons of a value: rings [m], well-known text, a Nav2 map, or GeoJSON.

    ValueError if a polygon is invalid, or GeoJSON in degrees has no origin.
    """
    if isinstance(value, BaseGeometry):
        return value
    if is_wkt(value):
        return of_text(value)
    if isinstance(value, str) and Path(value).suffix.lower() in _MAPS:
        return read_map(value)
    if isinstance(value, (list, tuple)):
        drawn = value and isinstance(value[0], Feature)
        return polygons_of(value, origin) if drawn else of_rings(value)
    return polygons_of(features_of(value), origin)


#: Polygons in metres of the map; as text, well-known text.
Shape = Annotated[BaseGeometry, PlainValidator(read_shape), PlainSerializer(str, return_type=str)]


def environment_in_metres(given: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of an environment with all shapes in the map, and the bounds of its area.

    GeoJSON of an area may contain the origin, keep-outs and the prior, by role.
    """
    values = dict(given)
    area, origin = values.get('area'), values.get('origin')
    roles: dict[str, list[Feature]] = {}
    if is_geojson(area):
        with errors_at(area, 'area'):
            roles = by_role(area)
            origin = origin or origin_of(roles['area'])
    if origin:
        with errors_at(origin, 'origin'):
            origin = values['origin'] = OriginSettings.model_validate(origin)
    read = partial(_read, origin or None)
    if area:
        found = values['area'] = read(roles.get('area', area), 'area')
        with errors_at(area, 'area'):
            _check_area(found, bool(roles), given.get('origin'))
        west, south, east, north = found.bounds
        values['bounds'] = [[west, east], [south, north]]
        if values.get('altitude') is not None:
            values['bounds'].append(values['altitude'])
    elif values.get('altitude') is not None:
        with errors_at(values['altitude'], 'altitude'):
            raise ValueError('allowed with area; bounds have the heights themselves')
    for key in ('keep_outs', 'obstacles'):
        items = values.get(key) or []
        if is_geojson(items) or (isinstance(items, str) and Path(items).suffix.lower() in FILES):
            items = [items]
        if isinstance(items, (list, tuple)):
            values[key] = [_zone(read, item, key, index) for index, item in enumerate(items)]
            for item in roles.get('keep_out', ()) if key == 'keep_outs' else ():
                values[key].append({'polygon': read([item], 'area')})
                if found.disjoint(values[key][-1]['polygon']):
                    warn(
                        f'{item.name}: role keep_out: as environment.{key}[{len(values[key]) - 1}] '
                        'it does not touch the area'
                    )
    prior = _prior(read, values.get('prior'), roles.get('prior', []))
    return values if prior is None else {**values, 'prior': prior}


def _read(origin: OriginSettings | None, value: Any, *key: str | int) -> BaseGeometry:
    """Return the polygons of a value at a key, rounded to 0.1 mm where that is valid."""
    if isinstance(value, BaseGeometry):
        return value
    with errors_at(value, *key):
        if is_geojson(value) and key[0] in _ROLE_OF:
            value = with_role(features_of(value), _ROLE_OF[str(key[0])], f'environment.{key[0]}')
        found = read_shape(value, origin)
        if not (isinstance(value, str) and Path(value).suffix.lower() in _MAPS):
            found = with_few_corners(found, f'environment.{".".join(map(str, key))}')
    rounded = shapely.from_wkt(shapely.to_wkt(found, rounding_precision=4))
    return rounded if rounded.is_valid else shapely.from_wkt(str(found))


def _zone(read: Callable[..., BaseGeometry], item: Any, *key: str | int) -> Any:
    round_one = isinstance(item, Settings) or (isinstance(item, Mapping) and 'centre' in item)
    row = isinstance(item, str) and Path(item).suffix.lower() not in FILES
    if round_one or (row and item[:1] in _NUMBER):
        return item
    inner = item['polygon'] if isinstance(item, Mapping) and 'polygon' in item else item
    return {'polygon': read(inner, *key)}


def _prior(
    read: Callable[..., BaseGeometry], prior: Any, parts: Sequence[Feature]
) -> dict[str, Any] | None:
    """Return a prior with polygons in the map, with the parts from the file of the area."""
    found = [('area', item) for item in parts]
    if isinstance(prior, list) or is_geojson(prior):
        with errors_at(prior, 'prior'):
            for item in prior if isinstance(prior, list) else [prior]:
                own = with_role(features_of(item), 'prior', 'environment.prior')
                found += [('prior', part) for part in own]
        prior = {}
    elif isinstance(prior, str):
        prior = {'raster': prior}
    if not isinstance(prior, Mapping) and not found:
        return None
    prior = dict(prior or {})
    polygons = [
        {**item, 'polygon': read(item['polygon'], 'prior', 'polygons', index, 'polygon')}
        if isinstance(item, Mapping) and 'polygon' in item
        else item
        for index, item in enumerate(prior.get('polygons') or [])
    ]
    for key, item in found:
        with errors_at(item, key):
            weight = weight_of(item)
        polygons.append({'polygon': read([item], key), 'weight': weight})
    return {**prior, 'polygons': polygons}


@contextmanager
def errors_at(value: Any, *key: str | int) -> Iterator[None]:
    """Turn a ValueError into one at the key of its value."""
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


def _check_area(area: BaseGeometry, drawn: bool, origin: Any) -> None:
    """Raise ValueError if distance or size of an area suggest wrong units."""
    west, south, east, north = area.bounds
    gap, length = area.distance(shapely.Point(0.0, 0.0)), max(east - west, north - south)
    if drawn and origin and gap > _FARTHEST:
        raise ValueError(
            f'lies {gap / 1e3:,.0f} km from environment.origin, allowed are {_FARTHEST / 1e3:g}: '
            'is the latitude first in one of them? GeoJSON has the longitude first'
        )
    if drawn and area.area > _LARGEST:
        raise ValueError(
            f'covers {area.area / 1e6:,.0f} km2, allowed are {_LARGEST / 1e6:,.0f}: are these '
            'metres, or is the latitude first? GeoJSON has the longitude first, in degrees'
        )
    if not drawn and length < DEGREES:
        raise ValueError(
            f'is {length:.2g} m long, and corners are in metres of the map: are these degrees? '
            'Write them as GeoJSON'
        )


def shapes_of_texts(zones: Iterable[str]) -> list[Any]:
    """Return zones of received texts; ValueError if a text could name a file of this host.

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
                raise ValueError(f'keep_outs: {index}: got {text[:60]!r}, is not JSON') from None
            known = isinstance(shape, list) or 'polygon' not in shape
        elif text and text[0] in _NUMBER:
            known = len(text.split()) in (3, 4)
        else:
            known = is_wkt(text)
        if not known:
            raise ValueError(
                f'keep_outs: {index}: got {text[:60]!r}, allowed are x y radius, '
                'POLYGON ((x y, ...)), GeoJSON and [[x, y], ...], as text'
            )
        shapes.append(shape)
    return shapes
