"""Estimate of a search before its start: area, passes, batteries, time, and unseen parts.

Computed from the settings only, for flights at full speed without turns: a search takes longer.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from maasi_filter.geometry.area import Area, level_shape
from maasi_filter.geometry.geodesy import OriginSettings
from maasi_filter.geometry.terrain import Terrain
from maasi_filter.wording import number
from maasi_planner.candidates import half_view, map_spacing, swath_of
from maasi_sim.scenario.free_space import FreeSpace
from maasi_sim.scenario.on_earth import position_text
from maasi_sim.scenario.schema import RobotSettings, Scenario

# Smaller unreachable parts, relative to the area, are rounding or corners.
_SMALL_PART = 0.002
_MOST_PARTS = 5  # most named parts
_LONGEST = 1e9  # time that counts as never [s]
# Factor from the time of one pass to that of a search with turns and repeated measurements.
_PASSES = 3.0
_HECTARE = 1e4  # [m2]


@dataclass(frozen=True)
class Preflight:
    """The estimate of a search, as lines and warnings."""

    lines: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Effort:
    """Capacity of one robot.

    swath: width that it sees in passing [m]; speed: search speed [m/s]; use: battery share per
    second, 0: unknown; first, later: usable shares of the first and later flights; charging:
    time between flights, infinite if there is only one [s]; covered: volume (2D: area) that it
    can see [m^d]; pass_length: path length over all of that [m].
    """

    swath: float
    speed: float
    use: float
    first: float
    later: float
    charging: float
    covered: float
    pass_length: float

    @property
    def pass_time(self) -> float:
        """Flight time of one pass over all that it can see [s]."""
        return self.pass_length / self.speed

    @property
    def endurance(self) -> float:
        """Time of the first flight [s]."""
        return self.first / self.use if self.use > 0.0 else math.inf

    def working(self, time: float) -> tuple[float, int]:
        """Return the search time within a time [s] and the number of charges."""
        if time <= self.endurance:
            return time, 0
        left, done, charges = time - self.endurance, self.endurance, 0
        if math.isfinite(self.charging):
            flight = self.later / self.use
            rounds = math.floor(left / (self.charging + flight))
            rest = max(left - rounds * (self.charging + flight) - self.charging, 0.0)
            done += rounds * flight + rest
            charges = rounds + (rest > 0.0)
        return done, charges


def preflight(scenario: Scenario) -> Preflight:
    """Return the estimate for a scenario."""
    area = Area(scenario.environment)
    spaces = {name: FreeSpace(robot, area) for name, robot in scenario.robots.items()}
    solid = shapely.union_all(list(map(level_shape, scenario.environment.obstacles)))
    ground = (area.region or area.border).difference(solid)
    height = float(np.prod(area.bounds[2:, 1] - area.bounds[2:, 0]))
    efforts, seen = {}, []
    for name, space in spaces.items():
        visible = _visible(scenario, space, ground)
        seen.append(visible)
        efforts[name] = _effort(scenario, name, visible.area * height)
    together = shapely.union_all(seen)
    report = Preflight()
    whole = area.border.area
    closed = whole - ground.area
    shown = closed >= 1e-6 * whole  # less is rounding
    without = f', without {_area(closed)} of keep-out zones and obstacles' if shown else ''
    depth = f', {number(height)} m high' if area.dimension == 3 else ''
    report.lines.append(f'area: {_area(ground.area)}{without}{depth}')
    for name, effort in efforts.items():
        report.lines.append(f'{name}: {_pass_of(effort, ground.area * height)}')
    team = _add_team(report, efforts, together.area * height, scenario.limits.time)
    _add_cells(report, scenario, area)
    if area.terrain is not None:
        report.lines.append(_terrain_of(Path(str(scenario.environment.terrain.file)), area.terrain))
    # A strip along a wall is not a part.
    strip = 0.1 * min(effort.swath for effort in efforts.values())
    missed = ground.difference(together).buffer(-strip, join_style='mitre')
    _add_parts(report, missed.buffer(strip, join_style='mitre').intersection(ground), ground.area)
    for name, robot in scenario.robots.items():
        positions = _positions_of(robot, efforts[name], scenario.environment.origin)
        report.lines.append(f'{name}: {positions}')
        report.warnings.extend(
            f'{name}: {text}'
            for text in _battery_warnings(robot, efforts[name], scenario.limits.time, team)
        )
    return report


def _visible(scenario: Scenario, space: FreeSpace, ground: BaseGeometry) -> BaseGeometry:
    """Return the part of the ground that a robot can see from all reachable positions."""
    low, high = space.area.bounds[:2].T
    sensor = space.robot.sensor.build('robot', scenario.dimension)
    view = min(half_view(sensor), float(np.linalg.norm(high - low)))
    return _seen_from(tuple(space.reachable), view, ground)


# Robots of the same kind share it.
@lru_cache(maxsize=16)
def _seen_from(parts: tuple[BaseGeometry, ...], view: float, ground: BaseGeometry) -> BaseGeometry:
    reached = shapely.union_all(parts)
    return reached.buffer(view, join_style='mitre', mitre_limit=2.0).intersection(ground)


def _effort(scenario: Scenario, name: str, covered: float) -> Effort:
    robot, battery = scenario.robots[name], scenario.robots[name].battery
    bounds = scenario.environment.array()
    sensor = robot.sensor.build(name, scenario.dimension)
    swath = min(swath_of(sensor), float((bounds[:, 1] - bounds[:, 0]).max()))
    # At most the speed at which the views of successive measurements meet.
    speed = min(robot.motion.speed, swath / max(robot.sensor.period, scenario.step))
    home, charging, first, later = robot.endurance, math.inf, battery.charge, 0.0
    use = 0.0
    if home is not None and home.per_second + home.per_metre > 0.0:
        use = home.per_second + home.per_metre * speed
    elif not robot.external:
        use = (battery.idle_power + battery.motion_power * speed) / battery.capacity
    if home is not None:
        charge = 1.0 if robot.external else battery.charge
        first, later = max(charge - home.reserve, 0.0), home.full - home.reserve
        if battery.chargeable:
            charging = later * battery.capacity / battery.power_at_charger
    length = covered / swath ** (scenario.dimension - 1)
    return Effort(swath, speed, use, first, later, charging, covered, length)


def _pass_of(effort: Effort, whole: float) -> str:
    text = (
        f'swath {_metres(effort.swath)}; one pass alone takes {_metres(effort.pass_length)}, '
        f'{_time(effort.pass_time)} at {number(effort.speed)} m/s'
    )
    if effort.use > 0.0:
        share = effort.use * effort.pass_time
        percent = f'{100.0 * share:.0f} % of a battery'
        text += f', {percent if share < 1.0 else f"{share:.1f} batteries"}'
    if effort.covered < 0.99 * whole:
        text += f'; it can see {100.0 * effort.covered / whole:.0f} % of the area'
    return text


def _add_team(
    report: Preflight, efforts: Mapping[str, Effort], whole: float, limit: float
) -> float:
    """Add the team's cost of one pass and the share within the time limit; return its time [s]."""
    time = _time_of_pass(efforts, whole)
    endless = time >= _LONGEST
    charges = {name: effort.working(time)[1] for name, effort in efforts.items()}
    often = {name: 'once' if n == 1 else f'{n} times' for name, n in charges.items() if n}
    needed = ', '.join(f'{name} charges {text}' for name, text in often.items())
    charging = needed or 'no charging needed'
    takes = f'takes {_time(time)}; {charging}'
    if endless:
        takes = 'needs more than all batteries'
        report.warnings.append(
            f'one pass needs more than all batteries: at most {_share(efforts, _LONGEST, whole)} '
            'of the area can be seen; add robots, or endurance with chargers'
        )
    report.lines.append(f'team: one pass {takes}; the time limit is {_time(limit)}')
    if time > limit:
        needs = '' if endless else f'one pass of the team takes {_time(time)} without turns; '
        report.warnings.append(
            f'limits.time: {needs}in {_time(limit)} about {_share(efforts, limit, whole)} of the '
            'area can be seen; raise it or add robots'
        )
    return time


def _share(efforts: Mapping[str, Effort], time: float, whole: float) -> str:
    """Return the share of a volume that the robots see within a time [s], as text."""
    return f'{100.0 * min(_covered(efforts, time) / max(whole, 1e-9), 1.0):.0f} %'


def _covered(efforts: Mapping[str, Effort], time: float) -> float:
    """Return the volume that the robots see within a time [m^d]."""
    return sum(
        min(effort.working(time)[0] / effort.pass_time, 1.0) * effort.covered
        for effort in efforts.values()
        if effort.covered > 0.0
    )


def _time_of_pass(efforts: Mapping[str, Effort], whole: float) -> float:
    """Return the time in which the robots together see a volume once [s]."""
    whole *= 1.0 - 1e-6  # rounding of united shapes
    if _covered(efforts, _LONGEST) < whole:
        return _LONGEST
    low, high = 0.0, _LONGEST
    for _ in range(80):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if _covered(efforts, middle) >= whole else (middle, high)
    return high


def _add_cells(report: Preflight, scenario: Scenario, area: Area) -> None:
    sensors = [robot.sensor.build(n, scenario.dimension) for n, robot in scenario.robots.items()]
    spacing, warning = map_spacing(area.bounds, sensors)
    given, swath = scenario.filter.exploration_spacing, min(map(swath_of, sensors))
    if given is not None:
        spacing, warning = given, ''
        if given > swath:
            warning = (
                f'filter.exploration_spacing: read {given:g}, wider than the swath of a sensor, '
                f'{number(swath)} m: the explored share will be too low'
            )
    cells = np.maximum(np.ceil((area.bounds[:, 1] - area.bounds[:, 0]) / spacing), 1.0).astype(int)
    report.lines.append(
        f'exploration map: {" x ".join(map(str, cells.tolist()))} cells of {_metres(spacing)}'
    )
    if warning:
        report.warnings.append(warning)


def _terrain_of(file: Path, terrain: Terrain) -> str:
    surface = terrain.surface
    # Without the outer nodes, which level the outermost half cells.
    cells = np.array(surface.heights.shape) - 2
    size = ' x '.join(map(_metres, (cells * surface.step).tolist()))
    step = ' x '.join(dict.fromkeys(map(_metres, surface.step.tolist())))
    return (
        f'terrain: {file.name}, {size}, heights {number(surface.lowest)} to '
        f'{number(surface.highest)} m above z = 0, cells of {step}'
    )


def _add_parts(report: Preflight, missed: BaseGeometry, whole: float) -> None:
    """Add a warning about the parts of the area that no robot can see."""
    parts = sorted(
        (part for part in shapely.get_parts(missed) if part.area > _SMALL_PART * whole),
        key=lambda part: -float(part.area),
    )
    if not parts:
        return
    named = []
    for part in parts[:_MOST_PARTS]:
        west, south, east, north = part.bounds
        named.append(
            f'{_area(part.area)} (x {west:.4g} to {east:.4g} m, y {south:.4g} to {north:.4g} m)'
        )
    more = f' and {len(parts) - _MOST_PARTS} more' if len(parts) > _MOST_PARTS else ''
    share = 100.0 * sum(part.area for part in parts) / whole
    report.warnings.append(f'no robot can see {share:.2g} % of the area: {"; ".join(named)}{more}')


def _positions_of(robot: RobotSettings, effort: Effort, origin: OriginSettings | None) -> str:
    text = f'starts at {position_text(robot.start, origin)}'
    if robot.endurance is None:
        return text
    if not robot.battery.chargeable:
        return (
            f'{text}, its home; it cannot be charged and returns home after '
            f'{_time(effort.endurance)}'
        )
    if not robot.endurance.chargers:
        return f'{text}, its charger'
    chargers = '; '.join(position_text(charger, origin) for charger in robot.endurance.chargers)
    return f'{text}, chargers at {chargers}'


def _battery_warnings(robot: RobotSettings, effort: Effort, limit: float, team: float) -> list[str]:
    """Return problems of a robot's battery, for a time limit and the time of one pass [s]."""
    found = []
    if robot.endurance is None and effort.endurance < min(limit, _PASSES * team):
        found.append(
            f'its battery lasts for {_time(effort.endurance)} of {_time(limit)}, and without '
            'endurance settings it will run empty during the search'
        )
    return found


def _area(size: float) -> str:
    return f'{size / _HECTARE:.3g} ha' if size >= 0.1 * _HECTARE else f'{size:.3g} m2'


def _metres(length: float) -> str:
    return f'{length / 1e3:.3g} km' if length >= 2e3 else f'{length:.3g} m'


def _time(seconds: float) -> str:
    if seconds < 120.0:
        return f'{seconds:.0f} s'
    return f'{seconds / 60.0:.0f} min' if seconds < 7200.0 else f'{seconds / 3600.0:.1f} h'
