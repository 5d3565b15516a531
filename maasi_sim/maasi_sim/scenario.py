"""Scenario files: what is searched, by which robots, how, and when it ends."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from copy import deepcopy
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from maasi_drivers.camera_settings import CameraSettings
from maasi_drivers.mambo_settings import MamboSettings
from maasi_drivers.mavlink.settings import MavlinkSettings
from maasi_filter.settings import (
    EnvironmentSettings,
    FilterSettings,
    Finite,
    SensorSettings,
    Settings,
)
from maasi_planner.candidates import CandidateSet, Viewer, unseen_parts
from maasi_planner.node_settings import PlannerNodeSettings
from maasi_planner.settings import CandidateSettings, MotionSettings, PlannerSettings
from maasi_sim.autopilot_settings import AutopilotSettings
from maasi_sim.camera import RenderSettings
from maasi_sim.laser_scan import LaserSettings
from maasi_sim.odometry_model import OdometrySettings
from maasi_sim.robots import BatterySettings
from maasi_sim.world import TargetSettings, World
from maasi_sim.yaml_files import (
    Key,
    Layer,
    ScenarioError,
    dotted,
    merge,
    override,
    place,
    read_layer,
    to_yaml,
    unknown,
    validate,
)

__all__ = ['RobotSettings', 'Scenario', 'ScenarioError', 'load_scenario']

_ROBOT_NAME = re.compile(r'^[a-z][a-z0-9_]*$')
_RESERVED = ('exploration', 'ground_truth', 'lockstep', 'scenario')
# How far a time may be from a whole number of steps.
_STEP_TOLERANCE = 1e-6
# Farther than any way between two waypoints [m].
_FAR = 1e9
# Drivers of robots that have no camera.
_RANGING = ('ranging_driver', 'mavlink_driver')
# Drivers that have link mavlink.
_MAVLINK = ('mavlink_driver', 'mavlink_camera_driver')
# Where the driver of a vehicle listens that the sim plays.
_MAVLINK_URL = re.compile(r'^udpin:[^:]+:(\d+)$')


class RobotSettings(Settings):
    """One robot: its type's settings with the scenario's own on top."""

    type: str = Field(description='Name of the type: a file in config/robots')
    description: str = Field(default='', description='What it is, in words')
    driver: Literal[
        'mambo_driver',
        'turtlebot_driver',
        'ranging_driver',
        'mavlink_driver',
        'mavlink_camera_driver',
    ] = Field(description='Executable of maasi_drivers that drives it')
    guard: bool | None = Field(
        default=None,
        description='Whether a guard stops it when its driver dies or hangs; none: where it is '
        'reached by topics, as another link has a time limit of its own',
    )
    body: Literal['simulated', 'external'] = Field(
        default='simulated',
        description='With link topics: whether the sim moves it, or another program, as Gazebo, '
        'that publishes its odometry and the time (/clock)',
    )
    link: Literal['topics', 'mambo_wifi', 'mavlink'] = Field(
        default='topics', description='How its driver reaches it; the sim plays the other end'
    )
    mambo: MamboSettings | None = Field(
        default=None,
        description='With link mambo_wifi: how, and what it may be made to do; an address that '
        'is not of this host is replaced, as the sim plays the drone',
    )
    mavlink: MavlinkSettings | None = Field(
        default=None, description='With link mavlink: how, and what it may be made to do'
    )
    autopilot: AutopilotSettings = Field(
        default_factory=AutopilotSettings,
        description='With link mavlink: its autopilot, simulated; or external: another program',
    )
    start: Annotated[list[Finite], Field(min_length=3, max_length=3)] = Field(
        description='Position at the start, x y z [m, map]'
    )
    yaw: Finite = Field(default=0.0, description='Heading at the start [rad]')
    radius: float = Field(default=0.1, gt=0.0, description='Of a circle around the robot [m]')
    candidates: CandidateSettings = Field(description='Waypoints to choose from')
    motion: MotionSettings = Field(description='How it moves')
    sensor: SensorSettings = Field(description='What it sees, as the filter believes')
    camera: CameraSettings | None = Field(
        default=None, description='Its camera; none: a ranging sensor'
    )
    laser: LaserSettings | None = Field(default=None, description='Its laser scanner, if any')
    odometry: OdometrySettings = Field(
        default_factory=OdometrySettings, description='How good its odometry is, simulated'
    )
    battery: BatterySettings = Field(
        default_factory=BatterySettings, description='Its battery, simulated'
    )

    @property
    def external(self) -> bool:
        """Whether another program than the sim moves it."""
        if self.link == 'mavlink':
            return self.autopilot.external
        return self.body == 'external'

    @property
    def takes_off(self) -> bool:
        """Whether it is simulated, and takes off when its driver's service `arm` is called."""
        return self.link != 'topics' and not self.external


class EventSettings(Settings):
    """Something that happens to a robot."""

    at: float = Field(ge=0.0, description='When [s]')
    robot: str = Field(description='To whom')
    do: Literal['leave', 'back'] = Field(description='It goes silent, or it is there again')


class LimitSettings(Settings):
    """When a run is given up."""

    time: float = Field(default=600.0, gt=0.0, description='Simulated time [s]')
    start: float = Field(
        default=180.0,
        gt=0.0,
        description='Wall time until all nodes are ready; they may have to compile [s]',
    )
    silence: float = Field(
        default=30.0,
        gt=0.0,
        description='Wall time without a step until a node counts as hung [s]',
    )
    heartbeat: float = Field(
        default=4.5,
        ge=2.0,
        description='Wall time without a sign of life of a node, while it does not wait for a '
        'processor, until it counts as hung; free running [s]',
    )
    restarts: int = Field(
        default=3, ge=0, description='Restarts of one node with on_exit: respawn [1]'
    )


class ScoringSettings(Settings):
    """How found targets are compared with the truth."""

    radius: float | None = Field(
        default=None,
        gt=0.0,
        description='Distance within which a found target is true; none: 3 T_z, at most half the '
        'smallest distance of two targets [m]',
    )
    order: float = Field(default=2.0, ge=1.0, description='p of GOSPA [1]')


class RecordSettings(Settings):
    """What the recording holds."""

    images: Literal['jpeg', 'png', 'raw'] = Field(
        default='jpeg', description='How images are stored; png is lossless and slower'
    )


class Scenario(Settings):
    """A whole scenario file, all layers merged."""

    version: Literal[1] = Field(description='Of this format')
    description: str = Field(default='', description='What it shows, in words')
    environment: EnvironmentSettings = Field(description='Where the targets are')
    step: float = Field(default=0.05, gt=0.0, le=10.0, description='Between what nodes see [s]')
    seed: int = Field(default=1, ge=0, description='Of all random numbers, unless given otherwise')
    targets: TargetSettings = Field(description='The truth, for the simulation and the report')
    robots: dict[str, RobotSettings] = Field(min_length=1, description='Robots by name')
    filter: FilterSettings = Field(default_factory=FilterSettings, description='Search filter')
    planner: PlannerSettings = Field(default_factory=PlannerSettings, description='Planner')
    floor: RenderSettings = Field(
        default_factory=lambda: RenderSettings.model_validate({}),
        description='What simulated cameras see',
    )
    events: list[EventSettings] = Field(default_factory=list, description='What happens to robots')
    stop: Literal['all_found', 'planner_done'] = Field(
        default='all_found',
        description='When the run ends well: all true targets are found, or the planner says that '
        'nothing is left to gain',
    )
    on_exit: Literal['end', 'respawn'] = Field(
        default='end', description='A node that dies ends the run, or is started again'
    )
    limits: LimitSettings = Field(default_factory=LimitSettings, description='When to give up')
    scoring: ScoringSettings = Field(default_factory=ScoringSettings, description='Scores')
    record: RecordSettings = Field(default_factory=RecordSettings, description='Recording')

    @property
    def dimension(self) -> int:
        """2 or 3."""
        return self.environment.dimension

    def names(self) -> list[str]:
        """Return the robots' names in order."""
        return sorted(self.robots)

    def namespaces(self) -> dict[str, list[str]]:
        """Return the robots that share filter and planner, by the namespace of those nodes.

        The empty one stands for the root: all robots together.
        """
        if self.planner.coordination == 'independent':
            return {name: [name] for name in self.names()}
        return {'': self.names()}

    def check_pace(self, lockstep: bool, rate: float | None) -> None:
        """Check that it can be run in lockstep, or at a rate (simulated over wall time).

        Raises
        ------
        ScenarioError
            If it cannot: links other than topics run in real time.
        """
        for name in self.names():
            link = self.robots[name].link
            if link != 'topics' and (lockstep or rate not in (None, 1.0)):
                asked = 'lockstep' if lockstep else f'rate {rate:g}'
                raise ScenarioError(
                    f'robots.{name}.link: read {link!r}, which runs in real time, and {asked}; '
                    'allowed is topics, or rate 1 without lockstep'
                )
            if self.robots[name].body == 'external' and (lockstep or rate not in (None, 1.0)):
                asked = 'lockstep' if lockstep else f'rate {rate:g}'
                raise ScenarioError(
                    f"robots.{name}.body: read 'external', and {asked}; allowed is simulated, or "
                    'neither --lockstep nor --rate: the time is that of /clock'
                )

    @property
    def external_clock(self) -> bool:
        """Whether the time is that of the program that moves a robot."""
        return any(robot.body == 'external' for robot in self.robots.values())

    def removal_distance(self) -> float:
        """Return T_z [m]: the filter's, or four deviations of the coarsest range without."""
        distance = self.filter.resolved().removal_distance
        if distance is not None:
            return distance
        return 4.0 * max(
            float(robot.sensor.noise.deviations(self.dimension)[0])
            for robot in self.robots.values()
        )

    def world(self, seed: int) -> World:
        """Return the true world of a run."""
        return World.from_settings(self.environment, self.targets, seed)

    def content(self) -> dict[str, Any]:
        """Return all settings as plain values; `load_scenario` reads them back the same."""
        return self.model_dump(mode='python', by_alias=True)

    def text(self) -> str:
        """Return all settings as a scenario file that needs no other layer."""
        return to_yaml(self.content())


def config_folder() -> Path:
    """Return the folder of `robots/` and `scenarios/`: installed, or in this repository.

    Raises
    ------
    ScenarioError
        If it is in neither.
    """
    places = [Path(__file__).resolve().parents[2] / 'config']
    try:
        from ament_index_python.packages import get_package_share_directory

        places.insert(0, Path(get_package_share_directory('maasi_config')))
    except (ImportError, LookupError, OSError):
        pass
    for folder in places:
        if (folder / 'robots').is_dir():
            return folder
    raise ScenarioError(f'robots: no such folder in {", ".join(map(str, places))}')


def find_scenario(name: str | Path) -> Path:
    """Return the file of a scenario: a path, or the name of one in `config/scenarios`.

    Raises
    ------
    ScenarioError
        If there is none; the known ones are named.
    """
    path = Path(name)
    if path.exists() or path.suffix or len(path.parts) > 1:
        return path
    folder = config_folder() / 'scenarios'
    known = sorted(item.stem for item in folder.glob('*.yaml'))
    if path.name not in known:
        raise ScenarioError(unknown(path.name, known, 'scenario'))
    return folder / f'{path.name}.yaml'


def load_scenario(
    path: str | Path, overrides: Mapping[str, tuple[Key, Any]] | None = None
) -> Scenario:
    """Read a scenario file with its layers: all robots, then the type, then the robot itself.

    Types are looked for in `robots/` beside the scenario file and beside its folder, then in
    `config/robots`.

    Parameters
    ----------
    path : str or Path
        Scenario file, or the name of one in `config/scenarios`.
    overrides : mapping, optional
        Values that win over the file's: where each comes from (for messages), key and value.

    Raises
    ------
    ScenarioError
        With file, line, key, what was read and what is allowed.
    """
    return check_scenario(read_scenario(path, overrides))


def read_scenario(
    path: str | Path, overrides: Mapping[str, tuple[Key, Any]] | None = None
) -> Layer:
    """Return the values of a scenario file with its layers, not checked yet.

    Raises
    ------
    ScenarioError
        If a file cannot be read, or a robot's type is not known.
    """
    path = find_scenario(path)
    layer = read_layer(path)
    _lay_types_under(layer, path)
    for origin, (key, value) in (overrides or {}).items():
        override(layer, key, value, origin)
    return layer


def scenario_from_values(values: dict[str, Any], origin: str) -> Scenario:
    """Return the scenario of values as a scenario file has them: types come from config/robots.

    Raises
    ------
    ScenarioError
        As `load_scenario`.
    """
    layer = Layer(deepcopy(values), {(): origin})
    _lay_types_under(layer, config_folder() / 'scenarios' / origin)
    return check_scenario(layer)


def scenario_from_content(content: dict[str, Any], origin: str) -> Scenario:
    """Return the scenario of values with all layers merged, as from `Scenario.content`.

    Raises
    ------
    ScenarioError
        As `load_scenario`.
    """
    return check_scenario(Layer(content, {(): origin}))


def check_scenario(layer: Layer) -> Scenario:
    """Return the scenario of a tree of values with all layers merged."""
    scenario = validate(Scenario, layer)
    problems = list(_problems(scenario))
    if problems:
        raise ScenarioError(
            '\n'.join(
                f'{layer.origin(problem)}: {dotted(problem)}: {text}' for problem, text in problems
            )
        )
    return scenario


def _lay_types_under(layer: Layer, path: Path) -> None:
    """Put the layers of each robot's type under what the scenario says of it."""
    robots = layer.data.get('robots')
    if isinstance(robots, dict):
        for name in robots:
            if isinstance(robots[name], dict):
                key: Key = ('robots', name)
                place(layer, key, _robot_layer(path, layer.part(key), key))


def _robot_layer(path: Path, own: Layer, key: Key) -> Layer:
    folders = [path.parent / 'robots', path.parent.parent / 'robots', config_folder() / 'robots']
    files: dict[str, Path] = {}
    for folder in folders:
        for file in sorted(folder.glob('*.yaml')):
            files.setdefault(file.stem, file)
    layers = [read_layer(files['all'])] if 'all' in files else []
    kind = own.data.get('type')
    known = sorted(set(files) - {'all'})
    if kind is None:
        raise ScenarioError(
            f'{own.origin(())}: {dotted((*key, "type"))}: is missing, known are {", ".join(known)}'
        )
    if isinstance(kind, str):
        if kind not in known:
            raise ScenarioError(
                f'{own.origin(("type",))}: {dotted((*key, "type"))}: '
                f'{unknown(kind, known, "robot type")}'
            )
        layers.append(read_layer(files[kind]))
    return merge(*layers, own)


def robot_type(name: str) -> RobotSettings:
    """Return a robot of a type in `config/robots`, on its own.

    Raises
    ------
    ScenarioError
        If there is no such type, or its file is wrong.
    """
    content = {
        'type': name,
        'start': [0.0, 0.0, 0.0],
        'candidates': {'ring': 4, 'distance': 1.0},
    }
    own = Layer(content, {(): f'robot type {name}'})
    return validate(RobotSettings, _robot_layer(config_folder() / 'scenarios' / name, own, ()))


def _problems(scenario: Scenario) -> Iterator[tuple[Key, str]]:
    """Yield what is wrong between the keys: key and text."""
    yield from _world_problems(scenario)
    for name, robot in scenario.robots.items():
        for inner, text in _robot_problems(name, robot, scenario):
            yield ('robots', name, *inner), text
    yield from _mambo_problems(scenario)
    yield from _mavlink_problems(scenario)
    yield from event_problems(scenario.events, scenario.names(), scenario.limits)
    for index, event in enumerate(scenario.events):
        if event.robot in scenario.robots and scenario.robots[event.robot].external:
            yield (
                ('events', index, 'robot'),
                f"read '{event.robot}', which is external; allowed are simulated robots",
            )
    if scenario.stop == 'all_found' and scenario.targets.count == 0:
        yield ('stop',), "read 'all_found' but there are no targets, allowed is 'planner_done'"


def _world_problems(scenario: Scenario) -> Iterator[tuple[Key, str]]:
    found = False
    for index, obstacle in enumerate(scenario.environment.obstacles):
        if len(obstacle.centre) > scenario.dimension:
            found = True
            yield (
                ('environment', 'obstacles', index, 'centre'),
                f'read {obstacle.centre}, allowed are {scenario.dimension} coordinates, '
                'as in environment.bounds',
            )
    most = _room_for_targets(scenario)
    if scenario.targets.count is not None and scenario.targets.count > most:
        found = True
        yield (
            ('targets', 'separation'),
            f'read {scenario.targets.separation}, with which about {most} targets can be drawn '
            f'at most, not {scenario.targets.count}',
        )
    if found:
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


def _robot_problems(
    name: str, robot: RobotSettings, scenario: Scenario
) -> Iterator[tuple[Key, str]]:
    for text in check_names(name):
        yield (), text
    bounds = scenario.environment.array()
    start = np.array(robot.start)
    if not _inside(start, bounds):
        yield (
            ('start',),
            f'read {robot.start}, allowed is what lies inside environment.bounds, '
            f'{bounds.tolist()}',
        )
    for index, obstacle in enumerate(scenario.environment.obstacles):
        size = min(len(obstacle.centre), 3)
        distance = float(np.linalg.norm(start[:size] - np.array(obstacle.centre)[:size]))
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
    yield from _sensor_problems(robot, scenario)


def check_names(name: str) -> Iterator[str]:
    """Yield what is wrong with the name of a robot."""
    if not _ROBOT_NAME.match(name) or name.endswith('_') or '__' in name:
        yield f"read '{name}' as a name, allowed are lower case letters, digits and single _"
    if name in _RESERVED:
        yield f"read '{name}' as a name, which is that of a topic; allowed is any other"


def _sensor_problems(robot: RobotSettings, scenario: Scenario) -> Iterator[tuple[Key, str]]:
    detection = robot.sensor.detection
    used = ('lower', 'upper') if detection.kind == 'box' else ('size',)
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
    if robot.driver not in _RANGING and robot.camera is None:
        yield ('camera',), f"is missing, driver '{robot.driver}' needs it"


def _mambo_problems(scenario: Scenario) -> Iterator[tuple[Key, str]]:
    for name in scenario.names():
        robot = scenario.robots[name]
        if robot.link != 'mambo_wifi':
            continue
        key: Key = ('robots', name)
        if robot.driver != 'mambo_driver':
            yield (
                (*key, 'link'),
                f"read 'mambo_wifi', but driver '{robot.driver}' does not have it; allowed is "
                "'topics', or driver 'mambo_driver'",
            )
        if robot.motion.model != 'mambo':
            yield (
                (*key, 'motion', 'model'),
                f"read '{robot.motion.model}', allowed with link mambo_wifi is 'mambo'",
            )
        if robot.guard:
            yield (
                (*key, 'guard'),
                'read true, allowed with link mambo_wifi is false: the drone has one link only',
            )
        link = robot.mambo
        if link is None:
            yield (
                (*key, 'mambo'),
                'is missing, link mambo_wifi needs it: at least {arm: true, full_speed: ...}',
            )
            continue
        key = (*key, 'mambo')
        if not link.arm:
            yield (*key, 'arm'), 'read false, allowed is true: it would never take off'
        if link.full_speed is None:
            yield (
                (*key, 'full_speed'),
                'is missing: it would never take off; measure_mambo says it, of fake_mambo too',
            )
        if link.pose != 'events':
            yield (*key, 'pose'), f"read '{link.pose}', allowed in simulation is 'events'"
        if robot.start[2] <= link.ground:
            yield (
                ('robots', name, 'start'),
                f'read height {robot.start[2]}, allowed is what lies above mambo.ground, '
                f'{link.ground}',
            )


def _mavlink_problems(scenario: Scenario) -> Iterator[tuple[Key, str]]:
    ports: dict[str, str] = {}
    for name in scenario.names():
        robot = scenario.robots[name]
        if robot.link != 'mavlink':
            continue
        key: Key = ('robots', name)
        if robot.driver not in _MAVLINK:
            yield (
                (*key, 'link'),
                f"read 'mavlink', but driver '{robot.driver}' does not have it; allowed is "
                "'topics', or one of the drivers " + ', '.join(_MAVLINK),
            )
        if robot.guard:
            yield (
                (*key, 'guard'),
                'read true, allowed with link mavlink is false: its autopilot stops it',
            )
        link = robot.mavlink
        if link is None:
            yield (*key, 'mavlink'), 'is missing, link mavlink needs it: at least {arm: true}'
            continue
        key = (*key, 'mavlink')
        if not link.arm:
            yield (*key, 'arm'), 'read false, allowed is true: nothing would ever fly'
        match = _MAVLINK_URL.match(link.url)
        if match is None:
            if not robot.external:
                yield (
                    (*key, 'url'),
                    f"read '{link.url}', allowed is udpin:HOST:PORT, as the sim plays the vehicle, "
                    'or autopilot: external',
                )
        elif match[1] in ports:
            yield (
                (*key, 'url'),
                f'read port {match[1]}, which {ports[match[1]]} has as well; allowed is any other',
            )
        else:
            ports[match[1]] = name
        if link.map_yaw != 0.0 and not robot.external:
            yield (*key, 'map_yaw'), f'read {link.map_yaw}, allowed in simulation is 0'
        firmware = robot.autopilot.firmware
        submarine = link.vehicle == 'submarine'
        if submarine != (firmware == 'ardusub') and not robot.external:
            yield (
                (*key, 'vehicle'),
                f"read '{link.vehicle}', but its autopilot.firmware is '{firmware}'",
            )
        rise = robot.start[2] - link.ground
        if rise >= 0.0 if submarine else rise <= 0.0:
            side = 'below' if submarine else 'above'
            yield (
                ('robots', name, 'start'),
                f'read height {robot.start[2]}, allowed is what lies {side} mavlink.ground, '
                f'{link.ground}',
            )


def event_problems(
    events: Sequence[EventSettings], names: Sequence[str], limits: LimitSettings
) -> Iterator[tuple[Key, str]]:
    """Yield what is wrong with what happens to robots: key and text."""
    away: set[str] = set()
    order = sorted(range(len(events)), key=lambda index: events[index].at)
    for index in order:
        event = events[index]
        key: Key = ('events', index)
        if event.robot not in names:
            yield (*key, 'robot'), unknown(event.robot, list(names), 'robot')
            continue
        if event.at > limits.time:
            yield (
                (*key, 'at'),
                f'read {event.at}, allowed is at most limits.time, {limits.time}',
            )
        if (event.do == 'back') != (event.robot in away):
            state = 'is there' if event.do == 'back' else 'has left'
            yield (*key, 'do'), f"read '{event.do}', but {event.robot} {state} at that time"
        (away.add if event.do == 'leave' else away.discard)(event.robot)


def _inside(position: Sequence[float] | np.ndarray, bounds: np.ndarray) -> bool:
    point = np.asarray(position, dtype=float)[: len(bounds)]
    return bool(((point >= bounds[:, 0]) & (point <= bounds[:, 1])).all())


def robot_candidates(robot: RobotSettings, environment: EnvironmentSettings) -> CandidateSet:
    """Return a robot's candidate waypoints; in 2D at the height of its start."""
    return CandidateSet(robot.candidates, environment.array(), height=robot.start[2])


def planner_settings(
    scenario: Scenario, names: Sequence[str], common: Mapping[str, Any]
) -> PlannerNodeSettings:
    """Return the settings of the planner of some robots; the others plan for themselves.

    Parameters
    ----------
    scenario : Scenario
        With all layers.
    names : sequence of str
        Its robots.
    common : mapping
        Settings that all nodes share.
    """
    return PlannerNodeSettings.model_validate(
        {
            **common,
            'environment': scenario.environment,
            'planner': scenario.planner,
            # As the filter has it.
            'exploration_spacing': scenario.filter.exploration_spacing,
            'robots': {
                name: {
                    'candidates': scenario.robots[name].candidates,
                    'motion': scenario.robots[name].motion,
                    'sensor': scenario.robots[name].sensor,
                    'radius': scenario.robots[name].radius,
                    'start': scenario.robots[name].start,
                }
                for name in names
            },
            'others': {
                name: {'radius': robot.radius, 'start': robot.start}
                for name, robot in scenario.robots.items()
                if name not in names
            },
        }
    )


def never_seen(scenario: Scenario) -> str:
    """Return a warning that says which parts can never be seen from the candidates, or ''."""
    if any(robot.candidates.ring is not None for robot in scenario.robots.values()):
        # Waypoints that move with the robot lead anywhere.
        return ''
    bounds = scenario.environment.array()
    margin = scenario.targets.margin if scenario.targets.positions is None else 0.0
    # What is seen from the waypoints alone needs no look at the ways between them.
    standing = {name: _viewer(scenario, name, _FAR) for name in scenario.names()}
    steady = {name: viewer for name, viewer in standing.items() if viewer.yaw is not None}
    if steady and not unseen_parts(bounds, steady, margin):
        return ''
    moving = {
        name: _viewer(scenario, name, robot.motion.speed * max(robot.sensor.period, scenario.step))
        for name, robot in scenario.robots.items()
    }
    return unseen_parts(bounds, moving, margin).describe()


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


def steps_of(time: float, step: float) -> int:
    """Return how many steps a time takes, at least one."""
    return max(1, math.floor(time / step + 0.5))
