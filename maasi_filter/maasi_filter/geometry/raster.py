"""The raster of a prior: an array, an image, or a GeoTIFF in its own coordinates."""

from __future__ import annotations

import dataclasses
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


@dataclass(frozen=True)
class Raster:
    """Densities (rows, columns), and the map from x, y [m, map] to columns and rows.

    corners (4, 2): position of the raster by its own file [m, map].
    """

    values: FloatArray
    cells: Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]
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
    except (OSError, ValueError, TypeError, EOFError) as error:
        raise ValueError(f'{key}: {error}') from None
    values = raster.values
    if values.ndim != 2 or not np.isfinite(values).all() or (values < 0.0).any():
        raise ValueError(
            f'{key}: got shape {values.shape}, allowed are two axes of finite numbers from 0'
        )
    return dataclasses.replace(raster, values=scaled(values))


def scaled(values: FloatArray) -> FloatArray:
    """Return values scaled by a power of two to at most 1, exactly and with finite sums."""
    return np.asarray(np.ldexp(values, -np.frexp(values.max(initial=0.0))[1]))


def _read_array(path: str) -> FloatArray:
    """Return the array of a .npy file after a check of its header."""
    array = np.load(path, mmap_mode='r')
    if not isinstance(array, np.ndarray):
        raise ValueError('holds several arrays, allowed is one')
    check_pixels(array.shape)
    return np.array(array, dtype=float)


def _over(values: FloatArray, extent: list[list[float]]) -> Raster:
    (west, east), (south, north) = extent

    def cells(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        rows, columns = values.shape
        return (x - west) / (east - west) * columns, (north - y) / (north - south) * rows

    return Raster(values, cells)


def scaled_band(file: Any, band: int, unknown: float) -> FloatArray:
    """Return a band of a file of rasterio in its unit, which may be stored as other numbers."""
    values = file.read(band, masked=True).astype(float)
    found = values * file.scales[band - 1] + file.offsets[band - 1]
    return np.asarray(found.filled(unknown))


def _of_geotiff(path: str, origin: OriginSettings | None, band: str | None) -> Raster:
    """Return a band of a GeoTIFF in its own coordinates; cells without data are 0."""
    try:
        import rasterio
        from rasterio.warp import transform
    except ImportError:
        raise ValueError('needs rasterio, the extra geo: pip install "rasterio>=1.4"') from None
    if origin is None:
        raise ValueError('a GeoTIFF needs environment.origin')
    with rasterio.open(path) as file:
        if file.crs is None:
            raise ValueError('has no coordinate system')
        check_pixels(file.shape)
        bands = [str(number) for number in file.indexes]
        if band not in (None, *bands) or (band is None and len(bands) > 1):
            read = 'several' if band is None else band
            raise ValueError(f'band: read {read}, allowed are {", ".join(bands)}')
        crs, grid = file.crs, list(~file.transform)
        a, b, c, d, e, f = list(file.transform)[:6]
        u, v = np.transpose(_CORNERS) * [[file.width], [file.height]]
        ends = a * u + b * v + c, d * u + e * v + f
        corners = to_map(np.array(transform(crs, 'EPSG:4326', *ends)).T, origin)
        values = scaled_band(file, int(band or 1), 0.0)

    def cells(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        degrees = geodetic(np.stack([x.ravel(), y.ravel()], axis=1), origin)
        coordinates = transform('EPSG:4326', crs, degrees[:, 1], degrees[:, 0])
        east, north = (np.reshape(axis, x.shape) for axis in coordinates)
        a, b, c, d, e, f = grid[:6]
        return a * east + b * north + c, d * east + e * north + f

    return Raster(values, cells, corners)
