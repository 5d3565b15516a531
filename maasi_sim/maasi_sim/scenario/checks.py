"""Checks between the settings of a scenario."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from itertools import chain, combinations

import numpy as np

from maasi_drivers.settings.driver import DRIVERS
from maasi_filter.settings import DETECTIONS
from maasi_sim.scenario.base import BaseScenario, EventSettings
from maasi_sim.scenario.layering import Key, unknown
from maasi_sim.scenario.schema import RobotSettings, Scenario
from maasi_sim.scenario.visibility import robot_candidates
from maasi_sim.simulation.robots import SimulatedSettings

Problems = Iterator[tuple[Key, str]]

_ROBOT_NAME = re.compile(r'^[a-z][a-z0-9]*(_[a-z0-9]+)*$')
_RESERVED = ('exploration', 'ground_truth', 'lockstep', 'scenario')
# Largest deviation of a time from a whole number of steps.
_STEP_TOLERANCE = 1e-6
# Drivers of robots that have no camera, and those that have link mavlink.
_RANGING = ('ranging_driver', 'mavlink_driver')
_MAVLINK = ('mavlink_driver', 'mavlink_camera_driver')
# URL of the driver of a simulated vehicle.
_MAVLINK_URL = re.compile(r'^udpin:[^:]+:(\d+)$')


def problems_of(scenario: Scenario) -> Problems:
    """Yield problems between keys: key and text."""
    yield from _world_problems(scenario)
    ports: dict[str, str] = {}
    for name in scenario.names():
        robot = scenario.robots[name]
        problems = [_robot_problems(name, robot, scenario)]
        problems.append(_sensor_problems(robot, scenario))
        problems.append(_simulated_problems(robot, scenario))
        if robot.link == 'mambo_wifi':
            problems.append(_mambo_problems(robot))
        elif robot.link == 'mavlink':
            problems.append(_mavlink_problems(name, robot, ports))
        for inner, text in chain(*problems):
            yield ('robots', name, *inner), text
    yield from event_problems(scenario.events, scenario.names())
    for index, event in enumerate(scenario.events):
        if event.robot in scenario.robots and scenario.robots[event.robot].external:
            yield (
                ('events', index, 'robot'),
                f"read '{event.robot}', which is external; allowed are simulated robots",
            )
    if scenario.stop == 'all_found' and scenario.targets.count == 0:
        yield ('stop',), "read 'all_found' but there are no targets, allowed is 'planner_done'"


def _world_problems(scenario: Scenario) -> Problems:
    problems: list[tuple[Key, str]] = [
        (
            ('environment', 'obstacles', index, 'centre'),
            f'read {obstacle.centre}, allowed are {scenario.dimension} coordinates, '
            'as in environment.bounds',
        )
        for index, obstacle in enumerate(scenario.environment.obstacles)
        if len(obstacle.centre) > scenario.dimension
    ]
    most, count = _room_for_targets(scenario), scenario.targets.count
    if count is not None and count > most:
        text = f'read {scenario.targets.separation}, with which about {most} targets can be drawn'
        problems.append((('targets', 'separation'), f'{text} at most, not {count}'))
    yield from problems
    if problems:
        return
    try:
        scenario.world(scenario.seed)
    except ValueError as error:
        head, _, text = str(error).partition(': ')
        key: Key = tuple(int(part) if part.isdigit() else part for part in re.findall(r'\w+', head))
        yield (key, text) if key[:1] == ('targets',) else (('targets',), str(error))


def _room_for_targets(scenario: Scenario) -> int:
    """Return how many targets can be drawn one after the other at their separation, at most.

    Balls that are placed at random, none moved again, fill 0.547 of a plane and 0.382 of space.
    """
    targets = scenario.targets
    bounds = scenario.environment.array()
    sides = bounds[:, 1] - bounds[:, 0] - 2.0 * targets.margin
    if targets.separation == 0.0 or sides.min() < 0.0:
        return targets.count or 0
    filled, ball = (0.547, math.pi / 4.0) if scenario.dimension == 2 else (0.382, math.pi / 6.0)
    space = float(np.prod(sides + targets.separation))
    return max(1, round(1.1 * filled * space / (ball * targets.separation**scenario.dimension)))


def _robot_problems(name: str, robot: RobotSettings, scenario: Scenario) -> Problems:
    for text in check_names(name):
        yield (), text
    bounds = scenario.environment.array()
    start = np.array(robot.start)
    point = start[: len(bounds)]
    if not ((point >= bounds[:, 0]) & (point <= bounds[:, 1])).all():
        yield (
            ('start',),
            f'read {robot.start}, allowed is what lies inside environment.bounds, '
            f'{bounds.tolist()}',
        )
    for index, obstacle in enumerate(scenario.environment.obstacles):
        distance = math.dist(start[: len(obstacle.centre)], obstacle.centre[:3])
        if distance < obstacle.radius + robot.radius:
            yield (
                ('start',),
                f'read {robot.start}, {distance:.3g} m from the centre of '
                f'environment.obstacles[{index}], allowed is at least its radius and the '
                f"robot's, {obstacle.radius + robot.radius:g} m",
            )
    try:
        candidates = robot_candidates(robot, scenario.environment)
    except ValueError as error:
        head, _, text = str(error).partition(': ')
        yield (('candidates', head), text) if head != 'candidates' else (('candidates',), text)
    else:
        if not len(candidates.at(robot.start)):
            yield ('candidates',), 'leave no waypoint inside environment.bounds'
    if robot.body == 'external' and robot.link != 'topics':
        yield ('body',), f"read 'external', allowed with link {robot.link} is simulated"


def _simulated_problems(robot: RobotSettings, scenario: Scenario) -> Problems:
    """Yield settings that a camera or an external robot does not have."""
    nothing = SimulatedSettings()
    if robot.camera is not None:
        for field in ('noise', 'noise_factor', 'probability_factor', 'clutter_per_scan'):
            value = getattr(robot.simulated, field)
            if value != getattr(nothing, field):
                yield (
                    ('simulated', field),
                    f'read {value}, which is of a ranging sensor; allowed without a camera',
                )
        for field, allowed in (
            ('walk', 'targets that stand still'),
            ('identified', 'targets without'),
            ('classes', 'targets without'),
        ):
            value = getattr(scenario.targets, field)
            if value:
                yield (
                    ('camera',),
                    f'is there, and targets.{field} is {value}; allowed are {allowed}, or robots '
                    'without a camera',
                )
    if robot.external and robot.simulated != nothing:
        yield ('simulated',), 'is given for a robot that is external; allowed are simulated robots'


def check_names(name: str) -> Iterator[str]:
    """Yield problems of the name of a robot."""
    if not _ROBOT_NAME.match(name):
        yield f"read '{name}' as a name, allowed are lower case letters, digits and single _"
    if name in _RESERVED:
        yield f"read '{name}' as a name, which is that of a topic; allowed is any other"


def _sensor_problems(robot: RobotSettings, scenario: Scenario) -> Problems:
    detection = robot.sensor.detection
    used: tuple[str, ...] = ('lower', 'upper') if detection.kind == 'box' else ('size',)
    if detection.kind not in DETECTIONS.own:
        used = ()
        try:
            detection.build(scenario.dimension)
        except Exception as error:
            # User code: report any error before the nodes start.
            yield ('sensor', 'detection'), f'{type(error).__name__}: {error}'
    for name in used:
        length = len(getattr(detection, name))
        if length < scenario.dimension:
            yield (
                ('sensor', 'detection', name),
                f'read {length} numbers, allowed are {scenario.dimension}, '
                'as in environment.bounds',
            )
    times: list[tuple[Key, float]] = [(('sensor', 'period'), robot.sensor.period)]
    if robot.camera is not None:
        times.append((('camera', 'rate'), 1.0 / robot.camera.rate))
    if robot.laser is not None:
        times.append((('laser', 'rate'), 1.0 / robot.laser.rate))
    for key, time in times:
        steps = time / scenario.step
        if abs(steps - round(steps)) > _STEP_TOLERANCE * max(steps, 1.0) or (
            time > 0.0 and round(steps) == 0
        ):
            yield key, f'is every {time:g} s, allowed are whole multiples of step, {scenario.step}'
    if robot.driver in _RANGING and robot.camera is not None:
        yield ('camera',), f"read one, but driver '{robot.driver}' has none; allowed is null"
    if robot.driver in DRIVERS.own and robot.driver not in _RANGING and robot.camera is None:
        yield ('camera',), f"is missing, driver '{robot.driver}' needs it"


def _mambo_problems(robot: RobotSettings) -> Problems:
    link, model = robot.mambo, robot.motion.model
    yield from _link_problems(robot, ('mambo_driver',), 'the drone has one link only')
    if model != 'mambo':
        yield ('motion', 'model'), f"read '{model}', allowed with link mambo_wifi is 'mambo'"
    if link is None:
        text = 'is missing, link mambo_wifi needs it: at least {arm: true, full_speed: ...}'
        yield ('mambo',), text
        return
    if not link.arm:
        yield ('mambo', 'arm'), 'read false, allowed is true: it would never take off'
    if link.full_speed is None:
        text = 'is missing: it would never take off; measure_mambo measures it'
        yield ('mambo', 'full_speed'), text
    if link.pose != 'events':
        yield ('mambo', 'pose'), f"read '{link.pose}', allowed in simulation is 'events'"
    yield from _height_problems(robot, 'above', 'mambo', link.ground)


def _link_problems(robot: RobotSettings, drivers: Sequence[str], no_guard: str) -> Problems:
    if robot.driver not in drivers:
        yield (
            ('link',),
            f"read '{robot.link}', but driver '{robot.driver}' does not have it; allowed is "
            f"'topics', or driver {' or '.join(drivers)}",
        )
    if robot.guard:
        yield ('guard',), f'read true, allowed with link {robot.link} is false: {no_guard}'


def _height_problems(robot: RobotSettings, side: str, link: str, ground: float) -> Problems:
    rise = robot.start[2] - ground
    if (rise if side == 'above' else -rise) <= 0.0:
        text = f'allowed is what lies {side} {link}.ground, {ground}'
        yield ('start',), f'read height {robot.start[2]}, {text}'


def _mavlink_problems(name: str, robot: RobotSettings, ports: dict[str, str]) -> Problems:
    """Yield problems of a vehicle; `ports` has the robots of other vehicles by their ports."""
    link, firmware = robot.mavlink, robot.autopilot.firmware
    yield from _link_problems(robot, _MAVLINK, 'its autopilot stops it')
    if link is None:
        yield ('mavlink',), 'is missing, link mavlink needs it: at least {arm: true}'
        return
    if not link.arm:
        yield ('mavlink', 'arm'), 'read false, allowed is true: nothing would ever fly'
    match = _MAVLINK_URL.match(link.url)
    if match is None and not robot.external:
        yield (
            ('mavlink', 'url'),
            f"read '{link.url}', allowed is udpin:HOST:PORT, as the vehicle is simulated, "
            'or autopilot: external',
        )
    if match is not None and (other := ports.setdefault(match[1], name)) != name:
        text = f'read port {match[1]}, which {other} has as well; allowed is any other'
        yield ('mavlink', 'url'), text
    submarine = link.vehicle == 'submarine'
    if not robot.external:
        if link.map_yaw != 0.0:
            yield ('mavlink', 'map_yaw'), f'read {link.map_yaw}, allowed in simulation is 0'
        if submarine != (firmware == 'ardusub'):
            text = f"read '{link.vehicle}', but its autopilot.firmware is '{firmware}'"
            yield ('mavlink', 'vehicle'), text
    yield from _height_problems(robot, 'below' if submarine else 'above', 'mavlink', link.ground)


def doubts_about(scenario: BaseScenario) -> Problems:
    """Yield valid but probably unintended values: key and text."""
    robots, limit = scenario.robots, scenario.limits.time
    for index, event in enumerate(scenario.events):
        if event.at > limit:
            yield ('events', index, 'at'), f'read {event.at:g}, but the run ends at {limit:g} s'
    for name, robot in robots.items():
        if abs(robot.yaw) > 2.0 * math.pi:
            yield (
                ('robots', name, 'yaw'),
                f'read {robot.yaw:g}, more than a turn: it is in radians, and {robot.yaw:g} '
                f'degrees are {math.radians(robot.yaw):.4g}',
            )
    for (first, one), (name, robot) in combinations(robots.items(), 2):
        gap = math.dist(one.start, robot.start)
        bodies = getattr(one, 'radius', 0.0) + getattr(robot, 'radius', 0.0)
        if gap == 0.0 or gap < bodies:
            yield (
                ('robots', name, 'start'),
                f'read {robot.start}, {gap:.3g} m from the start of {first}: their bodies overlap',
            )


def event_problems(events: Sequence[EventSettings], names: Sequence[str]) -> Problems:
    """Yield problems of the events: key and text."""
    away: set[str] = set()
    for index, event in sorted(enumerate(events), key=lambda item: item[1].at):
        key: Key = ('events', index)
        if event.robot not in names:
            yield (*key, 'robot'), unknown(event.robot, list(names), 'robot')
            continue
        if (event.do == 'back') != (event.robot in away):
            state = 'is there' if event.do == 'back' else 'has left'
            yield (*key, 'do'), f"read '{event.do}', but {event.robot} {state} at that time"
        (away.add if event.do == 'leave' else away.discard)(event.robot)
