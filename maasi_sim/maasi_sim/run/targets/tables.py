"""Found targets as rows, for CSV, GeoJSON and data frames; and a search as GeoJSON (RFC 7946)."""

import csv
import io
import json
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np
import shapely
from shapely.geometry import Polygon, box, mapping, shape
from shapely.geometry.base import BaseGeometry

from maasi_filter.arrays import FloatArray
from maasi_filter.geometry.area import Area
from maasi_filter.geometry.geodesy import OriginSettings, geodetic
from maasi_filter.records import FoundTarget
from maasi_filter.unexplored_map import UnexploredMap
from maasi_sim.run.log import RunLog

Row = dict[str, Any]


def found_rows(
    found: Sequence[FoundTarget],
    truth: FloatArray,
    pairs: Iterable[tuple[int, int]],
    origin: OriginSettings | None,
) -> list[Row]:
    """Return a row of `columns` for each found target; `pairs`: found and true indices."""
    rows, true = [], dict(pairs)
    for index, item in enumerate(found):
        target = true.get(index)
        error = None if target is None else float(np.linalg.norm(item.position - truth[target]))
        rows.append({**_row(item, origin), 'target': target, 'error': error})
    return rows


def _row(item: FoundTarget, origin: OriginSettings | None) -> Row:
    axes = 'xyz'[: len(item.position)]
    return {
        'id': item.id,
        'agent': item.robot,
        'time': float(item.time),
        'measurement': item.measurement,
        **{axis: float(value) for axis, value in zip(axes, item.position)},
        **({} if origin is None else _on_earth(item.position, origin)),
        **{
            second + first: float(item.covariance[j, i])
            for i, first in enumerate(axes)
            for j, second in enumerate(axes[: i + 1])
        },
        'class_id': item.label.class_id,
        'score': float(item.label.score),
        'identity': item.label.identity,
    }


def columns(dimension: int, origin: OriginSettings | None) -> list[str]:
    """Return the columns of the table; dimension is 2 or 3."""
    some = FoundTarget(1, np.zeros(dimension), np.eye(dimension), '', 0, 0.0)
    return [*_row(some, origin), 'target', 'error']


def _on_earth(position: FloatArray, origin: OriginSettings) -> Row:
    places = geodetic(position[None], origin)[0].tolist()
    return dict(zip(('latitude', 'longitude', 'altitude'), places))


def csv_text(rows: Sequence[Row], dimension: int, origin: OriginSettings | None) -> str:
    """Return the table as CSV; missing values are empty cells."""
    out = io.StringIO()
    writer = csv.DictWriter(out, columns(dimension, origin), lineterminator='\n')
    writer.writeheader()
    writer.writerows(rows)
    return out.getvalue()


def found_geojson(rows: Sequence[Row]) -> str:
    """Return rows with geodetic coordinates as points, to a millimetre."""
    features = []
    for row in rows:
        properties, digits = dict(row), {'longitude': 8, 'latitude': 8, 'altitude': 3}
        place = [round(properties.pop(name), number) for name, number in digits.items()]
        features.append(_feature({'type': 'Point', 'coordinates': place}, properties))
    return collection(features)


def searched(record: RunLog, explored: UnexploredMap, origin: OriginSettings) -> list[Row]:
    """Return the area, the explored ground and the paths of the robots as features."""
    return [*_area(record, origin), _explored(explored, origin), *_paths(record, origin)]


def _area(record: RunLog, origin: OriginSettings) -> Iterator[Row]:
    for kind, shapes in Area(record.scenario.environment).shapes.items():
        for polygon in shapely.get_parts(shapes):
            yield _polygon(polygon, origin, {'kind': kind})


def _explored(explored: UnexploredMap, origin: OriginSettings) -> Row:
    """Return the explored area (less than half unseen), in 3D over the whole height."""
    unseen = np.atleast_3d(explored.values).mean(axis=2)
    # Consecutive cells along y form a box: row, first cell, end.
    edges = np.diff(unseen < 0.5, axis=1, prepend=False, append=False)
    row, ends = (index.reshape(-1, 2) for index in np.nonzero(edges))
    half, (low, high) = 0.5 * explored.step[:2], explored.bounds[:2].T
    x, y = explored.axes()[:2]
    first = np.clip(np.stack([x[row[:, 0]], y[ends[:, 0]]], axis=1) - half, low, high)
    last = np.clip(np.stack([x[row[:, 0]], y[ends[:, 1] - 1]], axis=1) + half, low, high)
    # Join boxes that touch, to a micrometre.
    cells = shapely.union_all(shapely.box(*first.T, *last.T), grid_size=1e-6)
    share = round(explored.explored_fraction(), 6)
    return _polygon(cells, origin, {'kind': 'explored', 'share': share})


def _polygon(polygon: BaseGeometry, origin: OriginSettings, properties: Row) -> Row:
    # Outer rings run counterclockwise.
    turned = shapely.reverse(shapely.normalize(polygon))
    placed = shapely.transform(turned, lambda points: _coordinates(points, origin)[:, :2])
    return _feature(mapping(placed), properties)


def cut_at_180(features: Iterable[Row]) -> list[Row]:
    """Return features whose polygons across 180 degrees of longitude are cut there (RFC 7946)."""
    return [{**feature, 'geometry': _cut(feature['geometry'])} for feature in features]


def _cut(geometry: Any) -> Any:
    if geometry['type'] not in ('Polygon', 'MultiPolygon'):
        return geometry
    whole = shape(geometry)
    points = shapely.get_coordinates(whole)
    if not len(points) or np.ptp(points[:, 0]) <= 180.0:
        return geometry

    def eastern(points: FloatArray) -> FloatArray:
        return np.stack([points[:, 0] % 360.0, points[:, 1]], axis=1).round(8)

    turned = shapely.transform(whole, eastern)
    sides = shapely.intersection(turned, [box(0, -90, 180, 90), box(180, -90, 360, 90)])
    parts = [sides[0], shapely.transform(sides[1], lambda points: (points - [360.0, 0.0]).round(8))]
    # What only touches 180 degrees leaves lines.
    polygons = [item for item in shapely.get_parts(parts) if isinstance(item, Polygon)]
    return mapping(shapely.union_all(polygons))


def _paths(record: RunLog, origin: OriginSettings) -> Iterator[Row]:
    spacing = 1e-3 * np.linalg.norm(np.ptp(record.scenario.environment.array(), axis=1))
    for robot, states in sorted(record.trajectories.items()):
        path = states[np.isfinite(states).all(axis=1)]
        if len(path) < 2:
            continue
        lengths = np.linalg.norm(np.diff(path[:, 1:], axis=0), axis=1)
        passed = np.append(0.0, lengths.cumsum())
        path = path[np.union1d(np.unique(passed // spacing, return_index=True)[1], len(path) - 1)]
        places, times = _coordinates(path[:, 1:], origin).tolist(), path[:, 0].tolist()
        properties = {'kind': 'way', 'robot': robot, 'length': passed[-1], 'times': times}
        yield _feature({'type': 'LineString', 'coordinates': places}, properties)


def _coordinates(positions: FloatArray, origin: OriginSettings) -> FloatArray:
    """Return longitude, latitude and altitude, to a millimetre (n, 3)."""
    latitudes, longitudes, altitudes = geodetic(positions, origin).T
    return np.stack([longitudes.round(8), latitudes.round(8), altitudes.round(3)], axis=1)


def _feature(geometry: Any, properties: Row) -> Row:
    return {'type': 'Feature', 'geometry': geometry, 'properties': properties}


def collection(features: Iterable[Row]) -> str:
    """Return features as the text of GeoJSON."""
    content = {'type': 'FeatureCollection', 'features': [*features]}
    return json.dumps(content, indent=1, allow_nan=False) + '\n'
