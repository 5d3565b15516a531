"""Markers in an image: the papers' rule, one that adapts to the light, and fiducial markers.

All rules take an RGB image and return `Blobs`; `segment` chooses by name.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from maasi_drivers.settings.camera import SegmentationSettings
from maasi_drivers.vision.detector import Blobs
from maasi_filter.arrays import BoolArray, FloatArray, ImageArray, IntArray

# About how many pixels the colour of the floor is taken from.
_FLOOR_SAMPLES = 4096
# Added to the mean of the channels before dividing by it: noise in the dark is not blue.
_DARK = 6.0


def check_image(image: NDArray[np.generic]) -> ImageArray:
    """Return an image fit for segmentation."""
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or image.size == 0:
        raise ValueError(
            f'image: got an array of shape {image.shape} and type {image.dtype}, '
            'allowed (height, width, 3) of uint8, channels R, G, B'
        )
    # One memory layout: kernels are compiled for the layouts that they meet.
    return np.ascontiguousarray(image, dtype=np.uint8)


@njit(cache=True)
def _paper_mask(red, green, blue, limit, mask):
    for row in range(mask.shape[0]):
        for column in range(mask.shape[1]):
            excess = (
                np.int16(2) * np.int16(blue[row, column])
                - np.int16(red[row, column])
                - np.int16(green[row, column])
            )
            mask[row, column] = np.uint8(excess > limit)


def paper_mask(image: ImageArray, threshold: float = 35.0) -> ImageArray:
    """Return 1 where B - R/2 - G/2 > threshold, else 0 (001, eq. (16)).

    Computed in whole numbers of half grey levels, so nothing is rounded or clipped.
    """
    red, green, blue = _planes(check_image(image))
    mask = np.empty(image.shape[:2], dtype=np.uint8)
    _paper_mask(red, green, blue, np.int16(np.floor(2.0 * threshold)), mask)
    return mask


def _planes(image: ImageArray) -> list[ImageArray]:
    # Masks are computed plane by plane, which compilers vectorise.
    return [np.asarray(plane, dtype=np.uint8) for plane in cv2.split(image)]


class _Components(NamedTuple):
    """The 8-connected components of a mask (h, w), in the order of rows.

    Attributes
    ----------
    labels : ndarray, shape (h, w)
        Component plus one; 0: background.
    boxes : ndarray, shape (n, 4)
        Left, top, width, height.
    areas : ndarray, shape (n,)
        Pixels.
    centroids : ndarray, shape (n, 2)
        Means of columns and rows.
    """

    labels: NDArray[np.int32]
    boxes: IntArray
    areas: IntArray
    centroids: FloatArray


def _components(mask: ImageArray) -> _Components:
    # Labelled pixel by pixel: other algorithms number them in the order of blocks of pixels.
    _, labels, stats, centroids = cv2.connectedComponentsWithStatsWithAlgorithm(
        mask, 8, cv2.CV_32S, cv2.CCL_SAUF
    )
    numbers = stats[1:].astype(np.int64)
    boxes = np.ascontiguousarray(numbers[:, :4])
    return _Components(
        np.asarray(labels, np.int32),
        boxes,
        numbers[:, 4].copy(),
        np.asarray(centroids[1:], np.float64),
    )


def _border_cut(boxes: IntArray, shape: tuple[int, ...]) -> BoolArray:
    low, high = boxes[:, :2], boxes[:, :2] + boxes[:, 2:]
    return np.asarray(((low <= 0) | (high >= np.array([shape[1], shape[0]]))).any(axis=1))


def segment_paper(image: ImageArray, settings: SegmentationSettings) -> Blobs:
    """
    Find blobs of a fixed blue excess, with the plain centroid of their pixels (001, section 6.1).

    Shapes and units: image (h, w, 3).
    """
    mask = paper_mask(image, settings.threshold)
    _, boxes, areas, centroids = _components(mask)
    blobs = Blobs(
        centroids,
        areas.astype(np.float64),
        boxes[:, 2:].astype(np.float64),
        _border_cut(boxes, mask.shape),
        np.zeros((len(areas), 2, 2)),
    )
    return blobs.select(areas >= settings.minimum_area * mask.size)


@njit(cache=True)
def _histogram_median(histogram):
    """Median of counted values, interpolated within its bin; bins are centred on whole numbers."""
    half = 0.5 * histogram.sum()
    below = 0.0
    for value in range(histogram.shape[0]):
        count = histogram[value]
        if count > 0 and below + count >= half:
            return value - 0.5 + (half - below) / count
        below += count
    return float(histogram.shape[0] - 1)


@njit(cache=True)
def _floor_statistics(image, samples):
    """White-balance gains (3,) from the floor; median and deviation of its blueness."""
    height, width = image.shape[0], image.shape[1]
    stride = max(1, int(np.sqrt(height * width / samples)))
    histograms = np.zeros((3, 256), dtype=np.int64)
    for row in range(stride // 2, height, stride):
        for column in range(stride // 2, width, stride):
            for channel in range(3):
                histograms[channel, image[row, column, channel]] += 1
    medians = np.empty(3)
    for channel in range(3):
        medians[channel] = max(_histogram_median(histograms[channel]), 1.0)
    mean = (medians[0] + medians[1] + medians[2]) / 3.0
    gains = np.empty(3)
    for channel in range(3):
        # Bounded, as an image of mostly marker or coloured sheet is no reference.
        gains[channel] = min(max(mean / medians[channel], 0.6), 1.7)
    # Blueness is between -3 and 3: bins of 1/256.
    blueness = np.zeros(1536, dtype=np.int64)
    for row in range(stride // 2, height, stride):
        for column in range(stride // 2, width, stride):
            value = _blueness(image, row, column, gains[0], gains[1], gains[2])
            blueness[min(max(int(np.floor(value * 256.0)) + 768, 0), 1535)] += 1
    centre = (_histogram_median(blueness) + 0.5 - 768.0) / 256.0
    deviations = np.zeros(1536, dtype=np.int64)
    for index in range(1536):
        if blueness[index] > 0:
            offset = abs((index + 0.5 - 768.0) / 256.0 - centre)
            deviations[min(int(np.floor(offset * 256.0)), 1535)] += blueness[index]
    deviation = 1.4826 * (_histogram_median(deviations) + 0.5) / 256.0
    return gains, centre, deviation


@njit(cache=True)
def _blueness(image, row, column, gain_r, gain_g, gain_b):
    red = gain_r * image[row, column, 0]
    green = gain_g * image[row, column, 1]
    blue = gain_b * image[row, column, 2]
    return 3.0 * (blue - max(red, green)) / (red + green + blue + 3.0 * _DARK)


@njit(cache=True)
def _robust_mask(red, green, blue, gains, threshold, mask):
    """Set mask to 1 where the blueness exceeds the threshold (no division per pixel)."""
    red_gain, green_gain, blue_gain = (
        np.float32(gains[0]),
        np.float32(gains[1]),
        np.float32(gains[2]),
    )
    slope = np.float32(threshold / 3.0)
    offset = np.float32(threshold * _DARK)
    for row in range(mask.shape[0]):
        for column in range(mask.shape[1]):
            r = red_gain * np.float32(red[row, column])
            g = green_gain * np.float32(green[row, column])
            b = blue_gain * np.float32(blue[row, column])
            excess = b - max(r, g) - offset
            mask[row, column] = np.uint8(excess > slope * (r + g + b))


@njit(cache=True)
def _excess(image, row, column, gains):
    """Blue excess O_p of the white-balanced image: linear in how much of a pixel is marker."""
    return gains[2] * image[row, column, 2] - 0.5 * (
        gains[0] * image[row, column, 0] + gains[1] * image[row, column, 1]
    )


@njit(cache=True)
def _shape_of(image, components, blob, gains, values):
    """Fill `values` with the excess of each pixel; return mean, axes and peak blueness of the mask.

    The lengths of the axes go as the roots of `long` and `short`, the principal second moments.
    """
    left, top, width, height = components.boxes[blob]
    count = components.areas[blob]
    sx = sy = sxx = syy = sxy = 0.0
    peak = 0.0
    reached = 0
    for row in range(top, top + height):
        for column in range(left, left + width):
            if components.labels[row, column] != blob + 1:
                continue
            x, y = float(column - left), float(row - top)
            sx += x
            sy += y
            sxx += x * x
            syy += y * y
            sxy += x * y
            peak = max(peak, _blueness(image, row, column, gains[0], gains[1], gains[2]))
            values[reached] = _excess(image, row, column, gains)
            reached += 1
    mx, my = sx / count, sy / count
    # Each pixel is a square with a second moment of 1/12.
    vxx = sxx / count - mx * mx + 1.0 / 12.0
    vyy = syy / count - my * my + 1.0 / 12.0
    vxy = sxy / count - mx * my
    middle = 0.5 * (vxx + vyy)
    apart = np.sqrt(0.25 * (vxx - vyy) ** 2 + vxy * vxy)
    return mx, my, middle + apart, max(middle - apart, 1e-9), peak


@njit(cache=True)
def _surroundings(image, components, blob, gains):
    """Mean excess and noise of the floor: the box's frame, three pixels wide, without blobs."""
    labels = components.labels
    height, width = labels.shape
    left, top = components.boxes[blob, 0], components.boxes[blob, 1]
    right, bottom = left + components.boxes[blob, 2], top + components.boxes[blob, 3]
    around = 0
    square = total = 0.0
    for row in range(max(top - 3, 0), min(bottom + 3, height)):
        for column in range(max(left - 3, 0), min(right + 3, width)):
            frame = row < top - 1 or row > bottom or column < left - 1 or column > right
            if frame and labels[row, column] == 0:
                value = _excess(image, row, column, gains)
                around += 1
                total += value
                square += value * value
    background = total / around if around > 0 else 0.0
    noise = square / around - background * background if around > 1 else 0.0
    return background, noise


@njit(cache=True)
def _weigh(image, components, blob, gains, background, contrast, mean):
    """Return sums over the blob and the ring of one pixel around it, other blobs left out.

    Returns the sum of the weights, their moments about the box's corner, and the pixels' second
    moments about `mean`.
    """
    labels = components.labels
    height, width = labels.shape
    left, top = components.boxes[blob, 0], components.boxes[blob, 1]
    right, bottom = left + components.boxes[blob, 2], top + components.boxes[blob, 3]
    mx, my = mean
    weight_sum = wx = wy = 0.0
    spread_x = spread_y = 0.0
    for row in range(max(top - 1, 0), min(bottom + 1, height)):
        for column in range(max(left - 1, 0), min(right + 1, width)):
            near = labels[row, column] == blob + 1
            if labels[row, column] == 0:
                for r in range(max(row - 1, 0), min(row + 2, height)):
                    for c in range(max(column - 1, 0), min(column + 2, width)):
                        near |= labels[r, c] == blob + 1
            if near:
                weight = (_excess(image, row, column, gains) - background) / contrast
                x, y = float(column - left), float(row - top)
                weight_sum += weight
                wx += weight * x
                wy += weight * y
                spread_x += (x - mx) * (x - mx)
                spread_y += (y - my) * (y - my)
    return weight_sum, wx, wy, spread_x, spread_y


class _Measures(NamedTuple):
    """Of each blob.

    Attributes
    ----------
    keep : ndarray of bool, shape (n,)
        Whether it is within the gates.
    centroids, areas : ndarray, shapes (n, 2) and (n,)
        Weighted by the part of each pixel that is marker.
    variances : ndarray, shape (n, 2)
        Of the centroids, from the noise of the surroundings.
    """

    keep: BoolArray
    centroids: FloatArray
    areas: FloatArray
    variances: FloatArray


@njit(cache=True)
def _measure_blobs(image, components, gains, gates, measures):
    """Measure each blob; keep those within the gates: least peak blueness, aspect, solidity."""
    boxes = components.boxes
    for blob in range(boxes.shape[0]):
        count = components.areas[blob]
        measures.keep[blob] = False
        values = np.empty(count)
        mx, my, long, short, peak = _shape_of(image, components, blob, gains, values)
        # An ellipse has area 4 pi root(long short).
        if peak < gates[0] or long > gates[1] * gates[1] * short:
            continue
        if count < gates[2] * 4.0 * np.pi * np.sqrt(long * short):
            continue
        # The excess of a pixel inside a marker: the mean of the upper half of the blob.
        upper = np.sort(values)[count // 2 :].mean()
        background, noise = _surroundings(image, components, blob, gains)
        contrast = max(upper - background, 1e-6)
        weight_sum, wx, wy, spread_x, spread_y = _weigh(
            image, components, blob, gains, background, contrast, (mx, my)
        )
        if weight_sum < 0.25 * count:
            continue
        measures.keep[blob] = True
        measures.areas[blob] = weight_sum
        measures.centroids[blob, 0] = boxes[blob, 0] + wx / weight_sum
        measures.centroids[blob, 1] = boxes[blob, 1] + wy / weight_sum
        scale = max(noise, 0.0) / (contrast * weight_sum) ** 2
        measures.variances[blob, 0] = scale * spread_x
        measures.variances[blob, 1] = scale * spread_y


def segment_robust(image: ImageArray, settings: SegmentationSettings) -> Blobs:
    """Find compact blobs that are bluer than the floor, in any light.

    White balance from the median of the image (the floor); blueness (B - max(R, G)) over the mean
    of the channels, which neither gradients nor exposure change, and which tells purple and pale
    blue from blue; a threshold on it, raised where the floor is noisy (median absolute deviation);
    gates on the blueness at the peak, on aspect and solidity; centroids weighted by how much of
    each pixel is marker. Sizes are gated where the geometry is known, in
    `maasi_drivers.vision.marker_detector`.

    Shapes and units: image (h, w, 3).
    """
    image = check_image(image)
    gains, centre, deviation = _floor_statistics(image, _FLOOR_SAMPLES)
    threshold = max(settings.saturation, centre + settings.noise_factor * deviation)
    mask = np.empty(image.shape[:2], dtype=np.uint8)
    red, green, blue = _planes(image)
    _robust_mask(red, green, blue, gains, threshold, mask)
    components = _components(mask)
    count = len(components.boxes)
    measures = _Measures(
        np.zeros(count, dtype=np.bool_), np.zeros((count, 2)), np.zeros(count), np.zeros((count, 2))
    )
    gates = np.array(
        [
            max(settings.peak_saturation, threshold),
            settings.maximum_aspect,
            settings.minimum_solidity,
        ]
    )
    _measure_blobs(image, components, gains, gates, measures)
    covariances = np.zeros((count, 2, 2))
    covariances[:, [0, 1], [0, 1]] = measures.variances
    blobs = Blobs(
        measures.centroids,
        measures.areas,
        components.boxes[:, 2:].astype(np.float64),
        _border_cut(components.boxes, mask.shape),
        covariances,
    )
    return blobs.select(measures.keep)


def segment_fiducials(image: ImageArray, settings: SegmentationSettings) -> Blobs:
    """Find ArUco markers; their ids are the identities of the targets.

    The detector finds whole markers only, so none is cut by the border. The centre is where the
    diagonals intersect, which perspective does not shift.

    Shapes and units: image (h, w, 3).
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


def _intersections(corners: FloatArray) -> FloatArray:
    """Return where the diagonals of quadrilaterals (n, 4, 2) intersect, (n, 2)."""
    one, two = corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1]
    gap = corners[:, 1] - corners[:, 0]
    share = (gap[:, 0] * two[:, 1] - gap[:, 1] * two[:, 0]) / (
        one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0]
    )
    centres: FloatArray = corners[:, 0] + share[:, None] * one
    return centres


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
    """Find marker blobs by the rule that the settings name.

    Parameters
    ----------
    image : ndarray, shape (h, w, 3), uint8
        R, G, B.
    settings : SegmentationSettings
        Rule and its numbers.

    Raises
    ------
    ValueError
        If the image has another shape or type.
    """
    return RULES[settings.rule](image, settings)
