"""Checks a search of a random field by the true positions of its robots, step by step."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from itertools import combinations
from typing import Any

import numpy as np
import shapely
from shapely.geometry import LineString, Point

from maasi_filter.geometry.area import Area, level_shape

ROUNDING = 1e-3  # of checked lengths [m]
UNSEEN = {'lawnmower': 0.5}  # share that a search may leave though it could be had
MOST_UNSEEN = 0.15
IDLE = 40.0  # time in which a team that has something to do moves [s]


@dataclass(frozen=True)
class Fault:
    """What is wrong: a kind, the step, and figures in words."""

    kind: str
    step: int
    text: str


@dataclass
class Ground:
    """The closed zones from a step on: of these, `drawn` were added while the search runs."""

    step: int
    area: Area
    drawn: int

    def __post_init__(self) -> None:
        self.zones = list(self.area.settings.keep_outs)
        self.shapes = [level_shape(zone) for zone in self.zones]
        self.free = self.area.border.difference(shapely.union_all(self.shapes))

    def gaps(self, zone: int, points: np.ndarray) -> np.ndarray:
        """Return the distances of points (n, 2) from a zone, negative inside [m]."""
        settings = self.zones[zone]
        if settings.centre is not None:
            return np.linalg.norm(points - settings.centre, axis=1) - settings.radius
        shape = self.shapes[zone]
        places = shapely.points(points)
        away = shapely.distance(shape, places)
        within = away == 0.0
        away[within] = -shapely.distance(shapely.boundary(shape), places[within])
        return np.asarray(away)


@dataclass
class Track:
    """What happened: positions (k, n, 3), speeds and charges (k, n) by step, and measurements."""

    names: list[str]
    step: float
    grounds: list[Ground] = field(default_factory=list)
    positions: list[np.ndarray] = field(default_factory=list)
    speeds: list[np.ndarray] = field(default_factory=list)
    charges: list[np.ndarray] = field(default_factory=list)
    measured: list[tuple[str, Any]] = field(default_factory=list)

    def ground_of(self, step: int) -> Ground:
        """Return the ground of a step."""
        return [item for item in self.grounds if item.step <= step][-1]

    def spans(self) -> Iterator[tuple[Ground, int, int]]:
        """Yield each ground with its first step, and the one after its last."""
        ends = [*(item.step for item in self.grounds[1:]), len(self.positions)]
        for ground, end in zip(self.grounds, ends):
            yield ground, ground.step, end


class SearchChecker:
    """The true facts of a search that has ended, or failed."""

    def __init__(self, made: Any, scenario: Any, track: Track, result: Any, finished: str) -> None:
        self.made, self.scenario, self.track, self.result = made, scenario, track, result
        self.finished = finished
        self.positions = np.array(track.positions)
        self.speeds, self.charges = np.array(track.speeds), np.array(track.charges)
        self.area = track.grounds[0].area
        self.robots = [scenario.robots[name] for name in track.names]
        self.cut_off = np.zeros(len(self.robots), dtype=bool)

    def faults(self) -> list[Fault]:
        """Return all faults, in the order of time."""
        found: list[Fault] = []
        if not np.isfinite(self.positions).all() or not np.isfinite(self.charges).all():
            step = int(np.flatnonzero(~np.isfinite(self.positions).all(axis=(1, 2)))[0])
            return [Fault('nan', step, 'a position or charge is not finite')]
        self._find_cut_off()
        for index in range(len(self.robots)):
            found += self._border(index)
            found += self._solid(index)
            found += self._zones(index)
            found += self._battery(index)
        found += self._apart()
        if self.result is not None:
            found += self._ending()
        return sorted(found, key=lambda item: item.step)

    def _first(self, kind: str, index: int, bad: np.ndarray, gaps: np.ndarray) -> Iterator[Fault]:
        """Yield the worst of what is wrong with one robot."""
        if bad.any():
            step, worst = int(np.flatnonzero(bad)[0]), float(gaps[bad].min())
            text = f'{self.track.names[index]}: {worst:.3f} m at worst, {bad.sum()} steps'
            yield Fault(kind, step, text)

    def _border(self, index: int) -> Iterator[Fault]:
        places = shapely.points(self.positions[:, index, :2])
        inside = -shapely.distance(self.area.border, places)
        yield from self._first('outside', index, inside < -ROUNDING, inside)
        if self.area.settings.area is not None:
            edge = shapely.distance(shapely.boundary(self.area.border), places)
            gaps = edge - self.robots[index].radius
            yield from self._first('edge', index, (gaps < -ROUNDING) & (inside >= 0.0), gaps)
        elif self.area.dimension == 3:
            low, high = self.area.bounds[2]
            z = self.positions[:, index, 2]
            gaps = np.minimum(z - low, high - z)
            yield from self._first('outside', index, gaps < -ROUNDING, gaps)

    def _solid(self, index: int) -> Iterator[Fault]:
        gaps = np.full(len(self.positions), np.inf)
        places = self.positions[:, index]
        for zone in self.area.settings.obstacles:
            if zone.centre is not None:
                d = len(zone.centre)
                near = np.linalg.norm(places[:, :d] - zone.centre, axis=1) - zone.radius
            else:
                near = shapely.distance(zone.polygon, shapely.points(places[:, :2]))
            gaps = np.minimum(gaps, near)
        gaps -= self.robots[index].radius
        yield from self._first('solid', index, gaps < -ROUNDING, gaps)

    def _apart(self) -> Iterator[Fault]:
        if self.scenario.planner.coordination == 'independent':
            return  # robots that plan for themselves exchange destinations, not paths
        for (i, one), (j, other) in combinations(enumerate(self.robots), 2):
            gaps = np.linalg.norm(self.positions[:, i] - self.positions[:, j], axis=1)
            gaps -= one.radius + other.radius
            bad = gaps < -ROUNDING
            yield from self._first(f'apart ({self.track.names[j]})', i, bad, gaps)

    def _zones(self, index: int) -> Iterator[Fault]:
        """A robot is in a zone only where it was drawn over it, and leaves at once."""
        robot, points = self.robots[index], self.positions[:, index, :2]
        motion = robot.motion
        braking = motion.speed**2 / (2.0 * (motion.acceleration or 4.0))
        # Until it has stopped, and turned.
        reaction = motion.speed / (motion.acceleration or 4.0) + 3.0 * self.track.step
        if motion.model == 'unicycle':
            reaction += math.pi / motion.yaw_rate + motion.yaw_rate / (
                motion.yaw_acceleration or 9.0
            )
        caught: dict[str, int] = {}  # zones that it may be in, and since when
        known = {str(zone) for zone in self.track.grounds[0].zones}
        for ground, first, end in self.track.spans():
            if first >= end:
                continue
            before = max(first - 1, 0)
            present = {str(zone) for zone in ground.zones}
            caught = {key: since for key, since in caught.items() if key in present}
            away = [
                ground.gaps(number, points[before:end]) - robot.radius
                for number in range(len(ground.zones))
            ]
            at_once = self.speeds[before, index] * (braking / motion.speed + 0.5) + motion.clearance
            for zone, gaps in zip(ground.zones, away):
                if str(zone) not in known and gaps[0] < at_once:
                    caught[str(zone)] = first  # drawn over it, or where it cannot stop before
            known = present
            for zone, gaps in zip(ground.zones, away):
                bad = gaps[first - before :] < -ROUNDING
                if not bad.any():
                    if gaps[-1] > 0.0:
                        caught.pop(str(zone), None)
                    continue
                step = first + int(np.flatnonzero(bad)[0])
                if str(zone) not in caught and self._in_another(index, ground, step, caught):
                    caught[str(zone)] = step  # zones that overlap are left together
                if str(zone) not in caught:
                    text = (
                        f'{self.track.names[index]}: {gaps.min():.3f} m at worst, {bad.sum()} steps'
                    )
                    yield Fault('entered', step, text)
                    continue
                after = np.flatnonzero(bad)
                # Once it is clear of it, it stays out.
                breaks = np.flatnonzero(np.diff(after) > 2)
                if len(breaks):
                    back = first + int(after[breaks[0] + 1])
                    yield Fault('entered again', back, f'{self.track.names[index]}')
                elif gaps[-1] > 0.0:
                    caught.pop(str(zone), None)
            yield from self._leaving(index, ground, first, end, reaction)

    def _in_another(self, index: int, ground: Ground, step: int, caught: Mapping[str, int]) -> bool:
        """Return whether a robot leaves another zone at a step."""
        point, radius = self.positions[step - 1, index, None, :2], self.robots[index].radius
        return any(
            str(zone) in caught and ground.gaps(number, point)[0] < radius
            for number, zone in enumerate(ground.zones)
        )

    def _leaving(
        self, index: int, ground: Ground, first: int, end: int, reaction: float
    ) -> Iterator[Fault]:
        robot, name = self.robots[index], self.track.names[index]
        places = shapely.points(self.positions[first:end, index, :2])
        depth = np.asarray(shapely.distance(ground.free, places))
        inside = depth > ROUNDING
        if not inside.any() or self._hindered(index, first, end):
            return
        begin = int(np.flatnonzero(inside)[0])
        react = begin + math.ceil(reaction / self.track.step)
        straight = self._straight_out(ground, places[min(react, len(places) - 1)])
        number = int(inside.sum())
        motion = robot.motion
        slowing = motion.speed / (motion.acceleration or 4.0)
        allowed = reaction + depth.max() * (2.0 if straight else 6.0) / motion.speed
        allowed += slowing * max(1.0, math.log(motion.speed * slowing / (robot.radius + 0.1)))
        if number * self.track.step > allowed + 1.0:
            text = f'{name}: {number * self.track.step:.1f} s in a zone, {depth.max():.2f} m deep, '
            yield Fault('leaves late', first + begin, f'{text}allowed are {allowed:.1f} s')
        least = np.minimum.accumulate(depth[react:]) if react < len(depth) else np.zeros(0)
        more = depth[react:] - least
        # The exit is chosen where the zone is drawn; while it brakes another edge may get nearer.
        braking = motion.speed**2 / (2.0 * (motion.acceleration or 4.0))
        if straight and more.max(initial=0.0) > 0.1 + braking:
            worst = float(more.max())
            yield Fault('goes deeper', first + react, f'{name}: {worst:.2f} m deeper in a zone')

    def _straight_out(self, ground: Ground, place: Any) -> bool:
        """Return whether a straight line leads to the nearest free ground inside the border."""
        line = shapely.shortest_line(place, ground.free)
        if line is None or line.is_empty:
            return False
        solid = shapely.union_all([level_shape(zone) for zone in self.area.settings.obstacles])
        corridor = LineString(line.coords).buffer(1.5)
        return bool(self.area.border.buffer(1e-6).covers(corridor)) and not corridor.intersects(
            solid
        )

    def _hindered(self, index: int, first: int, end: int) -> bool:
        """Return whether its battery is empty, or another robot is near it."""
        if (self.charges[first:end, index] <= 0.0).any():
            return True
        others = [i for i in range(len(self.robots)) if i != index]
        gaps = np.linalg.norm(
            self.positions[first:end, others] - self.positions[first:end, index][:, None], axis=2
        )
        return bool(gaps.min(initial=np.inf) < 6.0)

    def _find_cut_off(self) -> None:
        """Note robots that a zone has cut off from every charger for some time."""
        if not any(robot.endurance for robot in self.robots):
            return
        for ground, first, end in self.track.spans():
            if first >= end or not ground.drawn:
                continue
            for index, robot in enumerate(self.robots):
                if robot.endurance is None or self.cut_off[index]:
                    continue
                part = self._reach(index, ground, self.positions[first, index, :2])
                homes = [shapely.Point(home[:2]) for home in self._chargers(index)]
                self.cut_off[index] = not any(part.distance(home) < 0.1 for home in homes)

    def _chargers(self, index: int) -> list[Any]:
        robot = self.robots[index]
        return [*(robot.endurance.chargers if robot.endurance else [])] or [robot.start]

    def _reach(self, index: int, ground: Ground, place: np.ndarray) -> Any:
        """Return the connected part of the room in which a robot is."""
        robot = self.robots[index]
        solid = [level_shape(zone) for zone in self.area.settings.obstacles if self._level(zone)]
        room = ground.free.difference(shapely.union_all(solid))
        room = room.buffer(-robot.radius - robot.motion.clearance)
        parts = [part for part in shapely.get_parts(room) if not part.is_empty]
        here = Point(place)
        return min(parts, key=lambda part: part.distance(here), default=here)

    @staticmethod
    def _level(zone: Any) -> bool:
        return zone.centre is None or len(zone.centre) == 2

    def _battery(self, index: int) -> Iterator[Fault]:
        robot, name = self.robots[index], self.track.names[index]
        charges, step = self.charges[:, index], self.track.step
        if robot.endurance is None or self.cut_off[index]:
            return
        changes = [ground.step for ground in self.track.grounds[1:]]
        if (charges <= 0.0).any():
            first = int(np.flatnonzero(charges <= 0.0)[0])
            if self._barred(index, first):
                return
            yield Fault('dry', first, f'{name}: empty at {first * step:.0f} s')
            return
        if robot.battery.charging_power <= 0.0:
            return
        rises = np.diff(charges) > 0.0
        arrivals = np.flatnonzero(rises[1:] & ~rises[:-1]) + 1
        left_at = 0
        least = robot.endurance.reserve - 0.02 if not self.made.weak else 0.0
        for arrival in arrivals.tolist():
            changed = any(left_at <= change <= arrival for change in changes)
            if charges[arrival] < least and not changed:
                text = f'{name}: home with {100.0 * charges[arrival]:.1f} %, '
                yield Fault(
                    'reserve', arrival, f'{text}reserve is {100 * robot.endurance.reserve:.0f} %'
                )
            left_at = arrival

    def _barred(self, index: int, last: int) -> bool:
        """Return whether zones were drawn across its path home since it was charged."""
        charged = np.flatnonzero(np.diff(self.charges[:last, index]) > 0.0)
        left = int(charged[-1]) if len(charged) else 0
        for ground in self.track.grounds[1:]:
            if ground.drawn and left <= ground.step <= last:
                drawn = shapely.union_all(ground.shapes[-ground.drawn :])
                here = self.positions[ground.step, index, :2]
                paths = [LineString([here, home[:2]]) for home in self._chargers(index)]
                if all(drawn.intersects(path) for path in paths):
                    return True
        return False

    def _home(self, index: int) -> bool:
        robot, here = self.robots[index], self.positions[-1, index, :2]
        near = min(math.dist(here, home[:2]) for home in self._chargers(index))
        return near <= 2.0 * robot.motion.tolerance + robot.radius

    def _ending(self) -> Iterator[Fault]:
        last = len(self.positions) - 1
        result, limit = self.result, self.scenario.limits.time
        false = len(result.found_targets) - result.scores.match.true_found
        if false:
            yield Fault('false target', last, f'{false} of {len(result.found_targets)}')
        explored, unseen = self._unseen()
        most = UNSEEN.get(self.made.planner, MOST_UNSEEN)
        ending = f'{result.end_reason} ({self.finished}) at {last * self.track.step:.0f} s'
        facts = f'{100 * explored:.0f} % explored, {100 * unseen:.0f} % could be: {ending}'
        if result.end_reason == 'planner_done':
            if unseen > most:
                yield Fault('gives up', last, facts)
            share = re.search(r'([\d.]+) % of the \w+ (?:is|are) explored', self.finished)
            if share and float(share[1]) > 100.0 * explored + 8.0:
                yield Fault('false share', last, facts)
            for index, robot in enumerate(self.robots):
                if robot.endurance is None or self.cut_off[index] or self._home(index):
                    continue
                yield Fault('not home', last, f'{self.track.names[index]}: {ending}')
            yield from self._under_zone(ending)
        elif result.end_reason == 'time_limit':
            if last * self.track.step < limit - 1.0:
                yield Fault('end', last, ending)
            steps = round(IDLE / self.track.step)
            tail = self.positions[-steps:]
            moved = np.linalg.norm(tail - tail[0], axis=2).max()
            charged = (np.diff(self.charges[-steps:], axis=0) > 0.0).any()
            quiet = self.track.grounds[-1].step < last - steps
            if last > steps and quiet and moved < 1.0 and not charged and unseen > most:
                yield Fault('stuck', last - steps, facts)

    def _under_zone(self, ending: str) -> Iterator[Fault]:
        """Closed ground is not explored: a search waits for what zones still cover."""
        ground = self.track.grounds[-1]
        if not ground.drawn:
            return
        points, values = self._map()
        drawn = shapely.union_all(ground.shapes[-ground.drawn :])
        whole = shapely.contains_xy(self.track.grounds[0].free, *points.T)
        density = self.area.density(points) * whole
        left = density * values * shapely.contains_xy(drawn, *points.T)
        share = float(left.sum() / density.sum())
        if share > 0.1:
            text = f'{100 * share:.0f} % lie unexplored under zones: {ending}'
            yield Fault('ended under a zone', len(self.positions) - 1, text)

    def _map(self) -> tuple[np.ndarray, np.ndarray]:
        """Return places (n, 2) all over the bounds, and e there after all measurements."""
        low, high = self.area.bounds[:2].T
        spacing = math.sqrt(float(np.prod(high - low)) / 4000.0)
        axes = [np.arange(a + 0.5 * spacing, b, spacing) for a, b in zip(low, high)]
        points = np.stack(np.meshgrid(*axes, indexing='ij'), axis=-1).reshape(-1, 2)
        values = np.ones(len(points))
        for name, position in self.track.measured:
            box = self.scenario.robots[name].sensor.detection
            away = points - position[:2]
            seen = ((away >= box.lower[:2]) & (away <= box.upper[:2])).all(axis=1)
            values[seen] *= 1.0 - box.probability
        return points, values

    def _unseen(self) -> tuple[float, float]:
        """Return the explored share, and the share that is not and that robots could explore."""
        points, values = self._map()
        ground = self.track.grounds[-1]
        density = self.area.density(points) * shapely.contains_xy(ground.free, *points.T)
        if density.sum() <= 0.0:
            return 1.0, 0.0
        could = np.zeros(len(points), dtype=bool)
        for index in range(len(self.robots)):
            could |= self._could_see(index, ground, points)
        density /= density.sum()
        return 1.0 - float((density * values).sum()), float((density * values * could).sum())

    def _could_see(self, index: int, ground: Ground, points: np.ndarray) -> np.ndarray:
        """Return which places a robot could see from where it can go and come back."""
        robot = self.robots[index]
        if self.charges[-1, index] <= 0.0 or self.cut_off[index]:
            return np.zeros(len(points), dtype=bool)
        half = 0.7 * robot.sensor.detection.upper[0]
        part = self._reach(index, ground, self.positions[-1, index, :2])
        could = np.asarray(shapely.dwithin(part, shapely.points(points), half))
        if self.made.planner in ('maasi', 'nearest_widest', 'auto'):
            shown = np.zeros(len(points), dtype=bool)
            grid = robot.candidates
            for x, y in self._candidates(grid):
                shown |= (np.abs(points - [x, y]) < half).all(axis=1)
            could &= shown
        if robot.endurance is not None:
            home = np.array(self._chargers(index)[0][:2])
            away = np.linalg.norm(points - home, axis=1)
            use = robot.endurance.per_metre + robot.endurance.per_second / robot.motion.speed
            cost = 2.0 * 2.0 * away * use + 12.0 * robot.endurance.per_second
            full = 1.0 if robot.battery.charging_power > 0.0 else float(self.charges[-1, index])
            could &= cost < full - robot.endurance.reserve
        return could

    @staticmethod
    def _candidates(grid: Any) -> list[list[float]]:
        if grid.points is not None:
            return [point[:2] for point in grid.points]
        x, y = (a + s * np.arange(n) for a, s, n in zip(grid.corner, grid.spacing, grid.grid))
        return [[a, b] for a in x.tolist() for b in y.tolist()]
