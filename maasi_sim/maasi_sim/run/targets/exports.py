"""Results of a search for map programs, TAK and ground stations, without the true targets."""

from __future__ import annotations

import contextlib
import json
import math
import re
from collections.abc import Mapping, Sequence
from datetime import datetime, timedelta
from typing import Any
from xml.etree.ElementTree import Element, SubElement, indent, tostring

import cv2
import numpy as np

from maasi_filter.arrays import FloatArray
from maasi_filter.geometry.geodesy import OriginSettings, geodetic
from maasi_filter.unexplored_map import UnexploredMap
from maasi_filter.wording import number
from maasi_sim.run.targets.tables import cut_at_180

Row = dict[str, Any]
_TRUTH = ('target', 'error')
# Line and fill of a kind of feature: opacity, blue, green, red.
_COLOURS = {
    'explored': ('ff2e8b57', '402e8b57'),
    'area': ('ff00ffff', '00ffffff'),
    'keep_out': ('ff0000ff', '400000ff'),
    'obstacle': ('ff606060', '80606060'),
    'way': ('ffff8000', '00ffffff'),
}
_NAMES = {'explored': 'Searched ground', 'area': 'Search area', 'keep_out': 'Keep-out'}
_STALE = timedelta(days=1)  # until TAK greys a target out
_TURNED = 0.1  # rotation of a raster that is neglected, at its ends [pixels]
_UNKNOWN = '9999999.0'  # of errors, in Cursor on Target
# What XML cannot contain.
_INVALID = re.compile('[^\t\n\r\u0020-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]')


def map_files(
    name: str,
    found: Sequence[Row],
    searched: Sequence[Row],
    paths: Mapping[str, FloatArray],
    explored: UnexploredMap,
    origin: OriginSettings,
    written: datetime,
) -> dict[str, str | bytes]:
    """Return the files of a search by name.

    found: rows of `found_rows`; searched: features of GeoJSON; paths: start and waypoints of each
    robot (n, 3) [m]; written: now, in UTC.
    """
    found = [{key: value for key, value in row.items() if key not in _TRUTH} for row in found]
    zones = [*searched, *_bounds(searched, explored, origin)]
    plans = {f'{robot}.plan': plan_text(path, zones, origin) for robot, path in paths.items()}
    return {
        'search.kml': kml_text(name, found, cut_at_180(searched)),
        'found_targets.gpx': gpx_text(found),
        'found_targets.cot': cot_text(name, found, written),
        **probability_rasters(explored, origin),
        **{name: text for name, text in plans.items() if text},
    }


def _bounds(searched: Sequence[Row], explored: UnexploredMap, origin: OriginSettings) -> list[Row]:
    """Return the bounds as area of a search without one."""
    if any(feature['properties']['kind'] == 'area' for feature in searched):
        return []
    (west, east), (south, north) = explored.bounds[:2].tolist()
    corners = [[west, south], [east, south], [east, north], [west, north], [west, south]]
    ring = geodetic(np.array(corners), origin)[:, 1::-1].round(8).tolist()
    geometry = {'type': 'Polygon', 'coordinates': [ring]}
    return [{'type': 'Feature', 'geometry': geometry, 'properties': {'kind': 'area'}}]


def _add(parent: Element, tag: str, text: object = '', **attributes: object) -> Element:
    element = SubElement(parent, tag, {key: str(value) for key, value in attributes.items()})
    element.text = _INVALID.sub('?', str(text)) or None
    return element


def _xml(root: Element) -> str:
    indent(root)
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{tostring(root, "unicode")}\n'


def _title(row: Row) -> str:
    return f'Target {row["id"]}' + (f' {row["class_id"]}' if row['class_id'] else '')


def _words(row: Row) -> str:
    spread = math.sqrt(max(row['xx'], row['yy'], 0.0))
    tag = f', identity {row["identity"]}' if row['identity'] else ''
    return (
        f'Found by {row["agent"]} {row["time"]:.0f} s after the start, standard deviation '
        f'{number(spread)} m{tag}'
    )


def kml_text(name: str, found: Sequence[Row], searched: Sequence[Row]) -> str:
    """Return found targets and searched ground as KML, on the ground."""
    root = Element('kml', xmlns='http://www.opengis.net/kml/2.2')
    document = _add(root, 'Document')
    _add(document, 'name', name)
    for kind, (edge, fill) in _COLOURS.items():
        style = _add(document, 'Style', id=kind)
        _add(_add(style, 'LineStyle'), 'color', edge)
        _add(_add(style, 'PolyStyle'), 'color', fill)
    folder = _add(document, 'Folder')
    _add(folder, 'name', 'Found targets')
    for row in found:
        mark = _add(folder, 'Placemark')
        _add(mark, 'name', _title(row))
        _add(mark, 'description', _words(row))
        _add(_add(mark, 'Point'), 'coordinates', f'{row["longitude"]:.8f},{row["latitude"]:.8f}')
    folder = _add(document, 'Folder')
    _add(folder, 'name', 'Searched')
    for feature in searched:
        facts, geometry = feature['properties'], feature['geometry']
        kind, shape = facts['kind'], geometry['coordinates']
        mark = _add(folder, 'Placemark')
        title = f'Path of {facts["robot"]}' if kind == 'way' else _NAMES.get(kind, kind)
        _add(mark, 'name', title)
        _add(mark, 'styleUrl', f'#{kind}')
        if kind == 'way':
            line = _add(mark, 'LineString')
            _add(line, 'tessellate', 1)
            _add(line, 'coordinates', _coordinates(shape))
            continue
        several = _add(mark, 'MultiGeometry')
        for rings in _polygons(geometry):
            polygon = _add(several, 'Polygon')
            for side, ring in zip(('outer', *['inner'] * len(rings)), rings):
                line = _add(_add(polygon, f'{side}BoundaryIs'), 'LinearRing')
                _add(line, 'coordinates', _coordinates(ring))
    return _xml(root)


def _polygons(geometry: Mapping[str, Any]) -> Sequence[Any]:
    single = geometry['type'] == 'Polygon'
    found = [geometry['coordinates']] if single else geometry['coordinates']
    return [rings for rings in found if rings]


def _coordinates(positions: Sequence[Sequence[float]]) -> str:
    return ' '.join(f'{position[0]:.8f},{position[1]:.8f}' for position in positions)


def gpx_text(found: Sequence[Row]) -> str:
    """Return found targets as GPX waypoints."""
    root = Element('gpx', version='1.1', creator='MAASI', xmlns='http://www.topografix.com/GPX/1/1')
    for row in found:
        point = _add(root, 'wpt', lat=f'{row["latitude"]:.8f}', lon=f'{row["longitude"]:.8f}')
        _add(point, 'name', _title(row))
        _add(point, 'desc', _words(row))
    return _xml(root)


def cot_text(name: str, found: Sequence[Row], written: datetime) -> str:
    """Return found targets as Cursor-on-Target events; errors are one standard deviation."""
    root = Element('events')
    root.extend(cot_event(name, row, written) for row in found)
    return _xml(root)


def cot_message(event: Element) -> bytes:
    """Return an event as the content of a datagram."""
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{tostring(event, "unicode")}'.encode()


def cot_event(name: str, row: Row, written: datetime) -> Element:
    """Return the event of a found target."""
    event = _cot_event(f'maasi.{name}.{row["id"]}', 'b-m-p-s-m', 'm-f', written)
    covariance = np.array([[row['xx'], row['xy']], [row['xy'], row['yy']]])
    worst = np.linalg.eigvalsh(covariance)[-1] if np.isfinite(covariance).all() else math.nan
    _add(
        event,
        'point',
        lat=f'{row["latitude"]:.8f}',
        lon=f'{row["longitude"]:.8f}',
        hae=f'{row["altitude"]:.3f}',
        ce=_deviation(worst),
        le=_deviation(row.get('zz', math.nan)),
    )
    detail = _add(event, 'detail')
    _add(detail, 'contact', callsign=_INVALID.sub('?', _title(row)))
    _add(detail, 'remarks', _words(row))
    return event


def _deviation(variance: float) -> str:
    return f'{math.sqrt(variance):.3f}' if 0.0 <= variance < math.inf else _UNKNOWN


def cot_removal(name: str, number: int, written: datetime) -> Element:
    """Return the event that removes a found target from the map."""
    uid = f'maasi.{name}.{number}'
    event = _cot_event(f'{uid}.removed', 't-x-d-d', 'm-g', written)
    _add(event, 'point', lat='0.0', lon='0.0', hae='0.0', ce=_UNKNOWN, le=_UNKNOWN)
    detail = _add(event, 'detail')
    _add(detail, 'link', uid=_INVALID.sub('?', uid), type='none', relation='none')
    _add(detail, '__forcedelete')
    return event


def _cot_event(uid: str, kind: str, how: str, written: datetime) -> Element:
    now, stale = (f'{time:%Y-%m-%dT%H:%M:%S}Z' for time in (written, written + _STALE))
    times = {'time': now, 'start': now, 'stale': stale}
    facts = {'version': '2.0', 'uid': _INVALID.sub('?', uid), 'type': kind, **times, 'how': how}
    return Element('event', facts)


def plan_text(path: FloatArray, searched: Sequence[Row], origin: OriginSettings) -> str:
    """Return start and waypoints of a robot as a QGroundControl plan with its fence, or ''.

    Heights are relative to the start.
    """
    if len(path) < 2:
        return ''
    items = []
    fixes = geodetic(path, origin).round(8).tolist()
    for index, (latitude, longitude, altitude) in enumerate(fixes[1:], 1):
        height = round(altitude - fixes[0][2], 3)
        item = {'type': 'SimpleItem', 'command': 16, 'frame': 3, 'doJumpId': index}
        item |= {'autoContinue': True, 'Altitude': height, 'AltitudeMode': 1}
        item |= {'params': [0, 0, 0, None, latitude, longitude, height]}
        items.append({**item, 'AMSLAltAboveTerrain': None})
    fence = []
    for feature in searched:
        inclusion = feature['properties']['kind'] == 'area'
        if inclusion or feature['properties']['kind'] in ('keep_out', 'obstacle'):
            for outer, *holes in _polygons(feature['geometry']):
                for ring, inside in (
                    (outer, inclusion),
                    *((hole, not inclusion) for hole in holes),
                ):
                    corners = [[north, east] for east, north in ring[:-1]]
                    fence.append({'polygon': corners, 'inclusion': inside, 'version': 1})
    plan = {
        'fileType': 'Plan',
        'groundStation': 'MAASI',
        'version': 1,
        'mission': {
            'version': 2,
            'firmwareType': 12,
            'vehicleType': 2,
            'cruiseSpeed': 15,
            'hoverSpeed': 5,
            'globalPlanAltitudeMode': 1,
            'plannedHomePosition': fixes[0],
            'items': items,
        },
        'geoFence': {'version': 2, 'polygons': fence, 'circles': []},
        'rallyPoints': {'version': 2, 'points': []},
    }
    return json.dumps(plan, indent=1, allow_nan=False) + '\n'


def probability_rasters(explored: UnexploredMap, origin: OriginSettings) -> dict[str, str | bytes]:
    """Return where a target would have been found, as PNG with its world file and as GeoTIFF.

    In the PNG 255 is certain; where no target can be, it is transparent. In space it is the mean
    over the heights. Coordinates are degrees (WGS 84). GeoTIFF needs rasterio.
    """
    unseen = np.atleast_3d(explored.unseen())
    known = unseen >= 0.0
    sums = np.where(known, 1.0 - unseen, 0.0).sum(axis=2)
    # The first row is in the north.
    share = (sums / np.maximum(known.sum(axis=2), 1)).T[::-1]
    possible = known.any(axis=2).T[::-1]
    pixels = np.rint(255.0 * np.stack([share, share, share, possible], axis=2)).astype(np.uint8)
    # The plane that is closest to longitude and latitude of the pixels.
    x, y = explored.axes()[:2]
    column, row = np.meshgrid(np.arange(len(x)), np.arange(len(y)))
    positions = np.stack([x[column.ravel()], y[::-1][row.ravel()]], axis=1)
    degrees = geodetic(positions, origin)[:, 1::-1]
    # The raster continues beyond 180 degrees.
    degrees[:, 0] -= 360.0 * np.round((degrees[:, 0] - origin.longitude) / 360.0)
    factors = np.column_stack([column.ravel(), row.ravel(), np.ones(column.size)])
    plane = np.asarray(np.linalg.lstsq(factors, degrees, rcond=None)[0], dtype=float)
    # Many programs refuse rotated rasters; near the origin this one is rotated by rounding only.
    turned = np.abs([plane[0, 1] / plane[1, 1] * len(x), plane[1, 0] / plane[0, 0] * len(y)])
    if (turned < _TURNED).all():
        plane[0, 1] = plane[1, 0] = 0.0
    files: dict[str, str | bytes] = {
        'detection_probability.png': cv2.imencode('.png', pixels)[1].tobytes(),
        'detection_probability.pgw': ''.join(f'{value:.12f}\n' for value in plane.ravel()),
    }
    with contextlib.suppress(ImportError):
        files['detection_probability.tif'] = _geotiff(np.where(possible, share, -1.0), plane)
    return files


def _geotiff(values: FloatArray, plane: FloatArray) -> bytes:
    """Return values below 0 as no data; plane (3, 2): degrees of the centres of pixels."""
    import rasterio
    from rasterio.io import MemoryFile

    step, corner = plane[:2].T, plane[2] - 0.5 * plane[:2].sum(axis=0)
    transform = rasterio.Affine(*np.column_stack([step, corner]).ravel())
    facts = {'height': len(values), 'width': values.shape[1], 'count': 1, 'dtype': 'float32'}
    with MemoryFile() as memory:
        with memory.open(
            driver='GTiff', crs='EPSG:4326', transform=transform, nodata=-1.0, **facts
        ) as file:
            file.write(values.astype(np.float32), 1)
        return bytes(memory.read())
