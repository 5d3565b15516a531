"""The interface of user detectors: from an image to target positions in it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike
from pydantic import BaseModel

from maasi_filter.arrays import BoolArray, FloatArray, ImageArray
from maasi_filter.records import Label


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
    labels : tuple of Label
        Class, score and identity (id of a fiducial marker) of each; empty: the rule does not tell.
    frame : str
        Optical frame in which the camera is where tf says; empty: it is at its mount.
    """

    centroids: FloatArray
    areas: FloatArray
    extents: FloatArray
    border_cut: BoolArray
    covariances: FloatArray
    labels: tuple[Label, ...] = ()
    frame: str = ''

    def __len__(self) -> int:
        return len(self.areas)

    def select(self, mask: BoolArray) -> Blobs:
        """Return the blobs where ``mask`` (n,) is true."""
        return replace(
            self,
            centroids=self.centroids[mask],
            areas=self.areas[mask],
            extents=self.extents[mask],
            border_cut=self.border_cut[mask],
            covariances=self.covariances[mask],
            labels=tuple(label for label, kept in zip(self.labels, mask.tolist()) if kept),
        )


class Detector(ABC):
    """Detects targets in images; each camera has its own instance.

    Parameters
    ----------
    settings : BaseModel or None
        Instance of `Settings`, from `camera.segmentation.settings`.

    Attributes
    ----------
    Settings : type or None
        Model of the settings that a scenario may give.
    """

    Settings: ClassVar[type[BaseModel] | None] = None

    def __init__(self, settings: Any = None) -> None:
        self.own = settings

    @abstractmethod
    def detect(self, image: ImageArray) -> Blobs:
        """Return the targets in an image.

        Parameters
        ----------
        image : ndarray, shape (h, w, 3), uint8
            R, G, B; read-only.

        Returns
        -------
        Blobs
            See `blobs_at`. Each counts as a point on the floor.
        """


def blobs_at(pixels: ArrayLike, deviation: float = 0.5, identities: tuple[str, ...] = ()) -> Blobs:
    """Return blobs at pixels.

    Parameters
    ----------
    pixels : (n, 2) array
        Column and row, pixel centres at whole numbers.
    deviation : float
        Standard deviation of their error on each axis, pixels.
    identities : tuple of str
        Unique name of each, such as the id of a marker; empty: unknown.

    Raises
    ------
    ValueError
        If the shape is wrong, a number is not finite, or identities are missing.
    """
    centroids = np.array(pixels, dtype=float).reshape(-1, 2)
    number = len(centroids)
    if not np.isfinite(centroids).all():
        raise ValueError(f'pixels: got {centroids.tolist()}, allowed are finite numbers')
    if len(identities) not in (0, number):
        raise ValueError(f'identities: got {len(identities)}, allowed are {number}, or none')
    return Blobs(
        centroids,
        np.ones(number),
        np.ones((number, 2)),
        np.zeros(number, dtype=bool),
        np.tile(deviation**2 * np.eye(2), (number, 1, 1)),
        tuple(Label(identity=name) for name in identities),
    )
