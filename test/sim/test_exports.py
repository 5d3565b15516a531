"""Results for map programs: complete, readable by others, and without the true targets."""

import io
import json
import re
import sys
import warnings
from datetime import datetime, timezone
from xml.etree import ElementTree

import numpy as np
import pytest
import shapely
from PIL import Image
from shapely.geometry import shape
from small_field import small_field

from maasi_filter.geometry.environment import EnvironmentSettings
from maasi_filter.geometry.geodesy import OriginSettings, geodetic, to_map
from maasi_filter.geometry.polygons import InputWarning
from maasi_filter.geometry.raster import read_raster
from maasi_filter.records import Label
from maasi_sim.run.targets.exports import cot_text, gpx_text, kml_text, map_files
from maasi_sim.run.targets.mission import TargetMission
from maasi_sim.run.targets.report import explored_after
from maasi_sim.run.targets.tables import collection, cut_at_180, found_rows, searched
from maasi_sim.search import search

NOW = datetime(2026, 5, 4, 3, 2, 1, tzinfo=timezone.utc)
ODD = Label('cup <a&b>', 0.5, 'tag\x00\x1b"3"\ufffe')


@pytest.fixture(scope='module')
def run():
    environment = {
        'area': [[0, 0], [60, 0], [60, 60], [0, 60]],
        'expected_targets': 2.0,
        'origin': {'latitude': 46.0, 'longitude': 23.5, 'altitude': 350.0},
        'keep_outs': [[[40, 40], [50, 40], [50, 50]]],
    }
    return search(small_field(environment), 2)


@pytest.fixture
def files(run):
    return files_of(run, run.truth)


def files_of(run, truth):
    origin, explored = run.scenario.environment.origin, explored_after(run)
    pairs = [(index, index) for index in range(min(len(truth), len(run.found_targets)))]
    rows = found_rows(run.found_targets, truth, pairs, origin)
    features = searched(run, explored, origin)
    return map_files('field', rows, features, run.planned_paths(), explored, origin, NOW)


def elements(text):
    found = list(ElementTree.fromstring(text).iter())
    for item in found:
        item.tag = item.tag.rpartition('}')[2]
    return found


def test_no_file_depends_on_the_true_targets(run, files):
    other = files_of(run, run.truth + np.array([7.0, -3.0]))
    assert files == other and len(run.found_targets) > 0
    for name, content in files.items():
        if isinstance(content, str):
            for axis in run.truth.ravel():
                assert repr(float(axis)) not in content, name
            assert not re.search(r'\b(truth|error|rmse)\b', content), name


def test_a_run_writes_them_into_a_folder_of_their_own(run):
    made = TargetMission('field', run.scenario).tables(run)
    names = {'search.kml', 'found_targets.gpx', 'found_targets.cot', 'drone.plan'}
    names |= {f'detection_probability.{kind}' for kind in ('png', 'pgw', 'tif')}
    assert {name for name in made if '/' in name} == {f'map_files/{name}' for name in names}


def test_found_targets_are_where_they_were_found(run, files):
    origin = run.scenario.environment.origin
    fixes = geodetic(np.array([item.position for item in run.found_targets]), origin)
    marks = [item for item in elements(files['search.kml']) if item.tag == 'Point']
    kml = [list(map(float, item[0].text.split(',')))[::-1] for item in marks]
    points = [item for item in elements(files['found_targets.gpx']) if item.tag == 'wpt']
    gpx = [[float(item.get(key)) for key in ('lat', 'lon')] for item in points]
    events = [item for item in elements(files['found_targets.cot']) if item.tag == 'point']
    cot = [[float(item.get(key)) for key in ('lat', 'lon', 'hae')] for item in events]
    assert np.allclose(kml, fixes[:, :2], atol=1e-8) and np.allclose(gpx, kml)
    assert np.allclose(cot, fixes, atol=1e-3)
    spread = [np.sqrt(np.linalg.eigvalsh(item.covariance)[-1]) for item in run.found_targets]
    assert np.allclose([float(item.get('ce')) for item in events], spread, atol=1e-3)
    times = [item for item in elements(files['found_targets.cot']) if item.tag == 'event']
    assert times[0].get('time') == '2026-05-04T03:02:01Z' < times[0].get('stale')


def test_the_area_comes_back_from_kml_and_plan(run, files, tmp_path):
    environment = run.scenario.environment
    for name in ('drone.plan', 'search.kml'):
        (tmp_path / name).write_text(files[name])
        values = {'area': str(tmp_path / name), 'origin': environment.origin.model_dump()}
        with warnings.catch_warnings():
            warnings.simplefilter('ignore', InputWarning)
            made = EnvironmentSettings.model_validate(values)
        assert made.area.area == pytest.approx(3600.0, abs=0.1)
        (kept,) = made.keep_outs
        assert kept.polygon.area == pytest.approx(50.0, abs=0.01)


@pytest.mark.parametrize('east', [180.0, -180.0, 179.9997, -179.9998])
def test_a_search_across_180_degrees_comes_back(run, tmp_path, east):
    """KML and GeoJSON are cut there; the raster continues beyond; fences have no larger numbers."""
    origin, explored = OriginSettings(latitude=1.0, longitude=east), explored_after(run)
    features = searched(run, explored, origin)
    made = map_files('field', [], features, run.planned_paths(), explored, origin, NOW)
    made['ways.geojson'] = collection(cut_at_180(features))
    moved = run.scenario.environment.model_dump() | {'origin': origin.model_dump()}
    before = EnvironmentSettings.model_validate(moved)
    for row in json.loads(made['ways.geojson'])['features']:
        if row['geometry']['type'] != 'LineString':
            for part in shapely.get_parts(shape(row['geometry'])):
                west, _, last, _ = part.bounds
                assert -180.0 <= west <= last <= 180.0 and last - west < 0.001
    for name in ('drone.plan', 'search.kml'):
        (tmp_path / name).write_text(made[name])
        with warnings.catch_warnings():
            warnings.simplefilter('ignore', InputWarning)
            values = {'area': str(tmp_path / name), 'origin': origin}
            back = EnvironmentSettings.model_validate(values)
        assert back.area.symmetric_difference(before.area).area < 0.1
        assert back.keep_outs[0].polygon.area == pytest.approx(50.0, abs=0.01)
    (tmp_path / 'seen.tif').write_bytes(made['detection_probability.tif'])
    moved |= {'prior': {'raster': str(tmp_path / 'seen.tif')}}
    read = read_raster(EnvironmentSettings.model_validate(moved)).at(*explored.nodes().T)
    unseen = explored.unseen().ravel()
    wanted = np.where(unseen >= 0.0, 1.0 - unseen, 0.0)
    assert np.allclose(read * wanted.max() / read.max(), wanted, atol=1e-6)


def test_a_plan_of_a_search_with_bounds_has_them_as_a_fence(run, tmp_path):
    explored = explored_after(run)
    origin = run.scenario.environment.origin
    paths = run.planned_paths()
    made = map_files('field', [], [], paths, explored, origin, NOW)['drone.plan']
    (fence,) = json.loads(made)['geoFence']['polygons']
    corners = to_map(np.array(fence['polygon'])[:, ::-1], origin)
    assert fence['inclusion'] and np.allclose(
        corners, [[0, 0], [60, 0], [60, 60], [0, 60]], atol=0.01
    )


def test_a_plan_has_the_waypoints_above_the_start(run, files):
    mission = json.loads(files['drone.plan'])['mission']
    chosen = [place for _, place in run.waypoints['drone']]
    items = np.array([item['params'][4:] for item in mission['items']])
    origin = run.scenario.environment.origin
    assert np.allclose(to_map(items[:, 1::-1], origin), np.array(chosen)[:, :2], atol=0.01)
    heights = run.planned_paths()['drone'][:, 2]
    assert np.allclose(items[:, 2], heights[1:] - heights[0], atol=0.01)
    assert [item['doJumpId'] for item in mission['items']] == [*range(1, len(chosen) + 1)]


def test_the_picture_shows_what_would_have_been_found(run, files):
    explored = explored_after(run)
    image = np.asarray(Image.open(io.BytesIO(files['detection_probability.png'])))
    a, d, b, e, c, f = map(float, files['detection_probability.pgw'].split())
    origin = run.scenario.environment.origin
    # Programs of others refuse rotated rasters.
    assert d == b == 0.0
    for place in ([10.0, 12.0], [30.0, 5.0], [55.0, 55.0]):
        latitude, longitude = geodetic(np.array([place]), origin)[0, :2]
        column, row = np.linalg.solve([[a, b], [d, e]], [longitude - c, latitude - f])
        x, y = (column * explored.step[0], 60.0 - row * explored.step[1])
        assert (x, y) == pytest.approx(place, abs=0.01)
        pixel = image[round(row), round(column)]
        shown = 1.0 - explored.values[round(column), len(image) - 1 - round(row)]
        assert pixel[0] == pytest.approx(255.0 * shown, abs=1.0) and pixel[3] == 255
    # A target cannot be in the keep-out.
    assert image[round((60.0 - 42.5) / explored.step[1]), round(47.5 / explored.step[0]), 3] == 0


def test_any_text_of_a_detection_is_valid_xml(run):
    rows = found_rows(run.found_targets, run.truth, [], run.scenario.environment.origin)
    rows = [{**row, 'class_id': ODD.class_id, 'identity': ODD.identity} for row in rows]
    for text in (kml_text('a&b', rows, []), gpx_text(rows), cot_text('<"', rows, NOW)):
        assert any('cup <a&b>' in (item.text or '') for item in elements(text)) or (
            'cup &lt;a&amp;b&gt;' in text
        )


def test_a_search_without_finds_or_paths_is_written_too(run):
    origin, explored = run.scenario.environment.origin, explored_after(run)
    paths = {'drone': np.zeros((1, 3)), 'other': np.zeros((0, 3))}
    made = map_files('field', [], [], paths, explored, origin, NOW)
    assert 'drone.plan' not in made and elements(made['search.kml'])


def test_the_geotiff_is_a_prior_with_the_values_of_the_map(run, files, tmp_path, monkeypatch):
    """Read back as any GeoTIFF; without rasterio there is none."""
    pytest.importorskip('rasterio')
    path = tmp_path / 'seen.tif'
    path.write_bytes(files['detection_probability.tif'])
    explored = explored_after(run)
    environment = run.scenario.environment.model_dump() | {'prior': {'raster': str(path)}}
    raster = read_raster(EnvironmentSettings.model_validate(environment))
    nodes, unseen = explored.nodes(), explored.unseen().ravel()
    wanted = np.where(unseen >= 0.0, 1.0 - unseen, 0.0)
    read = raster.at(*nodes.T)
    assert np.allclose(read * wanted.max() / read.max(), wanted, atol=1e-6)
    monkeypatch.setitem(sys.modules, 'rasterio', None)
    assert 'detection_probability.tif' not in files_of(run, run.truth)
