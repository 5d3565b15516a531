"""Reads polygons and points from GeoJSON of map programs."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from shapely.geometry import MultiPolygon, Polygon
from shapely.geometry.base import BaseGeometry

from maasi_filter.arrays import FloatArray
from maasi_filter.geometry.geodesy import OriginSettings, continued, to_map
from maasi_filter.geometry.map_files import LABEL, READERS, read_bytes, read_map_file, text_of
from maasi_filter.geometry.polygons import is_wkt, short, sound, warn
from maasi_filter.geometry.vector_files import VECTOR_FILES, read_vector_file

FILES = ('.json', '.geojson', *READERS, *VECTOR_FILES)  # with features
_ROLES = ('area', 'keep_out', 'prior')  # of polygons
_POINT_ROLES = ('start', 'home', 'charger')
_BEYOND = 10.0  # degrees by which areas of the page may exceed 180 degrees
_SIMPLE = ('Point', 'LineString', 'Polygon')
_KINDS = (*_SIMPLE, *(f'Multi{kind}' for kind in _SIMPLE), 'GeometryCollection')
_NAMED = 5  # most ignored features that a warning names
# Names of WGS 84 in degrees, longitude first; RFC 7946 allows no other system.
_WGS84 = re.compile(
    r'(CRS:?84h?|EPSG:{1,2}(4326|4979)|(?<!\d)4326|WGS[ _]?(19)?84)\)?$', re.IGNORECASE
)
_CONVERT = 'convert it: ogr2ogr -f GeoJSON -t_srs EPSG:4326 wgs84.geojson FILE'


@dataclass(frozen=True)
class Feature:
    """A GeoJSON feature with polygons in degrees, or in metres of the map."""

    name: str
    shape: BaseGeometry
    properties: Mapping[str, Any]

    @property
    def in_metres(self) -> bool:
        """Whether it was drawn on the page of a run without an origin, in metres of the map."""
        return bool(self.properties.get('unit') == 'm')


def is_geojson(value: Any) -> bool:
    """Return whether a value is GeoJSON or the name of a file with features."""
    if isinstance(value, str):
        return Path(value).suffix.lower() in FILES and not is_wkt(value)
    return isinstance(value, Mapping) and 'type' in value


def polygons_of(features: Sequence[Feature], origin: OriginSettings | None) -> BaseGeometry:
    """Return the union of features [m, map]; ValueError if an origin is missing."""
    if all(feature.in_metres for feature in features):
        return shapely.union_all([feature.shape for feature in features])
    if origin is None:
        raise ValueError('GeoJSON in degrees needs environment.origin')
    around = origin.longitude
    shapes = [_unwrapped(feature.shape, around) for feature in features]

    def project(degrees: FloatArray) -> FloatArray:
        return to_map(degrees, origin)

    found = shapely.transform(shapely.union_all(shapes), project)
    if found.is_valid:
        return found
    # Closes gaps of fractions of a millimetre, as straight edges bend on the map.
    parts = shapely.get_parts(shapely.make_valid(found))
    return shapely.union_all([part for part in parts if isinstance(part, (Polygon, MultiPolygon))])


def _unwrapped(shape: BaseGeometry, around: float) -> BaseGeometry:
    """Return a shape with longitudes at most 180 degrees from `around`."""

    def turn(degrees: FloatArray) -> FloatArray:
        turns = np.round((degrees[:, 0].mean() - around) / 360.0)
        return degrees - [360.0 * turns, 0.0]

    parts = [shapely.transform(part, turn) for part in shapely.get_parts(shape)]
    return shapely.union_all(parts)


def by_role(value: Any) -> dict[str, list[Feature]]:
    """Return the features of an area's GeoJSON by role; null or nothing means no role."""
    roles: dict[str, list[Feature]] = {role: [] for role in _ROLES}
    for feature in features_of(value):
        role = feature.properties.get('role')
        role = 'area' if role in (None, '') else role
        if role not in _ROLES:
            raise ValueError(f'{feature.name}: role: read {role}, allowed are {", ".join(_ROLES)}')
        roles[role].append(feature)
    if not roles['area']:
        source = value if isinstance(value, str) and is_geojson(value) else short(value)
        raise ValueError(
            f'{source}: no polygon has the role area; keep-outs alone belong under '
            'environment.keep_outs'
        )
    return roles


def origin_of(features: Sequence[Feature]) -> Mapping[str, Any] | None:
    """Return the origin of the run on whose page features were drawn, or the centre of others."""
    values = (item.properties.get('origin') for item in features)
    # Other programs may use that name differently.
    drawn_at = (item for item in values if isinstance(item, Mapping) and 'latitude' in item)
    in_metres = all(item.in_metres for item in features)
    return next(drawn_at, None if in_metres else _centre_of(features))


def with_role(features: Sequence[Feature], wanted: str, key: str) -> list[Feature]:
    """Return the features with the wanted role or without one; warn about others by name."""
    others = [item for item in features if item.properties.get('role') in _ROLES]
    others = [item for item in others if item.properties['role'] != wanted]
    words = '; '.join(f'{item.name}: role {item.properties["role"]}' for item in others[:5])
    if len(others) == len(features):
        raise ValueError(f'{words}; allowed under {key} is role {wanted}, or none')
    if others:
        warn(f'{key}: left out, as these have another role: {words}')
    return [item for item in features if item not in others]


def weight_of(feature: Feature) -> float:
    """Return the weight of a prior polygon; null or nothing is 1."""
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


def _centre_of(features: Sequence[Feature]) -> dict[str, float]:
    whole = shapely.union_all([feature.shape for feature in features])
    west, _, east, _ = whole.bounds
    if east - west > 180.0:
        whole = _unwrapped(whole, 180.0)
    west, south, east, north = whole.bounds
    longitude = 0.5 * (west + east)
    longitude -= 360.0 if longitude > 180.0 else 0.0
    return {'latitude': 0.5 * (south + north), 'longitude': longitude}


def points_of(value: Any) -> list[tuple[str, str, list[float]]]:
    """Return role, robot, and longitude and latitude of points with a role of robots.

    The robot of a start is its property robot, or else its name.
    """
    found = []
    for row in _rows(value)[1]:
        facts = row.get('properties') if isinstance(row, Mapping) else None
        if isinstance(facts, Mapping) and facts.get('role') in _POINT_ROLES:
            geometry = row.get('geometry')
            if isinstance(geometry, Mapping) and geometry.get('type') == 'Point':
                (position,) = _position(geometry.get('coordinates'), 'a point').tolist()
                role, owner = str(facts['role']), facts.get('robot')
                if not owner and role == 'start':
                    owner = facts.get('name')
                found.append((role, str(owner or ''), position))
    return found


def features_of(value: Any) -> list[Feature]:
    """Return the features with polygons of GeoJSON values, text, or a file; warn about others."""
    source, rows = _rows(value)
    found, left = [], []
    for number, row in enumerate(rows, 1):
        if not isinstance(row, Mapping):
            raise ValueError(
                f'{source}feature {number}: read {short(row)}, allowed is a list of features'
            )
        feature, rest = _feature(number, row, source)
        left += rest
        if feature is not None:
            found.append(feature)
    more = f' and {len(left) - _NAMED} more' if len(left) > _NAMED else ''
    words = '; '.join(left[:_NAMED]) + more
    if not found:
        read = f', read {words}' if left else ''
        raise ValueError(
            f'{source}there is no polygon in it{read}' if source else f'holds no polygon{read}'
        )
    if left:
        warn(f'{source}left out, as these are no polygons: {words}')
    return found


def _rows(value: Any) -> tuple[str, list[Any]]:
    """Return the source of GeoJSON, for messages, and its raw features."""
    named = isinstance(value, str) and is_geojson(value) and not value.lstrip().startswith('{')
    source = f'{value}: ' if named else ''
    data = _parsed(value, named)
    if not isinstance(data, Mapping):
        raise ValueError(f'{source}read {short(data)}, allowed is GeoJSON')
    _check_system(data, source)
    rows: Any = [data]
    if data.get('type') == 'FeatureCollection':
        rows = data.get('features')
    elif data.get('type') != 'Feature':
        if data.get('type') not in _KINDS:
            raise ValueError(
                f'{source}type: read {short(data.get("type"))}, allowed are FeatureCollection, '
                'Feature and Polygon: this is not GeoJSON'
            )
        rows = [{'type': 'Feature', 'geometry': data}]
    if not isinstance(rows, list):
        raise ValueError(f'{source}features: read {short(rows)}, allowed is a list of features')
    return source, rows


def _parsed(value: Any, named: bool) -> Any:
    if not isinstance(value, str):
        return value
    if not named and not value.lstrip().startswith('{'):
        raise ValueError(
            f'read {short(Path(value).name)}, allowed is GeoJSON, or the name of a file '
            f'({", ".join(FILES)}); {_CONVERT}'
        )
    if named and Path(value).suffix.lower() in READERS:
        return read_map_file(value)
    if named and Path(value).suffix.lower() in VECTOR_FILES:
        return read_vector_file(value)
    return _json_of_file(value) if named else _json(value, short(value))


def _json_of_file(path: str) -> Any:
    try:
        text = text_of(read_bytes(path))
    except OSError as error:
        raise ValueError(f'{path}: {error.strerror}') from None
    except UnicodeError:
        raise ValueError(f'{path}: is not UTF-8 text') from None
    except ValueError as error:
        raise ValueError(f'{path}: {error}') from None
    return _json(text, short(path))


def _json(text: str, source: str) -> Any:
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        line = f' in line {error.lineno}' if isinstance(error, json.JSONDecodeError) else ''
        raise ValueError(f'{source}: is not JSON{line}') from None


def _check_system(data: Mapping[str, Any], source: str) -> None:
    """Raise ValueError if the member `crs` of GeoJSON is not WGS 84."""
    crs = data.get('crs')
    if crs is None:
        return
    properties = crs.get('properties') if isinstance(crs, Mapping) else None
    facts = properties if isinstance(properties, Mapping) else {'name': crs}
    # Old files have {type: EPSG, properties: {code: 4326}}.
    name = facts.get('name', f'EPSG:{facts["code"]}' if 'code' in facts else None)
    if not isinstance(name, str) or not _WGS84.search(name.strip()):
        raise ValueError(
            f'{source}crs: read {short(name)}, allowed is WGS 84 (EPSG:4326); {_CONVERT}'
        )


def _feature(number: int, row: Mapping[str, Any], source: str) -> tuple[Feature | None, list[str]]:
    """Return a feature, or None without a polygon, and texts about its other parts."""
    properties = row.get('properties')
    if properties is not None and not isinstance(properties, Mapping):
        raise ValueError(
            f'{source}feature {number}: properties: read {short(properties)}, allowed is an object'
        )
    facts = properties or {}
    values = [facts.get('name'), facts.get('title'), row.get('id'), facts.get('id')]
    title = next((str(word) for word in values if word not in (None, '')), '')
    name = str(row.get(LABEL) or f'feature {number}') + (f' ({title[:40]})' if title else '')
    where, left, shapes = f'{source}{name}', [], []
    parts = list(_parts(row.get('geometry'), where)) or [('empty', None)]
    for kind, coordinates in parts:
        if kind == 'Point' and facts.get('role') in _POINT_ROLES:
            check_degrees(_position(coordinates, where), where)
            continue
        if kind != 'Polygon' or not coordinates:
            left.append(f'{name}: {kind}')
            continue
        rings = _rings(coordinates, where)
        if facts.get('unit') != 'm':
            check_degrees(np.concatenate(rings), where)
            rings = _short_way(rings, where)
        shapes.append(sound(Polygon(rings[0], rings[1:]), where, 'degrees'))
    if not shapes:
        return None, left
    return Feature(where, shapely.union_all(shapes), facts), left


def _parts(geometry: Any, where: str) -> Iterator[tuple[str, Any]]:
    if geometry is None:
        yield 'no geometry', None
        return
    if not isinstance(geometry, Mapping) or not isinstance(geometry.get('type'), str):
        raise ValueError(
            f'{where}: geometry: read {short(geometry)}, allowed is an object with type'
        )
    kind, coordinates = geometry['type'], geometry.get('coordinates')
    if kind == 'GeometryCollection':
        for part in geometry.get('geometries') or ():
            yield from _parts(part, where)
    elif kind == 'MultiPolygon' and isinstance(coordinates, list):
        for part in coordinates:
            yield 'Polygon', part
    else:
        yield kind, coordinates


def _position(coordinates: Any, where: str) -> FloatArray:
    try:
        position = np.array([coordinates[:2]], dtype=float)
    except (TypeError, ValueError):
        position = np.empty(0)
    if position.shape != (1, 2) or not np.isfinite(position).all():
        raise ValueError(
            f'{where}: coordinates: read {short(coordinates)}, allowed are longitude and latitude'
        )
    return position


def _rings(coordinates: Any, where: str) -> list[FloatArray]:
    try:
        rings = [np.array([row[:2] for row in ring], dtype=float) for ring in coordinates]
        if any(ring.ndim != 2 or ring.shape[1] != 2 or len(ring) < 3 for ring in rings):
            raise ValueError
    except (TypeError, ValueError, LookupError):
        raise ValueError(
            f'{where}: coordinates: read {short(coordinates)}, allowed are rings of at least 3 '
            'positions [longitude, latitude]'
        ) from None
    if not all(np.isfinite(ring).all() for ring in rings):
        raise ValueError(f'{where}: coordinates: allowed are finite numbers')
    return rings


def _short_way(rings: Sequence[FloatArray], where: str) -> list[FloatArray]:
    """Return rings [degrees] whose edges take the shorter direction; warn if some did not."""
    if not any((np.abs(np.diff(ring[:, 0])) > 180.0).any() for ring in rings):
        return list(rings)
    warn(f'{where}: has edges longer than 180 degrees: read as an area across 180 degrees')
    east = [continued(ring[:, 0]) for ring in rings]
    turns = [np.round((axis.mean() - east[0].mean()) / 360.0) for axis in east]
    columns = zip(east, turns, rings)
    return [np.column_stack([x - 360.0 * turn, ring[:, 1]]) for x, turn, ring in columns]


def check_degrees(degrees: FloatArray, where: str) -> None:
    """Raise ValueError with the likely cause if coordinates are not in degrees."""
    x, y = degrees.T
    wrong = np.flatnonzero((np.abs(x) > 180.0 + _BEYOND) | (np.abs(y) > 90.0))
    if not len(wrong):
        return
    east, north = float(x[wrong[0]]), float(y[wrong[0]])
    if np.abs([x, y]).max() > 360.0:
        cause = f'are these metres? {_CONVERT}'
    elif np.abs(x).max() <= 90.0:
        cause = 'is the latitude first? GeoJSON has the longitude first'
    else:
        cause = 'cut the polygon at 180 degrees, as RFC 7946 says'
    raise ValueError(
        f'{where}: read longitude {east:.10g}, latitude {north:.10g}, allowed are 180 and 90 '
        f'degrees: {cause}'
    )
