"""Reads Nav2 maps (YAML with an image) as polygons, and grey values of images."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import shapely
import shapely.affinity
from shapely.geometry.base import BaseGeometry

from maasi_filter.arrays import BoolArray, FloatArray
from maasi_filter.wording import shown

_MOST_PIXELS = 25_000_000  # of maps and rasters, as 5000 x 5000: 200 MB as numbers
_MODES = ('trinary', 'scale', 'raw')
CHANNELS = ('grey', 'red', 'green', 'blue', 'alpha')


def check_pixels(shape: Sequence[int]) -> None:
    """Raise ValueError if a raster has too many cells."""
    if math.prod(shape) > _MOST_PIXELS:
        raise ValueError(
            f'got {" x ".join(map(str, shape))} cells, allowed are at most {_MOST_PIXELS} in all: '
            'scale it down'
        )


def read_channels(path: str) -> FloatArray:
    """Return red, green, blue and alpha of an image, 0 to 255 (rows, columns, 4).

    Values of 16 bits are scaled; an image without alpha is opaque.
    """
    # Deferred: only maps and priors that are images need it.
    from PIL import Image, UnidentifiedImageError

    try:
        with warnings.catch_warnings():
            warnings.simplefilter('ignore', Image.DecompressionBombWarning)
            with Image.open(path) as image:
                check_pixels((image.height, image.width))
                if not image.height or not image.width:
                    raise ValueError('is empty')
                if image.mode == 'F':
                    raise ValueError('has values that are not integers: save it as .npy')
                if image.mode.startswith('I'):
                    grey = np.asarray(image, dtype=float) / 257.0
                    if grey.max() > 255.0 or grey.min() < 0.0:
                        raise ValueError('has values beyond 16 bits: save it as .npy')
                    return np.dstack([grey, grey, grey, np.full(grey.shape, 255.0)])
                return np.asarray(image.convert('RGBA'), dtype=float)
    except Image.DecompressionBombError:
        raise ValueError(f'is larger than {_MOST_PIXELS} pixels: scale it down') from None
    except UnidentifiedImageError:
        raise ValueError('is not an image') from None
    except OSError as error:
        raise ValueError(error.strerror or 'is not a complete image') from None


def read_image(path: str, band: str | None = None) -> FloatArray:
    """Return the grey values of an image, 0 to 255 (rows, columns), or one of its `CHANNELS`.

    ValueError if no channel is named and the image is not grey and opaque.
    """
    channels = read_channels(path)
    if band is not None:
        if band not in CHANNELS:
            raise ValueError(f'band: read {band}, allowed are {", ".join(CHANNELS)}')
        if band == 'grey':
            return np.asarray(channels[:, :, :3].mean(axis=2))
        return np.asarray(channels[:, :, CHANNELS.index(band) - 1])
    wrong = ''
    if (channels[:, :, 3] != 255.0).any():
        wrong = 'has transparent pixels'
    elif (channels[:, :, 1:3] != channels[:, :, :1]).any():
        wrong = 'has colours'
    if wrong:
        raise ValueError(f'{wrong}: set band to one of {", ".join(CHANNELS)}')
    return np.asarray(channels[:, :, 0])


def read_map(path: str) -> BaseGeometry:
    """Return the occupied cells of a Nav2 map as polygons [m, map], as its map server reads them.

    Unknown cells are free; ValueError names a wrong key.
    """
    import yaml

    try:
        facts = yaml.safe_load(Path(path).read_text(encoding='utf-8-sig'))
    except OSError as error:
        raise ValueError(f'{path}: is not a Nav2 map: {error.strerror}') from None
    except (ValueError, yaml.YAMLError):
        raise ValueError(f'{path}: is not a Nav2 map: not YAML') from None
    if not isinstance(facts, Mapping):
        raise ValueError(f'{path}: is not a Nav2 map: allowed are keys with values')
    try:
        cell = _number(facts, 'resolution')
        if cell <= 0.0:
            raise ValueError(f'resolution: read {cell:g}, allowed are numbers above 0')
        origin = facts.get('origin')
        if not isinstance(origin, list) or len(origin) != 3:
            raise ValueError(f'origin: read {shown(origin)}, allowed is [x, y, yaw]')
        west, south, yaw = (_number({'origin': value}, 'origin') for value in origin)
        occupied = _occupied(facts, Path(path).parent)
    except ValueError as error:
        raise ValueError(f'{path}: is not a Nav2 map: {error}') from None
    if not occupied.any():
        raise ValueError(f'{path}: no cell of the map is occupied')
    cells = _boxes(occupied, cell, west, south)
    return shapely.affinity.rotate(cells, yaw, (west, south), use_radians=True) if yaw else cells


def _number(facts: Mapping[str, Any], key: str) -> float:
    if key not in facts:
        raise ValueError(f'{key}: is missing')
    try:
        number = float(facts[key])
    except (TypeError, ValueError):
        number = math.nan
    if not math.isfinite(number):
        raise ValueError(f'{key}: read {shown(facts[key])}, allowed is a number')
    return number


def _occupied(facts: Mapping[str, Any], folder: Path) -> BoolArray:
    """Return which cells are occupied, (rows, columns), first row in the north."""
    mode, image = facts.get('mode', 'trinary'), facts.get('image')
    if mode not in _MODES:
        raise ValueError(f'mode: read {shown(mode)}, allowed are {", ".join(_MODES)}')
    if not isinstance(image, str) or not image:
        raise ValueError(f'image: read {shown(image)}, allowed is the name of a file')
    threshold = _number(facts, 'occupied_thresh')
    if not 0.0 <= threshold <= 1.0:
        raise ValueError(f'occupied_thresh: read {threshold:g}, allowed are numbers from 0 to 1')
    try:
        channels = read_channels(str(folder / image)) / 255.0
    except ValueError as error:
        raise ValueError(f'{folder / image}: {error}') from None
    shade = channels[:, :, :3].mean(axis=2)
    if mode == 'raw':
        value = np.round(255.0 * shade)
        return np.asarray((value <= 100.0) & (value > 100.0 * threshold))
    opaque = channels[:, :, 3] == 1.0
    if mode == 'trinary' and not opaque.all():
        # The map server counts alpha as a fourth colour.
        shade = channels.mean(axis=2)
        opaque[:] = True
    dark = shade if _number({'negate': 0, **facts}, 'negate') else 1.0 - shade
    return np.asarray((dark > threshold) & opaque)


def _boxes(occupied: BoolArray, cell: float, west: float, south: float) -> BaseGeometry:
    """Return the union of cells, with one box per run in a row, which is fast."""
    ends = np.diff(np.pad(occupied, ((0, 0), (1, 1))).astype(np.int8), axis=1)
    row, first = np.nonzero(ends == 1)
    last = np.nonzero(ends == -1)[1]
    # Shared edges have the same numbers, so that touching cells merge.
    x = west + cell * np.arange(occupied.shape[1] + 1)
    y = south + cell * np.arange(len(occupied), -1, -1)
    boxes = shapely.box(x[first], y[row + 1], x[last], y[row])
    return shapely.simplify(shapely.union_all(boxes), 0.0)
