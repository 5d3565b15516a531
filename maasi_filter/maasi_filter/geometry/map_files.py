"""Reads files of map programs and ground stations as features of GeoJSON.

KML, KMZ, GPX, QGroundControl `.plan`, Mission Planner `.poly` and `.waypoints`.
"""

from __future__ import annotations

import codecs
import io
import json
import lzma
import math
import re
import struct
import zipfile
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

import numpy as np
import shapely
from shapely.geometry import Polygon

from maasi_filter.geometry.geodesy import OriginSettings, continued, geodetic
from maasi_filter.geometry.polygons import short
from maasi_filter.wording import counted

Row = dict[str, Any]
LABEL = 'maasi:label'  # member of a feature: the element it was read from, for messages

MOST_BYTES = 20_000_000  # of a file, and of the KML in a KMZ
MOST_ELEMENTS = 1_000_000  # of XML
_CORNERS = 64  # of the polygon of a circle
_GAP = 0.05  # most between the ends of a closed track, relative to its length
_LOOPS = 0.05  # most of a track's area in small loops where it crosses itself
_DEGREE = 111_195.0  # of latitude [m]
# Beginnings of names, and of names of KML folders, that are a role.
_POLYGON_WORDS = {'keep_out': r'keep[-_ ]?outs?|no[-_ ]?(?:fly|go)', 'prior': 'prior'}
_POINT_WORDS = {'start': 'starts?', 'home': 'home', 'charger': 'chargers?'}
_KML_SHAPES = ('Polygon', 'LinearRing', 'LineString', 'Point', 'Model', 'Track', 'MultiTrack')
# The encoding in the declaration of XML, and those of texts.
_DECLARED = re.compile(rb'\s*<\?xml[^>]*\sencoding\s*=\s*["\']([\w.:-]+)')
_ENCODINGS = re.compile(r'(utf|iso|latin|windows|cp|koi8|mac|gb|big5|shift|euc)[\w-]*$')
_RING = '%sBoundaryIs/LinearRing'
_KML_OTHERS = ('NetworkLink', 'GroundOverlay', 'ScreenOverlay', 'PhotoOverlay', 'Tour')
# Fence commands of MAVLink.
_VERTICES = {5001: True, 5002: False}
_CIRCLES = {5003: True, 5004: False}
# What zipfile raises for archives that are broken, encrypted (RuntimeError), or compressed by a
# method that it does not support (NotImplementedError).
_ZIP_ERRORS = (
    *(zipfile.BadZipFile, zlib.error, lzma.LZMAError, struct.error, EOFError, OSError),
    *(NotImplementedError, RuntimeError, ValueError, LookupError),
)


def read_map_file(path: str) -> Row:
    """Return a file as a GeoJSON feature collection; ValueError names the wrong element."""
    try:
        rows = [*READERS[Path(path).suffix.lower()](read_bytes(path))]
    except OSError as error:
        raise ValueError(f'{path}: {error.strerror}') from None
    except ValueError as error:
        raise ValueError(f'{path}: {error}') from None
    return {'type': 'FeatureCollection', 'features': rows}


def encoding_of(data: bytes) -> str:
    """Return the encoding of text as its byte order mark says, or else UTF-8."""
    marks = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
    return 'utf-16' if data.startswith(marks) else 'utf-8-sig'


def text_of(data: bytes) -> str:
    """Return text as its byte order mark says, or in UTF-8; UnicodeError if it is not."""
    return data.decode(encoding_of(data))


def read_bytes(path: str) -> bytes:
    """Return the content of a file; ValueError if it is too large."""
    with Path(path).open('rb') as file:
        data = file.read(MOST_BYTES + 1)
    if len(data) > MOST_BYTES:
        raise ValueError(f'is too large, allowed are {MOST_BYTES // 1_000_000} MB')
    return data


def feature_row(label: str, shape: str, coordinates: Any = None, **properties: Any) -> Row:
    """Return a feature; a shape that is not of GeoJSON is the text of a warning."""
    known = {key: value for key, value in properties.items() if value not in (None, '')}
    geometry = {'type': shape, 'coordinates': coordinates}
    return {'type': 'Feature', LABEL: label, 'geometry': geometry, 'properties': known}


def _role(words: Mapping[str, str], texts: Iterable[str]) -> tuple[str, str]:
    """Return the role at the beginning of the first text with one, and the rest of that text."""
    for text in texts:
        for role, word in words.items():
            if found := re.match(rf'\s*(?:{word})(?![a-z])[\W_]*', text, re.IGNORECASE):
                return role, text[found.end() :].strip()
    return '', ''


def polygon_role(texts: Iterable[str]) -> str:
    """Return the role at the beginning of the first of some names, or ''."""
    return _role(_POLYGON_WORDS, texts)[0]


def point_row(label: str, position: Any, name: str, texts: Sequence[str], facts: Row) -> Row:
    """Return the feature of a point; its role is in its facts, or in the texts."""
    role, rest = _role(_POINT_WORDS, texts)
    role, robot = facts.get('role') or role, facts.get('robot')
    if role not in _POINT_WORDS:
        what = f'point without a role, allowed at the start of its name: {", ".join(_POINT_WORDS)}'
        return feature_row(label, what, name=name)
    if role == 'start' and not robot:
        robot = rest or name
    return feature_row(label, 'Point', position, name=name, role=role, robot=robot)


def polygons_row(
    label: str, polygons: Sequence[Any], name: str, texts: Sequence[str], facts: Row
) -> Row:
    """Return the feature of polygons; their role is in its facts, or in the texts."""
    role = facts.get('role') or polygon_role(texts)
    weight = facts.get('weight')
    return feature_row(label, 'MultiPolygon', polygons, name=name, role=role, weight=weight)


# ----------------------------------------------------------------------------- XML


def _xml(data: bytes, root: str) -> Element:
    """Return the root of XML: tags without namespaces, each with its `line`."""
    # Without namespaces, as files often use prefixes that they do not declare.
    builder, parser, count = TreeBuilder(), expat.ParserCreate(), 0

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal count
        count += 1
        if count > MOST_ELEMENTS:
            raise ValueError(f'has too many elements, allowed are {MOST_ELEMENTS:,}')
        line = str(parser.CurrentLineNumber)
        builder.start(tag.rpartition(':')[2], {**attributes, 'line': line})

    def refuse(*_: Any) -> None:
        line = parser.CurrentLineNumber
        raise ValueError(f'line {line}: read DOCTYPE, allowed is XML without one')

    parser.StartElementHandler, parser.StartDoctypeDeclHandler = start, refuse
    parser.EndElementHandler = lambda tag: builder.end(tag.rpartition(':')[2])
    parser.CharacterDataHandler = builder.data
    try:
        parser.Parse(_xml_text(data), True)
    except expat.ExpatError as error:
        reason = expat.ErrorString(error.code)
        raise ValueError(f'line {error.lineno}: is not XML: {reason}') from None
    found = builder.close()
    if found.tag != root:
        line = found.get('line')
        raise ValueError(f'line {line}: read <{short(found.tag)}>, allowed is <{root}>')
    return found


def _xml_text(data: bytes) -> str:
    """Return XML by its byte order mark, or in the encoding that it declares."""
    declared = _DECLARED.match(data)
    name = declared[1].decode().lower() if declared else 'utf-8'
    # A declaration that is read byte by byte is not in UTF-16.
    known = name if _ENCODINGS.match(name) and not name.startswith('utf') else 'utf-8'
    try:
        return text_of(data) if known == 'utf-8' else data.decode(known)
    except (UnicodeError, LookupError):
        raise ValueError(f'line 1: is not text in {short(name)}, allowed is UTF-8') from None


def _text(element: Element, path: str) -> str:
    return (element.findtext(path) or '').strip()


def _kml(data: bytes, archive: Sequence[str] = ()) -> Iterator[Row]:
    """Yield the features of KML; links into its own archive are not warned of."""
    root = _xml(data, 'kml')
    parents = {child: parent for parent in root.iter() for child in parent}
    for number, mark in enumerate(root.iter('Placemark'), 1):
        label, name = f'Placemark {number} in line {mark.get("line")}', _text(mark, 'name')
        facts = {str(item.get('name')): _text(item, 'value') for item in mark.iter('Data')}
        for item in mark.iter('SimpleData'):
            facts[str(item.get('name'))] = (item.text or '').strip()
        texts, above = [name], mark
        while (above := parents.get(above)) is not None:  # type: ignore[assignment]
            texts.append(_text(above, 'name') if above.tag == 'Folder' else '')
        shapes = [item for item in mark.iter() if item.tag in _KML_SHAPES]
        # A ring of a polygon belongs to it.
        shapes = [item for item in shapes if not parents[item].tag.endswith('BoundaryIs')]
        polygons = []
        for shape in shapes:
            if shape.tag in ('Polygon', 'LinearRing'):
                outer = [shape] if shape.tag == 'LinearRing' else shape.findall(_RING % 'outer')
                if len(outer) != 1:
                    read = f'{len(outer)} outer boundaries'
                    raise ValueError(f'{label}: read {read}, allowed is one in each polygon')
                rings = [*outer, *shape.findall(_RING % 'inner')]
                polygons.append([_kml_positions(ring, label) for ring in rings])
            elif shape.tag == 'Point':
                (position, *_) = _kml_positions(shape, label) or [None]
                yield point_row(label, position, name, texts, facts)
            else:
                yield feature_row(label, shape.tag, name=name)
        if polygons:
            yield polygons_row(label, polygons, name, texts, facts)
        if not shapes:
            yield feature_row(label, 'no geometry', name=name)
    others = [item for item in root.iter() if item.tag in _KML_OTHERS]
    others = [item for item in others if _text(item, 'Link/href') not in archive]
    for kind, count in Counter(item.tag for item in others).items():
        yield feature_row(f'{count} <{kind}>', 'not read')


def _kml_positions(shape: Element, label: str) -> list[Any]:
    positions = []
    for word in _text(shape, 'coordinates').split():
        try:
            east, north = map(float, word.split(',')[:2])
        except ValueError:
            raise ValueError(
                f'{label}: coordinates: read {short(word)}, allowed is longitude,latitude,altitude'
            ) from None
        positions.append([east, north])
    return positions


def _kmz(data: bytes) -> Iterator[Row]:
    files, left = {}, MOST_BYTES
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            for name in archive.namelist():
                # macOS adds its own data by the name of each file.
                if name.lower().endswith('.kml') and not name.startswith('__MACOSX/'):
                    with archive.open(name) as file:
                        files[name] = file.read(left + 1)
                    left -= len(files[name])
    except _ZIP_ERRORS as error:
        raise ValueError(f'is not a KMZ archive: {short(str(error))}') from None
    if left < 0:
        raise ValueError(f'its .kml are too large, allowed are {MOST_BYTES // 1_000_000} MB')
    if not files:
        raise ValueError('there is no .kml in it')
    for name, inner in files.items():
        try:
            yield from _kml(inner, [*files])
        except ValueError as error:
            raise ValueError(f'{short(name)}: {error}') from None


def _gpx(data: bytes) -> Iterator[Row]:
    root, counts = _xml(data, 'gpx'), Counter[str]()
    for item in root:
        counts[item.tag] += 1
        label = f'{item.tag} {counts[item.tag]} in line {item.get("line")}'
        name = _text(item, 'name')
        if item.tag == 'wpt':
            yield point_row(label, _gpx_position(item, label), name, [name], {})
        for line in [item] if item.tag == 'rte' else item.findall('trkseg'):
            points = [*line.findall('rtept'), *line.findall('trkpt')]
            ring = [_gpx_position(point, label) for point in points]
            if not ring:
                continue
            gap, length = _gap(ring)
            if len({*map(tuple, ring)}) < 3:
                few = f'{counted(len(ring), "point")}, allowed are 3 at different positions'
                yield feature_row(label, few, name=name)
            elif gap <= _GAP * length:
                role = polygon_role([name])
                ring, loops = _uncrossed(ring) if item.tag == 'trk' else (ring, '')
                yield feature_row(label, 'Polygon', [ring], name=name, role=role)
                if loops:
                    yield feature_row(label, loops, name=name)
            else:
                what = 'track' if item.tag == 'trk' else 'route'
                yield feature_row(
                    label,
                    f'open {what}, ends {gap:.0f} m from its start, allowed are '
                    f'{100.0 * _GAP:.0f} % of its length ({_GAP * length:.0f} m)',
                    name=name,
                )


def _gpx_position(point: Element, label: str) -> list[float]:
    where = f'{label}: {point.tag} in line {point.get("line")}'
    return _flipped([point.get('lat'), point.get('lon')], where)


def _uncrossed(ring: list[list[float]]) -> tuple[list[list[float]], str]:
    """Return a recorded track without small loops where it crosses itself, and what is left out."""
    degrees = np.array(ring)
    whole = Polygon(np.column_stack([continued(degrees[:, 0]), degrees[:, 1]]))
    if whole.is_valid:
        return ring, ''
    parts = sorted(shapely.get_parts(shapely.make_valid(whole)), key=lambda part: -part.area)
    share = sum(part.area for part in parts[1:]) / max(parts[0].area, 1e-300)
    if not isinstance(parts[0], Polygon) or share > _LOOPS:
        return ring, ''
    text = f'loops where it crosses itself, {100.0 * share:.2f} % of its area'
    return [list(position) for position in parts[0].exterior.coords], text


def _gap(ring: Sequence[Sequence[float]]) -> tuple[float, float]:
    """Return the distance between the ends of a track, and its length [m]."""
    degrees = np.array(ring)
    degrees[:, 0] = continued(degrees[:, 0])
    metres = _DEGREE * degrees * [math.cos(math.radians(degrees[0, 1])), 1.0]
    length = np.linalg.norm(np.diff(metres, axis=0), axis=1).sum()
    return float(np.linalg.norm(metres[-1] - metres[0])), float(length)


# ------------------------------------------------------------------ Ground stations


def _number(value: Any, where: str, most: float, least: float | None = None) -> float:
    least = -most if least is None else least
    try:
        number = math.nan if isinstance(value, bool) else float(value)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not least <= number <= most:
        raise ValueError(
            f'{where}: read {short(value)}, allowed is a number from {least:g} to {most:g}'
        )
    return number


def _flipped(value: Any, where: str) -> list[float]:
    """Return longitude and latitude of latitude and longitude."""
    if not isinstance(value, (list, tuple)) or len(value) < 2:
        raise ValueError(f'{where}: read {short(value)}, allowed are latitude and longitude')
    north = _number(value[0], f'{where}: latitude', 90.0)
    return [_number(value[1], f'{where}: longitude', 360.0), north]


def _zone(label: str, rings: Any, inclusion: bool) -> Row:
    return feature_row(label, 'Polygon', rings, role='area' if inclusion else 'keep_out')


def _circle(label: str, centre: Any, radius: Any, inclusion: bool) -> Row:
    """Return a polygon inside of a circle that is included, around one that is excluded."""
    east, north = _flipped(centre, f'{label}: center')
    size = _number(radius, f'{label}: radius', 1e6, 1e-3)
    size /= 1.0 if inclusion else math.cos(math.pi / _CORNERS)
    angles = 2.0 * math.pi / _CORNERS * np.arange(_CORNERS)
    origin = OriginSettings(latitude=north, longitude=(east + 180.0) % 360.0 - 180.0)
    ring = geodetic(size * np.stack([np.cos(angles), np.sin(angles)], axis=1), origin)
    return _zone(label, [ring[:, 1::-1].tolist()], inclusion)


def _plan(data: bytes) -> Iterator[Row]:
    try:
        plan = json.loads(text_of(data))
    except UnicodeError:
        raise ValueError('is not UTF-8 text') from None
    except (ValueError, RecursionError) as error:
        line = f' in line {error.lineno}' if isinstance(error, json.JSONDecodeError) else ''
        raise ValueError(f'is not JSON{line}') from None
    if not isinstance(plan, Mapping) or plan.get('fileType') != 'Plan':
        read = plan.get('fileType') if isinstance(plan, Mapping) else plan
        raise ValueError(f'fileType: read {short(read)}, allowed is Plan')
    fence = _part(plan, 'geoFence', dict)
    if fence and fence.get('version') != 2:
        raise ValueError(f'geoFence.version: read {short(fence.get("version"))}, allowed is 2')
    for kind in ('polygons', 'circles'):
        for index, item in enumerate(_part(fence, kind, list, 'geoFence.')):
            label = f'geoFence.{kind}[{index}]'
            if not isinstance(item, Mapping) or not isinstance(item.get('inclusion'), bool):
                raise ValueError(f'{label}: read {short(item)}, allowed is a zone with inclusion')
            inclusion = item['inclusion']
            if kind == 'polygons':
                ring = _part(item, 'polygon', list, f'{label}.')
                yield _zone(label, [[_flipped(corner, label) for corner in ring]], inclusion)
            else:
                circle = _part(item, 'circle', dict, f'{label}.')
                yield _circle(label, circle.get('center'), circle.get('radius'), inclusion)
    mission = _part(plan, 'mission', dict)
    home = mission.get('plannedHomePosition')
    if isinstance(home, list) and any(home):
        yield _home('mission.plannedHomePosition')
    others = {'mission.items': _part(mission, 'items', list, 'mission.')}
    others['rallyPoints.points'] = _part(_part(plan, 'rallyPoints', dict), 'points', list)
    for label, items in others.items():
        if items:
            yield feature_row(label, f'{counted(len(items), "item")} not read, {_FENCE}')


def _home(label: str) -> Row:
    return feature_row(label, 'home position not used, give each robot its start')


def _part(data: Mapping[str, Any], key: str, kind: type, where: str = '') -> Any:
    value = data.get(key)
    if value is not None and not isinstance(value, kind):
        allowed = 'a list' if kind is list else 'an object'
        raise ValueError(f'{where}{key}: read {short(value)}, allowed is {allowed}')
    return value or kind()


def _lines(data: bytes) -> list[tuple[str, list[str]]]:
    """Return the name and the words of each line that is not empty or a comment."""
    try:
        rows = text_of(data).splitlines()
    except UnicodeError:
        raise ValueError('is not UTF-8 text') from None
    lines = [(f'line {number}', row.split()) for number, row in enumerate(rows, 1)]
    return [(label, words) for label, words in lines if words and words[0][0] != '#']


def _poly(data: bytes) -> Iterator[Row]:
    ring = []
    for label, words in _lines(data):
        if len(words) != 2:
            read = short(' '.join(words))
            raise ValueError(f'{label}: read {read}, allowed are latitude and longitude')
        ring.append(_flipped(words, label))
    yield feature_row('polygon', 'Polygon', [ring])


def _waypoints(data: bytes) -> Iterator[Row]:
    """Yield the fence of a file in MAVLink's text format."""
    lines = _lines(data)
    if not lines or lines[0][1][:2] != ['QGC', 'WPL']:
        read = short(' '.join(lines[0][1])) if lines else 'nothing'
        raise ValueError(f'line 1: read {read}, allowed is QGC WPL 110')
    ring: list[list[float]] = []
    begun, others = (0, 0), Counter[int]()  # command and vertices of an unfinished polygon
    for label, words in lines[1:]:
        if len(words) != 12:
            raise ValueError(f'{label}: read {len(words)} columns, allowed are 12')
        index, command = (
            int(_number(words[column], f'{label}: column {column + 1}', 65535.0, 0.0))
            for column in (0, 3)
        )
        if ring and command != begun[0]:
            raise ValueError(f'{label}: read command {command}, allowed is {begun[0]}: {_FEW}')
        if command in _VERTICES:
            count = int(_number(words[4], f'{label}: number of vertices', 65535.0, 3.0))
            if ring and count != begun[1]:
                raise ValueError(f'{label}: read {count} vertices, allowed are {begun[1]}: {_FEW}')
            begun = command, count
            ring.append(_flipped(words[8:10], label))
            if len(ring) == count:
                yield _zone(f'polygon up to {label}', [ring], _VERTICES[command])
                ring = []
        elif command in _CIRCLES:
            yield _circle(label, words[8:10], words[4], _CIRCLES[command])
        elif index or command != 16:
            others[command] += 1
        elif any(word.strip('-0.') for word in words[8:10]):
            yield _home(label)  # the first item
    if ring:
        raise ValueError(f'{lines[-1][0]}: ends after {len(ring)} of {begun[1]} vertices: {_FEW}')
    for command, number in others.items():
        yield feature_row(
            f'{counted(number, "item")} with command {command}', f'not read, {_FENCE}'
        )


_FEW = 'the polygon before is not complete'
_FENCE = 'draw zones as a fence'

#: By ending of the name.
READERS: dict[str, Callable[[bytes], Iterator[Row]]] = {
    '.kml': _kml,
    '.kmz': _kmz,
    '.gpx': _gpx,
    '.plan': _plan,
    '.poly': _poly,
    '.waypoints': _waypoints,
}
