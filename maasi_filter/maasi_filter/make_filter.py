"""The filter that the settings name, new or from a file."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from maasi_filter.ic_phd.filter import IcPhdFilter
from maasi_filter.pmb.filter import PmbFilter
from maasi_filter.search_filter import SearchFilter
from maasi_filter.settings import FilterSettings
from maasi_filter.state_file import read_state


def make_filter(
    settings: FilterSettings, bounds: ArrayLike, generator: np.random.Generator
) -> SearchFilter:
    """Return a new filter of the method that the settings name.

    Parameters
    ----------
    bounds : (d, 2) array
        Of the environment, metres; d = 2 or 3.
    generator : numpy.random.Generator
        Every random draw comes from it.

    Raises
    ------
    ValueError
        If the bounds or the spacing of the exploration grid are not usable.
    """
    if settings.method == 'pmb':
        return PmbFilter(settings, bounds, generator)
    return IcPhdFilter(settings, bounds, generator)


def load_filter(path: str | os.PathLike[str]) -> SearchFilter:
    """Return the saved filter; it continues bit for bit as the saved one would have.

    Raises
    ------
    StateFileError
        If the file is missing, of another format or version, or damaged; it says which.
    """
    return filter_from_state(read_state(path), path)


def filter_from_state(
    state: Mapping[str, NDArray[Any]], path: str | os.PathLike[str]
) -> SearchFilter:
    """Return the filter of a state; `path` is named in errors.

    Raises
    ------
    StateFileError
        If an array is missing, or has a wrong shape or number.
    """
    if 'method' in state and state['method'].tobytes() == b'pmb':
        return PmbFilter.from_state(state, path)
    return IcPhdFilter.from_state(state, path)
