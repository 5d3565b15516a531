"""The whole state of a Poisson multi-Bernoulli filter as arrays, and back."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maasi_filter.ic_phd.clusters import Cluster
from maasi_filter.ic_phd.found_targets import FoundTarget
from maasi_filter.pmb.clutter import ClutterEstimate
from maasi_filter.pmb.component import Component
from maasi_filter.pmb.density import Density
from maasi_filter.pmb.factors import FIRST, HEAD, TERM, TERMS
from maasi_filter.state_file import text, untext

Arrays = Mapping[str, NDArray[Any]]

# By name: kinds of dtype, and the shape; letters are sizes that have to agree.
_ARRAYS: dict[str, tuple[str, str]] = {
    'bounds': ('f', 'd 2'),
    'spacing': ('f', ''),
    'counters': ('i', '2'),
    'last_time': ('f', ''),
    'existence': ('f', 'c'),
    'hits': ('f', 'c'),
    'scan': ('i', 'c'),
    'pose_error': ('f', 'c'),
    'found_radius': ('f', 'c'),
    'particles': ('f', 'c n d'),
    'weights': ('f', 'c n'),
    'head_counts': ('i', 'c'),
    'heads': ('f', 'h HEAD'),
    'term_counts': ('i', 'c'),
    'terms': ('f', 't TERM'),
    'grid': ('i', 'c'),
    'found_ids': ('i', 'c'),
    'found_measurements': ('i', 'c'),
    'found_origins': ('i', 'c'),
    'found_times': ('f', 'c'),
    'found_positions': ('f', 'c d'),
    'found_covariances': ('f', 'c d d'),
    'cluster_positions': ('f', 'k d'),
    'cluster_covariances': ('f', 'k d d'),
    'cluster_radii': ('f', 'k'),
    'cluster_masses': ('f', 'k'),
    'clutter_scans': ('i', 'r'),
    'clutter_counts': ('f', 'r'),
}
_SIZES = {'HEAD': HEAD, 'TERM': TERM}
# What may be without a number: no step yet, and a radius that is not limited.
_UNDEFINED = ('last_time', 'found_radius')


def to_arrays(
    items: Sequence[Component],
    clusters: Sequence[Cluster],
    clutter: ClutterEstimate,
    particles: tuple[int, int],
    grid: tuple[int, ...],
) -> dict[str, NDArray[Any]]:
    """Return components, clusters and clutter as arrays for a file.

    Parameters
    ----------
    particles : tuple
        Number of particles of a component, and of their coordinates.
    grid : tuple
        Shape of e's grid.
    """
    n, d = particles
    densities = [item.density for item in items]
    grids: list[NDArray[Any]] = []
    numbers: dict[int, int] = {}
    for density in densities:
        # Components of one scan share it.
        if density.grid.size and id(density.grid) not in numbers:
            numbers[id(density.grid)] = len(grids)
            grids.append(density.grid)
    nothing = FoundTarget(0, np.zeros(d), np.zeros((d, d)), '', 0, 0.0)
    targets = [item.target or nothing for item in items]
    robots = sorted(clutter.scans)
    return {
        'method': text('pmb'),
        'existence': np.array([item.existence for item in items], float),
        'hits': np.array([item.hits for item in items], float),
        'scan': np.array([item.scan for item in items], np.int64),
        'pose_error': np.array([item.pose_error for item in items], float),
        'found_radius': np.array([item.found_radius for item in items], float),
        'particles': np.array([item.particles for item in densities]).reshape(-1, n, d),
        'weights': np.array([item.weights for item in densities]).reshape(-1, n),
        'head_counts': np.array([len(item.heads) for item in densities], np.int64),
        'heads': np.concatenate([np.empty((0, HEAD)), *[item.heads for item in densities]]),
        'term_counts': np.array([len(item.terms) for item in densities], np.int64),
        'terms': np.concatenate([np.empty((0, TERM)), *[item.terms for item in densities]]),
        'grid': np.array([numbers.get(id(item.grid), -1) for item in densities], np.int64),
        'grids': np.array(grids).reshape(-1, *grid),
        'robots': text(json.dumps([target.robot for target in targets])),
        'found_ids': np.array([target.id for target in targets], np.int64),
        'found_measurements': np.array([target.measurement for target in targets], np.int64),
        'found_origins': np.array([target.origin for target in targets], np.int64),
        'found_times': np.array([target.time for target in targets], float),
        'found_positions': np.array([t.position for t in targets]).reshape(-1, d),
        'found_covariances': np.array([t.covariance for t in targets]).reshape(-1, d, d),
        'cluster_positions': np.array([item.position for item in clusters]).reshape(-1, d),
        'cluster_covariances': np.array([item.covariance for item in clusters]).reshape(-1, d, d),
        'cluster_radii': np.array([item.radius for item in clusters], float),
        'cluster_masses': np.array([item.mass for item in clusters], float),
        'clutter_robots': text(json.dumps(robots)),
        'clutter_scans': np.array([clutter.scans[name] for name in robots], np.int64),
        'clutter_counts': np.array([clutter.counts[name] for name in robots], float),
    }


def components_of(
    state: Arrays, particles: int, grid: tuple[int, ...], frame: NDArray[np.float64]
) -> list[Component]:
    """Return the components of a checked state.

    Raises
    ------
    ValueError
        If they have another number of particles, or grid, than the filter.
    """
    grids = state['grids']
    if grids.shape[1:] != grid or grids.dtype.kind != 'f' or not np.isfinite(grids).all():
        raise ValueError(f'grids: got shape {grids.shape}, allowed is (g, {grid}) of floats')
    if len(state['particles']) and state['particles'].shape[1] != particles:
        raise ValueError(
            f'particles: got {state["particles"].shape[1]} of each component, allowed are '
            f'{particles}'
        )
    names = _names(state['robots'], 'robots', len(state['existence']))
    empty = np.empty((0, 0, 0))
    heads = np.split(state['heads'], np.cumsum(state['head_counts'])[:-1])
    terms = np.split(state['terms'], np.cumsum(state['term_counts'])[:-1])
    components = []
    for c, name in enumerate(names):
        number = int(state['grid'][c])
        density = Density(
            state['particles'][c].copy(),
            state['weights'][c].copy(),
            heads[c].copy(),
            terms[c].copy(),
            empty if number < 0 else grids[number],
            frame,
        )
        components.append(
            Component(
                float(state['existence'][c]),
                density,
                float(state['hits'][c]),
                int(state['scan'][c]),
                float(state['pose_error'][c]),
                float(state['found_radius'][c]),
                _target(state, c, name),
            )
        )
    return components


def clusters_of(state: Arrays) -> list[Cluster]:
    """Return the clusters of a checked state."""
    return [
        Cluster(position, covariance, float(radius), float(mass))
        for position, covariance, radius, mass in zip(
            state['cluster_positions'],
            state['cluster_covariances'],
            state['cluster_radii'],
            state['cluster_masses'],
        )
    ]


def clutter_of(state: Arrays) -> ClutterEstimate:
    """Return the clutter of a checked state.

    Raises
    ------
    ValueError
        If the robots' names are not those of the numbers.
    """
    clutter = ClutterEstimate()
    robots = _names(state['clutter_robots'], 'clutter_robots', len(state['clutter_scans']))
    clutter.scans = dict(zip(robots, state['clutter_scans'].tolist()))
    clutter.counts = dict(zip(robots, state['clutter_counts'].tolist()))
    return clutter


def _target(state: Arrays, c: int, robot: str) -> FoundTarget | None:
    number = int(state['found_ids'][c])
    if number == 0:
        return None
    return FoundTarget(
        number,
        state['found_positions'][c].copy(),
        state['found_covariances'][c].copy(),
        robot,
        int(state['found_measurements'][c]),
        float(state['found_times'][c]),
        int(state['found_origins'][c]),
    )


def check(state: Arrays) -> None:
    """Refuse a state that a filter cannot go on from.

    Raises
    ------
    KeyError
        If an array is missing.
    ValueError
        If a type, shape or number is not allowed; the message names the array.
    """
    sizes: dict[str, int] = dict(_SIZES)
    for name, (kind, shape) in _ARRAYS.items():
        array = state[name]
        if array.dtype.kind != kind:
            raise ValueError(f'{name}: got type {array.dtype}, allowed is kind {kind!r}')
        letters = shape.split()
        fits = array.ndim == len(letters)
        for letter, size in zip(letters, array.shape):
            wanted = int(letter) if letter.isdigit() else sizes.setdefault(letter, size)
            fits = fits and size == wanted
        if not fits:
            raise ValueError(f'{name}: got shape {array.shape}, allowed is ({shape})')
        if name not in _UNDEFINED and not np.isfinite(array).all():
            raise ValueError(f'{name}: got a number that is not finite')
    for name in ('existence', 'weights'):
        if ((state[name] < 0.0) | (state[name] > 1.0)).any():
            raise ValueError(f'{name}: got a number that is not from 0 to 1')
    for name in ('hits', 'pose_error', 'found_radius', 'cluster_masses', 'clutter_counts'):
        if not (state[name] >= 0.0).all():
            raise ValueError(f'{name}: got a number that is not from 0')
    _check_factors(state, sizes['h'], sizes['t'])
    ids = state['found_ids'][state['found_ids'] != 0]
    if (ids < 1).any() or len(np.unique(ids)) != len(ids):
        raise ValueError(f'found_ids: got {ids.tolist()}, allowed are different numbers from 1')


def _check_factors(state: Arrays, rows: int, terms: int) -> None:
    for name, total in (('head_counts', rows), ('term_counts', terms)):
        if (state[name] < 1).any() or state[name].sum() != total:
            raise ValueError(f'{name}: got a sum of {state[name].sum()}, allowed is {total}')
    if len(state['grid']) and not -1 <= state['grid'].min() <= state['grid'].max() < len(
        state['grids']
    ):
        raise ValueError(f'grid: got numbers that are not from -1 to {len(state["grids"]) - 1}')
    owners = np.repeat(np.arange(len(state['head_counts'])), state['head_counts'])
    first, number = state['heads'][:, FIRST], state['heads'][:, TERMS]
    if ((first < 0) | (number < 0) | (first + number > state['term_counts'][owners])).any():
        raise ValueError('heads: got terms that are not there')


def _names(content: NDArray[Any], field: str, number: int) -> list[str]:
    names = json.loads(untext(content))
    valid = isinstance(names, list) and all(isinstance(name, str) for name in names)
    if not valid or len(names) != number:
        raise ValueError(f'{field}: got {str(names)[:100]}, allowed are {number} names')
    return list(names)
