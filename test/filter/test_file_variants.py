"""Variants of map files that programs write: encodings, prefixes, recorded tracks, many corners."""

import codecs
import json
import warnings
import zipfile

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st
from test_map_files import FIELD, FILES, SIZES, closed, environment, gpx, refusal, track

from maasi_filter.geometry.geojson import features_of
from maasi_filter.geometry.polygons import MOST_CORNERS, InputWarning, sound, with_few_corners

GEOJSON = json.dumps({'type': 'Polygon', 'coordinates': [[[x, y] for y, x in closed(FIELD)]]})
TEXTS = {
    **{f'a.{name.rpartition(".")[2]}': text for name, text in FILES.items()},
    'a.geojson': GEOJSON,
    'a.poly': '#saved\n' + ''.join(f'{north} {east}\n' for north, east in FIELD),
}


def written(folder, name, content):
    (folder / name).write_bytes(content)
    return folder / name


@pytest.mark.parametrize('lines', ['\n', '\r\n'])
@pytest.mark.parametrize('encoding', ['utf-8', 'utf-8-sig', 'utf-16', 'utf-16-be'])
@pytest.mark.parametrize('name', TEXTS)
def test_text_is_read_as_its_byte_order_mark_says(tmp_path, name, encoding, lines):
    mark = codecs.BOM_UTF16_BE if encoding == 'utf-16-be' else b''
    text = TEXTS[name].replace('\n', lines)
    path = written(tmp_path, name, mark + text.encode(encoding))
    with warnings.catch_warnings():
        warnings.simplefilter('ignore', InputWarning)
        assert environment(path).area.area == pytest.approx(SIZES['area'], rel=1e-3)


@pytest.mark.parametrize(
    'declared, used',
    [
        *[(name, name) for name in ('ISO-8859-1', 'windows-1252', 'Shift_JIS', 'gb2312', 'Big5')],
        *[('utf-16', 'utf-8'), ('UTF-8', 'utf-8'), ('us-ascii', 'utf-8')],
    ],
)
def test_xml_is_read_in_the_encoding_that_it_declares(tmp_path, declared, used):
    # Some programs declare UTF-16 and write UTF-8.
    text = FILES['name.kml'].replace('UTF-8', declared)
    made = environment(written(tmp_path, 'a.kml', text.encode(used)))
    assert made.area.area == pytest.approx(SIZES['area'], rel=1e-3) and len(made.keep_outs) == 1


@pytest.mark.parametrize('declared', ['utf-8', 'gb2312'])
def test_text_in_another_encoding_is_refused(tmp_path, declared):
    text = FILES['name.kml'].replace('UTF-8', declared).encode() + b'<!-- \xff\xff -->'
    assert f'line 1: is not text in {declared}, allowed is' in refusal(
        written(tmp_path, 'a.kml', text)
    )


def test_prefixes_need_no_declaration(tmp_path):
    text = FILES['name.kml'].replace('<Document>', '<Document><gx:Tour/>')
    with pytest.warns(InputWarning, match='1 <Tour>: not read'):
        made = environment(written(tmp_path, 'a.kml', text.encode()))
    assert made.area.area == pytest.approx(SIZES['area'], rel=1e-3)


def test_what_macos_adds_to_an_archive_is_ignored(tmp_path):
    with zipfile.ZipFile(tmp_path / 'a.kmz', 'w') as archive:
        archive.writestr('doc.kml', FILES['name.kml'])
        archive.writestr('__MACOSX/._doc.kml', b'\0\5\26\7Mac OS X')
    assert environment(tmp_path / 'a.kmz').area.area == pytest.approx(SIZES['area'], rel=1e-3)


@pytest.mark.parametrize('number, words', [(1, '1 point, allowed are 3'), (2, '2 points'), (0, '')])
def test_a_segment_of_a_few_points_is_left_out(tmp_path, number, words):
    text = gpx(track(closed(FIELD), 'Field'), track([FIELD[0]] * number, 'stop'))
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter('always')
        made = environment(written(tmp_path, 'a.gpx', text.encode()))
    assert made.area.area == pytest.approx(SIZES['area'], rel=1e-3)
    assert words in ''.join(str(item.message) for item in told) and bool(told) == bool(words)


@pytest.mark.parametrize('seed', range(5))
def test_a_walked_border_may_cross_itself_a_little(tmp_path, seed):
    """Receivers have errors of metres, and record them while they stand still."""
    generator, corners = np.random.default_rng(seed), np.array(FIELD)
    sides = [
        start + part * (end - start)
        for start, end in zip(corners, np.roll(corners, -1, axis=0))
        for part in [*[0.0] * 20, *np.linspace(0.0, 1.0, 40)]
    ]
    walked = np.array(sides) + 2e-5 * generator.standard_normal((len(sides), 2))
    text = gpx(track(closed(walked.tolist()), 'border'))
    with pytest.warns(InputWarning, match=r'\(border\): loops where it crosses itself, 0\.\d+ %'):
        made = environment(written(tmp_path, 'a.gpx', text.encode()))
    assert made.area.area == pytest.approx(SIZES['area'], rel=0.05)
    eight = [FIELD[0], FIELD[2], FIELD[1], FIELD[3]]
    assert 'self-intersection' in refusal(
        written(tmp_path, 'b.gpx', gpx(track(closed(eight), 'eight')).encode())
    )


def test_a_track_across_180_degrees_is_closed_or_open(tmp_path):
    """Its longitudes jump by 360 degrees, its length does not."""
    moved = [(north, (east + 170.1 + 180.0) % 360.0 - 180.0) for north, east in FIELD]
    assert min(east for _, east in moved) < 0.0 < max(east for _, east in moved)
    path = written(tmp_path, 'a.gpx', gpx(track(closed(moved), 'ring')).encode())
    with pytest.warns(InputWarning, match='across 180 degrees'):
        assert environment(path).area.area == pytest.approx(SIZES['area'], rel=1e-3)
    # A small loop at a corner.
    loop = [(0.0, 0.0), (-1e-5, 1e-5), (-1e-5, -1e-5), (1e-5, 1e-5)]
    walked = [(moved[1][0] + a, moved[1][1] + b) for a, b in loop]
    path = written(
        tmp_path, 'b.gpx', gpx(track(closed([moved[0], *walked, *moved[2:]]), 'b')).encode()
    )
    with pytest.warns(InputWarning, match='loops where it crosses itself'):
        assert environment(path).area.area == pytest.approx(SIZES['area'], rel=1e-2)
    path = written(tmp_path, 'c.gpx', gpx(track(moved, 'walk')).encode())
    assert 'open track, ends 200 m from its start' in refusal(path)


DEGREES = st.floats(1e-4, 0.5)


@given(west=DEGREES, width=DEGREES, south=st.floats(-60.0, 60.0), height=DEGREES)
def test_any_uncut_polygon_across_180_degrees_is_read(west, width, south, height):
    east, north = -180.0 + width, south + height
    ring = [[180.0 - west, south], [east, south], [east, north], [180.0 - west, north]]
    with pytest.warns(InputWarning, match='across 180 degrees'):
        (feature,) = features_of({'type': 'Polygon', 'coordinates': [[*ring, ring[0]]]})
    assert feature.shape.area == pytest.approx((west + width) * height, rel=1e-6)


def jagged(corners, size=150.0, noise=0.05):
    angles = 2.0 * np.pi * np.arange(corners) / corners
    radii = size + noise * np.sin(7.3 * np.arange(corners))
    ring = radii[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return shapely.Polygon(ring)


def test_very_many_corners_are_read_as_fewer_with_a_warning():
    whole = sound(jagged(60_000), 'it')
    with pytest.warns(InputWarning, match=r'area: has 60,001 corners: read as [\d,]+, at most 0\.'):
        made = environment(str(whole)).area
    assert shapely.get_num_coordinates(made) <= MOST_CORNERS
    assert shapely.hausdorff_distance(made, whole) < 0.2
    few = jagged(MOST_CORNERS - 1)
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        assert with_few_corners(few, 'area') is few
