"""The offsets of robots and found targets as arrays, and back."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maasi_filter.pmb.offsets import Offsets
from maasi_filter.state_check import Arrays
from maasi_filter.state_file import text, untext

# By name: kinds of dtype, and shape; equal letters are equal sizes.
OFFSET_ARRAYS = {
    'offset_mean': ('f', 'o'),
    'offset_covariance': ('f', 'o o'),
    'offset_positions': ('f', 'q 3'),
    'offset_ways': ('f', 'q'),
}


def offset_arrays(offsets: Offsets) -> dict[str, NDArray[Any]]:
    """Return offsets as arrays for a file."""
    return {
        'offset_keys': text(json.dumps(offsets.keys)),
        'offset_mean': offsets.mean,
        'offset_covariance': offsets.covariance,
        'offset_positions': np.array(list(offsets.last.values())).reshape(-1, 3),
        'offset_ways': np.array(list(offsets.way.values()), float),
    }


def restore_offsets(offsets: Offsets, state: Arrays) -> None:
    """Fill new offsets from a checked state.

    Raises
    ------
    ValueError
        If robots and found targets do not match the arrays.
    """
    keys = json.loads(untext(state['offset_keys']))
    robots = [key for key in keys if isinstance(key, str)]
    ids = [key for key in keys if type(key) is int]
    fits = len(robots) + len(ids) == len(set(keys)) == len(keys)
    if not fits or len(keys) * offsets.dimension != len(state['offset_mean']):
        raise ValueError(f'offset_keys: got {str(keys)[:100]}, allowed is one for each offset')
    if len(robots) != len(state['offset_ways']):
        raise ValueError(f'offset_ways: got {len(state["offset_ways"])} of {len(robots)} robots')
    offsets.keys = keys
    offsets.mean, offsets.covariance = state['offset_mean'], state['offset_covariance']
    offsets.last = dict(zip(robots, state['offset_positions']))
    offsets.way = dict(zip(robots, state['offset_ways'].tolist()))
