"""Markers as they appear in an image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Blobs:
    """Connected marker pixels, in the order of their topmost and then leftmost pixel.

    Attributes
    ----------
    centroids : ndarray, shape (n, 2)
        (column, row), pixel centres at whole numbers [px].
    areas : ndarray, shape (n,)
        [px].
    extents : ndarray, shape (n, 2)
        Width and height of the bounding box [px].
    border_cut : ndarray of bool, shape (n,)
        True where the blob touches the image's border, so that its centroid is biased inwards.
    covariances : ndarray, shape (n, 2, 2)
        Of the centroids, as far as image noise explains them; zero where the rule does not tell
        [px^2].
    identities : tuple of str
        Ids of fiducial markers; empty: the rule does not tell.
    """

    centroids: Array
    areas: Array
    extents: Array
    border_cut: NDArray[np.bool_]
    covariances: Array
    identities: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.areas)

    def select(self, mask: NDArray[np.bool_]) -> Blobs:
        """Return the blobs where ``mask`` (n,) is true."""
        return Blobs(
            self.centroids[mask],
            self.areas[mask],
            self.extents[mask],
            self.border_cut[mask],
            self.covariances[mask],
            tuple(name for name, kept in zip(self.identities, mask.tolist()) if kept),
        )
