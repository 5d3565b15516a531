"""Robot positions as latitude and longitude, or as points in the file of the area."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from pydantic import ValidationError

from maasi_filter.geometry.area import Area, how_far
from maasi_filter.geometry.environment import EnvironmentSettings
from maasi_filter.geometry.geodesy import OriginSettings, on_ground, to_map
from maasi_filter.geometry.geojson import is_geojson, points_of
from maasi_filter.geometry.polygons import InputWarning
from maasi_filter.wording import shown
from maasi_sim.scenario.layering import Layer, ScenarioError

_DEGREES = {'latitude': 90.0, 'longitude': 180.0}


def position_text(position: list[float], origin: OriginSettings | None) -> str:
    """Return a position [m, map] as text, with latitude and longitude if there is an origin."""
    text = f'({", ".join(f"{value + 0.0:.4g}" for value in position)}) m'
    if origin is None:
        return text
    latitude, longitude = on_ground(np.array([position[:2]]), origin)[0].tolist()
    return f'{text}, latitude {latitude:.6f}, longitude {longitude:.6f}'


def outside_text(position: list[float], area: Area) -> str:
    """Return how far a position is outside of an area, and whether x and y seem swapped."""
    gap = area.outside_by(position)
    exchanged = area.exchanged(position, gap)
    return f', {how_far(gap)} outside of the area{exchanged}' if gap > 0.0 else ''


def put_on_map(layer: Layer, robots: Mapping[str, dict[str, Any]]) -> None:
    """Replace geodetic starts and chargers of robots by map positions.

    They are `{latitude, longitude, height}`, or points in the area's GeoJSON with the role
    start, home or charger and the property robot, or the robot's name.
    """
    given = layer.data.get('environment')
    area = given.get('area') if isinstance(given, Mapping) else None
    points = _points(area) if is_geojson(area) else []
    written = [key for name, values in robots.items() for key, _, _ in _positions(name, values)]
    if not written and not points:
        return
    try:
        with warnings.catch_warnings():
            # The scenario check reports them again.
            warnings.simplefilter('ignore', InputWarning)
            origin = EnvironmentSettings.model_validate(given).origin
    except ValidationError:
        # Validation reports its errors later, and not those of positions.
        origin, points = OriginSettings(latitude=0.0, longitude=0.0), []
    for name, values in robots.items():
        for key, value, put in _positions(name, values):
            put(_on_map(layer, key, value, origin))
    if origin is not None:
        _give_points(points, robots, origin)


def _points(area: Any) -> list[tuple[str, str, list[float]]]:
    try:
        return points_of(area)
    except ValueError:
        return []  # validation reports its errors later


def _positions(name: str, values: dict[str, Any]) -> list[tuple[str, Any, Callable[[Any], None]]]:
    found: list[tuple[str, Any, Callable[[Any], None]]] = []
    if isinstance(values.get('start'), Mapping):
        found.append((f'robots.{name}.start', values['start'], _setter(values, 'start')))
    endurance = values.get('endurance')
    chargers = endurance.get('chargers') if isinstance(endurance, Mapping) else None
    for index, charger in enumerate(chargers if isinstance(chargers, list) else ()):
        if isinstance(charger, Mapping):
            key = f'robots.{name}.endurance.chargers[{index}]'
            found.append((key, charger, _setter(chargers, index)))
    return found


def _setter(holder: Any, key: str | int) -> Callable[[Any], None]:
    def put(value: Any) -> None:
        holder[key] = value

    return put


def _on_map(
    layer: Layer, key: str, value: Mapping[str, Any], origin: OriginSettings | None
) -> list[float]:
    numbers = {}
    for axis, most in _DEGREES.items():
        number = value.get(axis)
        if (
            isinstance(number, bool)
            or not isinstance(number, (int, float))
            or not -most <= number <= most
        ):
            read = shown(number) if axis in value else 'nothing'
            text = f'{key}: {axis}: read {read}, allowed is a number from {-most:g} to {most:g}'
            raise ScenarioError(layer.located(text))
        numbers[axis] = float(number)
    height, others = value.get('height', 0.0), value.keys() - _DEGREES.keys() - {'height'}
    if others or isinstance(height, bool) or not isinstance(height, (int, float)):
        text = f'{key}: allowed are latitude, longitude, and height above the map [m]'
        raise ScenarioError(layer.located(text))
    if origin is None:
        text = f'{key}: latitude and longitude need environment.origin, or an area in degrees'
        raise ScenarioError(layer.located(text))
    east, north = to_map(np.array([[numbers['longitude'], numbers['latitude']]]), origin)[0]
    return [round(float(east), 4), round(float(north), 4), float(height)]


def _give_points(
    points: list[tuple[str, str, list[float]]],
    robots: Mapping[str, dict[str, Any]],
    origin: OriginSettings,
) -> None:
    chargers = []
    for role, owner, degrees in points:
        east, north = to_map(np.array([degrees]), origin)[0]
        position = [round(float(east), 4), round(float(north), 4), 0.0]
        if role == 'start' and owner in robots:
            robots[owner].setdefault('start', position)
        elif role != 'start' and owner in ('', *robots):
            chargers.append((owner, position))
        else:
            whose = f'its robot is {owner}' if owner else 'it names no robot'
            warnings.warn(
                f'environment.area: ignoring a point with role {role}, as {whose}; allowed as '
                f'its robot: {", ".join(robots)}',
                InputWarning,
                stacklevel=2,
            )
    for name, values in robots.items():
        own = [position for owner, position in chargers if owner == name]
        common = [position for owner, position in chargers if not owner]
        endurance = values.get('endurance')
        if isinstance(endurance, dict) and (own or common):
            endurance.setdefault('chargers', own or common)
