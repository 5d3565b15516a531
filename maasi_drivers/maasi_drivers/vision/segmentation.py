"""Markers in an image: the papers' rule, one that adapts to the light, and fiducial markers.

All rules take an RGB image (h, w, 3) and return `Blobs`; `segment` chooses by name.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from maasi_drivers.settings.camera import SegmentationSettings
from maasi_drivers.vision.detector import Blobs
from maasi_filter.arrays import FloatArray, ImageArray, IntArray

# Added to the mean of the channels before dividing by it: noise in the dark is not blue.
_DARK = 6.0


def paper_mask(image: ImageArray, threshold: float = 35.0) -> ImageArray:
    """Return 1 where B - R/2 - G/2 > threshold, else 0 (001, eq. (16)).

    Computed in whole numbers of half grey levels, so nothing is rounded or clipped.
    """
    red, green, blue = (plane.astype(np.int16) for plane in _planes(image))
    return (2 * blue - red - green > int(np.floor(2.0 * threshold))).astype(np.uint8)


def _planes(image: ImageArray) -> list[ImageArray]:
    # Masks are computed plane by plane, which is faster.
    return [np.asarray(plane, dtype=np.uint8) for plane in cv2.split(image)]


def _components(mask: ImageArray) -> tuple[NDArray[np.int32], IntArray, Blobs]:
    """Return the 8-connected components of a mask (h, w), in the order of rows.

    Labels (h, w), component plus one, 0: background; boxes (n, 4): left, top, width, height; and
    the components as blobs with the plain centroids of their pixels.
    """
    # Labelled pixel by pixel: other algorithms number them in the order of blocks of pixels.
    _, labels, stats, centroids = cv2.connectedComponentsWithStatsWithAlgorithm(
        mask, 8, cv2.CV_32S, cv2.CCL_SAUF
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


def _blueness(balanced: FloatArray) -> FloatArray:
    """Return (B - max(R, G)) over the mean of the channels of pixels (..., 3), -3 to 3."""
    red, green, blue = np.moveaxis(balanced, -1, 0)
    ratio: FloatArray = 3.0 * (blue - np.maximum(red, green)) / (red + green + blue + 3.0 * _DARK)
    return ratio


def _floor_statistics(image: ImageArray) -> tuple[FloatArray, float, float]:
    """Return white-balance gains (3,) from the floor; median and deviation of its blueness."""
    # About 4096 pixels.
    stride = max(1, int(np.sqrt(image.shape[0] * image.shape[1] / 4096)))
    sample = image[stride // 2 :: stride, stride // 2 :: stride].reshape(-1, 3)
    medians = np.array([max(_median(np.bincount(channel)), 1.0) for channel in sample.T])
    # Bounded, as an image of mostly marker or coloured sheet is no reference.
    gains = np.clip(medians.sum() / 3.0 / medians, 0.6, 1.7)
    # Blueness is between -3 and 3: bins of 1/256.
    bins = np.floor(_blueness(gains * sample) * 256.0).astype(np.int64) + 768
    counts = np.bincount(np.clip(bins, 0, 1535), minlength=1536)
    places = (np.arange(1536) + 0.5 - 768.0) / 256.0
    centre = (_median(counts) + 0.5 - 768.0) / 256.0
    offsets = np.floor(np.abs(places - centre) * 256.0).astype(np.int64)
    deviation = 1.4826 * (_median(np.bincount(offsets, weights=counts)) + 0.5) / 256.0
    return gains, centre, deviation


@njit(cache=True)
def _robust_mask(red, green, blue, gains, threshold, mask):
    """Set mask to 1 where the blueness exceeds the threshold; several times as fast as NumPy."""
    red_gain, green_gain, blue_gain = gains
    slope, offset = np.float32(threshold / 3.0), np.float32(threshold * _DARK)
    for row in range(mask.shape[0]):
        for column in range(mask.shape[1]):
            r = red_gain * np.float32(red[row, column])
            g = green_gain * np.float32(green[row, column])
            b = blue_gain * np.float32(blue[row, column])
            # Without a division per pixel.
            mask[row, column] = np.uint8(b - max(r, g) - offset > slope * (r + g + b))


def _compact(
    image: ImageArray,
    labels: NDArray[np.int32],
    boxes: IntArray,
    gains: FloatArray,
    peak: float,
    settings: SegmentationSettings,
) -> list[int]:
    """Return the components with this peak of blueness, and an allowed aspect and solidity."""
    if not len(boxes):
        return []
    columns, rows = cv2.findNonZero((labels > 0).view(np.uint8))[:, 0].T
    owners = labels[rows, columns] - 1
    count = np.bincount(owners)
    moments = [
        np.bincount(owners, weights=values)
        for x, y in [(columns - boxes[owners, 0], rows - boxes[owners, 1])]
        for values in (x, y, x * x, y * y, x * y)
    ]
    mx, my, xx, yy, xy = (values / count for values in moments)
    # Each pixel is a square with a second moment of 1/12.
    vxx, vyy, vxy = xx - mx * mx + 1.0 / 12.0, yy - my * my + 1.0 / 12.0, xy - mx * my
    middle, apart = 0.5 * (vxx + vyy), np.sqrt(0.25 * (vxx - vyy) ** 2 + vxy * vxy)
    # The lengths of the axes go as the roots of the principal second moments.
    long, short = middle + apart, np.maximum(middle - apart, 1e-9)
    peaks = np.full(len(count), -np.inf)
    np.maximum.at(peaks, owners, _blueness(gains * image[rows, columns]))
    aspect = settings.maximum_aspect
    keep = (peaks >= peak) & (long <= aspect * aspect * short)
    # An ellipse has area 4 pi root(long short).
    keep &= count >= settings.minimum_solidity * 4.0 * np.pi * np.sqrt(long * short)
    return [int(index) for index in np.flatnonzero(keep)]


def _weigh(
    image: ImageArray, labels: NDArray[np.int32], box: IntArray, blob: int, gains: FloatArray
) -> tuple[float, FloatArray, FloatArray] | None:
    """Return area, centroid and its variances (2,), by how much of each pixel is marker.

    None where that is much less than the pixels of the component.
    """
    left, top, width, height = box.tolist()
    # The component's box and three pixels around it.
    first_row, first_column = max(top - 3, 0), max(left - 3, 0)
    window = np.s_[first_row : top + height + 3, first_column : left + width + 3]
    red, green, blue = np.moveaxis(gains * image[window], -1, 0)
    # O_p of 001, which is linear in how much of a pixel is marker.
    excess = blue - 0.5 * (red + green)
    labels = labels[window]
    own, floor = labels == blob + 1, labels == 0
    # The excess of a pixel inside a marker: the mean of the upper half of the component.
    values = np.sort(excess[own])
    upper = float(values[len(values) // 2 :].mean())
    around = floor.copy()
    around[
        max(top - 1 - first_row, 0) : top + height + 1 - first_row,
        max(left - 1 - first_column, 0) : left + width + 1 - first_column,
    ] = False
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
    middle = np.argwhere(own).mean(axis=0)
    variances = noise / (contrast * area) ** 2 * ((places - middle) ** 2).sum(axis=0)
    centroid = weights @ places / area + [first_row, first_column]
    return area, centroid[::-1], variances[::-1]


def segment_robust(image: ImageArray, settings: SegmentationSettings) -> Blobs:
    """Find compact blobs that are bluer than the floor, in any light.

    White balance from the median of the image (the floor); blueness (B - max(R, G)) over the mean
    of the channels, which neither gradients nor exposure change, and which tells purple and pale
    blue from blue; a threshold on it, raised where the floor is noisy (median absolute deviation);
    gates on the blueness at the peak, on aspect and solidity; centroids weighted by how much of
    each pixel is marker. Sizes are gated where the geometry is known, in
    `maasi_drivers.vision.marker_detector`.
    """
    # One memory layout: kernels are compiled for the layouts that they meet.
    image = np.ascontiguousarray(image)
    gains, centre, deviation = _floor_statistics(image)
    threshold = max(settings.saturation, centre + settings.noise_factor * deviation)
    mask = np.empty(image.shape[:2], dtype=np.uint8)
    red, green, blue = _planes(image)
    _robust_mask(red, green, blue, gains.astype(np.float32), threshold, mask)
    labels, boxes, blobs = _components(mask)
    found = []
    peak = max(settings.peak_saturation, threshold)
    for blob in _compact(image, labels, boxes, gains, peak, settings):
        if (measured := _weigh(image, labels, boxes[blob], blob, gains)) is not None:
            found.append((blob, *measured))
    chosen = np.array([item[0] for item in found], dtype=int)
    covariances = np.zeros((len(found), 2, 2))
    covariances[:, [0, 1], [0, 1]] = np.reshape([item[3] for item in found], (-1, 2))
    return Blobs(
        np.reshape([item[2] for item in found], (-1, 2)),
        np.array([item[1] for item in found]),
        blobs.extents[chosen],
        blobs.border_cut[chosen],
        covariances,
    )


def segment_fiducials(image: ImageArray, settings: SegmentationSettings) -> Blobs:
    """Find ArUco markers; their ids are the identities of the targets.

    The detector finds whole markers only, so none is cut by the border. The centre is where the
    diagonals intersect, which perspective does not shift.
    """
    grey = cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY)
    found, ids, _ = _detector(settings.dictionary).detectMarkers(grey)
    corners = np.array(found, dtype=float).reshape(-1, 4, 2)
    count = len(corners)
    names = [] if ids is None else [f'{settings.dictionary}:{number}' for number in ids.ravel()]
    following = np.roll(corners, -1, axis=1)
    products = corners[..., 0] * following[..., 1] - corners[..., 1] * following[..., 0]
    one, two = corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1]
    gap = corners[:, 1] - corners[:, 0]
    share = (gap[:, 0] * two[:, 1] - gap[:, 1] * two[:, 0]) / (
        one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0]
    )
    return Blobs(
        corners[:, 0] + share[:, None] * one,
        0.5 * np.abs(products.sum(axis=1)),
        np.ptp(corners, axis=1) if count else np.zeros((0, 2)),
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


RULES: dict[str, Callable[[ImageArray, SegmentationSettings], Blobs]] = {
    'paper': segment_paper,
    'robust': segment_robust,
    'aruco': segment_fiducials,
}


def segment(image: ImageArray, settings: SegmentationSettings) -> Blobs:
    """Find marker blobs in an image (h, w, 3), uint8, by the rule that the settings name."""
    return RULES[settings.rule](image, settings)
