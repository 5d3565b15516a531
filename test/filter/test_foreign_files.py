"""Maps, areas and priors of other programs: taken, refused by name, or with a warning."""

import json
import warnings

import numpy as np
import pytest
import rasterio
import shapely
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from PIL import Image
from pydantic import ValidationError

from maasi_filter.geometry.area import Area
from maasi_filter.geometry.environment import EnvironmentSettings
from maasi_filter.geometry.occupancy_map import read_map
from maasi_filter.geometry.polygons import InputWarning

FACTS = {'image': 'room.pgm', 'resolution': 0.05, 'origin': [-3.2, -1.7, 0.0], 'negate': 0}
THRESHOLDS = {'occupied_thresh': 0.65, 'free_thresh': 0.25}
# A square of 200 m, with another north side.
RING = [[9.8987, 46.5991], [9.9013, 46.5991], [9.9013, 46.6009], [9.8987, 46.6009]]
ZONE = [[9.9002, 46.5995], [9.901, 46.5995], [9.901, 46.6005], [9.9002, 46.6005]]


def area_of(**values):
    return Area(EnvironmentSettings.model_validate(values))


def polygon(ring=RING, **properties):
    shape = {'type': 'Polygon', 'coordinates': [[*ring, ring[0]]]}
    return {'type': 'Feature', 'properties': properties or None, 'geometry': shape}


def collection(*features, **members):
    return {'type': 'FeatureCollection', 'features': list(features), **members}


def refusal(**values):
    """Return the text of the refusal of an environment: one line, without Python's own words."""
    with pytest.raises(ValidationError) as caught:
        EnvironmentSettings.model_validate(values)
    (error,) = caught.value.errors()
    words = error['msg']
    assert '\n' not in words and "{'" not in words and 'POLYGON' not in words
    return words


def write_map(folder, cells, name='room.yaml', **facts):
    Image.fromarray(cells).save(folder / 'room.pgm')
    (folder / name).write_text(yaml.safe_dump({**FACTS, **THRESHOLDS, **facts}))
    return str(folder / name)


@settings(max_examples=60, deadline=None)
@given(
    cells=arrays(bool, st.tuples(st.integers(1, 14), st.integers(1, 14))),
    resolution=st.sampled_from([0.05, 0.03, 0.1, 1.0 / 3.0]),
    west=st.floats(-100.0, 100.0),
    yaw=st.sampled_from([0.0, 0.3]),
)
def test_any_occupancy_grid_is_read_and_blocks_the_area_of_its_cells(
    tmp_path_factory, cells, resolution, west, yaw
):
    """Also cells that touch at corners, and rings of them."""
    folder = tmp_path_factory.getbasetemp()
    origin = [west, -1.7, yaw]
    grey = np.where(cells, 0, 254).astype(np.uint8)
    name = write_map(folder, grey, resolution=resolution, origin=origin)
    if not cells.any():
        with pytest.raises(ValueError, match=r'room\.yaml: '):
            read_map(name)
        return
    area = area_of(bounds=[[-200.0, 200.0]] * 2, obstacles=[name])
    (blocked,) = area.shapes['obstacle']
    # Coordinates are kept to a tenth of a millimetre.
    tolerance = 1e-4 * blocked.length
    assert blocked.is_valid
    assert blocked.area == pytest.approx(cells.sum() * resolution**2, abs=tolerance)
    rows, columns = np.indices(cells.shape).reshape(2, -1)
    x, y = resolution * (columns + 0.5), resolution * (len(cells) - rows - 0.5)
    middles = shapely.points(
        west + x * np.cos(yaw) - y * np.sin(yaw), -1.7 + x * np.sin(yaw) + y * np.cos(yaw)
    )
    assert (shapely.contains(blocked, middles) == cells.ravel()).all()


def test_maps_are_read_in_the_modes_of_nav2(tmp_path):
    """Values are those of its map server (nav2_map_server, map_io.cpp, Jazzy)."""
    raw = np.array([[0, 100, 255], [70, 60, 101]], np.uint8)
    assert read_map(write_map(tmp_path, raw, mode='raw')).area == pytest.approx(2 * 0.0025)
    grey = np.array([[0, 254, 205], [80, 100, 0]], np.uint8)
    for mode in ('trinary', 'scale'):
        assert read_map(write_map(tmp_path, grey, mode=mode)).area == pytest.approx(3 * 0.0025)
    assert read_map(write_map(tmp_path, grey, negate=1)).area == pytest.approx(2 * 0.0025)
    # Transparent pixels are unknown in the mode scale; trinary counts alpha as a colour.
    picture = np.dstack([np.zeros((2, 3, 3), np.uint8), [[255, 0, 255], [255, 255, 0]]])
    Image.fromarray(picture.astype(np.uint8)).save(tmp_path / 'room.PNG')
    for mode, number in (('scale', 4), ('trinary', 6)):
        facts = {**FACTS, **THRESHOLDS, 'image': 'room.PNG', 'mode': mode, 'occupied_thresh': 0.5}
        (tmp_path / 'ROOM.YML').write_text(yaml.safe_dump(facts))
        taken = area_of(bounds=[[-9.0, 9.0]] * 2, obstacles=[str(tmp_path / 'ROOM.YML')])
        assert taken.shapes['obstacle'][0].area == pytest.approx(number * 0.0025)


@pytest.mark.parametrize(
    'facts, words',
    [
        ({'resolution': 0}, 'resolution: read 0, allowed are numbers above 0'),
        ({'resolution': 'fine'}, "resolution: read 'fine', allowed is a number"),
        ({'mode': 'grey'}, "mode: read 'grey', allowed are trinary, scale, raw"),
        ({'origin': [1, 2]}, r'origin: read \[1, 2\], allowed is \[x, y, yaw\]'),
        ({'image': None}, 'image: read null, allowed is the name of a file'),
        ({'image': 'gone.pgm'}, r'gone\.pgm: No such file or directory'),
        ({'image': 'room.yaml'}, r'room\.yaml: '),
        ({'image': ''}, "image: read '', allowed is the name of a file"),
        ({'occupied_thresh': 65}, 'occupied_thresh: read 65, allowed are numbers from 0 to 1'),
        ({'occupied_thresh': None}, 'occupied_thresh: read null, allowed is a number'),
    ],
)
def test_a_map_that_cannot_be_used_is_refused_by_its_key(tmp_path, facts, words):
    name = write_map(tmp_path, np.zeros((2, 2), np.uint8), **facts)
    with pytest.raises(ValueError, match=rf'room\.yaml: .*{words}'):
        read_map(name)


def test_nothing_in_a_role_or_weight_means_not_given():
    for nothing in (None, ''):
        features = [
            polygon(role=nothing, weight=nothing, id=1),
            polygon(ZONE, role='prior', weight=nothing, id=2),
        ]
        area = area_of(area=collection(*features, name='layer'))
        assert area.settings.prior.polygons[0].weight == 1.0 and not area.settings.keep_outs
    much = polygon(ZONE, role='prior', weight='much')
    assert 'feature 2: weight: read much' in refusal(area=collection(polygon(), much))


def test_what_is_no_polygon_is_left_out_with_one_warning(tmp_path):
    """Folders, points and lines with heights and times, as programs for search teams export."""
    line = {'type': 'LineString', 'coordinates': [[9.9, 46.6, 0, 1700000000000], [9.9, 46.5, 0, 0]]}
    mixed = {'type': 'GeometryCollection', 'geometries': [polygon(ZONE)['geometry'], line]}
    features = [
        {'type': 'Feature', 'id': 'f', 'geometry': None, 'properties': {'title': 'Segments'}},
        {'type': 'Feature', 'geometry': line, 'properties': {'name': 'track'}},
        polygon([[*corner, 0, 0] for corner in RING]),
        {'type': 'Feature', 'geometry': mixed, 'properties': {'role': 'keep_out'}},
    ]
    file = tmp_path / 'export.JSON'
    # A byte order mark, as some programs write.
    file.write_text(json.dumps(collection(*features)), encoding='utf-8-sig')
    with pytest.warns(InputWarning) as told:
        area = area_of(area=str(file))
    assert len(area.settings.keep_outs) == 1 and area.border.area == pytest.approx(40000, rel=0.02)
    assert [str(item.message) for item in told] == [
        f'{file}: left out, as these are no polygons: feature 1 (Segments): no geometry; '
        'feature 2 (track): LineString; feature 4: LineString'
    ]


@pytest.mark.parametrize(
    'name, allowed',
    [
        ('urn:ogc:def:crs:OGC:1.3:CRS84', True),
        ('urn:ogc:def:crs:EPSG::4326', True),
        ('EPSG:4326', True),
        ('http://www.opengis.net/gml/srs/epsg.xml#4326', True),
        ('WGS 84', True),
        ('urn:ogc:def:crs:EPSG::25832', False),
        ('EPSG:3857', False),
        ('EPSG:14326', False),
        (None, False),
    ],
)
def test_another_coordinate_system_is_refused_by_its_name(name, allowed):
    given = collection(polygon(), crs={'type': 'name', 'properties': {'name': name}})
    if allowed:
        assert area_of(area=given).border.area == pytest.approx(40000, rel=0.02)
    else:
        words = refusal(area=given)
        assert f'crs: read {name or "null"}, allowed is WGS 84' in words and 'ogr2ogr' in words


@pytest.mark.parametrize(
    'ring, cause',
    [
        ([[568900, 5160900], [569100, 5160900], [569100, 5161100]], 'are these metres'),
        ([[46.6, 100.0], [46.7, 100.0], [46.7, 100.1]], 'is the latitude first'),
        ([[199.9, 1.0], [200.1, 1.0], [200.1, 1.1]], 'cut the polygon at 180 degrees'),
        ([[0, 0], [40, 0], [40, 30], [0, 30]], 'km2, allowed are 10,000'),
    ],
)
def test_coordinates_that_are_no_degrees_are_refused_with_the_likely_cause(ring, cause):
    assert cause in refusal(area=polygon(ring))


@pytest.mark.parametrize(
    'given, words',
    [
        (collection(), 'holds no polygon'),
        ({**polygon(), 'properties': ['a']}, 'feature 1: properties: read ["a"], allowed is an'),
        (polygon([[0, 0], ['a', 1], [1, 1]]), 'feature 1: coordinates: read [[[0, 0], ["a", 1]'),
        ({'type': 'Feature', 'geometry': 3}, 'feature 1: geometry: read 3, allowed is an object'),
        (
            collection(polygon(role='keep_out')),
            'keep-outs alone belong under environment.keep_outs',
        ),
    ],
)
def test_geojson_without_an_area_is_refused_in_one_line(given, words):
    assert words in refusal(area=given)


def test_halves_at_180_degrees_are_one_area():
    halves = [
        [[179.99, -16.6], [180.0, -16.6], [180.0, -16.59], [179.99, -16.59]],
        [[-180.0, -16.6], [-179.99, -16.6], [-179.99, -16.59], [-180.0, -16.59]],
    ]
    rings = [[[*half, half[0]]] for half in halves]
    shape = {'type': 'MultiPolygon', 'coordinates': rings}
    zone = polygon([[-179.999, -16.596], [-179.998, -16.596], [-179.998, -16.594]], role='keep_out')
    area = area_of(area=collection({'type': 'Feature', 'geometry': shape}, zone))
    assert abs(area.settings.origin.longitude) == 180.0 and area.warnings == []
    assert area.border.geom_type == 'Polygon'
    assert area.border.area == pytest.approx(2.36e6, rel=1e-3)


def test_a_hole_that_touches_the_border_in_a_point_is_taken():
    """Valid in degrees; on the map the corner lies off the side by less than a millimetre."""
    hole = [[9.8987, 46.6], [9.8993, 46.6002], [9.8993, 46.5998], [9.8987, 46.6]]
    whole = polygon()
    whole['geometry']['coordinates'].append(hole)
    cut = area_of(area=whole).border
    assert cut.is_valid
    assert cut.area == pytest.approx(area_of(area=polygon()).border.area - 1020.0, rel=1e-3)


def test_a_zone_with_exchanged_coordinates_is_named():
    exchanged = [corner[::-1] for corner in ZONE]
    far = [[x + 30.0, y] for x, y in ZONE]
    area = area_of(area=polygon(), keep_outs=[polygon(exchanged), polygon(ZONE), polygon(far)])
    first, second = area.warnings
    assert first.startswith('environment.keep_outs[0]: lies 4,739 km') and 'swapped' in first
    assert second.startswith('environment.keep_outs[2]: lies ') and 'swapped' not in second


def test_images_of_16_bits_are_the_same_prior_and_others_need_a_band(tmp_path):
    grey = np.array([[20, 200], [40, 20]], np.uint8)
    bounds = [[0.0, 100.0]] * 2
    Image.fromarray(grey).save(tmp_path / 'heat8.png')
    Image.fromarray(grey.astype(np.uint16) * 257).save(tmp_path / 'heat16.png')
    places = np.array([[25.0, 75.0], [75.0, 75.0], [75.0, 25.0]])
    first, second = (
        area_of(bounds=bounds, prior=str(tmp_path / name)).density(places)
        for name in ('heat8.png', 'heat16.png')
    )
    assert first == pytest.approx(second) and first[1] > 5.0 * first[0]
    clear = np.dstack([grey, grey, grey, grey])
    colour = np.dstack([grey, grey, 255 - grey])
    for values, words in ((clear, 'transparent'), (colour, 'colours')):
        file = str(tmp_path / 'other.png')
        Image.fromarray(values).save(file)
        with pytest.raises(ValueError, match=f'other.png: .*{words}'):
            area_of(bounds=bounds, prior=file)
        with pytest.raises(ValueError, match='band: read sky'):
            area_of(bounds=bounds, prior={'raster': file, 'band': 'sky'})
        named = area_of(bounds=bounds, prior={'raster': file, 'band': 'red'})
        assert named.density(places) == pytest.approx(first)
    Image.fromarray(np.dstack([grey, grey, grey, np.full((2, 2), 255, np.uint8)])).save(file)
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        assert area_of(bounds=bounds, prior=file).density(places) == pytest.approx(first)


def test_a_prior_that_is_the_same_everywhere_is_reported(tmp_path):
    Image.fromarray(np.full((9, 9), 70, np.uint8)).save(tmp_path / 'flat.png')
    area = area_of(bounds=[[0.0, 100.0]] * 2, prior=str(tmp_path / 'flat.png'))
    (warning,) = area.warnings
    assert warning.startswith('environment.prior: ')


def test_a_file_under_a_key_gives_what_belongs_there():
    """One file of a map program may hold area, keep-outs and prior, each with its role."""
    whole = collection(polygon(role='area'), polygon(ZONE, role='keep_out'))
    for zones in (whole, [whole], [{'polygon': whole}]):
        with pytest.warns(InputWarning, match='keep_outs: .* feature 1: role area$'):
            (zone,) = area_of(area=polygon(), keep_outs=zones).shapes['keep_out']
        assert zone.area == pytest.approx(6800.0, rel=0.01)
    words = refusal(area=polygon(), keep_outs=[polygon(role='area')])
    assert words.endswith(
        'role area; allowed under environment.keep_outs is role keep_out, or none'
    )
    words = refusal(area=polygon(), prior=polygon(ZONE, role='keep_out'))
    assert words.endswith('role keep_out; allowed under environment.prior is role prior, or none')
    # What the role is of another program says nothing here.
    hazard = area_of(area=polygon(), keep_outs=[polygon(ZONE, role='hazard')])
    assert len(hazard.shapes['keep_out']) == 1


def test_an_origin_is_near_the_area_and_not_any_property_of_that_name():
    assert area_of(area=polygon(origin='GPS')).settings.origin.latitude == pytest.approx(46.6)
    near = area_of(area=polygon(), origin={'latitude': 46.5, 'longitude': 9.9})
    assert near.border.area == pytest.approx(40000, rel=0.02)
    words = refusal(area=polygon(), origin={'latitude': 9.9, 'longitude': 46.6})
    assert 'lies 4,737 km from environment.origin, allowed are 100' in words


def test_polygons_across_180_degrees_that_are_not_cut_are_the_same_area():
    """As programs draw them, with a hole and a keep-out beyond; a warning says what is assumed."""
    ring = [[179.99, -16.6], [-179.99, -16.6], [-179.99, -16.59], [179.99, -16.59]]
    hole = [[-179.998, -16.596], [-179.997, -16.596], [-179.997, -16.594], [-179.998, -16.596]]
    zone = polygon([[-179.996, -16.596], [-179.995, -16.596], [-179.995, -16.594]], role='keep_out')
    whole = polygon(ring)
    whole['geometry']['coordinates'].append(hole)
    with pytest.warns(InputWarning, match='feature 1: '):
        area = area_of(area=collection(whole, zone))
    # Programs also count on beyond 180 degrees.
    beyond = polygon([[x % 360.0, y] for x, y in ring])
    assert area_of(area=beyond).border.area == pytest.approx(2.36e6, rel=1e-3)
    assert abs(area.settings.origin.longitude) == pytest.approx(180.0) and area.warnings == []
    assert area.border.area == pytest.approx(2.36e6 - 11800.0, rel=1e-3)
    assert area.region.area == pytest.approx(area.border.area - 11800.0, rel=1e-3)


@pytest.mark.parametrize(
    'crs, allowed',
    [
        ({'type': 'EPSG', 'properties': {'code': 4326}}, True),
        ({'type': 'name', 'properties': {'name': 'WGS 84 (EPSG:4326)'}}, True),
        ({'type': 'EPSG', 'properties': {'code': 3857}}, False),
        ({'type': 'name', 'properties': {'name': 'WGS 84 / UTM zone 32N'}}, False),
    ],
)
def test_other_forms_of_the_coordinate_system_are_known(crs, allowed):
    if allowed:
        assert area_of(area=collection(polygon(), crs=crs)).border.area > 0.0
    else:
        words = refusal(area=collection(polygon(), crs=crs))
        assert 'read EPSG:3857,' in words or 'read WGS 84 / UTM zone 32N,' in words


def test_what_is_another_format_or_encoding_is_refused_as_such(tmp_path):
    file = tmp_path / 'area.json'
    file.write_text(json.dumps({'geometryType': 'esriGeometryPolygon', 'features': []}))
    assert 'allowed are FeatureCollection, Feature and Polygon' in refusal(area=str(file))
    file.write_text(json.dumps(polygon(name='Süd'), ensure_ascii=False), encoding='latin-1')
    assert refusal(area=str(file)).endswith('UTF-8 text')
    for place, cause in (
        (None, 'read null, allowed are longitude and latitude'),
        ([9.9, 'north'], 'read [9.9, "north"], allowed are longitude and latitude'),
        ([46.6, 99.0], 'is the latitude first'),
    ):
        start = {'type': 'Feature', 'geometry': {'type': 'Point', 'coordinates': place}}
        start['properties'] = {'role': 'start'}
        assert cause in refusal(area=collection(polygon(), start))


def test_each_polygon_of_a_zone_that_lies_elsewhere_is_counted_and_its_feature_named():
    exchanged = polygon([corner[::-1] for corner in ZONE], name='pond')
    file = collection(polygon(ZONE), exchanged)
    (warning,) = area_of(area=polygon(), keep_outs=[file]).warnings
    assert warning.startswith('environment.keep_outs[0]: 1 of its 2 polygons lie up to 4,739 km')
    assert 'swapped' in warning
    pond = polygon(exchanged['geometry']['coordinates'][0][:-1], name='pond', role='keep_out')
    with pytest.warns(InputWarning, match=r'feature 2 \(pond\): .*keep_outs\[0\]'):
        assert len(area_of(area=collection(polygon(), pond)).warnings) == 1


def test_an_exchange_is_seen_where_latitude_and_longitude_are_nearly_the_same():
    ring = [[10.0, 10.1], [10.002, 10.1], [10.002, 10.102], [10.0, 10.102]]
    zone = polygon([[y, x] for x, y in ring[:3]])
    (warning,) = area_of(area=polygon(ring), keep_outs=[zone]).warnings
    assert 'lies 15 km outside' in warning and 'swapped' in warning
    away = polygon([[x + 0.1, y] for x, y in ring[:3]])
    (warning,) = area_of(area=polygon(ring), keep_outs=[away]).warnings
    assert 'swapped' not in warning


def test_a_raster_over_other_ground_is_told_with_its_distance(tmp_path):
    Image.fromarray(np.array([[20, 200]], np.uint8)).save(tmp_path / 'heat.png')
    prior = {'raster': str(tmp_path / 'heat.png'), 'extent': [[1100, 1200], [0, 100]]}
    first, second = area_of(bounds=[[0.0, 100.0]] * 2, prior=prior).warnings
    assert first.startswith('environment.prior.extent: lies 1000 m outside of the area')
    assert second.startswith('environment.prior: ')


@pytest.mark.parametrize('exchanged', [False, True])
def test_a_geotiff_of_other_ground_is_told_with_its_distance(tmp_path, exchanged):
    west, north = (46.6, 9.902) if exchanged else (9.95, 46.602)
    grid = rasterio.transform.from_origin(west, north, 1e-3, 1e-3)
    facts = {'driver': 'GTiff', 'width': 2, 'height': 2, 'count': 1, 'dtype': 'uint8'}
    with rasterio.open(
        tmp_path / 'heat.tif', 'w', crs='EPSG:4326', transform=grid, **facts
    ) as file:
        file.write(np.array([[20, 200], [0, 7]], np.uint8), 1)
    origin = {'latitude': 46.6, 'longitude': 9.9}
    bounds, prior = [[0.0, 100.0]] * 2, str(tmp_path / 'heat.tif')
    first, second = area_of(bounds=bounds, origin=origin, prior=prior).warnings
    gap = '4,739 km' if exchanged else '3731 m'
    assert first.startswith(f'environment.prior.raster: lies {gap} outside of the area')
    assert ('swapped' in first) == exchanged
    assert second.startswith('environment.prior: ')


def test_corners_in_degrees_are_not_an_area_of_millimetres():
    ring = ', '.join(f'{x} {y}' for x, y in [*RING, RING[0]])
    for corners in (RING, f'POLYGON (({ring}))'):
        assert refusal(area=corners) == (
            'Value error, is 0.0026 m long, and corners are in metres of the map: are these '
            'degrees? Write them as GeoJSON'
        )
