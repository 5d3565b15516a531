"""The result of a search as pandas data frames, where pandas is installed."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from maasi_sim.targets.found_table import columns, found_rows


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
    return pandas.DataFrame(
        [
            {
                'time': item.time,
                'step': item.step,
                'measurements': item.measurements,
                'found': item.found,
                'true_found': item.true_found,
                'rmse': item.rmse,
                **{
                    f'{name}_{axis}': float(value)
                    for name, place in item.positions.items()
                    for axis, value in zip('xyz', place)
                },
                **{f'{name}_measures': name in item.members for name in item.positions},
            }
            for item in result.progress
        ]
    )
