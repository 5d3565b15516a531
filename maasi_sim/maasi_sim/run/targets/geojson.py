"""A search on a map: found targets, ways and what was explored, as GeoJSON (RFC 7946)."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np
import shapely
from shapely.geometry import mapping

from maasi_filter.arrays import FloatArray
from maasi_filter.geodesy import OriginSettings, geodetic
from maasi_sim.run.targets.report import explored_after
from maasi_sim.run.targets.tables import Row
from maasi_sim.run.targets.tally import TargetRecord


def found_geojson(rows: Sequence[Row]) -> str:
    """Return rows with geodetic coordinates: a point each."""
    features = []
    for row in rows:
        properties = dict(row)
        place = [properties.pop(name) for name in ('longitude', 'latitude', 'altitude')]
        # To a millimetre.
        place = [round(place[0], 8), round(place[1], 8), round(place[2], 3)]
        features.append(_feature({'type': 'Point', 'coordinates': place}, properties))
    return _collection(features)


def ways_geojson(record: TargetRecord, origin: OriginSettings) -> str:
    """Return the ways of the robots, and what they have explored."""
    return _collection([*_area(record), _explored(record, origin), *_ways(record, origin)])


def _area(record: TargetRecord) -> list[Row]:
    """Return the area of the search and what in it is not to be entered."""
    return []


def _explored(record: TargetRecord, origin: OriginSettings) -> Row:
    """Return where less than half is unseen, in 3D of the whole height."""
    explored = explored_after(record)
    unseen = explored.values if explored.dimension == 2 else explored.values.mean(axis=2)
    x, y = (
        np.concatenate([nodes[:1], 0.5 * (nodes[1:] + nodes[:-1]), nodes[-1:]])
        for nodes in explored.axes()[:2]
    )
    i, j = np.nonzero(unseen < 0.5)
    seen = shapely.union_all(shapely.box(x[i], y[j], x[i + 1], y[j + 1]))
    # Outer rings run counterclockwise.
    seen = shapely.reverse(shapely.normalize(seen))
    placed = shapely.transform(seen, lambda points: _coordinates(points, origin)[:, :2])
    share = round(explored.explored_fraction(), 6)
    return _feature(mapping(placed), {'kind': 'explored', 'share': share})


def _ways(record: TargetRecord, origin: OriginSettings) -> Iterator[Row]:
    spacing = 1e-3 * np.linalg.norm(np.ptp(record.scenario.environment.array(), axis=1))
    for robot, states in sorted(record.trajectories.items()):
        way = states[np.isfinite(states).all(axis=1)]
        if len(way) < 2:
            continue
        lengths = np.linalg.norm(np.diff(way[:, 1:], axis=0), axis=1)
        passed = np.append(0.0, lengths.cumsum())
        first = np.unique(passed // spacing, return_index=True)[1]
        way, length = way[np.union1d(first, len(way) - 1)], float(passed[-1])
        places = _coordinates(way[:, 1:], origin).tolist()
        properties = {'kind': 'way', 'robot': robot, 'length': length, 'times': way[:, 0].tolist()}
        yield _feature({'type': 'LineString', 'coordinates': places}, properties)


def _coordinates(positions: FloatArray, origin: OriginSettings) -> FloatArray:
    """Return longitude, latitude and altitude, to a millimetre (n, 3)."""
    latitudes, longitudes, altitudes = geodetic(positions, origin).T
    return np.stack([longitudes.round(8), latitudes.round(8), altitudes.round(3)], axis=1)


def _feature(geometry: Any, properties: Row) -> Row:
    return {'type': 'Feature', 'geometry': geometry, 'properties': properties}


def _collection(features: Iterable[Row]) -> str:
    content = {'type': 'FeatureCollection', 'features': [*features]}
    return json.dumps(content, indent=1, allow_nan=False) + '\n'
