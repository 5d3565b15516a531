"""Found targets as rows of a table, for CSV, GeoJSON and data frames."""

import csv
import io
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from maasi_filter.arrays import FloatArray
from maasi_filter.geodesy import OriginSettings, geodetic
from maasi_filter.records import FoundTarget

Row = dict[str, Any]


def found_rows(
    found: Sequence[FoundTarget],
    truth: FloatArray,
    pairs: Iterable[tuple[int, int]],
    origin: OriginSettings | None,
) -> list[Row]:
    """Return a row of `columns` for each found target; `pairs`: of it and the true one it is."""
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
    """Return the table as CSV; empty cells for what there is not."""
    out = io.StringIO()
    writer = csv.DictWriter(out, columns(dimension, origin), lineterminator='\n')
    writer.writeheader()
    writer.writerows(rows)
    return out.getvalue()
