"""Markers in an image: the papers' rule, one that adapts to the light, and fiducial markers.

All rules take an RGB image (h, w, 3) and return `Blobs`; `segment` chooses by name.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from maasi_drivers.settings.camera import DETECTORS, SegmentationSettings
from maasi_drivers.vision.detector import Blobs
from maasi_filter.arrays import BoolArray, FloatArray, ImageArray, IntArray

# Added to the mean of the channels before dividing by it: noise in the dark is not blue.
_DARK = 6.0


def paper_mask(image: ImageArray, threshold: float = 35.0) -> BoolArray:
    """Return where B - R/2 - G/2 > threshold (001, eq. (16)).

    Computed in whole numbers of half grey levels, so nothing is rounded or clipped.
    """
    # Plane by plane, which is faster.
    red, green, blue = (plane.astype(np.int16) for plane in cv2.split(image))
    return np.asarray(2 * blue - red - green > int(np.floor(2.0 * threshold)))


def _components(mask: BoolArray) -> tuple[NDArray[np.int32], IntArray, Blobs]:
    """Return the 8-connected components of a mask (h, w), in the order of rows.

    Labels (h, w), component plus one, 0: background; boxes (n, 4): left, top, width, height; and
    the components as blobs with the plain centroids of their pixels.
    """
    # Labelled pixel by pixel: other algorithms number them in the order of blocks of pixels.
    _, labels, stats, centroids = cv2.connectedComponentsWithStatsWithAlgorithm(
        mask.view(np.uint8), 8, cv2.CV_32S, cv2.CCL_SAUF
    )
    boxes, areas = stats[1:, :4], stats[1:, 4]
    low, high = boxes[:, :2], boxes[:, :2] + boxes[:, 2:]
    cut = np.asarray(((low <= 0) | (high >= mask.shape[::-1])).any(axis=1))
    places, spread = np.asarray(centroids[1:], float), np.zeros((len(areas), 2, 2))
    blobs = Blobs(places, areas.astype(float), boxes[:, 2:].astype(float), cut, spread)
    return np.asarray(labels, np.int32), np.asarray(boxes, np.int64), blobs


def segment_paper(image: ImageArray, settings: SegmentationSettings) -> Blobs:
    """Find blobs of a fixed blue excess, with the centroid of their pixels (001, section 6.1)."""
    mask = paper_mask(image, settings.threshold)
    blobs = _components(mask)[2]
    return blobs.select(blobs.areas >= settings.minimum_area * mask.size)


def _median(counts: NDArray[Any]) -> float:
    """Return the median of counted whole numbers, interpolated within its bin."""
    total = np.cumsum(counts)
    half = 0.5 * total[-1]
    value = int(np.searchsorted(total, half))
    before = total[value] - counts[value]
    return value - 0.5 + float(half - before) / float(counts[value])


def _blueness(red: FloatArray, green: FloatArray, blue: FloatArray) -> FloatArray:
    """Return (B - max(R, G)) over the mean of the channels, -3 to 3."""
    return 3.0 * (blue - np.maximum(red, green)) / (red + green + blue + 3.0 * _DARK)


def _floor_statistics(image: ImageArray) -> tuple[FloatArray, float, float]:
    """Return white-balance gains (3,) from the floor; median and deviation of its blueness."""
    # About 4096 pixels.
    stride = max(1, int(np.sqrt(image.shape[0] * image.shape[1] / 4096)))
    sample = image[stride // 2 :: stride, stride // 2 :: stride].reshape(-1, 3)
    medians = np.array([max(_median(np.bincount(channel)), 1.0) for channel in sample.T])
    # Bounded, as an image of mostly marker or coloured sheet is no reference.
    gains = np.clip(medians.sum() / 3.0 / medians, 0.6, 1.7)
    # Blueness is between -3 and 3: bins of 1/256.
    bins = np.floor(_blueness(*(gains * sample).T) * 256.0).astype(np.int64) + 768
    counts = np.bincount(np.clip(bins, 0, 1535), minlength=1536)
    places = (np.arange(1536) + 0.5 - 768.0) / 256.0
    centre = (_median(counts) + 0.5 - 768.0) / 256.0
    offsets = np.floor(np.abs(places - centre) * 256.0).astype(np.int64)
    deviation = 1.4826 * (_median(np.bincount(offsets, weights=counts)) + 0.5) / 256.0
    return gains, centre, deviation


def _is_compact(own: BoolArray, settings: SegmentationSettings) -> bool:
    """Return whether a component (h, w) has an allowed aspect and solidity."""
    moments = cv2.moments(own.astype(np.uint8), binaryImage=True)
    xx, yy, xy = (moments[name] / moments['m00'] for name in ('mu20', 'mu02', 'mu11'))
    # Each pixel is a square with a second moment of 1/12.
    middle, apart = 0.5 * (xx + yy) + 1.0 / 12.0, math.hypot(0.5 * (xx - yy), xy)
    # The lengths of the axes go as the roots of the principal second moments.
    long, short = middle + apart, middle - apart
    if long > settings.maximum_aspect**2 * short:
        return False
    # An ellipse has area 4 pi root(long short).
    return moments['m00'] >= settings.minimum_solidity * 4.0 * math.pi * math.sqrt(long * short)


def _weigh(
    image: ImageArray, own: BoolArray, floor: BoolArray, gains: FloatArray
) -> tuple[float, FloatArray, FloatArray] | None:
    """Return area, centroid and its variances (2,), by how much of each pixel is marker.

    `own` and `floor` (h, w) are the pixels of the component, and those of none. None where the area
    is much less than the pixels of the component.
    """
    red, green, blue = np.moveaxis(gains * image, -1, 0)
    # O_p of 001, which is linear in how much of a pixel is marker.
    excess = blue - 0.5 * (red + green)
    # The excess of a pixel inside a marker: the mean of the upper half of the component.
    values = np.sort(excess[own])
    upper = float(values[len(values) // 2 :].mean())
    pixels = np.argwhere(own)
    (top, left), (bottom, right) = np.maximum(pixels.min(axis=0) - 1, 0), pixels.max(axis=0) + 2
    around = floor.copy()
    around[top:bottom, left:right] = False
    outside = excess[around]
    background = float(outside.mean()) if len(outside) else 0.0
    noise = float(outside.var()) if len(outside) else 0.0
    contrast = max(upper - background, 1e-6)
    # The component and the ring of one pixel around it, other components left out.
    ring = cv2.dilate(own.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    places = np.argwhere(own | (ring & floor))
    weights = (excess[places[:, 0], places[:, 1]] - background) / contrast
    area = float(weights.sum())
    if area < 0.25 * len(values):
        return None
    variances = noise / (contrast * area) ** 2 * ((places - pixels.mean(axis=0)) ** 2).sum(axis=0)
    return area, (weights @ places / area)[::-1], variances[::-1]


def segment_robust(image: ImageArray, settings: SegmentationSettings) -> Blobs:
    """Find compact blobs that are bluer than the floor, in any light.

    White balance from the median of the image (the floor); blueness (B - max(R, G)) over the mean
    of the channels, which neither gradients nor exposure change, and which tells purple and pale
    blue from blue; a threshold on it, raised where the floor is noisy (median absolute deviation),
    and a higher one that each blob has to reach (hysteresis); gates on aspect and solidity;
    centroids weighted by how much of each pixel is marker. Sizes are gated where the geometry is
    known, in `maasi_drivers.vision.marker_detector`.
    """
    gains, centre, deviation = _floor_statistics(image)
    threshold = max(settings.saturation, centre + settings.noise_factor * deviation)
    planes = zip(gains.astype(np.float32), cv2.split(image))
    blueness = _blueness(*(gain * plane.astype(np.float32) for gain, plane in planes))
    labels, boxes, blobs = _components(blueness > threshold)
    reached = np.unique(labels[blueness >= max(settings.peak_saturation, threshold)])
    found = []
    for blob in (reached[reached > 0] - 1).tolist():
        left, top, width, height = boxes[blob].tolist()
        # The component's box and three pixels around it, for the floor.
        first = np.maximum([left - 3, top - 3], 0)
        window = np.s_[first[1] : top + height + 3, first[0] : left + width + 3]
        own, floor = labels[window] == blob + 1, labels[window] == 0
        if not _is_compact(own, settings):
            continue
        if (measured := _weigh(image[window], own, floor, gains)) is not None:
            area, centroid, variances = measured
            found.append((blob, area, centroid + first, np.diag(variances)))
    chosen = np.array([item[0] for item in found], dtype=int)
    return Blobs(
        np.reshape([item[2] for item in found], (-1, 2)),
        np.array([item[1] for item in found]),
        blobs.extents[chosen],
        blobs.border_cut[chosen],
        np.reshape([item[3] for item in found], (-1, 2, 2)),
    )


# Corners of a marker in its own plane, in the order of the detector.
_SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]], dtype=np.float32)


def segment_fiducials(image: ImageArray, settings: SegmentationSettings) -> Blobs:
    """Find ArUco markers; their ids are the identities of the targets.

    The detector finds whole markers only, so none is cut by the border. The centre is where the
    diagonals intersect, which perspective does not shift.
    """
    grey = cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY)
    found, ids, _ = _detector(settings.dictionary).detectMarkers(grey)
    corners = np.reshape(np.array(found, dtype=np.float32), (-1, 4, 2))
    middle = np.array([[[0.5, 0.5]]])
    centres = [
        cv2.perspectiveTransform(middle, cv2.getPerspectiveTransform(_SQUARE, item))
        for item in corners
    ]
    count = len(corners)
    names = [] if ids is None else [f'{settings.dictionary}:{number}' for number in ids.ravel()]
    return Blobs(
        np.reshape(np.array(centres, dtype=float), (-1, 2)),
        np.array([cv2.contourArea(item) for item in corners]),
        np.ptp(corners, axis=1).astype(float),
        np.zeros(count, np.bool_),
        np.zeros((count, 2, 2)),
        tuple(names),
    )


@cache
def _detector(name: str) -> cv2.aruco.ArucoDetector:
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f'DICT_{name}'))
    return cv2.aruco.ArucoDetector(dictionary, parameters)


def segment(image: ImageArray, settings: SegmentationSettings) -> Blobs:
    """Find marker blobs in an image (h, w, 3), uint8, by the rule that the settings name."""
    rule: Callable[[ImageArray, SegmentationSettings], Blobs] = DETECTORS.load(settings.rule)
    return rule(image, settings)
