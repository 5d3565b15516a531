"""Statements of people during a search: checks, and what they say about a target's existence.

The equations are in `docs/filter.md`, section "Statements of people".
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import shapely
from pydantic import ValidationError
from shapely.geometry.base import BaseGeometry

from maasi_filter.arrays import FloatArray
from maasi_filter.geometry.area import Area, Sighting, how_far, level_shape
from maasi_filter.geometry.environment import EnvironmentSettings, Zone
from maasi_filter.geometry.geodesy import OriginSettings, to_map
from maasi_filter.geometry.geojson import check_degrees
from maasi_filter.geometry.polygons import is_wkt
from maasi_filter.geometry.readers import DEGREES, read_shape, shapes_of_texts
from maasi_filter.wording import number as shown
from maasi_filter.wording import problems

CONFIRMED, REJECTED, SIGHTING, SEARCHED = 'confirmed', 'rejected', 'sighting', 'searched'
#: Kinds by their number in messages.
KINDS = ('', CONFIRMED, REJECTED, SIGHTING, SEARCHED)
RELIABILITY = 0.95  # of a statement about a found target, if it is not given
MOST_RELIABLE = 0.999
#: Probability beforehand that something that answers like a target is none.
LOOKALIKE = 0.1
#: Probability of a target's existence below which a rejected one is withdrawn.
WITHDRAWN = 0.5
MOST_WEIGHT = 1000.0  # expected targets of one sighting
#: Least and largest weight by kind; 0 itself is not allowed.
LIMITS = {
    CONFIRMED: (0.5, MOST_RELIABLE),
    REJECTED: (0.5, MOST_RELIABLE),
    SIGHTING: (0.0, MOST_WEIGHT),
    SEARCHED: (0.0, 1.0),
}
MOST_REPORTS = 1000  # in one search
MOST_SOURCE = 100  # characters
CORNERS = 2000  # of a searched zone
GEOGRAPHIC = 'wgs84'  # frame of longitudes and latitudes [degrees]
_FARTHEST = 4e7  # coordinate of a corner [m]
# Largest probability of detection for potential targets, as for sensors.
MOST_PROBABLE = 0.98
_KEY = re.compile(r'keep_outs\W*0\W+')  # where errors of zones are found


@dataclass(frozen=True)
class Report:
    """A checked statement of a person.

    Parameters
    ----------
    kind : str
        `CONFIRMED`, `REJECTED`, `SIGHTING` or `SEARCHED`.
    weight : float
        Reliability of a review, expected targets of a sighting, or probability of detection.
    source : str
        Who states it.
    target : int
        Id of the found target of a review.
    position : list of float
        Of the target or sighting, or a point in the searched zone, metres.
    radius : float
        Of a sighting: two standard deviations, metres.
    zone : str
        Searched zone, well-known text or `x y radius`, metres.
    id : int
        Number from 1, in the order of use.
    time : float
        When the filter used it, seconds.
    batch : int
        Last batch that began before it.
    """

    kind: str
    weight: float
    source: str = ''
    target: int = 0
    position: list[float] = field(default_factory=list)
    radius: float = 0.0
    zone: str = ''
    id: int = 0
    time: float = 0.0
    batch: int = 0

    @property
    def shape(self) -> BaseGeometry:
        """Horizontal outline of the searched zone."""
        return level_shape(Zone.model_validate(self.zone))

    def check(self) -> None:
        """Raise ValueError if it cannot be used, as numbers and texts come from messages."""
        least, most = LIMITS[self.kind]
        if not (least <= self.weight <= most and self.weight > 0.0):
            above = f'numbers from {least:g}' if least else 'numbers above 0,'
            raise ValueError(f'weight: read {self.weight:g}, allowed are {above} to {most:g}')
        if self.kind == SIGHTING and not self.radius > 0.0:
            raise ValueError(f'radius: read {self.radius:g}, allowed are numbers above 0')
        if self.kind != SEARCHED:
            return
        try:
            usable = bool(np.isfinite(self.shape.area))
        except ValueError:
            usable = False
        if not usable:
            raise ValueError('zone: allowed are well-known text of polygons, or x y radius')

    def __str__(self) -> str:
        source = f' by {self.source}' if self.source else ''
        if self.kind == SEARCHED:
            size = how_much(self.shape.area)
            return f'{size} searched{source} with a probability of detection of {self.weight:g}'
        if self.kind == SIGHTING:
            at = ', '.join(f'{value:.3g}' for value in self.position[:2])
            source = f' of {self.source}' if self.source else ''
            return (
                f'sighting{source} at ({at}) m, radius {self.radius:g} m, '
                f'{self.weight:g} expected targets'
            )
        return f'target {self.target} {self.kind}{source} with reliability {self.weight:g}'


def how_much(area: float) -> str:
    """Return an area [m^2] as text."""
    return f'{shown(1e-4 * area)} ha' if area >= 1e4 else f'{shown(area)} m²'


def review(
    number: int, confirmed: bool, reliability: float, source: str, known: Sequence[int]
) -> Report:
    """Return a checked statement about one of the `known` targets; ValueError names a problem."""
    value = reliability or RELIABILITY
    if not 0.5 <= value <= MOST_RELIABLE:
        raise ValueError(
            f'reliability: read {reliability:g}, allowed are 0.5 to {MOST_RELIABLE:g}, or 0 for '
            f'{RELIABILITY:g}'
        )
    if number not in known:
        numbers = ', '.join(map(str, sorted(known))) or 'none, as no target is found yet'
        raise ValueError(f'id: read {number}, allowed are {numbers}')
    return Report(CONFIRMED if confirmed else REJECTED, value, _source(source), target=number)


def origin_of(
    frame: str, map_frame: str, environment: EnvironmentSettings
) -> OriginSettings | None:
    """Return the origin if positions are geographic, None if they are in the map.

    ValueError names another frame, or that there is no origin.
    """
    if frame.lower() == GEOGRAPHIC:
        if environment.origin is None:
            raise ValueError(f'frame_id: read {frame}, which needs environment.origin')
        return environment.origin
    if frame not in ('', map_frame):
        raise ValueError(
            f'frame_id: read {frame}, allowed are {map_frame} [m] and {GEOGRAPHIC} [degrees]'
        )
    return None


def position_on_map(
    longitude: float, latitude: float, origin: OriginSettings, field: str = 'position'
) -> tuple[float, float]:
    """Return a geographic position [degrees] in metres of the map; ValueError if it is none."""
    degrees = np.array([[longitude, latitude]])
    if not np.isfinite(degrees).all():
        raise ValueError(f'{field}: read ({longitude:g}, {latitude:g}), allowed are numbers')
    check_degrees(degrees, field)
    x, y = to_map(degrees, origin)[0].round(4).tolist()
    return x, y


def zone_on_map(zone: str, origin: OriginSettings) -> str:
    """Return a zone whose coordinates are longitude and latitude [degrees] as text for the map."""
    shape = _shape_of(zone)
    try:
        if isinstance(shape, str) and not is_wkt(shape):
            disc = Zone.model_validate(shape)
            longitude, latitude, *height = disc.centre or []
            x, y = position_on_map(longitude, latitude, origin, 'zone')
            return ' '.join(map(repr, [x, y, *height, disc.radius]))
        if not isinstance(shape, Mapping):
            shape = json.loads(shapely.to_geojson(read_shape(shape)))
        return str(read_shape(shape, origin))
    except ValueError as error:
        raise ValueError(f'zone: {_words(error).removeprefix("zone: ")}') from None


def sighting(
    position: Sequence[float], radius: float, weight: float, source: str, area: Area
) -> Report:
    """Return a checked sighting in an area; ValueError names a problem."""
    for axis, value in zip('xyz', position):
        if not abs(value) <= _FARTHEST:
            raise ValueError(
                f'position.{axis}: read {value:g}, allowed are numbers up to {_FARTHEST:g} m'
            )
    size = area.bounds[:2, 1] - area.bounds[:2, 0]
    most = 10.0 * float(np.hypot(*size))
    if not 0.0 < radius <= most:
        raise ValueError(f'radius: read {radius:g}, allowed are numbers above 0, to {most:.4g} m')
    x, y = map(float, position[:2])
    report = Report(SIGHTING, weight, _source(source), position=[x, y], radius=radius)
    report.check()
    if not area.inside(np.array([[x, y]]), bounded=False)[0] or area.outside_by([x, y]) > 0.0:
        gap = area.outside_by([x, y])
        where = f'{how_far(gap)} outside of the area' if gap > 0.0 else 'in a keep-out zone'
        hint = area.exchanged([x, y], gap)
        raise ValueError(f'position: read ({x:g}, {y:g}), which is {where}{hint}')
    return report


def searched(
    zone: str, probability: float, source: str, environment: EnvironmentSettings, area: Area
) -> Report:
    """Return a checked search by others in an area; ValueError names a problem."""
    if not 0.0 < probability <= 1.0:
        raise ValueError(
            f'detection_probability: read {probability:g}, allowed are numbers above 0, to 1'
        )
    shape = _shape_of(zone)
    try:
        values = {**dict(environment), 'keep_outs': [shape]}
        zones = EnvironmentSettings.model_validate(values).keep_outs
    except ValueError as error:
        raise ValueError(f'zone: {_words(error)}') from None
    if not zones:
        raise ValueError('zone: read nothing, allowed is a polygon or x y radius')
    if any((zone.radius or 0.0) > _FARTHEST for zone in zones):
        raise ValueError(f'zone: read a radius beyond {_FARTHEST:g} m')
    shape = shapely.union_all(list(map(level_shape, zones)))
    if not np.abs(shape.bounds).max() <= _FARTHEST:
        raise ValueError(f'zone: read coordinates beyond {_FARTHEST:g} m')
    west, south, east, north = shape.bounds
    if (length := max(east - west, north - south)) < DEGREES:
        raise ValueError(
            f'zone: is {length:.2g} m long in the map: are these degrees? Then set frame_id to '
            f'{GEOGRAPHIC}'
        )
    gap = float(area.border.distance(shape))
    if not shape.area > 0.0 or not area.border.intersection(shape).area > 0.0:
        centre = shapely.get_coordinates(shape.centroid)
        hint = area.exchanged(centre[0], gap) if len(centre) else ''
        raise ValueError(f'zone: lies {how_far(gap)} outside of the area{hint}')
    text = str(zones[0]) if len(zones) == 1 else str(shape)
    inner = area.border.intersection(shape).representative_point()
    return Report(SEARCHED, probability, _source(source), position=[inner.x, inner.y], zone=text)


def _shape_of(zone: str) -> Any:
    """Return the shape of a received text; ValueError if it is none."""
    corners = max(zone.count(','), len(zone) // 50)
    if corners > CORNERS:
        raise ValueError(f'zone: read about {corners} corners, allowed are {CORNERS}')
    try:
        return shapes_of_texts([zone])[0]
    except ValueError as error:
        raise ValueError(f'zone: {_words(error)}') from None


def _words(error: ValueError) -> str:
    """Return what is wrong with a zone, without the key of an environment."""
    text = problems(error) if isinstance(error, ValidationError) else str(error)
    return _KEY.sub('', text)


def _source(text: str) -> str:
    words = ' '.join(text.split())
    if len(words) > MOST_SOURCE:
        raise ValueError(f'source: read {len(words)} characters, allowed are {MOST_SOURCE}')
    return words


def log_odds(report: Report) -> float:
    """Return what a review adds to the log odds of a target's existence."""
    value = math.log(report.weight / (1.0 - report.weight))
    return value if report.kind == CONFIRMED else -value


def sighting_of(report: Report) -> Sighting:
    """Return the part of the prior that a sighting adds."""
    return Sighting(report.position[0], report.position[1], report.radius, report.weight)


def believed(existence: float, statements: float) -> float:
    """Return the probability of a target, given that of the sensors and the log odds of persons.

    Where rejections prevail, the sensors may see something that only looks like a target.
    """
    if statements == 0.0:
        return existence
    given = existence if statements > 0.0 else (1.0 - LOOKALIKE) * existence
    if given >= 1.0:
        return 1.0
    odds = given / (1.0 - given) * math.exp(statements)
    return odds / (1.0 + odds) if math.isfinite(odds) else 1.0


def seen_by_others(zone: BaseGeometry, probability: float, positions: FloatArray) -> FloatArray:
    """Return with which probability a search found a target at positions (n, d or more), (n,)."""
    shapely.prepare(zone)
    inside = shapely.contains_xy(zone, positions[:, 0], positions[:, 1])
    return np.where(inside, min(probability, MOST_PROBABLE), 0.0)
