"""Checks of the saved state of an IC-PHD filter."""

from __future__ import annotations

import numpy as np

from maasi_filter.state_check import (
    COMMON,
    Arrays,
    check_arrays,
    check_ids,
    check_not_negative,
)

_ARRAYS = {
    **COMMON,
    'particles': ('f', 'n d'),
    'weights': ('f', 'n'),
    'centres': ('f', 'k d'),
}
_NOT_NEGATIVE = (
    'weights',
    'cluster_radii',
    'cluster_masses',
    'found_measurements',
    'found_scores',
)


def check(state: Arrays) -> None:
    """Refuse a state that a filter cannot continue from.

    Raises
    ------
    KeyError
        If an array is missing.
    ValueError
        If a type, shape or number is not allowed; the message names the array.
    """
    check_arrays(state, _ARRAYS, {})
    check_not_negative(state, _NOT_NEGATIVE)
    check_ids(state['found_ids'])
    for number, covariance in zip(state['found_ids'].tolist(), state['found_covariances']):
        # A cluster of equal particles has zero covariance.
        if not np.allclose(covariance, covariance.T) or (np.diagonal(covariance) < 0.0).any():
            raise ValueError(
                f'found_covariances: of target {number}: got {covariance.tolist()}, allowed is a '
                'symmetric matrix with a diagonal from 0'
            )
