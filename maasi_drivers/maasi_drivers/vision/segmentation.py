"""Markers in RGB images (h, w, 3): the papers' rule, a robust rule, and fiducials."""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from maasi_drivers.settings.camera import DETECTORS, SegmentationSettings
from maasi_drivers.vision.detector import Blobs, blobs_at
from maasi_filter.arrays import BoolArray, ImageArray, IntArray

# Added to the mean of the channels before division, as noise in the dark is not blue.
_DARK = 6.0
_THREE = np.float32(3.0)  # in the images' type, which products with it keep


def paper_mask(image: ImageArray, threshold: float = 35.0) -> BoolArray:
    """Return where B - R/2 - G/2 > threshold (paper 001, eq. (16)), in half grey levels."""
    # Plane by plane, which is faster.
    red, green, blue = (plane.astype(np.int16) for plane in cv2.split(image))
    return np.asarray(2 * blue - red - green > int(np.floor(2.0 * threshold)))


def _components(mask: BoolArray) -> tuple[NDArray[np.int32], IntArray, Blobs]:
    """Return labels, boxes (left, top, width, height) and blobs of 8-connected components."""
    # Labelled pixel by pixel; other algorithms number by blocks of pixels.
    _, labels, stats, centroids = cv2.connectedComponentsWithStatsWithAlgorithm(
        mask.view(np.uint8), 8, cv2.CV_32S, cv2.CCL_SAUF
    )
    boxes, areas = stats[1:, :4], stats[1:, 4]
    low, high = boxes[:, :2], boxes[:, :2] + boxes[:, 2:]
    cut = np.asarray(((low <= 0) | (high >= mask.shape[::-1])).any(axis=1))
    centres, spread = np.asarray(centroids[1:], float), np.zeros((len(areas), 2, 2))
    blobs = Blobs(centres, areas.astype(float), boxes[:, 2:].astype(float), cut, spread)
    return np.asarray(labels, np.int32), np.asarray(boxes, np.int64), blobs


def segment_paper(image: ImageArray, settings: SegmentationSettings) -> Blobs:
    """Find blobs of a fixed blue excess with unweighted centroids (paper 001, section 6.1)."""
    mask = paper_mask(image, settings.threshold)
    blobs = _components(mask)[2]
    return blobs.select(blobs.areas >= settings.minimum_area * mask.size)


@njit(cache=True, error_model='numpy')
def _median(counts):  # type: ignore[no-untyped-def]
    total = np.cumsum(counts)
    half = 0.5 * total[-1]
    value = np.searchsorted(total, half)
    before = total[value] - counts[value]
    return value - 0.5 + (half - before) / counts[value]


@njit(cache=True, error_model='numpy')
def _blueness(planes):  # type: ignore[no-untyped-def]
    red, green, blue = planes[0], planes[1], planes[2]
    return _THREE * (blue - np.maximum(red, green)) / (red + green + blue + _THREE * _DARK)


@njit(cache=True, error_model='numpy')
def _floor_statistics(sample):  # type: ignore[no-untyped-def]
    """Return white-balance gains (3,) from pixels (3, n); median and deviation of blueness."""
    medians = np.array([max(_median(np.bincount(channel)), 1.0) for channel in sample])
    # Bounded, as an image full of marker or coloured floor is no reference.
    gains = np.clip(medians.sum() / 3.0 / medians, 0.6, 1.7)
    # Blueness is between -3 and 3: bins of 1/256.
    bins = np.floor(_blueness(gains.reshape(3, 1) * sample) * 256.0).astype(np.int64) + 768
    counts = np.bincount(np.clip(bins, 0, 1535), minlength=1536)
    values = (np.arange(1536) + 0.5 - 768.0) / 256.0
    centre = (_median(counts) + 0.5 - 768.0) / 256.0
    offsets = np.floor(np.abs(values - centre) * 256.0).astype(np.int64)
    deviation = 1.4826 * (_median(np.bincount(offsets, counts)) + 0.5) / 256.0
    return gains, centre, deviation


@njit(cache=True, error_model='numpy')
def _is_compact(x, y, aspect, solidity):  # type: ignore[no-untyped-def]
    """Return whether aspect and solidity of pixels are allowed."""
    dx, dy = x - x.mean(), y - y.mean()
    xx, yy, xy = (dx * dx).mean(), (dy * dy).mean(), (dx * dy).mean()
    # Each pixel is a square with a second moment of 1/12.
    middle, apart = 0.5 * (xx + yy) + 1.0 / 12.0, math.hypot(0.5 * (xx - yy), xy)
    # Axis lengths are proportional to the roots of the principal second moments.
    long, short = middle + apart, middle - apart
    # An ellipse has area 4 pi root(long short).
    least = solidity * 4.0 * math.pi * math.sqrt(long * short)
    return long <= aspect**2 * short and len(x) >= least


@njit(cache=True, error_model='numpy')
def _weigh(excess, own, floor, x, y):  # type: ignore[no-untyped-def]
    """Return area, centroid and its variances (5,), weighted by the marker share of pixels."""
    # Excess of a pixel inside a marker: mean of the upper half of the component.
    upper = np.sort(excess.ravel()[own.ravel()])[len(x) // 2 :].mean()
    around, near = floor.copy(), np.zeros_like(own)
    around[max(y.min() - 1, 0) : y.max() + 2, max(x.min() - 1, 0) : x.max() + 2] = False
    outside = excess.ravel()[around.ravel()]
    background, noise = (outside.mean(), outside.var()) if len(outside) else (0.0, 0.0)
    contrast = max(upper - background, 1e-6)
    # The component and a ring of one pixel, without other components.
    for column, row in zip(x, y):
        near[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2] = True
    rows, columns = np.nonzero(near)
    weights = (excess.ravel()[near.ravel()] - background) / contrast
    area = weights.sum()
    scale = noise / (contrast * area) ** 2
    spread_x, spread_y = ((columns - x.mean()) ** 2).sum(), ((rows - y.mean()) ** 2).sum()
    centre = (weights * columns).sum() / area, (weights * rows).sum() / area
    return np.array([area, *centre, scale * spread_x, scale * spread_y])


@njit(cache=True, error_model='numpy')
def _measure(planes, gains, labels, boxes, reached, aspect, solidity):  # type: ignore[no-untyped-def]
    """Return `_weigh` of each component (n, 5); zeros if it is no marker."""
    found = np.zeros((len(boxes), 5))
    for blob in np.flatnonzero(reached):
        # The component's box with three pixels of floor around it.
        first, end = np.maximum(boxes[blob, :2] - 3, 0), boxes[blob, :2] + boxes[blob, 2:] + 3
        rows, columns = slice(first[1], end[1]), slice(first[0], end[0])
        own, floor = labels[rows, columns] == blob + 1, labels[rows, columns] == 0
        y, x = np.nonzero(own)
        if _is_compact(x, y, aspect, solidity):
            # O_p of paper 001, which is linear in a pixel's marker share.
            red, green, blue = [gains[k] * planes[k, rows, columns] for k in range(3)]
            measured = _weigh(blue - 0.5 * (red + green), own, floor, x, y)
            if measured[0] >= 0.25 * len(x):
                found[blob] = measured
                found[blob, 1:3] += first
    return found


def segment_robust(image: ImageArray, settings: SegmentationSettings) -> Blobs:
    """Find compact blobs that are bluer than the floor, in any light.

    White balance by the image's median; blueness (B - max(R, G)) / mean, independent of
    gradients and exposure; hysteresis with a threshold raised by noise (median absolute
    deviation); checks of aspect and solidity; centroids weighted by the marker share of pixels.
    """
    planes = np.array(cv2.split(image))
    # About 4096 pixels.
    stride = max(1, int(np.sqrt(planes[0].size / 4096)))
    sample = planes[:, stride // 2 :: stride, stride // 2 :: stride].reshape(3, -1)
    gains, centre, deviation = _floor_statistics(sample)
    threshold = max(settings.saturation, centre + settings.noise_factor * deviation)
    blueness = _blueness(gains.astype(np.float32)[:, None, None] * planes)
    labels, boxes, blobs = _components(blueness > threshold)
    reached = np.zeros(len(blobs) + 1, np.bool_)
    reached[labels[blueness >= max(settings.peak_saturation, threshold)]] = True
    gates = settings.maximum_aspect, settings.minimum_solidity
    found = _measure(planes, gains, labels, boxes, reached[1:], *gates)
    markers = found[:, 0] > 0.0
    found, blobs = found[markers], blobs.select(markers)
    covariances = found[:, 3:, None] * np.eye(2)
    return replace(blobs, centroids=found[:, 1:3], areas=found[:, 0], covariances=covariances)


# Corners of a marker in its plane, in the detector's order.
_SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]], dtype=np.float32)


def segment_fiducials(image: ImageArray, settings: SegmentationSettings) -> Blobs:
    """Find complete ArUco markers by id; their diagonals cross at the centre in any perspective."""
    grey = cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY)
    found, ids, _ = _detector(settings.dictionary).detectMarkers(grey)
    corners = np.reshape(np.array(found, dtype=np.float32), (-1, 4, 2))
    middle = np.array([[[0.5, 0.5]]])
    centres = [
        cv2.perspectiveTransform(middle, cv2.getPerspectiveTransform(_SQUARE, item))
        for item in corners
    ]
    numbers = [] if ids is None else ids.ravel()
    return blobs_at(centres, 0.0, tuple(f'{settings.dictionary}:{number}' for number in numbers))


@cache
def _detector(name: str) -> cv2.aruco.ArucoDetector:
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f'DICT_{name}'))
    return cv2.aruco.ArucoDetector(dictionary, parameters)


def segment(image: ImageArray, settings: SegmentationSettings) -> Blobs:
    """Find marker blobs in an image (h, w, 3), uint8, by the rule of the settings."""
    rule: Callable[[ImageArray, SegmentationSettings], Blobs] = DETECTORS.load(settings.rule)
    return rule(image, settings)
