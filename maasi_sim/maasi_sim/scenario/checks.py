"""Checks between the settings of a scenario, and of the area seen from its waypoints."""

import math
import re
from collections.abc import Iterator
from itertools import combinations
from typing import Any

import numpy as np

from maasi_drivers.settings.driver import DRIVERS, LINKS, TERRAIN_LINKS
from maasi_drivers.settings.vehicles import MamboSettings, MavlinkSettings, PlatformSettings
from maasi_filter.geometry.area import Area
from maasi_filter.geometry.environment import EnvironmentSettings
from maasi_filter.plugins import unknown
from maasi_filter.wording import number
from maasi_planner.candidates import CandidateSet, Viewer, half_view, unseen_parts
from maasi_planner.planners import takes_tour
from maasi_planner.settings import CandidateSettings
from maasi_planner.terrain_frame import least_height
from maasi_sim.scenario.background import background_problems
from maasi_sim.scenario.base import BaseScenario
from maasi_sim.scenario.charger_checks import charger_problems, endurance_warnings
from maasi_sim.scenario.free_space import FreeSpace
from maasi_sim.scenario.on_earth import outside_text, position_text
from maasi_sim.scenario.schema import RobotSettings, Scenario, SimulatedSettings

Problems = Iterator[str]  # each is `key: text`

_ROBOT_NAME = re.compile(r'^[a-z][a-z0-9]*(_[a-z0-9]+)*$')
_RESERVED = ('exploration', 'ground_truth', 'lockstep', 'scenario')
_STEP_TOLERANCE = 1e-6  # largest deviation of a time from a whole number of steps
_RANGING = ('ranging_driver', 'mavlink_driver')  # drivers of robots without a camera
_MAVLINK_URL = re.compile(r'^udpin:[^:]+:(\d+)$')  # URL of the driver of a simulated vehicle


def problems_of(scenario: Scenario) -> Problems:
    """Yield problems between keys."""
    try:
        area = Area(scenario.environment)
    except ValueError as error:
        yield str(error)
        return
    if area.terrain is not None and scenario.filter.method == 'ic_phd':
        yield (
            "filter.method: read 'ic_phd' with environment.terrain, allowed with it is 'pmb': "
            'this one would take hidden targets for missed ones'
        )
    yield from _world_problems(scenario)
    yield from name_problems(scenario)
    yield from event_problems(scenario)
    ports: dict[str, str] = {}
    for name in scenario.names():
        robot = scenario.robots[name]
        for problems in (
            _position_problems(robot, scenario, area),
            _free_space_problems(robot, area),
            _sensor_problems(robot, scenario),
            _simulated_problems(robot, scenario),
            _link_problems(name, robot),
            _terrain_problems(robot, area),
        ):
            yield from (f'robots.{name}.{problem}' for problem in problems)
        if robot.link == 'mavlink' and robot.mavlink is not None:
            match = _MAVLINK_URL.match(robot.mavlink.url)
            if match is not None and (other := ports.setdefault(match[1], name)) != name:
                yield (
                    f'robots.{name}.mavlink.url: read port {match[1]}, which {other} also uses; '
                    'allowed is another port'
                )
    if scenario.stop == 'all_found' and scenario.targets.count == 0:
        yield "stop: read 'all_found' without targets, allowed is 'planner_done'"


def _world_problems(scenario: Scenario) -> Problems:
    most, count = _most_targets(scenario), scenario.targets.count or 0
    if count > most:
        yield (
            f'targets.separation: read {scenario.targets.separation}, which allows at most about '
            f'{most} targets, not {count}'
        )
        return
    try:
        scenario.world(scenario.seed)
    except ValueError as error:
        yield str(error)


def _most_targets(scenario: Scenario) -> int:
    """Return how many targets fit: balls at random fill 0.547 of a plane and 0.382 of space."""
    targets = scenario.targets
    bounds = scenario.environment.array()
    sides = bounds[:, 1] - bounds[:, 0] - 2.0 * targets.margin
    if targets.separation == 0.0 or sides.min() < 0.0:
        return targets.count or 0
    filled, ball = (0.547, math.pi / 4.0) if scenario.dimension == 2 else (0.382, math.pi / 6.0)
    space = float(np.prod(sides + targets.separation))
    return max(1, round(1.1 * filled * space / (ball * targets.separation**scenario.dimension)))


def _position_problems(robot: RobotSettings, scenario: Scenario, area: Area) -> Problems:
    if not area.inside([robot.start])[0]:
        yield (
            f'start: read {position_text(robot.start, area.settings.origin)}'
            f'{outside_text(robot.start, area)}; allowed are positions inside of environment.'
            f'bounds or the area, and outside of keep_outs; bounds are {area.bounds.tolist()}'
        )
    gap = area.distances(robot.start).min(initial=math.inf)
    if gap < robot.radius:
        yield (
            f'start: read {robot.start}, {number(gap)} m from one of environment.obstacles, '
            f'allowed is at least the radius, {robot.radius:g} m'
        )
    try:
        if not len(robot_candidates(robot, area).at(robot.start)):
            yield 'candidates: no waypoint is inside the environment'
    except ValueError as error:
        yield f'candidates.{error}'.replace('candidates.candidates: ', 'candidates: ')


def _terrain_problems(robot: RobotSettings, area: Area) -> Problems:
    """Yield what a robot cannot do over terrain."""
    if area.terrain is None:
        return
    if robot.link not in TERRAIN_LINKS:
        yield (
            f'link: read {robot.link} with environment.terrain; allowed with it are '
            f'{" and ".join(TERRAIN_LINKS)}: the driver does not control heights of the others'
        )
    elif robot.link == 'mavlink' and not robot.external:
        yield (
            'link: read mavlink with environment.terrain; allowed in simulation is topics, or '
            'autopilot: external, as the simulated autopilot has level ground'
        )
    elif robot.flies and robot.start[2] < least_height(robot):
        yield (
            f'start: read height {robot.start[2]:g}, allowed over environment.terrain is at least '
            f'{least_height(robot):g} m above the ground, radius and motion.clearance'
        )


def _free_space_problems(robot: RobotSettings, area: Area) -> Problems:
    space = FreeSpace(robot, area)
    if not space.parts:
        yield (
            f'radius: read {robot.radius:g}, with motion.clearance {robot.motion.clearance:g}; the '
            'area is too narrow, allowed are values that leave free space'
        )
        return
    # With a wrong start all further problems would follow from it.
    if area.inside([robot.start])[0]:
        yield from charger_problems(space)


def problems_of_file(scenario: Scenario) -> Problems:
    """Yield problems between keys; robots that a program makes may start at one point."""
    yield from problems_of(scenario)
    yield from background_problems(scenario.environment)
    for (first, one), (name, robot) in combinations(scenario.robots.items(), 2):
        gap, bodies = math.dist(one.start, robot.start), one.radius + robot.radius
        if gap < bodies:
            yield (
                f'robots.{name}.start: read {robot.start}, {number(gap)} m from the start of '
                f'{first}; allowed is at least both radii, {bodies:g} m: their bodies overlap'
            )


def _simulated_problems(robot: RobotSettings, scenario: Scenario) -> Problems:
    """Yield settings that a camera or an external robot does not have."""
    nothing = SimulatedSettings()
    if robot.camera is not None:
        factors = 'noise_factor', 'probability_factor'
        for field in ('noise', *factors, 'clutter_per_scan', 'clutter_in'):
            value = getattr(robot.simulated, field)
            if value != getattr(nothing, field):
                yield (
                    f'simulated.{field}: read {value}, a setting of ranging sensors; allowed '
                    'without a camera'
                )
        for field in ('walk', 'identified', 'classes'):
            value = getattr(scenario.targets, field)
            if value:
                yield (
                    f'camera: read one, but targets.{field} is {value}; allowed are targets '
                    'without it, or robots without a camera'
                )
    if robot.measurements == 'external' and robot.simulated != nothing:
        yield 'simulated: read settings, but its measurements are external; allowed is simulated'
    elif robot.external and robot.simulated != nothing:
        yield 'simulated: read settings for an external robot; allowed are simulated robots'


def name_problems(scenario: BaseScenario) -> Problems:
    """Yield problems of the names of robots."""
    for name in scenario.names():
        if not _ROBOT_NAME.match(name) or name in _RESERVED:
            yield (
                f"robots.{name}: read '{name}' as a name, allowed are lower case letters, digits "
                f'and single _, but not the topics {", ".join(_RESERVED)}'
            )


def _sensor_problems(robot: RobotSettings, scenario: Scenario) -> Problems:
    detection = robot.sensor.detection
    used = {'box': ['lower', 'upper'], 'exponential': ['size'], 'gaussian': ['size']}
    if detection.kind not in used:
        try:
            detection.build(scenario.dimension)
        except Exception as error:
            # User code: report any error before the nodes start.
            yield f'sensor.detection: {type(error).__name__}: {error}'
    for name in used.get(detection.kind, ()):
        length = len(getattr(detection, name))
        if length < scenario.dimension:
            yield (
                f'sensor.detection.{name}: read {length} numbers, allowed are '
                f'{scenario.dimension}, as in environment.bounds'
            )
    times = {'sensor.period': robot.sensor.period}
    if robot.camera is not None:
        times['camera.rate'] = 1.0 / robot.camera.rate
    if robot.laser is not None:
        times['laser.rate'] = 1.0 / robot.laser.rate
    for key, time in times.items():
        steps = time / scenario.step
        if abs(steps - round(steps)) > _STEP_TOLERANCE * max(steps, 1.0) or (
            time > 0.0 and round(steps) == 0
        ):
            yield (
                f'{key}: has a period of {time:g} s, allowed are multiples of step, {scenario.step}'
            )
    if robot.driver in _RANGING and robot.camera is not None:
        yield f"camera: read one, but driver '{robot.driver}' has none; allowed is null"
    if robot.driver in DRIVERS.built_in and robot.driver not in _RANGING and robot.camera is None:
        yield f"camera: is missing, driver '{robot.driver}' needs it"


def _link_problems(name: str, robot: RobotSettings) -> Problems:
    if robot.link == 'topics':
        return
    links = {'mambo_wifi': ('mambo', robot.mambo), 'mavlink': ('mavlink', robot.mavlink)}
    key, link = links.get(robot.link, ('platform', robot.platform))
    drivers = [driver for driver, links in LINKS.items() if robot.link in links]
    if robot.body == 'external':
        yield f"body: read 'external', allowed with link {robot.link} is simulated"
    if robot.driver not in drivers:
        yield (
            f"link: read '{robot.link}', but driver '{robot.driver}' does not have it; allowed is "
            f"'topics', or driver {' or '.join(drivers)}"
        )
    if robot.guard:
        yield (
            f'guard: read true, allowed with link {robot.link} is false: the link has its own '
            'timeout'
        )
    if link is None:
        least = {
            'mavlink': '{arm: true}',
            'mambo': '{arm: true, full_speed: ...}',
            'platform': '{arm: true, namespace: ...}',
        }[key]
        yield f'{key}: is missing, link {robot.link} needs it: at least {least}'
        return
    if isinstance(link, PlatformSettings) and link.namespace.strip('/') == name:
        yield (
            f"platform.namespace: read '{link.namespace}', the name of the robot; allowed is "
            'another one, as both have services of the same names'
        )
    if not link.arm:
        yield f'{key}.arm: read false, allowed is true: otherwise it never takes off'
    height, submarine = robot.start[2], getattr(link, 'vehicle', '') == 'submarine'
    if (height >= link.ground) if submarine else (height <= link.ground):
        allowed = f'{"below" if submarine else "above"} {key}.ground, {link.ground}'
        yield f'start: read height {height}, allowed are heights {allowed}'
    if isinstance(link, MamboSettings):
        if robot.motion.model != 'mambo':
            yield f"motion.model: read '{robot.motion.model}', allowed with its link is 'mambo'"
        if link.full_speed is None:
            yield 'mambo.full_speed: is missing, without it there is no take-off; measure_mambo '
            'measures it'
        if link.pose != 'events':
            yield f"mambo.pose: read '{link.pose}', allowed in simulation is 'events'"
    elif isinstance(link, MavlinkSettings) and not robot.external:
        if not _MAVLINK_URL.match(link.url):
            yield (
                f"mavlink.url: read '{link.url}', allowed is udpin:HOST:PORT, as the vehicle is "
                'simulated, or autopilot: external'
            )
        if link.map_yaw != 0.0:
            yield f'mavlink.map_yaw: read {link.map_yaw}, allowed in simulation is 0'
        if submarine != (robot.autopilot.firmware == 'ardusub'):
            firmware = f"but its autopilot.firmware is '{robot.autopilot.firmware}'"
            yield f"mavlink.vehicle: read '{link.vehicle}', {firmware}"


def warnings_about(scenario: BaseScenario) -> Problems:
    """Yield valid but improbable values."""
    robots, limit = scenario.robots, scenario.limits.time
    for index, event in enumerate(scenario.events):
        if event.at > limit:
            yield f'events[{index}].at: read {event.at:g}, but the run ends at {limit:g} s'
    for name, robot in robots.items():
        if abs(robot.yaw) > 2.0 * math.pi:
            yield (
                f'robots.{name}.yaw: read {robot.yaw:g}, more than one turn; the unit is radians: '
                f'{robot.yaw:g} degrees are {math.radians(robot.yaw):.4g}'
            )
    area = Area(scenario.environment)
    yield from area.warnings
    if isinstance(scenario, Scenario):
        yield from _robot_warnings(scenario, area)
        return
    for (first, one), (name, robot) in combinations(robots.items(), 2):
        if one.start == robot.start:
            yield f'robots.{name}.start: read {robot.start}, which is also the start of {first}'


def _robot_warnings(scenario: Scenario, area: Area) -> Problems:
    for name, robot in scenario.robots.items():
        wind = scenario.simulated.wind
        if robot.flies and math.hypot(*wind) >= robot.motion.speed:
            yield (
                f'simulated.wind: read {wind}, at least the speed of {name}, '
                f'{robot.motion.speed:g} m/s: the wind carries it away'
            )
        found = [*endurance_warnings(robot), *_start_warnings(robot, area)]
        yield from (f'robots.{name}.{warning}' for warning in found)


def _start_warnings(robot: RobotSettings, area: Area) -> Problems:
    gap = FreeSpace(robot, area).gap(robot.start)
    if gap < robot.radius:
        yield (
            f'start: read {robot.start}, {number(gap)} m from the border or a keep-out zone, '
            f'less than the radius, {robot.radius:g} m: it moves away first'
        )


def event_problems(scenario: BaseScenario) -> Problems:
    """Yield problems of the events."""
    away: set[str] = set()
    for index, event in sorted(enumerate(scenario.events), key=lambda item: item[1].at):
        key = f'events[{index}]'
        if event.robot not in scenario.robots:
            yield f'{key}.robot: {unknown(event.robot, scenario.names(), "robot")}'
            continue
        if scenario.robots[event.robot].external:
            yield (
                f"{key}.robot: read '{event.robot}', an external robot; allowed are simulated "
                'robots'
            )
        if (event.do == 'back') != (event.robot in away):
            state = 'is present' if event.do == 'back' else 'has left'
            yield f"{key}.do: read '{event.do}', but {event.robot} {state} at that time"
        (away.add if event.do == 'leave' else away.discard)(event.robot)


_FAR = 1e9  # longer than any path between two waypoints [m]
_MOST_CANDIDATES = 400  # of the grid that a robot without candidates gets


def robot_candidates(robot: RobotSettings, area: Area | EnvironmentSettings) -> CandidateSet:
    """Return a robot's candidate waypoints; in 2D at the height of its start."""
    return CandidateSet(robot.candidates, Area.of(area), height=robot.start[2])


def never_seen(scenario: Scenario) -> str:
    """Return a warning about parts that are invisible from all candidates, or ''."""
    if any(robot.candidates.ring is not None for robot in scenario.robots.values()):
        return ''  # candidates that move with the robot can reach every position
    area = Area(scenario.environment)
    if not _uses_candidates(scenario, area):
        return ''
    margin = scenario.targets.margin if scenario.targets.positions is None else 0.0
    # Areas seen from the waypoints need no check of the paths between them.
    standing = [_viewer(scenario, name, _FAR) for name in scenario.names()]
    steady = [viewer for viewer in standing if viewer.yaw is not None]
    if steady and not unseen_parts(area, steady, margin):
        return ''
    moving = [
        _viewer(scenario, name, robot.motion.speed * max(robot.sensor.period, scenario.step))
        for name, robot in scenario.robots.items()
    ]
    return unseen_parts(area, moving, margin).describe()


def _uses_candidates(scenario: Scenario, area: Area) -> bool:
    """Return whether the planner chooses among candidates instead of making its own path."""
    name = scenario.planner.name
    if name != 'auto':
        return name not in ('tour', 'lawnmower')
    sensors = [robot.sensor.build(n, scenario.dimension) for n, robot in scenario.robots.items()]
    return not takes_tour(area.volume, 2.0 * min(map(half_view, sensors)), scenario.dimension)


def covering_grid(
    name: str, robot: RobotSettings, environment: EnvironmentSettings
) -> dict[str, Any]:
    """Return a grid of candidates over the bounds from which a robot sees everything.

    Its spacing is at most the width of the sensor's view; if that needs too many waypoints, the
    grid is coarser and `never_seen` warns.
    """
    area = Area(environment)
    bounds = area.bounds
    sides = bounds[:, 1] - bounds[:, 0]
    sensor = robot.sensor.build(name, environment.dimension)
    start = np.array(robot.start)
    width = min(2.0 * half_view(sensor), float(sides.max()))
    while np.ceil(sides / width).prod() > _MOST_CANDIDATES:
        width *= 1.1
    first: dict[str, Any] = {}
    while True:
        numbers = np.ceil(sides / width - 1e-9).astype(int)
        if first and numbers.prod() > _MOST_CANDIDATES:
            # A finer grid would be too large; `never_seen` reports unseen parts.
            return first
        spacing = sides / numbers
        grid = {
            'grid': numbers.tolist(),
            'spacing': spacing.tolist(),
            'corner': (bounds[:, 0] + 0.5 * spacing).tolist(),
        }
        candidates = CandidateSet(CandidateSettings.model_validate(grid), area, robot.start[2])
        yaw = robot.yaw if robot.motion.heading == 'keep' else None
        if not unseen_parts(area, [Viewer(candidates.at(start), start, sensor, _FAR, yaw)]):
            return grid
        first = first or grid
        width *= 0.8


def _viewer(scenario: Scenario, name: str, spacing: float) -> Viewer:
    robot = scenario.robots[name]
    start = np.array(robot.start)
    return Viewer(
        candidates=robot_candidates(robot, scenario.environment).at(start),
        start=start,
        sensor=robot.sensor.build(name, scenario.dimension),
        spacing=spacing,
        yaw=robot.yaw if robot.motion.heading == 'keep' else None,
    )
