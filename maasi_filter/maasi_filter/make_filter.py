"""The filter that the settings name, new or from a file."""

from __future__ import annotations

import os

import numpy as np
from numpy.typing import ArrayLike

from maasi_filter.ic_phd.filter import IcPhdFilter, IcPhdState
from maasi_filter.pmb.filter import PmbFilter, PmbState
from maasi_filter.search_filter import SearchFilter
from maasi_filter.settings import FilterSettings
from maasi_filter.state_file import SavedState


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
    return filter_of(SavedState(path))


def filter_of(saved: SavedState) -> SearchFilter:
    """Return the filter of a file.

    Raises
    ------
    StateFileError
        If something is missing, or has a wrong type, shape or number.
    """
    with saved.named():
        if PmbState.method in saved:
            return PmbFilter.from_state(saved.read(PmbState.method, PmbState))
        return IcPhdFilter.from_state(saved.read(IcPhdState.method, IcPhdState))
