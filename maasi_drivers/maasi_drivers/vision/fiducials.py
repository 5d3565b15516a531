"""Square fiducial markers with an id, by OpenCV's ArUco detector (Garrido-Jurado et al. 2014)."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from maasi_drivers.vision.blobs import Blobs
from maasi_drivers.vision.camera_settings import SegmentationSettings


def segment_fiducials(image: NDArray[np.uint8], settings: SegmentationSettings) -> Blobs:
    """Find ArUco markers; their ids are the identities of the targets.

    The detector finds whole markers only, so none is cut by the border. The centre is where the
    diagonals intersect, which perspective does not shift.

    Parameters
    ----------
    image : ndarray, shape (h, w, 3), uint8
        R, G, B.
    settings : SegmentationSettings
        ``dictionary`` is used.
    """
    grey = cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY)
    found, ids, _ = _detector(settings.dictionary).detectMarkers(grey)
    corners = np.array(found, dtype=float).reshape(-1, 4, 2)
    count = len(corners)
    names = [] if ids is None else [f'{settings.dictionary}:{number}' for number in ids.ravel()]
    following = np.roll(corners, -1, axis=1)
    products = corners[..., 0] * following[..., 1] - corners[..., 1] * following[..., 0]
    return Blobs(
        _intersections(corners),
        0.5 * np.abs(products.sum(axis=1)),
        np.ptp(corners, axis=1) if count else np.zeros((0, 2)),
        np.zeros(count, np.bool_),
        np.zeros((count, 2, 2)),
        tuple(names),
    )


def _intersections(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return where the diagonals of quadrilaterals (n, 4, 2) intersect, (n, 2)."""
    one, two = corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1]
    gap = corners[:, 1] - corners[:, 0]
    share = (gap[:, 0] * two[:, 1] - gap[:, 1] * two[:, 0]) / (
        one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0]
    )
    centres: NDArray[np.float64] = corners[:, 0] + share[:, None] * one
    return centres


@cache
def _detector(name: str) -> cv2.aruco.ArucoDetector:
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f'DICT_{name}'))
    return cv2.aruco.ArucoDetector(dictionary, parameters)
