"""Random fields: areas, zones that change, robots and batteries, drawn from a seed."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import shapely
from shapely import affinity
from shapely.geometry import LineString, MultiPolygon, Point, Polygon, box

KINDS = ('bounds', 'holes', 'corridor', 'parts', 'gate', 'forest', 'space')
PLANNERS = ('auto', 'maasi', 'tour', 'lawnmower', 'nearest_widest', 'maas')
PERFECT = {'position_noise': 0.0, 'heading_noise': 0.0, 'velocity_noise': 0.0}
STEP = 0.2  # s


@dataclass(frozen=True)
class Change:
    """A change of the keep-outs: what is drawn at a time [s], and for how long [s]."""

    at: float
    kind: str  # appear, cut, cover (a robot), home (cover a charger), most (of the area)
    lasts: float
    draw: int  # seed of its shape, which depends on where the robots are


@dataclass
class Field:
    """A random field: a scenario's values, and what happens in it."""

    seed: int
    kind: str
    planner: str
    values: dict[str, Any]
    changes: list[Change] = field(default_factory=list)
    weak: bool = False  # whether batteries hold a fifth less than they say

    def describe(self) -> str:
        """Return in words what it is."""
        battery = ['none', 'honest', 'weak'][self._battery]
        changes = ','.join(f'{item.kind}@{item.at:g}' for item in self.changes) or '-'
        robots = '+'.join(sorted(item['type'] for item in self.values['robots'].values()))
        return f'{self.kind} {self.planner} {robots} battery={battery} zones={changes}'

    @property
    def _battery(self) -> int:
        some = any('endurance' in item for item in self.values['robots'].values())
        return 0 if not some else 1 + self.weak


@dataclass
class _Ground:
    """Where a field is: border, and what is in it."""

    border: Any
    area: str | None = None
    obstacles: list[Any] = field(default_factory=list)
    keep_outs: list[Any] = field(default_factory=list)
    height: float | None = None

    def shape(self, zone: Any) -> Any:
        if 'centre' in zone:
            return Point(zone['centre'][:2]).buffer(zone['radius'])
        return Polygon(zone['polygon'])

    def free(self, margin: float) -> Any:
        """Return where a body with a margin of all edges may be."""
        closed = [self.shape(zone) for zone in [*self.obstacles, *self.keep_outs]]
        return self.border.difference(shapely.union_all(closed)).buffer(-margin)


def make_field(seed: int) -> Field:
    """Return the field of a seed: always the same one."""
    rng = np.random.default_rng(seed)
    kind = str(rng.choice(KINDS, p=[0.2, 0.2, 0.15, 0.15, 0.1, 0.1, 0.1]))
    planner = str(rng.choice(PLANNERS, p=[0.22, 0.18, 0.22, 0.14, 0.14, 0.1]))
    while True:
        ground = _ground(rng, kind)
        robots = _robots(rng, kind, planner, ground)
        if robots:
            break
    weak = _batteries(rng, robots, ground)
    limit = _limit(rng, ground, robots)
    count = int(rng.integers(0, 6))
    environment: dict[str, Any] = {
        'expected_targets': float(rng.choice([0.3, 1.0, 3.0, 8.0])),
        'obstacles': ground.obstacles,
        'keep_outs': ground.keep_outs,
    }
    if ground.area is None:
        west, south, east, north = ground.border.bounds
        environment['bounds'] = [[west, east], [south, north]]
        if ground.height is not None:
            environment['bounds'].append([0.0, ground.height])
    else:
        environment['area'] = ground.area
    if rng.random() < 0.25:
        likely = _rounded(_blob(rng, *_inside(rng, ground.border), float(rng.uniform(8.0, 30.0))))
        weight = float(rng.choice([0.0, 0.2, 5.0, 30.0]))
        environment['prior'] = {'polygons': [{'polygon': _corners(likely), 'weight': weight}]}
    endurance = any('endurance' in robot for robot in robots.values())
    values = {
        'version': 1,
        'environment': environment,
        'step': STEP,
        'targets': {'count': count, 'separation': 3.0, 'margin': 0.5},
        'robots': robots,
        'filter': {'method': 'pmb'},
        'planner': {'name': planner},
        'stop': 'all_found' if count and not endurance and rng.random() < 0.25 else 'planner_done',
        'limits': {'time': limit},
    }
    if planner != 'lawnmower' and len(robots) > 1 and rng.random() < 0.1:
        values['planner']['coordination'] = 'independent'
    return Field(seed, kind, planner, values, _changes(rng, limit), weak)


def _limit(rng: np.random.Generator, ground: _Ground, robots: dict[str, Any]) -> float:
    """Return a time that is too short for some searches, and enough for most [s]."""
    width = [
        2.0 * robot['sensor']['detection']['upper'][0] * robot['motion']['speed']
        for robot in robots.values()
    ]
    one_pass = ground.border.area / sum(width)
    return float(round(np.clip(rng.uniform(2.0, 8.0) * one_pass, 60.0, 300.0)))


def _changes(rng: np.random.Generator, limit: float) -> list[Change]:
    if rng.random() < 0.45:
        return []
    kinds = ['appear', 'cut', 'cover', 'home', 'most']
    changes = [
        Change(
            round(float(rng.uniform(3.0, 0.7 * limit)), 1),
            str(rng.choice(kinds, p=[0.3, 0.15, 0.35, 0.1, 0.1])),
            round(float(rng.uniform(10.0, 60.0)), 1) if rng.random() < 0.75 else math.inf,
            int(rng.integers(2**31)),
        )
        for _ in range(rng.integers(1, 5))
    ]
    return sorted(changes, key=lambda item: item.at)


def _ground(rng: np.random.Generator, kind: str) -> _Ground:
    """Return the border of a kind of field, with obstacles and keep-outs in it."""
    if kind == 'space':
        ground = _Ground(box(0.0, 0.0, *rng.integers(40, 90, 2).tolist()))
        ground.height = float(rng.integers(20, 40))
    elif kind in ('bounds', 'forest'):
        ground = _Ground(box(0.0, 0.0, *rng.integers(40, 180, 2).tolist()))
    else:
        border = _rounded(_AREAS[kind](rng))
        ground = _Ground(border, shapely.to_wkt(border, rounding_precision=2))
    number = int(rng.integers(8, 30)) if kind == 'forest' else int(rng.integers(0, 5))
    if kind == 'bounds':
        number += 1  # an empty box is another test's
    for _ in range(number):
        zone = _zone(rng, ground, 0.6 if kind == 'forest' else 1.0)
        solid = rng.random() < (0.8 if kind == 'forest' else 0.5)
        whole = ground.border.area
        (ground.obstacles if solid or kind == 'space' else ground.keep_outs).append(zone)
        if ground.free(1.5).area < 0.4 * whole:
            (ground.obstacles if solid or kind == 'space' else ground.keep_outs).pop()
    return ground


def _zone(rng: np.random.Generator, ground: _Ground, scale: float) -> dict[str, Any]:
    x, y = _inside(rng, ground.border)
    radius = round(float(scale * rng.uniform(1.0, 9.0)), 2)
    if ground.height is not None and rng.random() < 0.5:
        return {
            'centre': [x, y, round(float(rng.uniform(0.0, ground.height)), 2)],
            'radius': radius,
        }
    if rng.random() < 0.6 or ground.height is not None:
        return {'centre': [x, y], 'radius': radius}
    return {'polygon': _corners(_rounded(_blob(rng, x, y, radius)))}


def _holes(rng: np.random.Generator) -> Any:
    x, y = rng.uniform(30.0, 90.0, 2)
    outer = affinity.scale(_blob(rng, x, y, 1.0, 9), x, y)
    holes = [
        _blob(rng, *_inside(rng, outer), float(rng.uniform(3.0, 0.2 * min(x, y))))
        for _ in range(rng.integers(1, 4))
    ]
    whole = outer.buffer(-2.0).difference(shapely.union_all(holes))
    return max(shapely.get_parts(whole), key=lambda part: part.area)


def _corridor(rng: np.random.Generator) -> Any:
    lengths, point, turn = rng.uniform(30.0, 80.0, rng.integers(2, 5)), np.zeros(2), 0.0
    points = [point]
    for length in lengths:
        point = point + length * np.array([math.cos(turn), math.sin(turn)])
        points.append(point)
        turn += float(rng.uniform(0.5, 1.6)) * (1.0 if len(points) % 2 else -1.0)
    width = float(rng.uniform(4.0, 10.0))
    return LineString(points).buffer(width, join_style='mitre', cap_style='flat')


def _parts(rng: np.random.Generator) -> Any:
    parts, west = [], 0.0
    for _ in range(rng.integers(2, 4)):
        part = _blob(rng, 0.0, 0.0, float(rng.uniform(18.0, 40.0)), 7)
        west += float(rng.uniform(3.0, 12.0)) - part.bounds[0]
        parts.append(affinity.translate(part, west, float(rng.uniform(-20.0, 20.0))))
        west = parts[-1].bounds[2]
    return MultiPolygon(parts)


def _gate(rng: np.random.Generator) -> Any:
    """Return two rooms with a passage that is narrow for some robots."""
    size = rng.uniform(25.0, 60.0, 4)
    gate = float(rng.uniform(3.2, 9.0))
    wall = float(rng.uniform(2.0, 15.0))
    middle = float(rng.uniform(0.2, 0.8)) * min(size[1], size[3])
    one, other = (
        box(0.0, 0.0, size[0], size[1]),
        box(size[0] + wall, 0.0, size[0] + wall + size[2], size[3]),
    )
    passage = box(size[0] - 1.0, middle - 0.5 * gate, size[0] + wall + 1.0, middle + 0.5 * gate)
    return affinity.rotate(shapely.union_all([one, other, passage]), float(rng.uniform(0.0, 90.0)))


_AREAS = {'holes': _holes, 'corridor': _corridor, 'parts': _parts, 'gate': _gate}


def _robots(
    rng: np.random.Generator, kind: str, planner: str, ground: _Ground
) -> dict[str, dict[str, Any]]:
    """Return one to four robots, flying and on the ground; none where they do not fit."""
    robots: dict[str, dict[str, Any]] = {}
    starts: list[tuple[float, float, float]] = []
    for index in range(rng.integers(1, 5)):
        rover = kind != 'space' and rng.random() < 0.35
        robot = _rover(rng) if rover else _drone(rng)
        clearance = robot['motion']['clearance']
        for _ in range(50):
            room = ground.free(robot['radius'] + 1.5 * clearance + 0.3)
            if room.is_empty:
                return {}
            x, y = _inside(rng, room)
            apart = robot['radius'] + 2.0 * clearance + 2.0
            if all(math.hypot(x - a, y - b) > apart + reach for a, b, reach in starts):
                break
        else:
            break
        starts.append((x, y, robot['radius'] + clearance))
        height = 0.0 if rover else float(rng.integers(10, 25))
        if ground.height is not None:
            height = round(0.5 * ground.height + 0.3, 2)
            if not _clear_of_spheres(ground, [x, y, height], robot['radius'] + 1.5 * clearance):
                break
        robot['start'] = [x, y, height]
        half = robot['sensor']['detection']['upper'][0]
        robot['candidates'] = _candidates(rng, kind, planner, ground, half, height)
        robots[f'r{index}'] = robot
    return robots


def _clear_of_spheres(ground: _Ground, place: list[float], least: float) -> bool:
    return all(
        math.dist(place, zone['centre']) > zone['radius'] + least
        for zone in ground.obstacles
        if len(zone.get('centre', ())) == 3
    )


def _drone(rng: np.random.Generator) -> dict[str, Any]:
    half = round(float(rng.uniform(6.0, 13.0)), 1)
    return {
        'type': 'mavlink_drone',
        'radius': 0.5,
        'motion': {
            'speed': round(float(rng.uniform(3.0, 9.0)), 1),
            'acceleration': round(float(rng.uniform(1.5, 4.0)), 1),
            'clearance': round(float(rng.uniform(0.5, 1.5)), 1),
        },
        'sensor': _sensor(rng, half),
        'odometry': PERFECT,
    }


def _rover(rng: np.random.Generator) -> dict[str, Any]:
    half = round(float(rng.uniform(5.0, 10.0)), 1)
    return {
        'type': 'rover',
        'radius': 0.6,
        'motion': {
            'speed': round(float(rng.uniform(1.0, 3.0)), 1),
            'clearance': round(float(rng.uniform(0.4, 1.0)), 1),
        },
        'sensor': _sensor(rng, half),
        'odometry': PERFECT,
    }


def _sensor(rng: np.random.Generator, half: float) -> dict[str, Any]:
    return {
        'detection': {
            'kind': 'box',
            'probability': round(float(rng.uniform(0.7, 0.95)), 2),
            'lower': [-half, -half, -60.0],
            'upper': [half, half, 60.0],
        },
        'noise': {
            'range': 0.2,
            'bearing': 0.01,
            'elevation': 0.01,
            'as': 'deviation',
            'angles': 'radians',
        },
    }


def _candidates(
    rng: np.random.Generator, kind: str, planner: str, ground: _Ground, half: float, height: float
) -> dict[str, Any]:
    if planner == 'maas':
        return {
            'ring': int(rng.choice([4, 8])),
            'distance': round(float(rng.uniform(0.6, 1.2)) * half, 1),
        }
    west, south, east, north = ground.border.bounds
    if kind in ('bounds', 'holes', 'forest'):
        numbers = [
            int(np.clip(math.ceil(side / (1.6 * half)), 2, 6))
            for side in (east - west, north - south)
        ]
        spacing = [round((east - west) / numbers[0], 2), round((north - south) / numbers[1], 2)]
        corner = [round(west + 0.5 * spacing[0], 2), round(south + 0.5 * spacing[1], 2)]
        return {'grid': numbers, 'spacing': spacing, 'corner': corner}
    room = ground.free(0.5)
    number = int(np.clip(room.area / (1.2 * half) ** 2, 6, 25))
    return {'points': [[*_inside(rng, room), height] for _ in range(number)]}


def _batteries(rng: np.random.Generator, robots: dict[str, Any], ground: _Ground) -> bool:
    """Give robots batteries that are worth planning with; return whether these are weak."""
    if rng.random() < 0.35:
        return False
    weak = bool(rng.random() < 0.4)
    some = rng.random(len(robots)) < 0.8
    for robot, has in zip(robots.values(), some):
        if not has:
            continue  # robots without a limit take part as well
        idle, moving = round(float(rng.uniform(20.0, 150.0))), round(float(rng.uniform(5.0, 40.0)))
        power = idle + moving * robot['motion']['speed']
        # Of a full battery, from what is too short for anything to several minutes.
        seconds = float(rng.choice([25.0, 60.0, 90.0, 150.0, 240.0]))
        capacity = float(round(power * seconds))
        robot['endurance'] = {
            'per_second': idle / capacity,
            'per_metre': moving / capacity,
            'reserve': round(float(rng.uniform(0.15, 0.3)), 2),
        }
        robot['battery'] = {
            'capacity': (0.8 if weak else 1.0) * capacity,
            'idle_power': idle,
            'motion_power': moving,
            'charging_power': round(capacity / float(rng.uniform(10.0, 40.0))),
            'charge': float(rng.choice([1.0, 1.0, 0.8])),
        }
        if rng.random() < 0.3:
            margin = robot['radius'] + 2.0 * robot['motion']['clearance']
            here = Point(robot['start'][:2])
            # Where it can get to from its start.
            parts = [
                part for part in shapely.get_parts(ground.free(margin)) if part.distance(here) < 0.5
            ]
            z = robot['start'][2]
            others = [item['start'] for item in robots.values() if item is not robot]
            places = [[*_inside(rng, part), z] for part in parts for _ in range(20)]
            places = [
                place
                for place in places
                if 3.0 < math.dist(place, robot['start']) < 25.0
                and _clear_of_spheres(ground, place, margin)
                and all(math.dist(place[:2], other[:2]) > 6.0 for other in others)
            ]
            if places:
                robot['endurance']['chargers'] = places[:1]
    return weak


def draw_zone(
    change: Change, free: Any, robots: dict[str, np.ndarray], chargers: list[np.ndarray]
) -> Any:
    """Return the shape of a zone at its time: the zone's settings, from where the robots are."""
    rng = np.random.default_rng(change.draw)
    west, south, east, north = free.bounds
    size = math.hypot(east - west, north - south)
    if change.kind == 'cut':
        x, y = _inside(rng, free)
        band = box(
            x - size, y - 0.5 * rng.uniform(1.0, 5.0), x + size, y + 0.5 * rng.uniform(1.0, 5.0)
        )
        return {
            'polygon': _corners(_rounded(affinity.rotate(band, float(rng.uniform(0.0, 180.0)))))
        }
    if change.kind == 'most':
        x, y = _inside(rng, free)
        return {'centre': [x, y], 'radius': round(float(rng.uniform(0.25, 0.4)) * size, 2)}
    x, y = _inside(rng, free)
    radius = round(float(rng.uniform(2.0, 10.0)), 2)
    places = chargers if change.kind == 'home' else list(robots.values())
    if change.kind in ('cover', 'home') and places:
        near = places[int(rng.integers(len(places)))]
        x, y = (round(float(v + rng.uniform(-0.5, 0.5) * radius), 2) for v in near[:2])
    if rng.random() < 0.6:
        return {'centre': [x, y], 'radius': radius}
    return {'polygon': _corners(_rounded(_blob(rng, x, y, radius)))}


def _blob(rng: np.random.Generator, x: float, y: float, radius: float, corners: int = 6) -> Any:
    """Return a polygon of about a radius around a place."""
    angles = np.sort(
        (np.arange(corners) + rng.uniform(0.0, 0.7, corners)) * 2.0 * math.pi / corners
    )
    away = radius * rng.uniform(0.65, 1.0, corners)
    return Polygon(np.stack([x + away * np.cos(angles), y + away * np.sin(angles)], axis=1))


def _inside(rng: np.random.Generator, shape: Any) -> tuple[float, float]:
    """Return a random place in a shape, to the centimetre."""
    west, south, east, north = shape.bounds
    for _ in range(5000):
        x, y = round(float(rng.uniform(west, east)), 2), round(float(rng.uniform(south, north)), 2)
        if shapely.contains_xy(shape, x, y):
            return x, y
    point = shape.representative_point()
    return round(point.x, 2), round(point.y, 2)


def _rounded(shape: Any) -> Any:
    """Return a shape with its corners on centimetres."""
    return shapely.set_precision(shape, 0.01)


def _corners(polygon: Any) -> list[list[float]]:
    polygon = max(shapely.get_parts(polygon), key=lambda part: part.area)
    return [[round(x, 2), round(y, 2)] for x, y in polygon.exterior.coords[:-1]]
