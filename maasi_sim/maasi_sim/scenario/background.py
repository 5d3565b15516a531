"""The background picture of a map: a GeoTIFF, or an image with a world file or an extent.

Without a picture, terrain is drawn with hill shading.
"""

import base64
import warnings
from collections.abc import Callable, Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from maasi_filter.arrays import FloatArray
from maasi_filter.geometry.environment import EnvironmentSettings
from maasi_filter.geometry.geodesy import geodetic
from maasi_filter.geometry.raster import cells_of
from maasi_filter.geometry.terrain_file import read_terrain
from maasi_sim.scenario.hill_shading import hill_shading

# Longest side of the shown picture [px], its quality, and the margin around the bounds.
_SIZE, _QUALITY, _MARGIN = 1100, 70, 0.06
# Most pixels of an image (400 MB while reading), and longest side of a GeoTIFF as read.
_MOST_PIXELS, _LARGEST = 100_000_000, 4000
_LATTICE = 33  # points per axis with exact coordinates
_NO_ORIGIN = 'needs environment.origin'
_NEEDS = (
    'allowed are a GeoTIFF, an image with a world file (.pgw, .jgw, .wld), or '
    'background: {file: FILE, extent: [[west, east], [south, north]]} [m, map]'
)


class Background(NamedTuple):
    """A picture over a part of the map: WebP in base64, and its bounds on x and y [m, map]."""

    data: str
    bounds: list[list[float]]


class _Picture(NamedTuple):
    """Pixels (rows, columns, 4), red to opacity, and a function from position [m] to pixel."""

    pixels: Any
    cells: Callable[[FloatArray], FloatArray]


@lru_cache(maxsize=4)
def read_background(environment_json: str) -> Background | None:
    """Return the picture of an environment, given as JSON, or that of its terrain, or None.

    Raises ValueError if it is unreadable or outside of the environment.
    """
    environment = EnvironmentSettings.model_validate_json(environment_json)
    given = environment.background
    if given.file is None and environment.terrain.file is None:
        return None
    if given.file is None:
        return _over(environment.array(), _of_terrain(environment))
    key = f'environment.background: {given.file}'
    try:
        geotiff = Path(given.file).suffix.lower() in ('.tif', '.tiff') and not given.extent
        picture = (_of_geotiff if geotiff else _of_image)(given.file, environment)
        return _over(environment.array(), picture)
    except (OSError, ValueError, TypeError) as error:
        raise ValueError(f'{key}: {error}') from None


def background_of(environment: EnvironmentSettings) -> Background | None:
    """Return the picture of an environment, as `read_background`."""
    if environment.background.file is None and environment.terrain.file is None:
        return None
    return read_background(environment.model_dump_json(exclude_none=True))


def background_problems(environment: EnvironmentSettings) -> Iterator[str]:
    """Yield the problems of an environment's picture."""
    try:
        background_of(environment)
    except ValueError as error:
        yield str(error)


def _of_terrain(environment: EnvironmentSettings) -> _Picture:
    low, high = _shown(environment.array())
    pixels = hill_shading(read_terrain(environment)[0], low, high)
    size = (high - low) / (pixels.shape[1], -pixels.shape[0])
    return _Picture(pixels, lambda positions: (positions - (low[0], high[1])) / size)


def _shown(bounds: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the shown bounds on x and y, with a margin [m]."""
    low, high = bounds[:2].T
    margin = _MARGIN * float((high - low).max())
    return low - margin, high + margin


def _over(bounds: FloatArray, picture: _Picture) -> Background:
    low, high = _shown(bounds)
    scale = _SIZE / float((high - low).max())
    width, height = np.maximum(np.rint(scale * (high - low)), 2).astype(int).tolist()
    x = low[0] + (np.linspace(0.0, 1.0, _LATTICE)) * (high[0] - low[0])
    y = high[1] - (np.linspace(0.0, 1.0, _LATTICE)) * (high[1] - low[1])
    lattice = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    # Coordinates of pixel corners; linear between the lattice points.
    coarse = picture.cells(lattice).reshape(_LATTICE, _LATTICE, 2)
    across, down = (_between((np.arange(number) + 0.5) / number) for number in (width, height))
    exact = np.stack([down @ coarse[:, :, k] @ across.T for k in range(2)], axis=-1) - 0.5
    rows, columns = picture.pixels.shape[:2]
    inside = (exact > -0.5) & (exact < (columns - 0.5, rows - 0.5))
    if not inside.all(axis=-1).any():
        centre = picture.cells(bounds[:2].mean(axis=1)[None])[0]
        raise ValueError(
            f'does not overlap the area, whose centre is at column {centre[0]:.0f} and row '
            f'{centre[1]:.0f} of {columns} x {rows} pixels; check the coordinate system'
        )
    # Averaged as often as it is reduced, so that all pixels count.
    step = np.abs(np.diff(exact[height // 2, :, :], axis=0)).max(initial=0.0)
    blurred = picture.pixels
    if step > 1.5:
        size = int(step) | 1
        blurred = cv2.blur(blurred, (size, size))
    maps = exact.astype(np.float32)
    shown = cv2.remap(
        blurred, maps[..., 0], maps[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT
    )
    coloured = cv2.cvtColor(shown, cv2.COLOR_RGBA2BGRA)
    data = cv2.imencode('.webp', coloured, [cv2.IMWRITE_WEBP_QUALITY, _QUALITY])[1]
    text = base64.b64encode(data.tobytes()).decode()
    return Background(text, np.stack([low, high], axis=1).round(3).tolist())


def _between(shares: FloatArray) -> FloatArray:
    """Return the weights of the lattice points for shares of an axis, (n, lattice)."""
    points = np.linspace(0.0, 1.0, _LATTICE)
    return np.stack([np.interp(shares, points, row) for row in np.eye(_LATTICE)], axis=1)


def _check_size(rows: int, columns: int) -> None:
    if rows * columns > _MOST_PIXELS:
        raise ValueError(
            f'read {columns} x {rows} pixels, allowed are at most {_MOST_PIXELS} in total; scale '
            'the image down'
        )


def _of_image(path: str, environment: EnvironmentSettings) -> _Picture:
    from PIL import Image

    with warnings.catch_warnings():
        # Sizes are checked here.
        warnings.simplefilter('ignore', Image.DecompressionBombWarning)
        with Image.open(path) as image:
            _check_size(image.height, image.width)
            pixels = np.array(image.convert('RGBA'))
    extent, world = environment.background.extent, _world_file(path)
    rows, columns = pixels.shape[:2]
    if extent is not None:
        (west, east), (south, north) = extent
        size = np.array([(east - west) / columns, (south - north) / rows])
        return _Picture(pixels, lambda positions: (positions - (west, north)) / size)
    if world is None:
        raise ValueError(f'has no coordinates; {_NEEDS}')
    a, d, b, e, c, f = world
    inverse = np.linalg.inv(np.array([[a, b], [d, e]]))

    def cells(positions: FloatArray) -> FloatArray:
        return (_earth(positions, environment) - (c, f)) @ inverse.T + 0.5

    # Degrees have small pixels near the origin; else metres of the map.
    degrees = max(abs(a), abs(b), abs(d), abs(e)) < 0.01 and environment.origin is not None
    if not degrees:
        return _Picture(pixels, lambda positions: (positions - (c, f)) @ inverse.T + 0.5)
    return _Picture(pixels, cells)


def _earth(positions: FloatArray, environment: EnvironmentSettings) -> FloatArray:
    """Return longitudes and latitudes (n, 2) [degrees] of positions (n, 2) [m, map]."""
    if environment.origin is None:
        raise ValueError(_NO_ORIGIN)
    return geodetic(positions, environment.origin)[:, [1, 0]]


def _world_file(path: str) -> list[float] | None:
    image, suffix = Path(path), Path(path).suffix
    names = [f'.{suffix[1]}{suffix[-1]}w', f'{suffix}w', '.wld']
    for name in [*names, *map(str.upper, names)]:
        file = image.with_suffix(name)
        if file.is_file():
            try:
                numbers = [float(word) for word in file.read_text(encoding='utf-8').split()]
            except ValueError:
                numbers = []
            a, d, b, e, *_ = [*numbers, 0.0, 0.0, 0.0, 0.0]
            if len(numbers) != 6 or not np.isfinite(numbers).all() or a * e == b * d:
                raise ValueError(f'{file}: is not a world file with six numbers in six lines')
            return numbers
    return None


def _of_geotiff(path: str, environment: EnvironmentSettings) -> _Picture:
    try:
        import rasterio
        from rasterio.enums import ColorInterp
    except ImportError:
        raise ValueError(
            'a GeoTIFF needs rasterio (extra geo): pip install "rasterio>=1.4"'
        ) from None
    with warnings.catch_warnings():
        warnings.simplefilter('ignore', rasterio.errors.NotGeoreferencedWarning)
        file = rasterio.open(path)
    with file:
        if file.crs is None:
            return _of_image(path, environment)
        if environment.origin is None:
            raise ValueError(_NO_ORIGIN)
        placed = cells_of(file, environment.origin)
        # Subsampled if large.
        size = tuple(-(-number // (1 + max(file.shape) // _LARGEST)) for number in file.shape)
        scale = np.divide(size[::-1], file.shape[::-1])
        chosen = list(range(1, min(file.count, 3) + 1))
        bands = file.read(chosen, out_shape=(len(chosen), *size)).astype(float)
        opaque = file.dataset_mask(out_shape=size)
        if file.colorinterp[0] == ColorInterp.palette:
            table = np.zeros((256, 4))
            for index, colour in file.colormap(1).items():
                table[min(index, 255)] = colour
            bands = np.moveaxis(table[bands[0].astype(int)], -1, 0)[:3]
    if bands.shape[0] < 3:
        bands = np.repeat(bands[:1], 3, axis=0)
    if bands.max(initial=0.0) > 255.0 or bands.min(initial=0.0) < 0.0:
        # More than 8 bits: cut the darkest and brightest pixels.
        low, high = np.percentile(bands[:3][:, opaque > 0] if opaque.any() else bands, (2, 98))
        bands = 255.0 * np.clip((bands - low) / max(high - low, 1e-9), 0.0, 1.0)
    pixels = np.dstack([*bands[:3], opaque]).astype(np.uint8)

    def cells(positions: FloatArray) -> FloatArray:
        return scale * np.stack(placed(*positions.T), axis=1)

    return _Picture(pixels, cells)
