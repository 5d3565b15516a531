"""Reads the terrain of an environment: an Esri ASCII grid, or a GeoTIFF in its own coordinates."""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from maasi_filter.arrays import FloatArray
from maasi_filter.geometry.environment import EnvironmentSettings
from maasi_filter.geometry.geodesy import OriginSettings
from maasi_filter.geometry.map_files import encoding_of
from maasi_filter.geometry.occupancy_map import check_pixels
from maasi_filter.geometry.polygons import short
from maasi_filter.geometry.raster import cells_of, data_bands, scaled_band
from maasi_filter.geometry.terrain import Terrain

_GEOTIFF = '.tif', '.tiff'
_METRES = {'m': 1.0, 'ft': 0.3048, 'us-ft': 1200.0 / 3937.0}  # in a unit of heights
_UNITS = {
    **dict.fromkeys(('m', 'metre', 'meter', 'metres', 'meters'), 'm'),
    **dict.fromkeys(('ft', 'foot', 'feet', 'international foot'), 'ft'),
    **dict.fromkeys(('us-ft', 'us survey foot', 'ftus'), 'us-ft'),
}
_HEADER = 'ncols', 'nrows', 'xllcorner', 'xllcenter', 'yllcorner', 'yllcenter', 'cellsize'
# By default; programs also use it where another value is declared, or none.
_NO_DATA, _NO_HEIGHT = 'nodata_value', -9999.0
_SPARE = 1e-6  # by which an area may exceed its file [cells]
# Heights beyond these are of another unit, or no heights at all [m].
_DEEPEST, _HIGHEST = -12_000.0, 9_000.0


class _Grid(NamedTuple):
    """Heights (nx, ny) at nodes, x to the east and y to the north; nan: unknown."""

    heights: FloatArray
    corner: FloatArray  # of the first node
    step: FloatArray
    unit: str | None = None  # as the file says


def read_terrain(environment: EnvironmentSettings) -> tuple[Terrain, tuple[str, ...]]:
    """Return the terrain of an environment, and what was assumed, `key: text`.

    Raises ValueError if the file is unusable, or does not cover the bounds.
    """
    given, origin = environment.terrain, environment.origin
    path = str(given.file)
    try:
        changed = os.stat(path).st_mtime_ns
        bounds = tuple(map(tuple, environment.bounds[:2]))
        return _read(path, changed, given.unit, given.zero, origin and _key(origin), bounds)
    except (OSError, ValueError, TypeError) as error:
        text = error.strerror if isinstance(error, OSError) and error.strerror else error
        raise ValueError(f'environment.terrain: {path}: {text}') from None


def _key(origin: OriginSettings) -> tuple[float, float, float]:
    return origin.latitude, origin.longitude, origin.altitude


@lru_cache(maxsize=4)
def _read(
    path: str,
    changed: int,
    unit: str | None,
    zero: float | None,
    origin: tuple[float, float, float] | None,
    bounds: tuple[tuple[float, float], ...],
) -> tuple[Terrain, tuple[str, ...]]:
    """Read a file, as its content was at a time."""
    found = np.array(bounds)
    geographic = Path(path).suffix.lower() in _GEOTIFF or _projection(path) is not None
    if geographic:
        if origin is None:
            raise ValueError('a file with a coordinate system needs environment.origin')
        names = ('latitude', 'longitude', 'altitude')
        grid = _of_rasterio(path, OriginSettings(**dict(zip(names, origin))), found)
    else:
        grid = _of_ascii(path)
    said = []
    if unit is None and grid.unit is not None and grid.unit.lower() not in _UNITS:
        raise ValueError(
            f'its heights have the unit {short(grid.unit)}; allowed are metres and feet, or '
            f'environment.terrain.unit: one of {", ".join(_METRES)}'
        )
    scale = _METRES[unit or _UNITS[(grid.unit or 'm').lower()]]
    heights = _covering(grid, found) * scale
    low, high = float(heights.min()), float(heights.max())
    if low < _DEEPEST or high > _HIGHEST:
        raise ValueError(
            f'has heights from {low:g} to {high:g} m in the area, allowed are {_DEEPEST:g} to '
            f'{_HIGHEST:g}: check environment.terrain.unit, and the value of cells without data'
        )
    known = 'environment.terrain'
    if unit is None and grid.unit is None and geographic:
        said.append(f'{known}: the file names no unit of its heights, metres are assumed')
    # Of the whole file, so that rays also meet the ground outside of the area.
    # The outer halves of its outermost cells are level.
    heights = np.pad(_filled(grid.heights) * scale, 1, mode='edge')
    terrain = Terrain(heights, grid.corner - grid.step, grid.step)
    if zero is None and geographic:
        zero = terrain.height([0.0, 0.0])
        said.append(
            f'{known}: the ground at x = y = 0 counts as z = 0, {zero:.2f} m in the file; '
            f'{known}.zero sets another height'
        )
    if zero:
        terrain = Terrain(heights - zero, grid.corner - grid.step, grid.step)
    return terrain, tuple(said)


def _covering(grid: _Grid, bounds: FloatArray) -> FloatArray:
    """Return the heights of the nodes at bounds (2, 2) [m, map]; ValueError if one is unknown."""
    parts = []
    for axis, name in enumerate('xy'):
        number = grid.heights.shape[axis]
        (low, high), first, step = bounds[axis], grid.corner[axis], grid.step[axis]
        # A height counts for a cell around it.
        begin, end = first - 0.5 * step, first + (number - 0.5) * step
        if low < begin - _SPARE * step or high > end + _SPARE * step:
            raise ValueError(
                f'covers {name} from {begin:.6g} to {end:.6g} m of the map, the area needs '
                f'{low:.6g} to {high:.6g}; an ASCII grid without .prj is in metres of the map'
            )
        inner = [int(np.floor((low - first) / step)), int(np.ceil((high - first) / step)) + 1]
        parts.append(slice(max(inner[0], 0), min(max(inner[1], 1), number)))
    heights = grid.heights[parts[0], parts[1]]
    unknown = np.isnan(heights)
    if unknown.any():
        i, j = np.argwhere(unknown)[0] + [parts[0].start, parts[1].start]
        x, y = grid.corner + grid.step * (i, j)
        raise ValueError(
            f'has no height at {np.count_nonzero(unknown)} of {heights.size} cells of the area, '
            f'the first at x {x:.6g}, y {y:.6g} m; fill them, for example by gdal_fillnodata.py'
        )
    return heights


def _filled(heights: FloatArray) -> FloatArray:
    """Return heights with the lowest one where they are unknown, outside of the area."""
    return np.where(np.isnan(heights), np.nanmin(heights), heights)


def _projection(path: str) -> Path | None:
    """Return the file with the coordinate system of an ASCII grid, if there is one."""
    for suffix in ('.prj', '.PRJ'):
        if (file := Path(path).with_suffix(suffix)).is_file():
            return file
    return None


def _of_ascii(path: str) -> _Grid:
    """Read an Esri ASCII grid in metres of the map."""
    header: dict[str, float] = {}
    with open(path, 'rb') as start:
        encoding = encoding_of(start.read(2))
    with open(path, encoding=encoding, errors='replace') as file:
        line, number = file.readline(), 1
        while (words := line.split()) and words[0][0].isalpha():
            name = words[0].lower()
            if name not in (*_HEADER, _NO_DATA) or len(words) != 2:
                allowed = f'allowed are {", ".join((*_HEADER, _NO_DATA))}, each with a number'
                raise ValueError(f'line {number}: read {short(line.strip())}, {allowed}')
            unknown = name == _NO_DATA and words[1].lower() == 'nan'
            header[name] = math.nan if unknown else _number(words[1], number)
            line, number = file.readline(), number + 1
        shape, corner, step = _layout(header)
        values = np.array(f'{line} {file.read()}'.split())
    if len(values) != shape[0] * shape[1]:
        raise ValueError(
            f'has {len(values)} heights, allowed are nrows x ncols, {shape[0] * shape[1]}'
        )
    try:
        rows = values.astype(float).reshape(shape)
    except ValueError:
        wrong = next(item for item in values.tolist() if not _is_number(item))
        raise ValueError(f'read {short(wrong)} as a height, allowed are numbers') from None
    rows[rows == header.get(_NO_DATA, _NO_HEIGHT)] = np.nan
    rows[~np.isfinite(rows) | (rows == _NO_HEIGHT)] = np.nan
    # The first row is that in the north.
    return _Grid(np.ascontiguousarray(rows[::-1].T), corner, np.array([step, step]))


def _layout(header: dict[str, float]) -> tuple[tuple[int, int], FloatArray, float]:
    """Return rows and columns, the first node and the step of a header."""
    for choice in (('ncols',), ('nrows',), _HEADER[2:4], _HEADER[4:6], ('cellsize',)):
        if sum(name in header for name in choice) != 1:
            raise ValueError(f'header: needs {" or ".join(choice)}, once')
    shape, step = (header['nrows'], header['ncols']), header['cellsize']
    if not all(size >= 2.0 and size == int(size) for size in shape):
        raise ValueError(
            f'header: read nrows {shape[0]:g} and ncols {shape[1]:g}, allowed are whole numbers '
            'from 2'
        )
    if not step > 0.0:
        raise ValueError(f'header: read cellsize {step:g}, allowed are numbers above 0')
    check_pixels([int(size) for size in shape])
    corner = [
        header[f'{axis}llcenter']
        if f'{axis}llcenter' in header
        else header[f'{axis}llcorner'] + 0.5 * step
        for axis in 'xy'
    ]
    return (int(shape[0]), int(shape[1])), np.array(corner), step


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _number(word: str, line: int) -> float:
    if not _is_number(word) or not np.isfinite(float(word)):
        raise ValueError(f'line {line}: read {short(word)}, allowed are finite numbers')
    return float(word)


def _of_rasterio(path: str, origin: OriginSettings, bounds: FloatArray) -> _Grid:
    """Return the heights of a file in its own coordinates on a grid of the map.

    Its nodes are as far apart as the file's cells. Heights between those are bilinear.
    """
    try:
        import rasterio
    except ImportError:
        raise ValueError('needs rasterio, the extra geo: pip install "rasterio>=1.4"') from None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter('ignore', rasterio.errors.NotGeoreferencedWarning)
            file = rasterio.open(path)
        with file:
            if file.crs is None:
                raise ValueError('has no coordinate system: add it with gdal_translate -a_srs')
            bands = data_bands(file)
            if len(bands) != 1:
                raise ValueError(f'has {len(bands)} bands, allowed is one with heights')
            check_pixels(file.shape)
            cells, unit = cells_of(file, origin), file.units[bands[0] - 1] or None
            values = scaled_band(file, bands[0], math.nan)
    except rasterio.errors.RasterioError:
        raise ValueError('is not a complete GeoTIFF') from None
    values[~np.isfinite(values) | (values == _NO_HEIGHT)] = np.nan
    ends = [corner.ravel() for corner in np.meshgrid(*bounds, indexing='ij')]
    column, row = cells(*ends)
    rows, columns = values.shape
    outside = (column < -_SPARE) | (column > columns + _SPARE)
    outside |= (row < -_SPARE) | (row > rows + _SPARE)
    if outside.any():
        x, y = (end[outside][0] for end in ends)
        raise ValueError(
            f'does not cover the area: x {x:.6g}, y {y:.6g} m is at column {column[outside][0]:.0f}'
            f' and row {row[outside][0]:.0f} of {columns} x {rows} cells; check environment.origin '
            'and the coordinate system'
        )
    span = bounds[:, 1] - bounds[:, 0]
    along = max(np.ptp(column), np.ptp(row), 1.0)
    number = np.maximum(np.ceil(span / (float(span.max()) / along)), 1.0).astype(int) + 1
    check_pixels(number.tolist())
    step = span / (number - 1)
    axes = [low + gap * np.arange(count) for low, gap, count in zip(bounds[:, 0], step, number)]
    x, y = (axis.ravel() for axis in np.meshgrid(*axes, indexing='ij'))
    column, row = cells(x, y)
    # Heights are those of the centres of cells.
    heights = _between(values, column - 0.5, row - 0.5).reshape(number)
    return _Grid(heights, bounds[:, 0].copy(), step, unit)


def _between(values: FloatArray, column: FloatArray, row: FloatArray) -> FloatArray:
    """Return bilinear values at columns and rows; nan where a neighbour with a weight is."""
    rows, columns = values.shape
    u, v = np.clip(column, 0.0, columns - 1.0), np.clip(row, 0.0, rows - 1.0)
    i, j = np.minimum(v.astype(int), rows - 2), np.minimum(u.astype(int), columns - 2)
    u, v, out = u - j, v - i, np.zeros(len(column))
    parts: Sequence[tuple[int, int, FloatArray]] = (
        (0, 0, (1.0 - v) * (1.0 - u)),
        (0, 1, (1.0 - v) * u),
        (1, 0, v * (1.0 - u)),
        (1, 1, v * u),
    )
    for down, right, weight in parts:
        out += np.where(weight > 0.0, weight * values[i + down, j + right], 0.0)
    return out
