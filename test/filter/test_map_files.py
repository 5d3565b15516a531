"""Areas of other map programs and of ground stations: KML, KMZ, GPX, plans and fences."""

import json
import random
import warnings
import zipfile

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from maasi_filter.geometry.environment import EnvironmentSettings
from maasi_filter.geometry.geojson import features_of, points_of
from maasi_filter.geometry.map_files import READERS
from maasi_filter.geometry.polygons import InputWarning

# 200 m by 200 m, and a keep-out of 61 m by 111 m in it; latitude first.
FIELD = [(46.5991, 9.8987), (46.5991, 9.9013), (46.6009, 9.9013), (46.6009, 9.8987)]
POND = [(46.5995, 9.9002), (46.5995, 9.901), (46.6005, 9.901), (46.6005, 9.9002)]
SIZES = {'area': 39838.0, 'keep_out': 6811.0}


def closed(corners):
    return [*corners, corners[0]]


def kml_polygon(corners, name, *holes, extra=''):
    def ring(side, row):
        text = ' '.join(f'{east},{north},0' for north, east in closed(row))
        line = f'<LinearRing><coordinates>{text}</coordinates></LinearRing>'
        return f'<{side}BoundaryIs>{line}</{side}BoundaryIs>'

    rings = ring('outer', corners) + ''.join(ring('inner', row) for row in holes)
    return f'<Placemark><name>{name}</name>{extra}<Polygon>{rings}</Polygon></Placemark>'


def kml(*content):
    head = '<?xml version="1.0" encoding="UTF-8"?>\n<kml xmlns="http://www.opengis.net/kml/2.2">'
    return '\n'.join([head, '<Document>', *content, '</Document></kml>'])


def gpx(*content):
    head = '<gpx version="1.1" creator="test" xmlns="http://www.topografix.com/GPX/1/1">'
    return '\n'.join([head, *content, '</gpx>'])


def track(corners, name):
    points = ''.join(f'<trkpt lat="{north}" lon="{east}"/>' for north, east in corners)
    return f'<trk><name>{name}</name><trkseg>{points}</trkseg></trk>'


def plan(polygons=(), circles=(), **members):
    fence = {'version': 2, 'polygons': [*polygons], 'circles': [*circles]}
    return json.dumps({'fileType': 'Plan', 'version': 1, 'geoFence': fence, **members})


def zone(corners, inclusion):
    return {'polygon': [list(corner) for corner in corners], 'inclusion': inclusion, 'version': 1}


def waypoints(*rows):
    lines = ['QGC WPL 110', '0\t1\t0\t16\t0\t0\t0\t0\t46.6\t9.9\t1700\t1']
    for number, (command, first, north, east) in enumerate(rows, 1):
        lines.append(f'{number}\t0\t3\t{command}\t{first}\t0\t0\t0\t{north}\t{east}\t0\t1')
    return '\n'.join(lines) + '\n'


def fence(command, corners):
    return [(command, len(corners), *corner) for corner in corners]


ROLE = '<ExtendedData><Data name="role"><value>keep_out</value></Data></ExtendedData>'
FILES = {
    'name.kml': kml(kml_polygon(FIELD, 'Field'), kml_polygon(POND, 'No-fly: pond')),
    'data.kml': kml(kml_polygon(FIELD, 'Field'), kml_polygon(POND, 'Pond', extra=ROLE)),
    'folder.kml': kml(
        kml_polygon(FIELD, 'Field'),
        f'<Folder><name>Keep-outs</name>{kml_polygon(POND, "Pond")}</Folder>',
    ),
    'field.gpx': gpx(track(closed(FIELD), 'Field'), track(closed(POND), 'keep out 1')),
    'field.plan': plan([zone(FIELD, True), zone(POND, False)]),
    'field.waypoints': waypoints(*fence(5001, FIELD), *fence(5002, POND)),
}


def environment(path, **values):
    return EnvironmentSettings.model_validate({'area': str(path), **values})


def written(folder, name, content):
    (folder / name).write_text(content)
    return folder / name


def refusal(path, **values):
    with pytest.raises(ValidationError) as caught:
        environment(path, **values)
    (error,) = caught.value.errors()
    assert '\n' not in error['msg'] and str(path) in error['msg']
    return error['msg']


@pytest.mark.parametrize('name', FILES)
def test_each_format_is_the_same_area_with_a_keep_out(tmp_path, name):
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        warnings.filterwarnings('ignore', r'.*field\.waypoints: .*: home position not used')
        made = environment(written(tmp_path, name, FILES[name]))
    assert made.area.area == pytest.approx(SIZES['area'], rel=1e-3)
    assert made.keep_outs[0].polygon.area == pytest.approx(SIZES['keep_out'], rel=1e-3)
    assert made.origin.latitude == pytest.approx(46.6) and made.origin.longitude == (
        pytest.approx(9.9)
    )


def test_an_archive_and_a_bare_polygon_are_an_area(tmp_path):
    with zipfile.ZipFile(tmp_path / 'field.kmz', 'w') as archive:
        # As GDAL writes it: a list of links to its own files.
        link = '<NetworkLink><Link><href>layers/1.kml</href></Link></NetworkLink>'
        archive.writestr('doc.kml', kml(link))
        archive.writestr('layers/1.kml', FILES['name.kml'])
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        assert len(environment(tmp_path / 'field.kmz').keep_outs) == 1
    rows = [f'{north} {east}' for north, east in closed(FIELD)]
    text = '\n'.join(['#saved by Mission Planner 1.3.80', *rows])
    file = written(tmp_path, 'field.poly', text)
    made = environment(file)
    assert made.area.area == pytest.approx(SIZES['area'], rel=1e-3)
    # Without a role it is also a keep-out, where that is asked for.
    (kept,) = environment(file, keep_outs=[str(file)]).keep_outs
    assert kept.polygon.equals(made.area)


def test_holes_weights_and_parts_of_kml_are_read(tmp_path):
    weight = '<ExtendedData><SchemaData><SimpleData name="weight">5</SimpleData></SchemaData>'
    east = [(north, lon + 0.005) for north, lon in FIELD]
    both = kml_polygon(FIELD, 'Field', POND).replace('<Polygon>', '<MultiGeometry><Polygon>')
    more = kml_polygon(east, '').partition('</name>')[2].replace('</Polygon>', '')
    both = both.replace('</Polygon>', f'</Polygon>{more}</Polygon></MultiGeometry>', 1)
    both = both.replace('</Placemark></Polygon></MultiGeometry>', '</Polygon></MultiGeometry>')
    text = kml(both, kml_polygon(POND, 'prior bank', extra=f'{weight}</ExtendedData>'))
    made = environment(written(tmp_path, 'field.kml', text))
    assert made.area.area == pytest.approx(2 * SIZES['area'] - SIZES['keep_out'], rel=1e-3)
    assert made.prior.polygons[0].weight == 5.0


def test_circles_of_a_fence_stay_inside_or_around(tmp_path):
    circle = {'center': [46.6, 9.9], 'radius': 100.0}
    small = {'center': [46.6, 9.9], 'radius': 10.0}
    rows = [{'circle': circle, 'inclusion': True}, {'circle': small, 'inclusion': False}]
    texts = {
        'a.plan': plan(circles=rows),
        'a.waypoints': waypoints((5003, 100, 46.6, 9.9), (5004, 10, 46.6, 9.9)),
    }
    for name, text in texts.items():
        made = environment(written(tmp_path, name, text))
        corners = np.array(made.area.exterior.coords)
        assert np.linalg.norm(corners, axis=1) == pytest.approx(100.0, abs=0.01)
        gap = made.keep_outs[0].polygon.exterior.distance(made.keep_outs[0].polygon.centroid)
        assert gap == pytest.approx(10.0, abs=0.01)


def test_points_named_by_a_role_are_starts_and_chargers(tmp_path):
    point = (
        '<Placemark><name>{}</name><Point><coordinates>9.9,46.6</coordinates></Point></Placemark>'
    )
    names = ('start scout', 'Charger 2', 'car park')
    way = ''.join(f'<wpt lat="46.6" lon="9.9"><name>{name}</name></wpt>' for name in names)
    texts = {
        'a.kml': kml(kml_polygon(FIELD, 'Field'), *map(point.format, names)),
        'a.gpx': gpx(way, track(closed(FIELD), 'Field')),
    }
    for name, text in texts.items():
        file = str(written(tmp_path, name, text))
        wanted = [('start', 'scout', [9.9, 46.6]), ('charger', '', [9.9, 46.6])]
        assert points_of(file) == wanted
        with pytest.warns(InputWarning, match=r'car park.*: point without a role'):
            features_of(file)


@pytest.mark.parametrize(
    'name, text, words',
    [
        ('a.gpx', gpx(track(FIELD, 'walk')), 'trk 1 in line 2 (walk): open track, ends 200 m from'),
        ('a.gpx', gpx('<wpt lat="1" lon="2"/>'), 'wpt 1 in line 2: point without a role'),
        ('a.gpx', gpx('<wpt lat="95" lon="2"/>'), 'wpt in line 2: latitude: read 95, allowed'),
        ('a.gpx', kml(), 'line 2: read <kml>, allowed is <gpx>'),
        ('a.kml', kml('<NetworkLink/>' * 2), '2 <NetworkLink>: not read'),
        (
            'a.kml',
            kml('<Placemark><name>P</name></Placemark>'),
            'Placemark 1 in line 4 (P): no geo',
        ),
        ('a.kml', FILES['name.kml'].replace('9.8987,', 'x,'), 'Placemark 1 in line 4: coordinates'),
        ('a.kml', FILES['name.kml'].replace('outerB', 'B'), 'Placemark 1 in line 4: read 0 outer'),
        ('a.kml', FILES['name.kml'][:-9], 'line 6: is not XML'),
        ('a.kml', f'<!DOCTYPE kml [<!ENTITY a "b">]>{kml()[38:]}', 'line 1: read DOCTYPE'),
        ('a.kmz', 'PK', 'is not a KMZ archive'),
        ('a.plan', '{"fileType": "Parameters"}', 'fileType: read Parameters, allowed is Plan'),
        ('a.plan', '{', 'is not JSON in line 1'),
        ('a.plan', plan(mission={'items': [1, 2]}), 'mission.items: 2 items not read'),
        ('a.plan', plan([{'polygon': []}]), 'geoFence.polygons[0]: read'),
        ('a.plan', plan([zone([(1, 'x')], True)]), 'geoFence.polygons[0]: longitude: read x'),
        (
            'a.plan',
            plan(circles=[{'circle': {'center': [1, 2], 'radius': -3}, 'inclusion': True}]),
            'geoFence.circles[0]: radius: read -3, allowed is a number from 0.001',
        ),
        ('a.plan', plan([zone(POND, False)]), 'no polygon has the role area'),
        ('a.poly', '#\n46.1 9.2 7\n', 'line 2: read 46.1 9.2 7, allowed are latitude and long'),
        ('a.poly', '46.1 9.2\n', 'rings of at least 3 positions'),
        ('a.waypoints', '46.1 9.2\n', 'line 1: read 46.1 9.2, allowed is QGC WPL 110'),
        ('a.waypoints', waypoints((16, 0, 1, 2)), '1 item with command 16: not read'),
        ('a.waypoints', waypoints(*fence(5001, FIELD)[:3]), 'line 5: ends after 3 of 4 vertices'),
        (
            'a.waypoints',
            waypoints(*fence(5001, FIELD)[:3], (16, 0, 1, 2)),
            'line 6: read command 16, allowed is 5001',
        ),
    ],
)
def test_what_cannot_be_an_area_is_refused_by_element(tmp_path, name, text, words):
    assert words in refusal(written(tmp_path, name, text))


def test_nothing_is_left_out_without_a_warning(tmp_path):
    link = '<Placemark><name>trail</name><LineString><coordinates>1,2</coordinates></LineString>'
    text = kml(kml_polygon(FIELD, 'Field'), f'{link}</Placemark>', '<GroundOverlay/>')
    with pytest.warns(InputWarning) as told:
        environment(written(tmp_path, 'a.kml', text))
    (words,) = {str(item.message) for item in told}
    assert 'Placemark 2 in line 5 (trail): LineString; 1 <GroundOverlay>: not read' in words


def test_archives_and_files_without_end_are_refused(tmp_path):
    with zipfile.ZipFile(tmp_path / 'big.kmz', 'w', zipfile.ZIP_DEFLATED) as archive:
        archive.writestr('doc.kml', ' ' * 30_000_000)
    assert 'its .kml are too large, allowed are 20 MB' in refusal(tmp_path / 'big.kmz')
    with zipfile.ZipFile(tmp_path / 'none.kmz', 'w') as archive:
        archive.writestr('picture.png', '')
    assert 'there is no .kml in it' in refusal(tmp_path / 'none.kmz')
    for name in ('big.poly', 'big.geojson'):
        written(tmp_path, name, '1 2\n' * 6_000_000)
        assert f'{name}: is too large, allowed are 20 MB' in refusal(tmp_path / name)
    assert 'No such file' in refusal(tmp_path / 'gone.gpx')
    with pytest.raises(ValidationError, match=r'read field\.dxf, .*\.kml.*ogr2ogr'):
        environment(tmp_path / 'field.dxf')


def test_an_upload_with_the_name_of_a_file_is_not_read(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    written(tmp_path, 'POLYGON ((.kml', FILES['name.kml'])
    with pytest.raises(ValidationError, match='allowed is text as POLYGON'):
        EnvironmentSettings.model_validate(
            {'bounds': [[0, 9]] * 2, 'keep_outs': ['POLYGON ((.kml']}
        )


def archive_of(folder, content):
    with zipfile.ZipFile(folder / 'seed.zip', 'w', zipfile.ZIP_DEFLATED) as archive:
        archive.writestr('doc.kml', content)
    return (folder / 'seed.zip').read_bytes()


@settings(max_examples=300, deadline=None)
@given(seed=st.integers(0, 2**32), noise=st.binary(max_size=300), kind=st.sampled_from([*READERS]))
def test_damaged_files_raise_nothing_but_the_error_of_the_reader(
    tmp_path_factory, seed, noise, kind
):
    folder, draw = tmp_path_factory.getbasetemp(), random.Random(seed)
    whole = {f'.{name.rpartition(".")[2]}': text.encode() for name, text in FILES.items()}
    whole['.kmz'] = archive_of(folder, FILES['data.kml'])
    whole['.poly'] = b'#saved\n46.1 9.1\n46.2 9.1\n46.1 9.2\n'
    data = bytearray(draw.choice([noise, whole[kind], whole[kind], draw.choice([*whole.values()])]))
    for _ in range(draw.randrange(6)):
        at, end = sorted(draw.randrange(len(data) + 1) for _ in range(2))
        part = data[at : min(end, at + 30)]
        data[at : at + len(part)] = draw.choice(
            [b'', part * 2, noise[:5], b'null', b'-1e999', b'[]', b'<', b'"x"', bytes([at % 256])]
        )
    file = folder / f'damaged{kind}'
    file.write_bytes(data)
    with warnings.catch_warnings():
        warnings.simplefilter('ignore', InputWarning)
        for read in (features_of, points_of):
            try:
                read(str(file))
            except ValueError as error:
                assert str(error).startswith(str(file))


def test_a_fence_of_pymavlink_is_an_area(tmp_path):
    mavwp = pytest.importorskip('pymavlink.mavwp')
    from pymavlink.dialects.v20 import ardupilotmega

    loader = mavwp.MAVWPLoader()
    for command, corners in ((5001, FIELD), (5002, POND)):
        for place in corners:
            values = (0, 0, 0, 3, command, 0, 1, len(corners), 0, 0, 0, *place, 0)
            loader.add(ardupilotmega.MAVLink_mission_item_message(*values))
    loader.save(str(tmp_path / 'fence.waypoints'))
    made = environment(tmp_path / 'fence.waypoints')
    assert made.area.area == pytest.approx(SIZES['area'], rel=1e-3) and len(made.keep_outs) == 1


def test_a_home_position_is_named_as_not_used(tmp_path):
    home = {'items': [], 'plannedHomePosition': [46.6, 9.9, 1700.0]}
    path = written(tmp_path, 'home.plan', plan([zone(FIELD, True)], mission=home))
    with pytest.warns(InputWarning, match=r'mission\.plannedHomePosition: home position not used'):
        environment(path)
    path = written(tmp_path, 'home.waypoints', waypoints(*fence(5001, FIELD)))
    with pytest.warns(InputWarning, match='line 2: home position not used, give each robot'):
        environment(path)
    # What ground stations write without a home position.
    nothing = waypoints(*fence(5001, FIELD)).replace('46.6\t9.9\t1700', '0.0\t-0.000000\t0')
    none = plan([zone(FIELD, True)], mission={'plannedHomePosition': [0, 0, 0]})
    for name, text in (('none.waypoints', nothing), ('none.plan', none)):
        with warnings.catch_warnings():
            warnings.simplefilter('error')
            environment(written(tmp_path, name, text))
