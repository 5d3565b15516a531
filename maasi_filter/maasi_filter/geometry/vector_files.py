"""Reads shapefiles and GeoPackages as features of GeoJSON, with pyogrio (GDAL)."""

from __future__ import annotations

import io
import struct
import warnings
import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import shapely
from shapely.geometry import mapping
from shapely.geometry.base import BaseGeometry

from maasi_filter.arrays import FloatArray
from maasi_filter.geometry.map_files import (
    MOST_BYTES,
    MOST_ELEMENTS,
    Row,
    feature_row,
    point_row,
    polygons_row,
    read_bytes,
)
from maasi_filter.geometry.polygons import short, warn
from maasi_filter.wording import counted

VECTOR_FILES = ('.shp', '.gpkg')
_SIDECARS = {
    '.shx': 'the positions of its shapes',
    '.dbf': 'their names and roles',
    '.prj': 'its coordinate system',
}
_SHAPE_CODE, _SQLITE = 9994, b'SQLite format 3\0'
_FACTS = ('name', 'role', 'weight', 'robot')  # attributes, in any case
_WGS84 = ('EPSG:4326', 'EPSG:4979', 'OGC:CRS84')
_LAYER = 'layer'  # name of a shapefile for GDAL
# What pyogrio and shapely raise for data that they cannot read; NameError: pyogrio 0.13 for a
# coordinate system that is not UTF-8.
_ERRORS = (
    *(RuntimeError, ValueError, TypeError, OverflowError, MemoryError, LookupError, NameError),
    shapely.errors.ShapelyError,
)


def read_vector_file(path: str) -> Row:
    """Return a file as a GeoJSON feature collection; ValueError names what is wrong."""
    try:
        pyogrio = _pyogrio()
        source = _shapefile(Path(path)) if path.lower().endswith('.shp') else _geopackage(path)
        driver = 'GPKG' if isinstance(source, str) else 'ESRI Shapefile'
        rows = [*_features(pyogrio, source, driver, Path(path).stem)]
    except OSError as error:
        raise ValueError(f'{error.filename or path}: {error.strerror}') from None
    except ValueError as error:
        raise ValueError(f'{path}: {error}') from None
    return {'type': 'FeatureCollection', 'features': rows}


def _pyogrio() -> ModuleType:
    try:
        import pyogrio
        import pyogrio.raw
    except ImportError:
        raise ValueError('needs pyogrio, the extra geo: pip install "pyogrio>=0.10"') from None
    return pyogrio


def _geopackage(path: str) -> str:
    """Return the path of a GeoPackage; by its path, GDAL also reads what is not merged yet."""
    if not read_bytes(path).startswith(_SQLITE):
        raise ValueError('is not a GeoPackage')
    return str(Path(path).resolve())


def _shapefile(path: Path) -> bytes:
    """Return a shapefile and its other files as an archive."""
    parts, left = {}, MOST_BYTES
    near = {item.name.lower(): item for item in path.parent.iterdir()}
    for suffix in ('.shp', *_SIDECARS, '.cpg'):
        file = path if suffix == '.shp' else near.get(f'{path.stem}{suffix}'.lower())
        if file is None:
            if suffix in _SIDECARS:
                raise ValueError(
                    f'needs {path.stem}{suffix} next to it, which holds {_SIDECARS[suffix]}'
                )
            continue
        with file.open('rb') as opened:
            parts[suffix] = opened.read(left + 1)
        left -= len(parts[suffix])
    if left < 0:
        raise ValueError(f'its files are too large, allowed are {MOST_BYTES // 1_000_000} MB')
    _check_whole(parts)
    out = io.BytesIO()
    with zipfile.ZipFile(out, 'w') as archive:
        for suffix, data in parts.items():
            archive.writestr(_LAYER + suffix, data)
    return out.getvalue()


def _check_whole(parts: dict[str, bytes]) -> None:
    """Raise ValueError if lengths and counts in the headers do not fit the files.

    GDAL returns the shapes before the damage, without those that follow.
    """
    for suffix in ('.shp', '.shx'):
        data = parts[suffix]
        if len(data) < 100 or struct.unpack('>i', data[:4])[0] != _SHAPE_CODE:
            raise ValueError(f'its {suffix} is not of a shapefile')
        size = 2 * struct.unpack('>i', data[24:28])[0]
        if size != len(data):
            raise ValueError(f'its {suffix} is damaged: has {len(data)} bytes, written were {size}')
    table = parts['.dbf']
    if len(table) < 32:
        raise ValueError('its .dbf is not a table')
    rows, head, width = struct.unpack('<IHH', table[4:12])
    shapes = (len(parts['.shx']) - 100) // 8
    if rows != shapes or len(table) < head + rows * width:
        raise ValueError(
            f'its .dbf is damaged or of another file: read {rows} rows in {len(table)} bytes, '
            f'allowed are those of {counted(shapes, "shape")}'
        )


def _features(pyogrio: ModuleType, source: str | bytes, driver: str, stem: str) -> Iterator[Row]:
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter('always')
            layers = [(str(name), kind) for name, kind in pyogrio.list_layers(source)]
    except _ERRORS:
        raise ValueError(f'is damaged, or no {driver}') from None
    for name, kind in layers:
        title = stem if name == _LAYER and isinstance(source, bytes) else name
        label = f'layer {short(title)}'
        if kind is None:
            yield feature_row(label, 'table without geometry')
            continue
        try:
            with warnings.catch_warnings(record=True) as more:
                warnings.simplefilter('always')
                facts = pyogrio.read_info(source, layer=name, force_feature_count=True)
                meta, _, shapes, columns = pyogrio.raw.read(
                    source, layer=name, max_features=MOST_ELEMENTS + 1
                )
                whole = shapely.force_2d(shapely.from_wkb(shapes))
        except _ERRORS:
            raise ValueError(
                f'{label}: is damaged, or has shapes of a kind that is not read'
            ) from None
        if facts['driver'] != driver:
            raise ValueError(f'{label}: read {short(facts["driver"])}, allowed is {driver}')
        if len(whole) > MOST_ELEMENTS:
            raise ValueError(f'{label}: has too many features, allowed are {MOST_ELEMENTS:,}')
        if facts['features'] not in (-1, len(whole)):
            count = facts['features']
            raise ValueError(f'{label}: is damaged: read {len(whole)} of {count} features')
        caught += more
        placed = _in_degrees(list(whole), meta['crs'], label)
        values = {str(key).lower(): column for key, column in zip(meta['fields'], columns)}
        for number, shape in enumerate(placed):
            known = {key: _value(values[key][number]) for key in _FACTS if key in values}
            yield from _rows(f'{label}, feature {number + 1}', shape, known, title)
    if caught:
        count = counted(len(caught), 'warning')
        warn(f'{stem}: GDAL read it with {count}: check it with ogrinfo -al')


def _value(value: Any) -> Any:
    """Return an attribute as text or number; None if there is none."""
    if isinstance(value, (np.floating, float)):
        return float(value) if np.isfinite(value) else None
    if isinstance(value, np.generic):
        value = value.item()
    return value.strip() if isinstance(value, str) else value


def _in_degrees(shapes: list[BaseGeometry], crs: Any, label: str) -> list[BaseGeometry]:
    """Return shapes in WGS 84, longitude first."""
    if crs is None:
        raise ValueError(
            f'{label}: has no coordinate system; allowed is a known one: '
            'ogr2ogr -a_srs EPSG:NUMBER new.gpkg FILE'
        )
    if crs in _WGS84:
        return shapes
    try:
        from rasterio.warp import transform
    except ImportError:
        raise ValueError(
            f'{label}: read coordinate system {short(str(crs))}, which needs rasterio, the extra '
            'geo: pip install "rasterio>=1.4"; or convert it: ogr2ogr -t_srs EPSG:4326 new.gpkg '
            'FILE'
        ) from None

    def project(points: FloatArray) -> FloatArray:
        return np.array(transform(crs, 'EPSG:4326', *points.T)[:2], dtype=float).T

    points = shapely.get_coordinates(shapes)
    try:
        degrees = project(points) if len(points) else points
    except Exception:  # errors of GDAL have no public class in rasterio
        raise ValueError(
            f'{label}: read coordinate system {short(str(crs))}, allowed is one on the earth'
        ) from None
    if not np.isfinite(degrees).all():
        wrong = points[~np.isfinite(degrees).all(axis=1)][0].tolist()
        raise ValueError(f'{label}: read {wrong}, which is outside of {short(str(crs))}')
    return list(shapely.set_coordinates(np.array(shapes, dtype=object), degrees))


def _rows(label: str, shape: BaseGeometry | None, facts: Row, layer: str) -> Iterator[Row]:
    name = str(facts.get('name') or '')
    texts = [name, layer]
    if shape is None or shape.is_empty:
        yield feature_row(label, 'no geometry', name=name)
        return
    polygons = []
    for part in _parts(shape):
        if part.geom_type == 'Polygon':
            polygons.append(mapping(part)['coordinates'])
        elif part.geom_type == 'Point':
            position = shapely.get_coordinates(part)[0].tolist()
            yield point_row(label, position, name, texts, facts)
        else:
            yield feature_row(label, part.geom_type, name=name)
    if polygons:
        yield polygons_row(label, polygons, name, texts, facts)


def _parts(shape: BaseGeometry) -> Sequence[BaseGeometry]:
    """Return the simple shapes of a collection of any depth that are not empty."""
    parts = shapely.get_parts(shape).tolist()
    if len(parts) == 1 and not hasattr(shape, 'geoms'):
        return [part for part in parts if not part.is_empty]
    return [simple for part in parts for simple in _parts(part)]
