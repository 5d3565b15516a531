"""The whole state of a Poisson multi-Bernoulli filter as arrays, and back."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maasi_filter.models.custom_kernel import renew_addresses
from maasi_filter.models.label import LabelTally
from maasi_filter.pmb.answers import RATES
from maasi_filter.pmb.component import Component
from maasi_filter.pmb.consistency import NOTHING
from maasi_filter.pmb.density import Density
from maasi_filter.pmb.factors import FIRST, HEAD, KIND, MODEL, TERM, TERMS
from maasi_filter.pmb.learnt import Learnt
from maasi_filter.pmb.offset_state import OFFSET_ARRAYS
from maasi_filter.pmb.position_error import LEVELS, PRIOR
from maasi_filter.records import FoundTarget
from maasi_filter.state_check import (
    COMMON,
    Arrays,
    check_arrays,
    check_ids,
    check_not_negative,
    found_arrays,
    found_of,
    names_of,
)
from maasi_filter.state_file import text, untext

# By name: kinds of dtype, and shape; equal letters are equal sizes.
_ARRAYS: dict[str, tuple[str, str]] = {
    **{name: item for name, item in COMMON.items() if not name.startswith('found_')},
    'counters': ('i', '2'),
    'last_time': ('f', ''),
    'existence': ('f', 'b'),
    'hits': ('f', 'b'),
    'answers': ('f', 'b RATE'),
    'scan': ('i', 'b'),
    'pose_error': ('f', 'b'),
    'found_radius': ('f', 'b'),
    'particles': ('f', 'b n d'),
    'weights': ('f', 'b n'),
    'head_counts': ('i', 'b'),
    'heads': ('f', 'h HEAD'),
    'term_counts': ('i', 'b'),
    'terms': ('f', 't TERM'),
    'grid': ('i', 'b'),
    'found_ids': ('i', 'b'),
    'found_measurements': ('i', 'b'),
    'found_origins': ('i', 'b'),
    'found_times': ('f', 'b'),
    'found_scores': ('f', 'b'),
    'found_positions': ('f', 'b d'),
    'found_covariances': ('f', 'b d d'),
    'clutter_scans': ('i', 'r'),
    'clutter_counts': ('f', 'r'),
    'noise_detections': ('f', 'r'),
    'noise_squares': ('f', 'r'),
    'position_errors': ('f', 'r LEVEL'),
    'consistency': ('f', 'r 3'),
    **OFFSET_ARRAYS,
}
_SIZES = {'HEAD': HEAD, 'TERM': TERM, 'LEVEL': len(LEVELS), 'RATE': len(RATES)}
_NOT_NEGATIVE = (
    'hits',
    'pose_error',
    'found_radius',
    'found_scores',
    'cluster_masses',
    'clutter_counts',
    'noise_detections',
    'noise_squares',
    'position_errors',
    'consistency',
    'offset_ways',
)
# Arrays that may contain non-finite numbers: no step yet, unlimited radius.
_UNDEFINED = ('last_time', 'found_radius', 'heads')


def to_arrays(
    items: Sequence[Component],
    learnt: Learnt,
    particles: tuple[int, int],
    grid: tuple[int, ...],
) -> dict[str, NDArray[Any]]:
    """Return components, and what is learnt of robots, as arrays for a file.

    Parameters
    ----------
    particles : tuple
        Number of particles of a component, and of their coordinates.
    grid : tuple
        Shape of e's grid.
    """
    n, d = particles
    clutter, noise = learnt.clutter, learnt.noise
    probabilities, sums = learnt.errors.probabilities, learnt.consistency.sums
    densities = [item.density for item in items]
    grids: list[NDArray[Any]] = []
    numbers: dict[int, int] = {}
    for density in densities:
        # Components of one scan share the grid.
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
        'answers': np.array([item.answers for item in items]).reshape(-1, len(RATES)),
        'scan': np.array([item.scan for item in items], np.int64),
        'pose_error': np.array([item.pose_error for item in items], float),
        'found_radius': np.array([item.found_radius for item in items], float),
        'birth_robots': text(json.dumps([item.robot for item in items])),
        'particles': np.array([item.particles for item in densities]).reshape(-1, n, d),
        'weights': np.array([item.weights for item in densities]).reshape(-1, n),
        'head_counts': np.array([len(item.heads) for item in densities], np.int64),
        'heads': np.concatenate([np.empty((0, HEAD)), *[item.heads for item in densities]]),
        'term_counts': np.array([len(item.terms) for item in densities], np.int64),
        'terms': np.concatenate([np.empty((0, TERM)), *[item.terms for item in densities]]),
        'grid': np.array([numbers.get(id(item.grid), -1) for item in densities], np.int64),
        'grids': np.array(grids).reshape(-1, *grid),
        **found_arrays(targets, d),
        'labels': text(json.dumps([item.labels.to_json() for item in items])),
        'clutter_robots': text(json.dumps(robots)),
        'clutter_scans': np.array([clutter.scans[name] for name in robots], np.int64),
        'clutter_counts': np.array([clutter.counts[name] for name in robots], float),
        'noise_detections': np.array([noise.detections.get(name, 0.0) for name in robots], float),
        'noise_squares': np.array([noise.squares.get(name, 0.0) for name in robots], float),
        'position_errors': np.array(
            [probabilities.get(name, PRIOR) for name in robots], float
        ).reshape(-1, len(LEVELS)),
        'consistency': np.array([sums.get(name, NOTHING) for name in robots]).reshape(-1, 3),
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
    targets = found_of(state)
    births = names_of(state, 'birth_robots', len(targets))
    # Share one array between the components of one scan, as before saving.
    shared = list(grids)
    empty = np.empty((0, 0, 0))
    every = state['heads'].copy()
    renew_addresses(every[:, KIND], every[:, MODEL:])
    heads = np.split(every, np.cumsum(state['head_counts'])[:-1])
    terms = np.split(state['terms'], np.cumsum(state['term_counts'])[:-1])
    labels = _labels_of(state, len(targets))
    components = []
    for c, target in enumerate(targets):
        number = int(state['grid'][c])
        density = Density(
            state['particles'][c].copy(),
            state['weights'][c].copy(),
            heads[c].copy(),
            terms[c].copy(),
            empty if number < 0 else shared[number],
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
                births[c],
                target if target.id else None,
                labels[c],
                answers=state['answers'][c].copy(),
            )
        )
    return components


def _labels_of(state: Arrays, number: int) -> list[LabelTally]:
    """Return the labels of a state.

    Raises
    ------
    ValueError
        If they are not JSON, or not one for each component.
    """
    labels = json.loads(untext(state['labels']))
    if not isinstance(labels, list) or len(labels) != number:
        raise ValueError(f'labels: got {str(labels)[:100]}, allowed are {number}')
    return [LabelTally.from_json(values) for values in labels]


def learnt_of(state: Arrays) -> Learnt:
    """Return what a checked state has learnt of robots.

    Raises
    ------
    ValueError
        If names and counts of robots do not match.
    """
    learnt = Learnt()
    clutter, noise = learnt.clutter, learnt.noise
    robots = names_of(state, 'clutter_robots', len(state['clutter_scans']))
    clutter.scans = dict(zip(robots, state['clutter_scans'].tolist()))
    clutter.counts = dict(zip(robots, state['clutter_counts'].tolist()))
    noise.detections = dict(zip(robots, state['noise_detections'].tolist()))
    noise.squares = dict(zip(robots, state['noise_squares'].tolist()))
    learnt.errors.probabilities = dict(zip(robots, state['position_errors']))
    learnt.consistency.sums = dict(zip(robots, state['consistency']))
    return learnt


def check(state: Arrays) -> None:
    """Refuse a state that a filter cannot continue from.

    Raises
    ------
    KeyError
        If an array is missing.
    ValueError
        If a type, shape or number is not allowed; the message names the array.
    """
    sizes: dict[str, int] = dict(_SIZES)
    check_arrays(state, _ARRAYS, sizes, _UNDEFINED)
    for name in ('existence', 'weights'):
        if ((state[name] < 0.0) | (state[name] > 1.0)).any():
            raise ValueError(f'{name}: got a number that is not from 0 to 1')
    check_not_negative(state, _NOT_NEGATIVE)
    _check_factors(state, sizes['h'], sizes['t'])
    check_ids(state['found_ids'][state['found_ids'] != 0])


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
