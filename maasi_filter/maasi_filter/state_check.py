"""Checks of a saved filter state, and the part common to the states of all filters.

A checksum proves that a file is as it was written, not that a filter wrote it.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maasi_filter.models.label import Label
from maasi_filter.records import Cluster, FoundTarget
from maasi_filter.settings import FilterSettings
from maasi_filter.state_file import (
    StateFileError,
    generator_state,
    restored_generator,
    text,
    untext,
)
from maasi_filter.unexplored_map import UnexploredMap

Arrays = Mapping[str, NDArray[Any]]

# By name: kind of dtype, and shape; equal letters are equal sizes.
COMMON = {
    'bounds': ('f', 'd 2'),
    'spacing': ('f', ''),
    'found_ids': ('i', 'f'),
    'found_measurements': ('i', 'f'),
    'found_origins': ('i', 'f'),
    'found_times': ('f', 'f'),
    'found_scores': ('f', 'f'),
    'found_positions': ('f', 'f d'),
    'found_covariances': ('f', 'f d d'),
    'cluster_positions': ('f', 'c d'),
    'cluster_covariances': ('f', 'c d d'),
    'cluster_radii': ('f', 'c'),
    'cluster_masses': ('f', 'c'),
}


@contextmanager
def naming(path: str | os.PathLike[str]) -> Iterator[None]:
    """Convert errors of a state to a StateFileError that names its file."""
    try:
        yield
    except KeyError as error:
        raise StateFileError(f'{path}: does not hold a usable state: no {error}') from None
    except (ValueError, TypeError) as error:
        raise StateFileError(f'{path}: does not hold a usable state: {error}') from None


def common_arrays(
    settings: FilterSettings, generator: np.random.Generator, exploration: UnexploredMap
) -> dict[str, NDArray[Any]]:
    """Return settings, generator and exploration as arrays."""
    return {
        'settings': text(settings.model_dump_json(exclude_unset=True)),
        'generator': text(generator_state(generator)),
        'bounds': exploration.bounds,
        'spacing': np.array(exploration.spacing),
        'exploration': exploration.values,
    }


def construction(state: Arrays) -> tuple[FilterSettings, NDArray[Any], np.random.Generator]:
    """Return the constructor arguments of the filter of a state."""
    return (
        FilterSettings.model_validate_json(untext(state['settings'])),
        state['bounds'],
        restored_generator(untext(state['generator'])),
    )


def exploration_of(state: Arrays) -> UnexploredMap:
    """Return the exploration function of a state.

    Raises
    ------
    ValueError
        If its values do not fit its nodes, or are not from 0 to 1.
    """
    exploration = UnexploredMap(state['bounds'], float(state['spacing']))
    values, shape = state['exploration'], exploration.values.shape
    if values.shape != shape or values.dtype.kind != 'f':
        raise ValueError(
            f'exploration: got shape {values.shape} of {values.dtype}, allowed is {shape} of floats'
        )
    # Negated, so that NaN is refused too.
    if not ((values >= 0.0) & (values <= 1.0)).all():
        raise ValueError('exploration: got a number that is not from 0 to 1')
    exploration.values[...] = values
    return exploration


def cluster_arrays(clusters: Sequence[Cluster], d: int) -> dict[str, NDArray[Any]]:
    """Return clusters in d dimensions as arrays."""
    return {
        'cluster_positions': np.array([item.position for item in clusters]).reshape(-1, d),
        'cluster_covariances': np.array([item.covariance for item in clusters]).reshape(-1, d, d),
        'cluster_radii': np.array([item.radius for item in clusters], float),
        'cluster_masses': np.array([item.mass for item in clusters], float),
    }


def clusters_of(state: Arrays) -> list[Cluster]:
    """Return the clusters of a checked state."""
    columns = ('cluster_positions', 'cluster_covariances', 'cluster_radii', 'cluster_masses')
    return [
        Cluster(position.copy(), covariance.copy(), float(radius), float(mass))
        for position, covariance, radius, mass in zip(*(state[name] for name in columns))
    ]


def found_arrays(targets: Sequence[FoundTarget], d: int) -> dict[str, NDArray[Any]]:
    """Return found targets in d dimensions as arrays."""
    return {
        'robots': text(json.dumps([target.robot for target in targets])),
        'found_classes': text(json.dumps([target.label.class_id for target in targets])),
        'found_identities': text(json.dumps([target.label.identity for target in targets])),
        'found_scores': np.array([target.label.score for target in targets], float),
        'found_ids': np.array([target.id for target in targets], np.int64),
        'found_measurements': np.array([target.measurement for target in targets], np.int64),
        'found_origins': np.array([target.origin for target in targets], np.int64),
        'found_times': np.array([target.time for target in targets], float),
        'found_positions': np.array([t.position for t in targets]).reshape(-1, d),
        'found_covariances': np.array([t.covariance for t in targets]).reshape(-1, d, d),
    }


def found_of(state: Arrays) -> list[FoundTarget]:
    """Return the found targets of a checked state."""
    number = len(state['found_ids'])
    robots, classes, identities = (
        names_of(state, name, number) for name in ('robots', 'found_classes', 'found_identities')
    )
    return [
        FoundTarget(
            int(state['found_ids'][f]),
            state['found_positions'][f].copy(),
            state['found_covariances'][f].copy(),
            robots[f],
            int(state['found_measurements'][f]),
            float(state['found_times'][f]),
            int(state['found_origins'][f]),
            Label(classes[f], float(state['found_scores'][f]), identities[f]),
        )
        for f in range(number)
    ]


def names_of(state: Arrays, field: str, number: int) -> list[str]:
    """Return the names in a field of a state: JSON, `number` of them."""
    try:
        names = json.loads(untext(state[field]))
    except ValueError as error:
        raise ValueError(f'{field}: {error}') from None
    valid = isinstance(names, list) and all(isinstance(name, str) for name in names)
    if not valid or len(names) != number:
        raise ValueError(f'{field}: got {str(names)[:100]}, allowed are {number} names')
    return list(names)


def check_arrays(
    state: Arrays,
    arrays: Mapping[str, tuple[str, str]],
    sizes: dict[str, int],
    undefined: Sequence[str] = (),
) -> None:
    """Refuse arrays of another type or shape, or with numbers that are not finite.

    Parameters
    ----------
    state : mapping of str to array
        As it was read.
    arrays : mapping
        Allowed kinds and shapes, as in COMMON.
    sizes : dict
        Known sizes by letter; new ones are added.
    undefined : sequence of str
        Arrays that may contain non-finite numbers.

    Raises
    ------
    KeyError
        If an array is missing.
    ValueError
        If a type, shape or number is not allowed; the message names the array.
    """
    for name, (kind, shape) in arrays.items():
        array = state[name]
        if array.dtype.kind != kind:
            raise ValueError(f'{name}: got type {array.dtype}, allowed is kind {kind!r}')
        letters = shape.split()
        fits = array.ndim == len(letters)
        for letter, size in zip(letters, array.shape):
            wanted = int(letter) if letter.isdigit() else sizes.setdefault(letter, size)
            fits = fits and size == wanted
        if not fits:
            known = ', '.join(f'{letter} = {size}' for letter, size in sorted(sizes.items()))
            raise ValueError(
                f'{name}: got shape {array.shape}, allowed is ({", ".join(letters)}) with {known}'
            )
        if name not in undefined and not np.isfinite(array).all():
            raise ValueError(f'{name}: got a number that is not finite')


def check_not_negative(state: Arrays, names: Sequence[str]) -> None:
    """Refuse negative numbers."""
    for name in names:
        if not (state[name] >= 0).all():
            raise ValueError(f'{name}: got {state[name].min()}, allowed are numbers from 0')


def check_ids(ids: NDArray[Any]) -> None:
    """Refuse ids of found targets that are not unique and positive."""
    if (ids < 1).any() or len(np.unique(ids)) != len(ids):
        raise ValueError(f'found_ids: got {ids.tolist()}, allowed are different numbers from 1')
