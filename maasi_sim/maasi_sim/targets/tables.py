"""Found targets as rows of a table, for CSV, GeoJSON and data frames."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterable, Sequence
from importlib import import_module
from typing import Any

import numpy as np

from maasi_filter.arrays import FloatArray
from maasi_filter.records import FoundTarget
from maasi_sim.scenario.base import OriginSettings

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
    true = dict(pairs)
    rows = []
    for index, item in enumerate(found):
        target = true.get(index)
        error = None if target is None else float(np.linalg.norm(item.position - truth[target]))
        row: Row = {
            'id': item.id,
            'agent': item.robot,
            'time': float(item.time),
            'measurement': item.measurement,
            **{axis: float(value) for axis, value in zip('xyz', item.position)},
        }
        if origin is not None:
            row |= geodetic(item.position, origin)
        for i, first in enumerate('xyz'[: len(item.position)]):
            for j, second in enumerate('xyz'[: i + 1]):
                row[second + first] = float(item.covariance[j, i])
        row |= {
            'class_id': item.label.class_id,
            'score': float(item.label.score),
            'identity': item.label.identity,
            'target': target,
            'error': error,
        }
        rows.append(row)
    return rows


def columns(dimension: int, origin: OriginSettings | None) -> list[str]:
    """Return the columns of the table; dimension is 2 or 3."""
    names = ['id', 'agent', 'time', 'measurement', *'xyz'[:dimension]]
    if origin is not None:
        names += ['latitude', 'longitude', 'altitude']
    names += [b + a for i, a in enumerate('xyz'[:dimension]) for b in 'xyz'[: i + 1]]
    return [*names, 'class_id', 'score', 'identity', 'target', 'error']


def geodetic(position: FloatArray, origin: OriginSettings) -> Row:
    """Return latitude, longitude [degrees] and altitude [m] on WGS 84 of a place [m, map]."""
    # Deferred: only scenarios with an origin need it.
    import pymap3d

    east, north, up = [*map(float, position), 0.0][:3]
    latitude, longitude, altitude = pymap3d.enu2geodetic(
        east, north, up, origin.latitude, origin.longitude, origin.altitude
    )
    places = map(float, (latitude, longitude, altitude))
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


def data_frame(result: Any, table: str) -> Any:
    """Return a table of a `SearchResult`, see `SearchResult.to_dataframe`."""
    if table not in ('found_targets', 'progress'):
        raise ValueError(f"table: got {table!r}, allowed are 'found_targets', 'progress'")
    try:
        pandas = import_module('pandas')
    except ImportError:
        raise ImportError(
            'to_dataframe needs pandas, which is not installed: pip install pandas'
        ) from None
    if table == 'found_targets':
        rows = found_rows(result.found_targets, result.truth, result.pairs, result.origin)
        names = columns(result.truth.shape[1], result.origin)
        frame = pandas.DataFrame(rows, columns=names)
        return frame.astype({'target': 'Int64', 'error': float})
    rows = []
    for item in result.progress:
        counts = ('time', 'step', 'measurements', 'found', 'true_found', 'rmse')
        row = {name: getattr(item, name) for name in counts}
        for name, place in item.positions.items():
            row |= {f'{name}_{axis}': float(value) for axis, value in zip('xyz', place)}
        rows.append(row | {f'{name}_measures': name in item.members for name in item.positions})
    return pandas.DataFrame(rows)
