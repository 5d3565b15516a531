"""Files of terrain: ASCII grids and GeoTIFF, and what is refused by name."""

import sys

import numpy as np
import pytest
import rasterio
from rasterio.warp import transform

from maasi_filter.geometry.area import Area
from maasi_filter.geometry.environment import EnvironmentSettings
from maasi_filter.geometry.geodesy import OriginSettings, to_map
from maasi_filter.geometry.raster import read_raster

ORIGIN = {'latitude': 46.6, 'longitude': 9.9, 'altitude': 1800.0}


def area(terrain, **others):
    given = {'bounds': [[0.0, 40.0], [0.0, 30.0]], 'terrain': terrain} | others
    return Area(EnvironmentSettings.model_validate(given))


def header(**changes):
    values = {'ncols': 5, 'nrows': 4, 'xllcorner': 0, 'yllcorner': 0, 'cellsize': 10} | changes
    return ''.join(f'{name} {value}\n' for name, value in values.items() if value is not None)


def grid(tmp_path, body=None, name='hill.asc', **changes):
    rows = [' '.join(str(10 * row + column) for column in range(5)) for row in range(4)]
    (tmp_path / name).write_text(header(**changes) + ('\n'.join(rows) if body is None else body))
    return str(tmp_path / name)


def test_an_ascii_grid_has_its_first_row_in_the_north(tmp_path):
    terrain = area(grid(tmp_path, NODATA_value=-1)).terrain
    # Centres of the cells in the south west, south east and north west.
    assert terrain.heights([[5, 5], [45, 5], [5, 35]]) == pytest.approx([30, 34, 0])
    assert terrain.height([20.0, 20.0]) == pytest.approx(16.5)
    # In the outer halves of the outermost cells the height of their centres.
    assert terrain.height([1.0, 2.0]) == pytest.approx(30.0)
    assert np.isfinite(terrain.meets([1.0, 2.0, 90.0], [[0.0, 0.1, -1.0]])).all()


def test_centres_units_and_zero(tmp_path):
    path = grid(tmp_path, xllcorner=None, yllcorner=None, xllcenter=0, yllcenter=0)
    assert area(path).terrain.height([10.0, 0.0]) == pytest.approx(31.0)
    feet = area({'file': path, 'unit': 'ft', 'zero': 1.0})
    assert feet.terrain.height([10.0, 0.0]) == pytest.approx(31.0 * 0.3048 - 1.0)
    assert feet.warnings == []
    assert feet.above_ground([10.0, 0.0, 5.0]) == pytest.approx([10.0, 0.0, 31 * 0.3048 + 4.0])


def test_no_terrain_changes_nothing():
    plain = Area([[0.0, 40.0], [0.0, 30.0]])
    assert plain.terrain is None
    assert plain.above_ground([1.0, 2.0, 3.0]).tolist() == [1.0, 2.0, 3.0]


@pytest.mark.parametrize(
    ('changes', 'body', 'text'),
    [
        ({'cellsize': 7}, None, r'covers x from 0 to 35 m of the map, the area needs 0 to 40'),
        ({'xllcorner': 620000}, None, 'an ASCII grid without .prj is in metres of the map'),
        ({'cellsize': None}, None, 'header: needs cellsize, once'),
        ({'xllcenter': 3}, None, 'header: needs xllcorner or xllcenter, once'),
        ({'ncols': 4}, None, 'has 20 heights, allowed are nrows x ncols, 16'),
        ({'ncols': 4.5}, None, 'header: read nrows 4 and ncols 4.5'),
        ({'nrows': 'four'}, None, 'line 2: read "?four"?, allowed are finite numbers'),
        ({'cellsize': -1}, None, 'read cellsize -1, allowed are numbers above 0'),
        ({'dx': 3}, None, 'line 6: read "?dx 3"?, allowed are ncols'),
        ({'ncols': 90000, 'nrows': 90000}, None, 'allowed are at most'),
        ({}, ' '.join(['1'] * 19 + ['high']), 'read "?high"? as a height'),
        ({}, ' '.join(['1'] * 19 + ['-9999']), r'no height at 1 of 20 cells.*x 45, y 5 m'),
        ({}, ' '.join(['1'] * 19 + ['nan']), r'no height at 1 of 20 cells'),
        ({}, ' '.join(['20000'] * 20), 'heights from 20000 to 20000 m .*check environment.terrain'),
        ({}, '', 'has 0 heights'),
    ],
)
def test_bad_grids_are_refused_by_name(tmp_path, changes, body, text):
    path = grid(tmp_path, body, **changes)
    with pytest.raises(ValueError, match=rf'^environment\.terrain: .*hill\.asc: .*{text}'):
        area(path)


def test_unknown_heights_outside_of_the_area_do_not_matter(tmp_path):
    body = ' '.join(['1'] * 15 + ['-9999'] * 5)
    path = grid(tmp_path, body, yllcorner=-10)
    assert area(path, bounds=[[0.0, 40.0], [6.0, 29.0]]).terrain.height([7.0, 10.0]) == 1.0


def test_other_environments_refuse_terrain(tmp_path):
    path = grid(tmp_path)
    with pytest.raises(ValueError, match=r'terrain\n.*allowed with two axes only'):
        area(path, bounds=[[0.0, 40.0], [0.0, 30.0], [0.0, 5.0]])
    with pytest.raises(ValueError, match=r'terrain: .*none\.asc: No such file'):
        area(str(tmp_path / 'none.asc'))
    (tmp_path / 'hill.prj').write_text('GEOGCS["WGS 84"]')
    with pytest.raises(ValueError, match=r'hill\.asc: .*needs environment\.origin'):
        area(path)


def geotiff(path, crs='EPSG:32632', cell=5.0, function=None, unit=None, nodata=None):
    """Write heights that are linear in the coordinates of the file, around the area."""
    origin = OriginSettings(**ORIGIN)
    (east,), (north,) = transform('EPSG:4326', crs, [origin.longitude], [origin.latitude])
    corner = east - 20.0 * cell, north + 30.0 * cell
    x = corner[0] + (np.arange(60) + 0.5) * cell - east
    y = corner[1] - (np.arange(50) + 0.5) * cell - north
    heights = function(*np.meshgrid(x, y)).astype(np.float32)
    facts = {'driver': 'GTiff', 'width': 60, 'height': 50, 'count': 1, 'dtype': 'float32'}
    grid = rasterio.transform.from_origin(*corner, cell, cell)
    with rasterio.open(path, 'w', crs=crs, transform=grid, nodata=nodata, **facts) as file:
        file.write(heights, 1)
        if unit:
            file.units = (unit,)
    return str(path), (east, north)


def test_a_geotiff_is_at_its_coordinates(tmp_path):
    def plane(x, y):
        return 1830.0 + 0.2 * x - 0.1 * y

    path, (east, north) = geotiff(tmp_path / 'hill.tif', function=plane)
    found = area(path, origin=ORIGIN)
    points = np.random.default_rng(1).uniform([0.0, 0.0], [40.0, 30.0], (50, 2))
    # The position of each point by the file's coordinates.
    axis = np.linspace(-5.0, 45.0, 11)
    x, y = (item.ravel() for item in np.meshgrid(axis, axis))
    degrees = transform('EPSG:32632', 'EPSG:4326', x + east, y + north)
    on_map = to_map(np.array(degrees).T, OriginSettings(**ORIGIN))
    inside = (on_map > 0.0).all(axis=1) & (on_map < [40.0, 30.0]).all(axis=1)
    expected = plane(x, y)[inside] - 1830.0
    # Rounding of heights to 32 bits, and curvature of the earth's coordinates over a cell.
    assert found.terrain.heights(on_map[inside]) == pytest.approx(expected, abs=1e-3)
    assert len(found.terrain.heights(points)) == 50
    assert len(found.warnings) == 2
    assert 'names no unit of its heights, metres are assumed' in found.warnings[0]
    assert 'the ground at x = y = 0 counts as z = 0, 1830.00 m in the file' in found.warnings[1]
    fixed = area({'file': path, 'unit': 'm', 'zero': 1800.0}, origin=ORIGIN)
    assert fixed.warnings == []
    assert fixed.terrain.height([0.0, 0.0]) == pytest.approx(30.0, abs=1e-3)


@pytest.mark.parametrize('scale, offset', [(0.1, 0.0), (1.0, 1000.0), (0.25, -50.0)])
def test_scaled_numbers_of_a_geotiff_are_heights_in_metres(tmp_path, scale, offset):
    """Many programs store heights as whole numbers."""

    def stored(x, y):
        return np.round((100.0 + 0.2 * x - offset) / scale)

    path, _ = geotiff(tmp_path / 'hill.tif', function=stored)
    with rasterio.open(path, 'r+') as file:
        file.scales, file.offsets = (scale,), (offset,)
    found = area({'file': path, 'unit': 'm', 'zero': 0.0}, origin=ORIGIN).terrain
    assert found.height([0.0, 0.0]) == pytest.approx(100.0, abs=0.5)
    assert found.height([40.0, 0.0]) == pytest.approx(108.0, abs=0.5 + 0.5 * scale)
    ground = {'bounds': [[0.0, 40.0], [0.0, 30.0]], 'origin': ORIGIN, 'prior': path}
    raster = read_raster(EnvironmentSettings.model_validate(ground))
    assert raster.values.max() / raster.values.min() == pytest.approx(139.5 / 80.5, rel=0.01)


def test_a_band_of_transparency_is_no_second_band(tmp_path):
    path, _ = geotiff(tmp_path / 'one.tif', function=lambda x, y: 100.0 + 0.0 * x)
    with rasterio.open(path) as file:
        facts, heights = file.profile | {'count': 2}, file.read(1)
    for name, alpha in (('two.tif', 'NO'), ('alpha.tif', 'YES')):
        with rasterio.open(tmp_path / name, 'w', alpha=alpha, **facts) as file:
            file.write(heights, 1)
            file.write(np.full_like(heights, 255), 2)
    fixed = {'file': str(tmp_path / 'alpha.tif'), 'unit': 'm', 'zero': 0.0}
    assert area(fixed, origin=ORIGIN).terrain.height([1.0, 1.0]) == pytest.approx(100.0)
    ground = {'bounds': [[0.0, 40.0], [0.0, 30.0]], 'origin': ORIGIN, 'prior': fixed['file']}
    assert read_raster(EnvironmentSettings.model_validate(ground)).values.min() > 0.5
    (tmp_path / 'text.tif').write_text('no picture')
    for name, words in (('text', 'is not a complete GeoTIFF'), ('gone', 'No such file')):
        other = ground | {'prior': str(tmp_path / f'{name}.tif')}
        with pytest.raises(ValueError, match=rf'{name}\.tif: {words}'):
            read_raster(EnvironmentSettings.model_validate(other))
    with pytest.raises(ValueError, match=r'two\.tif: has 2 bands, allowed is one'):
        area(str(tmp_path / 'two.tif'), origin=ORIGIN)


@pytest.mark.parametrize('declared', [None, -1.0, 'nan'])
def test_the_usual_number_without_data_is_no_height(tmp_path, declared):
    """Whatever a file declares, -9999 m is nowhere on the earth."""
    line = '' if declared is None else f'NODATA_value {declared}\n'
    heights = ['7 ' * 20] * 10 + ['7 ' * 5 + '-9999 ' + '7 ' * 14] + ['7 ' * 20] * 9
    text = f'ncols 20\nnrows 20\nxllcorner 0\nyllcorner 0\ncellsize 2\n{line}'
    path = tmp_path / 'a.asc'
    path.write_text(text + '\n'.join(heights))
    with pytest.raises(ValueError, match=r'a\.asc: has no height at 1 of \d+ cells'):
        area(str(path))
    path, _ = geotiff(tmp_path / 'a.tif', function=lambda x, y: -9999.0 + 0.0 * x)
    with pytest.raises(ValueError, match=r'a\.tif: has no height at'):
        area(str(path), origin=ORIGIN)


@pytest.mark.parametrize('encoding', ['utf-8', 'utf-8-sig', 'utf-16'])
def test_a_grid_is_read_as_its_byte_order_mark_says(tmp_path, encoding):
    text = 'ncols 20\r\nnrows 20\r\nxllcorner 0\r\nyllcorner 0\r\ncellsize 2\r\n'
    (tmp_path / 'a.asc').write_bytes((text + '7 ' * 400).encode(encoding))
    assert area(str(tmp_path / 'a.asc')).terrain.height([3.0, 3.0]) == 7.0


def test_units_and_gaps_of_a_geotiff(tmp_path, monkeypatch):
    def level(x, y):
        return np.full(x.shape, 100.0)

    path, _ = geotiff(tmp_path / 'feet.tif', function=level, unit='ft')
    assert area({'file': path, 'zero': 0.0}, origin=ORIGIN).terrain.height([1, 1]) == (
        pytest.approx(30.48)
    )
    path, _ = geotiff(tmp_path / 'cubits.tif', function=level, unit='cubit')
    with pytest.raises(ValueError, match=r'cubits\.tif: its heights have the unit "?cubit'):
        area(path, origin=ORIGIN)
    path, _ = geotiff(tmp_path / 'gap.tif', function=lambda x, y: 0.0 * x - 9.0, nodata=-9.0)
    with pytest.raises(ValueError, match=r'gap\.tif: has no height at'):
        area(path, origin=ORIGIN)
    path, _ = geotiff(tmp_path / 'away.tif', function=level)
    with pytest.raises(ValueError, match=r'away\.tif: does not cover the area'):
        area(path, origin=ORIGIN | {'longitude': 9.93})
    (tmp_path / 'text.tif').write_text('no picture')
    with pytest.raises(ValueError, match=r'text\.tif: is not a complete GeoTIFF'):
        area(str(tmp_path / 'text.tif'), origin=ORIGIN)
    monkeypatch.setitem(sys.modules, 'rasterio', None)
    with pytest.raises(ValueError, match=r'needs rasterio, the extra geo'):
        area({'file': path, 'zero': 1.0}, origin=ORIGIN)
