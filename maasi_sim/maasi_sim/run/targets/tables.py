"""Found targets as rows of a table, for CSV, GeoJSON and data frames."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from maasi_filter.arrays import FloatArray
from maasi_filter.environment import OriginSettings
from maasi_filter.records import FoundTarget

Row = dict[str, Any]


def found_rows(
    found: Sequence[FoundTarget],
    truth: FloatArray,
    pairs: Iterable[tuple[int, int]],
    origin: OriginSettings | None,
) -> list[Row]:
    """Return a row for each found target, with the columns of `columns`.

    `pairs` are indices of a found target and of the true one that it is. Without an origin of the
    map rows have no geodetic coordinates.
    """
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
        **({} if origin is None else geodetic(item.position, origin)),
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


def geodetic(position: FloatArray, origin: OriginSettings) -> Row:
    """Return latitude, longitude [degrees] and altitude [m] on WGS 84 of a place [m, map]."""
    # Deferred: only scenarios with an origin need it.
    import pymap3d

    east, north, up = [*map(float, position), 0.0][:3]
    reference = origin.latitude, origin.longitude, origin.altitude
    places = map(float, pymap3d.enu2geodetic(east, north, up, *reference))
    return dict(zip(('latitude', 'longitude', 'altitude'), places))


def csv_text(rows: Sequence[Row], dimension: int, origin: OriginSettings | None) -> str:
    """Return the table as CSV; empty cells for what there is not."""
    out = io.StringIO()
    writer = csv.DictWriter(out, columns(dimension, origin), lineterminator='\n')
    writer.writeheader()
    writer.writerows(rows)
    return out.getvalue()


def geojson_text(rows: Sequence[Row]) -> str:
    """Return rows with geodetic coordinates as GeoJSON (RFC 7946): a point each."""
    features = []
    for row in rows:
        properties = dict(row)
        place = [properties.pop(name) for name in ('longitude', 'latitude', 'altitude')]
        # To a millimetre.
        place = [round(place[0], 8), round(place[1], 8), round(place[2], 3)]
        geometry = {'type': 'Point', 'coordinates': place}
        features.append({'type': 'Feature', 'geometry': geometry, 'properties': properties})
    content = {'type': 'FeatureCollection', 'features': features}
    return json.dumps(content, indent=1, allow_nan=False) + '\n'
