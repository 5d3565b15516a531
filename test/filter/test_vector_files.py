"""Shapefiles and GeoPackages, made by pyogrio and, where it is installed, by ogr2ogr."""

import json
import random
import shutil
import sqlite3
import struct
import subprocess
import sys
import warnings
from contextlib import closing

import numpy as np
import pyogrio
import pytest
import shapely
from pydantic import ValidationError
from rasterio.warp import transform

from maasi_filter.geometry.environment import EnvironmentSettings
from maasi_filter.geometry.geojson import features_of, points_of
from maasi_filter.geometry.polygons import InputWarning

FIELD = shapely.box(9.8987, 46.5991, 9.9013, 46.6009)
POND = shapely.box(9.9002, 46.5995, 9.901, 46.6005)
SIZES = {'area': 39862.0, 'keep_out': 6814.0}  # on the ellipsoid [m^2]
OGR = shutil.which('ogr2ogr')


def write(path, shapes, crs='EPSG:4326', layer=None, kind='Unknown', **columns):
    if crs not in (None, 'EPSG:4326'):
        shapes = [
            shapely.transform(shape, lambda xy: np.array(transform('EPSG:4326', crs, *xy.T)).T)
            for shape in shapes
        ]
    values = [np.array(column, dtype=object) for column in columns.values()] or [
        np.array(['x'] * len(shapes), dtype=object)
    ]
    pyogrio.raw.write(
        path,
        shapely.to_wkb(shapes, include_srid=False),
        values,
        list(columns) or ['other'],
        layer=layer,
        geometry_type=kind if path.suffix == '.gpkg' else 'Polygon',
        crs=crs,
        append=layer is not None and path.exists(),
    )
    return path


def field(folder, name='field.gpkg', crs='EPSG:4326'):
    names = {'name': ['Field', 'No-fly: pond']}
    return write(folder / name, [FIELD, POND], crs, kind='Polygon', **names)


def environment(path):
    return EnvironmentSettings.model_validate({'area': str(path)})


def refusal(path):
    with pytest.raises(ValidationError) as caught:
        environment(path)
    (error,) = caught.value.errors()
    return error['msg'].removeprefix('Value error, ')


def sizes(path):
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        made = environment(path)
    return {'area': made.area.area, 'keep_out': sum(zone.polygon.area for zone in made.keep_outs)}


@pytest.mark.parametrize('crs', ['EPSG:4326', 'EPSG:32632', 'EPSG:3857', 'EPSG:25832'])
@pytest.mark.parametrize('name', ['field.gpkg', 'field.shp'])
def test_area_and_keep_out_in_any_coordinate_system(tmp_path, name, crs):
    assert sizes(field(tmp_path, name, crs)) == pytest.approx(SIZES, abs=2.0)


@pytest.mark.skipif(OGR is None, reason='needs ogr2ogr (sudo apt install gdal-bin)')
@pytest.mark.parametrize('name', ['made.gpkg', 'made.shp'])
def test_files_of_ogr2ogr(tmp_path, name):
    rows = [
        {
            'type': 'Feature',
            'properties': {'ROLE': role, 'weight': 3.0},
            'geometry': json.loads(shapely.to_geojson(shapely.force_3d(shape, 7.0))),
        }
        for role, shape in (('area', FIELD), ('keep_out', POND))
    ]
    source = tmp_path / 'source.geojson'
    source.write_text(json.dumps({'type': 'FeatureCollection', 'features': rows}))
    made = tmp_path / name
    subprocess.run([OGR, '-t_srs', 'EPSG:32632', made, source], check=True, capture_output=True)
    assert sizes(made) == pytest.approx(SIZES, abs=2.0)
    assert [item.properties['weight'] for item in features_of(str(made))] == [3.0, 3.0]


def test_layers_are_roles_and_points_have_robots(tmp_path):
    path = tmp_path / 'all.gpkg'
    write(path, [FIELD], layer='area', kind='Polygon')
    write(path, [POND], layer='keep-outs', kind='Polygon')
    points = [shapely.Point(9.9, 46.6), shapely.Point(9.899, 46.5995, 12.0)]
    names = {'name': ['start scout', 'depot'], 'Role': [None, 'charger'], 'robot': [None, 'scout']}
    write(path, points, layer='points', **names)
    with closing(sqlite3.connect(path)) as table, table:
        table.execute('CREATE TABLE notes (id INTEGER PRIMARY KEY)')
        table.execute(
            'INSERT INTO gpkg_contents (table_name, data_type, identifier) '
            "VALUES ('notes', 'attributes', 'notes')"
        )
    with pytest.warns(InputWarning, match='layer notes: table without geometry'):
        made = environment(path)
    assert (made.area.area, made.keep_outs[0].polygon.area) == pytest.approx(
        tuple(SIZES.values()), abs=2.0
    )
    assert sorted(points_of(str(path))) == [
        ('charger', 'scout', [9.899, 46.5995]),
        ('start', 'scout', [9.9, 46.6]),
    ]


def test_lines_and_empty_shapes_are_left_out_with_a_warning(tmp_path):
    line = shapely.LineString([[9.9, 46.6], [9.901, 46.6]])
    path = write(tmp_path / 'mixed.gpkg', [FIELD, line, shapely.Point(9.9, 46.6)])
    with pytest.warns(InputWarning, match=r'feature 2: LineString; .*feature 3: point without'):
        assert len(features_of(str(path))) == 1


def test_curves_become_polygons(tmp_path):
    """A circle through four points of its border, as GDAL divides it."""
    circle = '1 1, 2 2, 3 1, 2 0, 1 1'
    path = tmp_path / 'curve.gpkg'
    corners = np.array([[float(v) for v in pair.split()] for pair in circle.split(', ')])
    # Well-known binary of a CURVEPOLYGON (10) with a CIRCULARSTRING (8).
    curve = struct.pack('<BIIBII', 1, 10, 1, 1, 8, len(corners)) + corners.tobytes()
    shapes = np.array([curve], dtype=object)
    names = [np.array(['round'], dtype=object)]
    pyogrio.raw.write(path, shapes, names, ['name'], geometry_type='Unknown', crs='EPSG:4326')
    (found,) = features_of(str(path))
    assert found.shape.area == pytest.approx(np.pi, abs=0.01)


@pytest.mark.parametrize('suffix', ['.shx', '.dbf', '.prj'])
def test_a_missing_file_of_a_shapefile_is_named(tmp_path, suffix):
    path = field(tmp_path, 'field.shp')
    path.with_suffix(suffix).rename(path.with_suffix(suffix.upper()))
    assert sizes(path) == pytest.approx(SIZES, abs=2.0)
    path.with_suffix(suffix.upper()).unlink()
    assert f'field.shp: needs field{suffix} next to it' in refusal(path)


def test_a_table_of_another_file_is_refused(tmp_path):
    """Names and roles would belong to other shapes."""
    path = field(tmp_path, 'field.shp')
    other = write(tmp_path / 'other.shp', [FIELD], name=['Field'])
    shutil.copy(other.with_suffix('.dbf'), path.with_suffix('.dbf'))
    assert 'its .dbf is damaged or of another file: read 1 row' in refusal(path)


def test_without_a_coordinate_system_or_with_a_local_one(tmp_path):
    path = tmp_path / 'none.gpkg'
    with warnings.catch_warnings():
        warnings.simplefilter('ignore')
        write(path, [FIELD], crs=None, kind='Polygon')
    assert 'coordinate system' in refusal(path)
    path = field(tmp_path, 'field.shp')
    path.with_suffix('.prj').write_text('LOCAL_CS["site",UNIT["metre",1]]')
    assert 'read coordinate system' in refusal(path)
    path.with_suffix('.prj').write_text('nonsense')
    assert 'coordinate system' in refusal(path)


def test_other_contents_are_refused(tmp_path):
    for name in ('a.gpkg', 'b.shp'):
        path = tmp_path / name
        for suffix in ('.shx', '.dbf', '.prj'):
            path.with_suffix(suffix).write_bytes(b'x' * 200)
        path.write_text('<OGRVRTDataSource><OGRVRTLayer name="x"/></OGRVRTDataSource>' * 3)
        assert f'{name}: is not a' in refusal(path) or f'{name}: its .shp is not' in refusal(path)
    assert 'gone.gpkg: No such file' in refusal(tmp_path / 'gone.gpkg')
    assert 'gone.shp: No such file' in refusal(tmp_path / 'gone.shp')
    empty = tmp_path / 'empty.gpkg'
    with closing(sqlite3.connect(empty)) as table, table:
        table.execute('CREATE TABLE x (y)')
    assert 'empty.gpkg: is damaged, or no GPKG' in refusal(empty)


def test_without_the_libraries_they_are_named(tmp_path, monkeypatch):
    path = field(tmp_path, 'field.gpkg', 'EPSG:32632')
    monkeypatch.setitem(sys.modules, 'rasterio.warp', None)
    assert 'EPSG:32632, which needs rasterio, the extra geo' in refusal(path)
    monkeypatch.setitem(sys.modules, 'pyogrio', None)
    assert 'needs pyogrio, the extra geo: pip install' in refusal(path)


@pytest.mark.parametrize('seed', range(60))
@pytest.mark.parametrize('name', ['field.gpkg', 'field.shp'])
def test_damaged_files_raise_nothing_but_the_readers_errors(tmp_path, name, seed):
    chance = random.Random(seed)
    path = field(tmp_path, name, chance.choice(['EPSG:4326', 'EPSG:32632']))
    damaged = path.with_suffix(chance.choice(['.shp', '.shx', '.dbf', '.prj']))
    damaged = path if name == 'field.gpkg' else damaged
    data = bytearray(damaged.read_bytes())
    for _ in range(chance.choice([1, 3, 30, 300])):
        data[chance.randrange(len(data))] = chance.randrange(256)
    if chance.random() < 0.3:
        del data[chance.randrange(len(data)) :]
    damaged.write_bytes(data)
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        warnings.simplefilter('ignore', InputWarning)
        try:
            made = environment(path)
        except ValidationError as error:
            text = str(error)
            assert 'GDAL' not in text and 'sqlite' not in text and 'Traceback' not in text
        else:
            assert np.isfinite(made.area.area)
