"""The interface of a detector of a user's own: from an image to where targets are in it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import BaseModel

from maasi_drivers.vision.blobs import Blobs


class Detector(ABC):
    """Finds targets in images; one is made for each camera.

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
    def detect(self, image: NDArray[np.uint8]) -> Blobs:
        """Return the targets in an image.

        Parameters
        ----------
        image : ndarray, shape (h, w, 3), uint8
            R, G, B; read only.

        Returns
        -------
        Blobs
            See `blobs_at`. Each is taken for a point on the floor.
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
        What tells each from all others, such as the id of a marker; empty: not known.

    Raises
    ------
    ValueError
        If the shape is another, a number is not finite, or not each has an identity.
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
        identities,
    )
