"""The raster of a prior: an array, an image, or a GeoTIFF in its own coordinates."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from maasi_filter.arrays import FloatArray
from maasi_filter.geometry.environment import EnvironmentSettings
from maasi_filter.geometry.geodesy import OriginSettings, geodetic, to_map
from maasi_filter.geometry.occupancy_map import check_pixels, read_image

_CORNERS = (0, 0), (1, 0), (1, 1), (0, 1)


Cells = Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]


@dataclass(frozen=True)
class Raster:
    """Densities (rows, columns), and the map from x, y [m, map] to columns and rows.

    corners (4, 2): position of the raster by its own file [m, map].
    """

    values: FloatArray
    cells: Cells
    corners: FloatArray | None = None

    def at(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the values at positions [m, map], 0 outside."""
        rows, columns = self.values.shape
        column, row = self.cells(x, y)
        known = (column >= 0.0) & (column < columns) & (row >= 0.0) & (row < rows)
        found = np.zeros(x.shape)
        found[known] = self.values[row[known].astype(int), column[known].astype(int)]
        return found


def read_raster(environment: EnvironmentSettings) -> Raster:
    """Return the raster of an environment's prior; ValueError if it is invalid."""
    path = str(environment.prior.raster)
    key = f'environment.prior.raster: {path}'
    try:
        suffix = Path(path).suffix.lower()
        band = environment.prior.band
        if suffix in ('.tif', '.tiff'):
            raster = _of_geotiff(path, environment.origin, band)
        else:
            values = _read_array(path) if suffix == '.npy' else read_image(path, band)
            extent = environment.prior.extent or environment.bounds[:2]
            raster = _over(np.asarray(values, dtype=float), extent)
    except OSError as error:
        raise ValueError(f'{key}: {error.strerror or "cannot be read"}') from None
    except ValueError as error:
        raise ValueError(f'{key}: {error}') from None
    values = raster.values
    if values.ndim != 2 or not values.size:
        size = ' x '.join(map(str, values.shape))
        raise ValueError(f'{key}: got {size} numbers, allowed are two axes, rows and columns')
    wrong = values[~(np.isfinite(values) & (values >= 0.0))]
    if wrong.size:
        raise ValueError(
            f'{key}: got {wrong[0]:g}, allowed are finite numbers from 0; if it means no data, '
            'use 0 or, in a GeoTIFF, declare it: gdal_edit.py -a_nodata'
        )
    return dataclasses.replace(raster, values=scaled(values))


def scaled(values: FloatArray) -> FloatArray:
    """Return values scaled by a power of two to at most 1, exactly and with finite sums."""
    return np.asarray(np.ldexp(values, -np.frexp(values.max(initial=0.0))[1]))


def _read_array(path: str) -> FloatArray:
    """Return the array of a .npy file after a check of its header."""
    try:
        array = np.load(path, mmap_mode='r')
    except (ValueError, EOFError):
        raise ValueError('is not a complete array of numbers') from None
    if not isinstance(array, np.ndarray):
        raise ValueError('holds several arrays, allowed is one')
    check_pixels(array.shape)
    try:
        return np.array(array, dtype=float)
    except (ValueError, TypeError):
        raise ValueError('is an array of other things than numbers') from None


def _over(values: FloatArray, extent: list[list[float]]) -> Raster:
    (west, east), (south, north) = extent

    def cells(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        rows, columns = values.shape
        return (x - west) / (east - west) * columns, (north - y) / (north - south) * rows

    return Raster(values, cells)


def data_bands(file: Any) -> list[int]:
    """Return the numbers of the bands with data of a file of rasterio: all but alpha bands."""
    kinds = zip(file.indexes, file.colorinterp)
    return [number for number, kind in kinds if kind.name != 'alpha']


def scaled_band(file: Any, band: int, unknown: float) -> FloatArray:
    """Return a band of a file of rasterio in its unit, which may be stored as other numbers."""
    values = file.read(band, masked=True).astype(float)
    found = values * file.scales[band - 1] + file.offsets[band - 1]
    return np.asarray(found.filled(unknown))


def cells_of(file: Any, origin: OriginSettings) -> Cells:
    """Return the map from x, y [m, map] to columns and rows of a file of rasterio."""
    from rasterio.warp import transform

    crs, (a, b, c, d, e, f) = file.crs, list(~file.transform)[:6]
    west, along, down = file.transform.c, file.transform.a, file.transform.b
    middle = west + 0.5 * (along * file.width + down * file.height)

    def cells(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        degrees = geodetic(np.stack([x.ravel(), y.ravel()], axis=1), origin)
        coordinates = transform('EPSG:4326', crs, degrees[:, 1], degrees[:, 0])
        east, north = (np.reshape(axis, x.shape) for axis in coordinates)
        if crs.is_geographic:
            # Files across 180 degrees count on to one of the sides.
            east = east + 360.0 * np.round((middle - east) / 360.0)
        return a * east + b * north + c, d * east + e * north + f

    return cells


def _of_geotiff(path: str, origin: OriginSettings | None, band: str | None) -> Raster:
    """Return a band of a GeoTIFF in its own coordinates; cells without data are 0."""
    try:
        import rasterio
        from rasterio.warp import transform
    except ImportError:
        raise ValueError('needs rasterio, the extra geo: pip install "rasterio>=1.4"') from None
    if origin is None:
        raise ValueError('a GeoTIFF needs environment.origin')
    try:
        with warnings.catch_warnings():
            warnings.simplefilter('ignore', rasterio.errors.NotGeoreferencedWarning)
            file = rasterio.open(path)
        with file:
            return _of_open_file(file, origin, band, transform)
    except rasterio.errors.RasterioError:
        if not Path(path).is_file():
            raise ValueError('No such file or directory') from None
        raise ValueError('is not a complete GeoTIFF') from None


def _of_open_file(
    file: Any, origin: OriginSettings, band: str | None, transform: Callable[..., Any]
) -> Raster:
    if file.crs is None:
        raise ValueError('has no coordinate system')
    check_pixels(file.shape)
    bands = [str(number) for number in data_bands(file)]
    if band not in (None, *bands) or (band is None and len(bands) > 1):
        read = 'several' if band is None else band
        raise ValueError(f'band: read {read}, allowed are {", ".join(bands)}')
    crs = file.crs
    a, b, c, d, e, f = list(file.transform)[:6]
    u, v = np.transpose(_CORNERS) * [[file.width], [file.height]]
    ends = a * u + b * v + c, d * u + e * v + f
    corners = to_map(np.array(transform(crs, 'EPSG:4326', *ends)).T, origin)
    values = scaled_band(file, int(band or bands[0]), 0.0)
    return Raster(values, cells_of(file, origin), corners)
