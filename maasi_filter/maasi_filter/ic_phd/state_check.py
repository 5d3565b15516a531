"""Checks of a saved filter state: shapes, types and ranges of its arrays."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

# By name: kinds of dtype, and the shape; letters are sizes that have to agree.
_ARRAYS: dict[str, tuple[str, str]] = {
    'bounds': ('f', 'd 2'),
    'spacing': ('f', ''),
    'particles': ('f', 'n d'),
    'weights': ('f', 'n'),
    'group': ('i', 'n'),
    'groups': ('i', ''),
    'information': ('f', 'g d d'),
    'places': ('f', 'g d'),
    'credit_measurements': ('i', 'g'),
    'credit_radii': ('f', 'g'),
    'centres': ('f', 'k d'),
    'found_ids': ('i', 'f'),
    'found_measurements': ('i', 'f'),
    'found_origins': ('i', 'f'),
    'found_times': ('f', 'f'),
    'found_positions': ('f', 'f d'),
    'found_covariances': ('f', 'f d d'),
    'own_covariances': ('f', 'f d d'),
    'cluster_positions': ('f', 'c d'),
    'cluster_covariances': ('f', 'c d d'),
    'cluster_radii': ('f', 'c'),
    'cluster_masses': ('f', 'c'),
}
# Detections kept for lost targets; presets without them save none of these.
_LOST: dict[str, tuple[str, str]] = {
    'lost_values': ('f', 'm d'),
    'lost_covariances': ('f', 'm d d'),
    'lost_cartesian': ('b', 'm'),
    'lost_centres': ('f', 'm d'),
    'lost_roots': ('f', 'm d d'),
    'lost_information': ('f', 'm d d'),
    'lost_log_norm': ('f', 'm'),
    'lost_volume': ('f', 'm'),
    'lost_gates': ('f', 'm 2'),
    'lost_probability': ('f', 'm'),
    'lost_scans': ('i', 's'),
    'lost_positions': ('f', 's 3'),
    'lost_clutter': ('f', 's'),
    'lost_room': ('i', ''),
}
_NOT_NEGATIVE = ('weights', 'groups', 'cluster_radii', 'cluster_masses', 'found_measurements')
_LOST_NOT_NEGATIVE = ('lost_probability', 'lost_scans', 'lost_clutter', 'lost_room')

Arrays = Mapping[str, NDArray[Any]]


def check_state(state: Arrays) -> None:
    """Refuse a state that a filter cannot go on from.

    A checksum tells that a file is as it was written, not that it was written by a filter.

    Parameters
    ----------
    state : mapping of str to array
        As `SearchFilter.state` returns it.

    Raises
    ------
    KeyError
        If an array is missing.
    ValueError
        If a type, shape or number is not allowed; the message names the array.
    """
    tables = {**_ARRAYS, **(_LOST if 'lost_scans' in state else {})}
    sizes: dict[str, int] = {}
    for name, (kind, shape) in tables.items():
        array = state[name]
        if array.dtype.kind != kind:
            raise ValueError(f'{name}: got type {array.dtype}, allowed is kind {kind!r}')
        _check_shape(name, array, shape, sizes)
        # Gates may be unlimited; nothing may be undefined.
        bad = np.isnan(array) if name.startswith('lost_') else ~np.isfinite(array)
        if bad.any():
            raise ValueError(f'{name}: got a number that is not finite')
    not_negative = (*_NOT_NEGATIVE, *(_LOST_NOT_NEGATIVE if 'lost_scans' in state else ()))
    for name in not_negative:
        if (state[name] < 0).any():
            raise ValueError(f'{name}: got {state[name].min()}, allowed are numbers from 0')
    _check_groups(state, sizes['g'])
    _check_found(state)
    if 'lost_scans' in state and state['lost_scans'].sum() != sizes['m']:
        raise ValueError(
            f'lost_scans: got a sum of {state["lost_scans"].sum()}, allowed is {sizes["m"]}'
        )


def check_exploration(values: NDArray[Any], shape: tuple[int, ...]) -> None:
    """Refuse values of the exploration that do not fit its nodes, or are not from 0 to 1."""
    if values.shape != shape or values.dtype.kind != 'f':
        raise ValueError(
            f'exploration: got shape {values.shape} of {values.dtype}, allowed is {shape} of floats'
        )
    # Written so that it holds for NaN, too.
    if not ((values >= 0.0) & (values <= 1.0)).all():
        raise ValueError('exploration: got a number that is not from 0 to 1')


def _check_shape(name: str, array: NDArray[Any], shape: str, sizes: dict[str, int]) -> None:
    letters = shape.split()
    fits = array.ndim == len(letters)
    if fits:
        for letter, size in zip(letters, array.shape):
            wanted = int(letter) if letter.isdigit() else sizes.setdefault(letter, size)
            fits = fits and size == wanted
    if not fits:
        known = ', '.join(f'{letter} = {size}' for letter, size in sorted(sizes.items()))
        raise ValueError(
            f'{name}: got shape {array.shape}, allowed is ({", ".join(letters)}) with {known}'
        )


def _check_groups(state: Arrays, rows: int) -> None:
    groups, group = int(state['groups']), state['group']
    if rows != groups:
        raise ValueError(f'information: got {rows} groups, allowed are {groups}')
    if len(group) and not (group.min() >= 0 and group.max() < groups):
        raise ValueError(f'group: got {group.min()} to {group.max()}, allowed is 0 to {groups - 1}')


def _check_found(state: Arrays) -> None:
    ids = state['found_ids']
    if (ids < 1).any() or len(np.unique(ids)) != len(ids):
        raise ValueError(f'found_ids: got {ids.tolist()}, allowed are different numbers from 1')
    for name in ('found_covariances', 'own_covariances'):
        for number, covariance in zip(ids.tolist(), state[name]):
            # A group of equal particles has none, so zeros are allowed.
            if not np.allclose(covariance, covariance.T) or (np.diagonal(covariance) < 0.0).any():
                raise ValueError(
                    f'{name}: of target {number}: got {covariance.tolist()}, allowed is a '
                    'symmetric matrix with a diagonal from 0'
                )
