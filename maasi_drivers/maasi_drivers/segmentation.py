"""
Blue markers in an image: the papers' rule, and one that adapts to the light.

Both rules take an RGB image and return `Blobs`; `segment` chooses by name.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from maasi_drivers.camera_settings import SegmentationSettings

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

# About how many pixels the colour of the floor is taken from.
_FLOOR_SAMPLES = 4096
# Added to the mean of the channels before dividing by it: noise in the dark is not blue.
_DARK = 6.0


@dataclass(frozen=True)
class Blobs:
    """
    Connected marker pixels, in the order of their topmost and then leftmost pixel.

    Attributes
    ----------
    centroids : ndarray, shape (n, 2)
        (column, row), pixel centres at whole numbers [px].
    areas : ndarray, shape (n,)
        [px].
    border_cut : ndarray of bool, shape (n,)
        True where the blob touches the image's border, so that its centroid is biased inwards.
    covariances : ndarray, shape (n, 2, 2)
        Of the centroids, as far as image noise explains them; zero where the rule does not tell
        [px^2].

    """

    centroids: Array
    areas: Array
    border_cut: NDArray[np.bool_]
    covariances: Array

    def __len__(self) -> int:
        return len(self.areas)

    def select(self, mask: NDArray[np.bool_]) -> Blobs:
        """Return the blobs where ``mask`` (n,) is true."""
        return Blobs(
            self.centroids[mask], self.areas[mask], self.border_cut[mask], self.covariances[mask]
        )


def check_image(image: NDArray[np.generic]) -> Image:
    """
    Return an image fit for segmentation.

    Raises
    ------
    ValueError
        Unless it is an (h, w, 3) array of bytes with h, w of at least 1.

    """
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or image.size == 0:
        raise ValueError(
            f'image: got an array of shape {image.shape} and type {image.dtype}, '
            'allowed (height, width, 3) of uint8, channels R, G, B'
        )
    return image.view(np.uint8)


@njit(cache=True)
def _paper_mask(image, limit, mask):  # type: ignore[no-untyped-def]
    height, width = mask.shape
    for row in range(height):
        for column in range(width):
            excess = (
                2 * np.int32(image[row, column, 2])
                - np.int32(image[row, column, 0])
                - np.int32(image[row, column, 1])
            )
            mask[row, column] = 1 if excess > limit else 0


def paper_mask(image: Image, threshold: float = 35.0) -> NDArray[np.uint8]:
    """
    Return 1 where B - R/2 - G/2 > threshold, else 0 (001, eq. (16)).

    Computed in whole numbers of half grey levels, so nothing is rounded or clipped.
    """
    mask = np.empty(image.shape[:2], dtype=np.uint8)
    _paper_mask(check_image(image), int(np.floor(2.0 * threshold)), mask)
    return mask


def _border_cut(statistics: NDArray[Any], shape: tuple[int, ...]) -> NDArray[np.bool_]:
    left, top = statistics[:, cv2.CC_STAT_LEFT], statistics[:, cv2.CC_STAT_TOP]
    right = left + statistics[:, cv2.CC_STAT_WIDTH]
    bottom = top + statistics[:, cv2.CC_STAT_HEIGHT]
    return np.asarray((left <= 0) | (top <= 0) | (right >= shape[1]) | (bottom >= shape[0]))


def segment_paper(image: Image, settings: SegmentationSettings) -> Blobs:
    """
    Find blobs of a fixed blue excess, with the plain centroid of their pixels (001, section 6.1).

    Parameters
    ----------
    image : ndarray, shape (h, w, 3), uint8
        R, G, B.
    settings : SegmentationSettings
        ``threshold`` and ``minimum_area`` are used.

    """
    mask = paper_mask(image, settings.threshold)
    _, _, boxes, means = cv2.connectedComponentsWithStats(mask, connectivity=8)
    # The first component is the background.
    statistics, centroids = np.asarray(boxes)[1:], np.asarray(means, dtype=np.float64)[1:]
    areas = statistics[:, cv2.CC_STAT_AREA].astype(np.float64)
    blobs = Blobs(
        centroids, areas, _border_cut(statistics, mask.shape), np.zeros((len(areas), 2, 2))
    )
    return blobs.select(areas >= settings.minimum_area)


@njit(cache=True)
def _histogram_median(histogram):  # type: ignore[no-untyped-def]
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
def _floor_statistics(image, samples):  # type: ignore[no-untyped-def]
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
        # A frame that is mostly a marker or a coloured sheet must not turn into the reference.
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
def _blueness(image, row, column, gain_r, gain_g, gain_b):  # type: ignore[no-untyped-def]
    red = gain_r * image[row, column, 0]
    green = gain_g * image[row, column, 1]
    blue = gain_b * image[row, column, 2]
    return 3.0 * (blue - max(red, green)) / (red + green + blue + 3.0 * _DARK)


@njit(cache=True)
def _robust_mask(image, gains, threshold, mask):  # type: ignore[no-untyped-def]
    """Set mask to 1 where the blueness exceeds the threshold (no division per pixel)."""
    height, width = mask.shape
    red_gain, green_gain, blue_gain = (
        np.float32(gains[0]),
        np.float32(gains[1]),
        np.float32(gains[2]),
    )
    slope = np.float32(threshold / 3.0)
    offset = np.float32(threshold * _DARK)
    for row in range(height):
        for column in range(width):
            red = red_gain * np.float32(image[row, column, 0])
            green = green_gain * np.float32(image[row, column, 1])
            blue = blue_gain * np.float32(image[row, column, 2])
            largest = red if red > green else green
            excess = blue - largest - offset
            mask[row, column] = 1 if excess > slope * (red + green + blue) else 0


@njit(cache=True)
def _excess(image, row, column, gains):  # type: ignore[no-untyped-def]
    """Blue excess O_p of the white-balanced image: linear in how much of a pixel is marker."""
    return gains[2] * image[row, column, 2] - 0.5 * (
        gains[0] * image[row, column, 0] + gains[1] * image[row, column, 1]
    )


@njit(cache=True)
def _blob_statistics(image, labels, boxes, gains, result, centroids, variances):  # type: ignore[no-untyped-def]
    """
    Measure each blob.

    result (n, 4): peak blueness, aspect, solidity, area with part pixels counted in part.
    centroids (n, 2): weighted by the part of each pixel that is marker. variances (n, 2): of the
    centroids, from the noise of the surroundings.
    """
    height, width = labels.shape
    largest = 0
    for blob in range(boxes.shape[0]):
        largest = max(largest, boxes[blob, 2] * boxes[blob, 3])
    values = np.empty(largest, dtype=np.float64)
    for blob in range(boxes.shape[0]):
        label = blob + 1
        left, top = boxes[blob, 0], boxes[blob, 1]
        right, bottom = left + boxes[blob, 2], top + boxes[blob, 3]
        # Moments of the mask, for the shape, and the peak.
        count = 0
        sx = sy = sxx = syy = sxy = 0.0
        peak = 0.0
        inside = 0
        for row in range(top, bottom):
            for column in range(left, right):
                if labels[row, column] == label:
                    x, y = float(column - left), float(row - top)
                    count += 1
                    sx += x
                    sy += y
                    sxx += x * x
                    syy += y * y
                    sxy += x * y
                    peak = max(peak, _blueness(image, row, column, gains[0], gains[1], gains[2]))
                    values[inside] = _excess(image, row, column, gains)
                    inside += 1
        mx, my = sx / count, sy / count
        # A pixel is a square: it has a second moment of 1/12 of its own.
        vxx = sxx / count - mx * mx + 1.0 / 12.0
        vyy = syy / count - my * my + 1.0 / 12.0
        vxy = sxy / count - mx * my
        middle = 0.5 * (vxx + vyy)
        radius = np.sqrt(0.25 * (vxx - vyy) ** 2 + vxy * vxy)
        small = max(middle - radius, 1e-9)
        result[blob, 0] = peak
        result[blob, 1] = np.sqrt((middle + radius) / small)
        result[blob, 2] = count / (4.0 * np.pi * np.sqrt((middle + radius) * small))
        # The excess of a pixel that is all marker: the mean of the upper half inside the blob.
        inside_values = np.sort(values[:inside])
        upper = inside_values[inside // 2 :].mean()
        # The floor around, from the frame of the box widened by three pixels, blobs left out.
        around = 0
        square = 0.0
        total = 0.0
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
        contrast = max(upper - background, 1e-6)
        # Weights in the blob and the ring of one pixel around it: what belongs to no other blob.
        weight_sum = wx = wy = 0.0
        members = 0
        wxx = wyy = 0.0
        for row in range(max(top - 1, 0), min(bottom + 1, height)):
            for column in range(max(left - 1, 0), min(right + 1, width)):
                near = False
                other = False
                for r in range(max(row - 1, 0), min(row + 2, height)):
                    for c in range(max(column - 1, 0), min(column + 2, width)):
                        if labels[r, c] == label:
                            near = True
                if labels[row, column] != 0 and labels[row, column] != label:
                    other = True
                if near and not other:
                    weight = (_excess(image, row, column, gains) - background) / contrast
                    x, y = float(column - left), float(row - top)
                    weight_sum += weight
                    wx += weight * x
                    wy += weight * y
                    members += 1
                    wxx += (x - mx) * (x - mx)
                    wyy += (y - my) * (y - my)
        if weight_sum > 0.25 * count:
            centroids[blob, 0] = left + wx / weight_sum
            centroids[blob, 1] = top + wy / weight_sum
            scale = max(noise, 0.0) / (contrast * weight_sum) ** 2
            variances[blob, 0] = scale * wxx
            variances[blob, 1] = scale * wyy
            result[blob, 3] = weight_sum
        else:
            centroids[blob, 0] = left + mx
            centroids[blob, 1] = top + my
            variances[blob, 0] = variances[blob, 1] = 0.25
            result[blob, 3] = count


def segment_robust(image: Image, settings: SegmentationSettings) -> Blobs:
    """
    Find compact blobs that are bluer than the floor, whatever the light.

    White balance from the median of the image (the floor); blueness (B - max(R, G)) over the mean
    of the channels, which neither gradients nor exposure change, and which tells purple and pale
    blue from blue; a threshold on it, raised where the floor is noisy (median absolute deviation);
    gates on the blueness at the peak, on aspect and solidity; centroids weighted by how much of
    each pixel is marker. Sizes are gated where the geometry is known, in
    `maasi_drivers.marker_detector`.

    Parameters
    ----------
    image : ndarray, shape (h, w, 3), uint8
        R, G, B.
    settings : SegmentationSettings
        All but ``threshold`` and ``minimum_area`` are used.

    """
    image = check_image(image)
    gains, centre, deviation = _floor_statistics(image, _FLOOR_SAMPLES)
    threshold = max(settings.saturation, centre + settings.noise_factor * deviation)
    mask = np.empty(image.shape[:2], dtype=np.uint8)
    _robust_mask(image, gains, threshold, mask)
    _, labels, statistics, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
    boxes = np.asarray(statistics)[1:]
    measured = np.zeros((len(boxes), 4))
    centroids = np.zeros((len(boxes), 2))
    variances = np.zeros((len(boxes), 2))
    _blob_statistics(image, labels, boxes, gains, measured, centroids, variances)
    cut = _border_cut(boxes, mask.shape)
    keep = measured[:, 0] >= max(settings.peak_saturation, threshold)
    # What the border cuts has any aspect.
    keep &= cut | (measured[:, 1] <= settings.maximum_aspect)
    keep &= measured[:, 2] >= settings.minimum_solidity
    covariances = np.zeros((len(boxes), 2, 2))
    covariances[:, 0, 0], covariances[:, 1, 1] = variances[:, 0], variances[:, 1]
    return Blobs(centroids, measured[:, 3].copy(), cut, covariances).select(keep)


RULES: dict[str, Callable[[Image, SegmentationSettings], Blobs]] = {
    'paper': segment_paper,
    'robust': segment_robust,
}


def segment(image: Image, settings: SegmentationSettings) -> Blobs:
    """
    Find marker blobs by the rule that the settings name.

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
