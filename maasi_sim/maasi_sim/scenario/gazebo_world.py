"""A scenario as a world of Gazebo (SDF), and the topics that its bridge carries. Without ROS.

Read in the sources of sdformat (`sdf/1.9/*.sdf`), ros_gz_bridge (README.md) and gz-sim (systems
VelocityControl: twists in the axes of the model; OdometryPublisher: poses in the world).
"""

import math
import re
from collections.abc import Sequence
from copy import deepcopy
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as Xml

import numpy as np
import yaml
from shapely.geometry import Polygon, box
from shapely.geometry.base import BaseGeometry
from shapely.geometry.polygon import orient

from maasi_drivers.settings.camera import CameraSettings
from maasi_drivers.vision.camera_model import Camera
from maasi_filter.geometry.area import level_shape
from maasi_filter.geometry.environment import Zone
from maasi_sim.scenario.external import external_topics
from maasi_sim.scenario.layering import ScenarioError
from maasi_sim.scenario.schema import RobotSettings, Scenario
from maasi_sim.simulation.sensors import LaserSettings

_VERSION = '1.9'
# Without heights in the scenario obstacles stand this much above the highest start [m].
_ABOVE = 1.0
_MARGIN = 0.2  # of the ground around the bounds, as a share of their size
_STEP = 0.004  # of the physics [s]
_THICKNESS = 0.002  # of a marker on the ground [m]
_GREY = (0.35, 0.35, 0.4)
_SYSTEMS = {
    'gz-sim-physics-system': 'gz::sim::systems::Physics',
    'gz-sim-user-commands-system': 'gz::sim::systems::UserCommands',
    'gz-sim-scene-broadcaster-system': 'gz::sim::systems::SceneBroadcaster',
}
_SENSORS = 'gz-sim-sensors-system', 'gz::sim::systems::Sensors'


def moved_robots(scenario: Scenario) -> dict[str, RobotSettings]:
    """Return the robots that Gazebo can move: those whose driver uses topics."""
    return {name: robot for name, robot in scenario.robots.items() if robot.link == 'topics'}


def world_text(scenario: Scenario, name: str) -> str:
    """Return the world (SDF 1.9): ground, obstacles, markers of simulated targets, robots."""
    root = Xml.Element('sdf', version=_VERSION)
    world = _add(root, 'world', name=name)
    physics = _add(world, 'physics', name='default', type='ignored')
    _values(physics, max_step_size=_STEP, real_time_factor=1.0, real_time_update_rate=1.0 / _STEP)
    _values(world, gravity='0 0 -9.8', magnetic_field='0 2e-05 -4e-05')
    _add(world, 'atmosphere', type='adiabatic')
    robots = moved_robots(scenario)
    for file, system in _SYSTEMS.items():
        _add(world, 'plugin', filename=file, name=system)
    if any(robot.camera or robot.laser for robot in robots.values()):
        file, system = _SENSORS
        _values(_add(world, 'plugin', filename=file, name=system), render_engine='ogre2')
    if (origin := scenario.environment.origin) is not None:
        _values(
            _add(world, 'spherical_coordinates'),
            surface_model='EARTH_WGS84',
            world_frame_orientation='ENU',
            latitude_deg=origin.latitude,
            longitude_deg=origin.longitude,
            elevation=origin.altitude,
            heading_deg=0.0,
        )
    _values(_add(world, 'scene'), ambient='0.7 0.7 0.7', background='0.7 0.8 0.9', shadows=False)
    light = _add(world, 'light', name='sun', type='directional')
    _values(light, cast_shadows=False, pose=_pose([0.0, 0.0, 50.0]), diffuse='0.6 0.6 0.6')
    _values(light, specular='0 0 0', direction='-0.2 0.1 -1')
    _ground(world, scenario)
    low, high = _heights(scenario)
    for number, zone in enumerate(scenario.environment.obstacles, start=1):
        _obstacle(world, f'obstacle_{number}', zone, low, high)
    _targets(world, scenario)
    taken = {item.get('name') for item in (*world.iter('model'), light)}
    for robot_name, robot in robots.items():
        if robot_name in taken:
            raise ScenarioError(
                f'robots.{robot_name}: read a name that the world has for another part, allowed '
                'is one that is not in it: rename the robot'
            )
        _robot(world, robot_name, robot)
    Xml.indent(root)
    return '<?xml version="1.0"?>\n' + Xml.tostring(root, encoding='unicode') + '\n'


def bridge_text(scenario: Scenario) -> str:
    """Return the configuration of ros_gz_bridge for the world."""
    topics = [_bridged('/clock', 'rosgraph_msgs/msg/Clock', 'gz.msgs.Clock')]
    for name, robot in moved_robots(scenario).items():
        outside = {'body': 'external', 'measurements': 'external'}
        for topic in external_topics(name, robot.model_copy(update=outside)):
            if topic.gazebo_type is not None:
                direction = 'ROS_TO_GZ' if topic.command else 'GZ_TO_ROS'
                topics.append(_bridged(topic.name, topic.type, topic.gazebo_type, direction))
    return yaml.safe_dump(topics, sort_keys=False)


def write_world(scenario: Scenario, world: Path) -> list[str]:
    """Write the world and, next to it, the file of its bridge; return what differs from it."""
    # Gazebo has the name in its topics, which allow few characters.
    text = world_text(scenario, re.sub(r'[^A-Za-z0-9_-]', '_', world.stem))
    world.parent.mkdir(parents=True, exist_ok=True)
    world.write_text(text, encoding='utf-8')
    bridge_file(world).write_text(bridge_text(scenario), encoding='utf-8')
    notes = []
    if scenario.environment.terrain.file is not None:
        notes.append('environment.terrain: the ground of the world is flat')
    for name, robot in scenario.robots.items():
        if robot.link != 'topics':
            notes.append(f"robots.{name}.link: read '{robot.link}': not in the world")
            continue
        if robot.body != 'external':
            notes.append(
                f"robots.{name}.body: read 'simulated'; with Gazebo it is external, which moves it"
            )
        if robot.camera is not None and robot.measurements != 'external':
            notes.append(
                f"robots.{name}.camera: read 'simulated'; external uses the images of Gazebo"
            )
    return notes


def bridge_file(world: Path) -> Path:
    """Return the file of the bridge of a world."""
    return world.with_suffix('.bridge.yaml')


def _bridged(topic: str, ros: str, gazebo: str, direction: str = 'GZ_TO_ROS') -> dict[str, str]:
    return {
        'ros_topic_name': topic,
        'gz_topic_name': topic,
        'ros_type_name': ros,
        'gz_type_name': gazebo,
        'direction': direction,
    }


# ---- elements ---------------------------------------------------------------------------------


def _add(parent: Xml.Element, tag: str, **attributes: str) -> Xml.Element:
    return Xml.SubElement(parent, tag, attributes)


def _values(element: Xml.Element, **values: Any) -> Xml.Element:
    """Add an element for each value."""
    for tag, value in values.items():
        text = str(value).lower() if isinstance(value, bool) else str(value)
        Xml.SubElement(element, tag).text = text
    return element


def _numbers(values: Sequence[float]) -> str:
    return ' '.join(f'{value:.9g}' for value in values)


def _pose(position: Sequence[float], rpy: Sequence[float] = (0.0, 0.0, 0.0)) -> str:
    return _numbers([*position, *rpy])


def _body(
    world: Xml.Element,
    name: str,
    pose: str,
    shape: Xml.Element,
    colour: Sequence[float],
    solid: bool = True,
) -> Xml.Element:
    """Add a model with one link of a shape; return the model."""
    model = _add(world, 'model', name=name)
    _values(model, pose=pose)
    link = _add(model, 'link', name='base_link')
    parts = [_add(link, 'visual', name='visual')]
    parts += [_add(link, 'collision', name='collision')] if solid else []
    for part in parts:
        part.append(deepcopy(shape))
    text = _numbers([*colour, 1.0])
    _values(_add(parts[0], 'material'), ambient=text, diffuse=text, specular='0 0 0 1')
    return model


def _shape(kind: str, **values: Any) -> Xml.Element:
    geometry = Xml.Element('geometry')
    _values(_add(geometry, kind), **values)
    return geometry


def _static(model: Xml.Element) -> None:
    static = Xml.Element('static')
    static.text = 'true'
    model.insert(0, static)


# ---- parts of the world -----------------------------------------------------------------------


def _heights(scenario: Scenario) -> tuple[float, float]:
    """Return the heights of foot and top of obstacles without heights."""
    if scenario.dimension == 3:
        low, high = scenario.environment.array()[2].tolist()
        return low, high
    return 0.0, max(robot.start[2] for robot in scenario.robots.values()) + _ABOVE


def _ground(world: Xml.Element, scenario: Scenario) -> None:
    bounds = scenario.environment.array()
    centre, size = bounds[:2].mean(axis=1), bounds[:2, 1] - bounds[:2, 0]
    size = size * (1.0 + 2.0 * _MARGIN)
    height = bounds[2, 0] if scenario.dimension == 3 else 0.0
    plane = _shape('plane', normal='0 0 1', size=_numbers(size.tolist()))
    pose = _pose([*centre, height])
    _static(_body(world, 'ground', pose, plane, scenario.floor.floor_colour))


def _obstacle(world: Xml.Element, name: str, zone: Zone, low: float, high: float) -> None:
    length, middle = high - low, 0.5 * (low + high)
    if zone.centre is not None and len(zone.centre) == 3:
        shape = _shape('sphere', radius=zone.radius)
        _static(_body(world, name, _pose(zone.centre), shape, _GREY))
    elif zone.centre is not None:
        shape = _shape('cylinder', radius=zone.radius, length=length)
        _static(_body(world, name, _pose([*zone.centre, middle]), shape, _GREY))
    else:
        polygons = _whole_parts(level_shape(zone))
        for number, polygon in enumerate(polygons, start=1):
            part, block = f'{name}_{number}' if len(polygons) > 1 else name, _as_box(polygon)
            if block is not None:
                centre, sides, yaw = block
                shape = _shape('box', size=_numbers([*sides, length]))
                pose = _pose([*centre, middle], (0.0, 0.0, yaw))
            else:
                shape, pose = _prism(polygon, length), _pose([0.0, 0.0, low])
            _static(_body(world, part, pose, shape, _GREY))


def _whole_parts(shape: BaseGeometry) -> list[Polygon]:
    """Return polygons without holes, which SDF does not have: cut through each hole."""
    if not isinstance(shape, Polygon):
        return [part for item in getattr(shape, 'geoms', []) for part in _whole_parts(item)]
    if not shape.interiors:
        return [shape]
    west, south, east, north = shape.bounds
    middle = shape.interiors[0].centroid.x
    halves = box(west, south, middle, north), box(middle, south, east, north)
    return [part for half in halves for part in _whole_parts(shape.intersection(half))]


def _as_box(polygon: Polygon) -> tuple[list[float], list[float], float] | None:
    """Return centre, sides and yaw of a rectangle, or None for another polygon."""
    corners = np.array(orient(polygon).exterior.coords)[:-1]
    if len(corners) != 4:
        return None
    edges = np.roll(corners, -1, axis=0) - corners
    sides = np.hypot(*edges.T)
    square = abs(float(edges[0] @ edges[1])) < 1e-6 * sides[0] * sides[1]
    if not square or not np.allclose(edges[0], -edges[2], atol=1e-6 * sides[0]):
        return None
    yaw = math.atan2(edges[0, 1], edges[0, 0])
    return corners.mean(axis=0).tolist(), sides[:2].tolist(), yaw


def _prism(polygon: Polygon, height: float) -> Xml.Element:
    """Return a shape that extrudes a polygon."""
    geometry = Xml.Element('geometry')
    line = _add(geometry, 'polyline')
    for corner in list(orient(polygon).exterior.coords)[:-1]:
        Xml.SubElement(line, 'point').text = _numbers(corner[:2])
    _values(line, height=f'{height:.9g}')
    return geometry


def _targets(world: Xml.Element, scenario: Scenario) -> None:
    radius = 0.5 * scenario.floor.marker_diameter
    for number, place in enumerate(scenario.world(scenario.seed).targets_3d_at(0), start=1):
        if scenario.dimension == 3:
            shape, height = _shape('sphere', radius=radius), place[2]
        else:
            shape, height = _shape('cylinder', radius=radius, length=_THICKNESS), _THICKNESS
        pose = _pose([*place[:2], height])
        colour = scenario.floor.marker_colour
        _static(_body(world, f'target_{number}', pose, shape, colour, solid=False))


def _robot(world: Xml.Element, name: str, robot: RobotSettings) -> None:
    """Add a robot that moves as it is commanded: no gravity, no wheels or rotors."""
    height = 0.5 * robot.radius
    shape = _shape('cylinder', radius=robot.radius, length=height)
    start = _pose(robot.start, (0.0, 0.0, robot.yaw))
    model = _body(world, name, start, shape, (0.9, 0.6, 0.1), solid=False)
    link = model.find('link')
    assert link is not None
    _values(link, gravity=False)
    if robot.camera is not None:
        _camera(link, name, robot.camera)
    if robot.laser is not None:
        _laser(link, name, robot.laser)
    velocity = _add(
        model,
        'plugin',
        filename='gz-sim-velocity-control-system',
        name='gz::sim::systems::VelocityControl',
    )
    _values(velocity, topic=f'/{name}/cmd_vel')
    odometry = _add(
        model,
        'plugin',
        filename='gz-sim-odometry-publisher-system',
        name='gz::sim::systems::OdometryPublisher',
    )
    _values(
        odometry,
        dimensions=3,
        odom_topic=f'/{name}/odom',
        odom_frame='map',
        robot_base_frame=f'{name}/base_link',
        odom_publish_frequency=50,
    )


def _sensor(link: Xml.Element, kind: str, topic: str, rate: float, pose: str) -> Xml.Element:
    sensor = _add(link, 'sensor', name=topic.rpartition('/')[2], type=kind)
    return _values(sensor, pose=pose, topic=topic, update_rate=f'{rate:g}', always_on=True)


def _camera(link: Xml.Element, name: str, settings: CameraSettings) -> None:
    mount, camera = settings.mount, Camera.from_settings(settings)
    (fx, _, cx), (_, fy, cy), _ = camera.matrix.tolist()
    topic, pose = f'/{name}/camera/image_raw', _pose(mount.position, mount.rpy)
    sensor = _sensor(link, 'camera', topic, settings.rate, pose)
    element = _add(sensor, 'camera')
    field = 2.0 * math.atan(0.5 * settings.width / fx)
    _values(
        element,
        camera_info_topic=f'/{name}/camera/camera_info',
        horizontal_fov=f'{field:.9g}',
    )
    image = _add(element, 'image')
    _values(image, width=settings.width, height=settings.height, format='R8G8B8')
    _values(_add(element, 'clip'), near=0.02, far=1000.0)
    if settings.distortion_model == 'plumb_bob' and settings.distortion:
        names = dict(zip(('k1', 'k2', 'p1', 'p2', 'k3'), settings.distortion))
        _values(_add(element, 'distortion'), **{key: f'{names[key]:.9g}' for key in sorted(names)})
    # Ours are at the centres of pixels, Gazebo's at their corners.
    lens = _values(_add(element, 'lens'), type='gnomonical', scale_to_hfov=True)
    intrinsics = _add(lens, 'intrinsics')
    _values(intrinsics, fx=fx, fy=fy, cx=cx + 0.5, cy=cy + 0.5, s=0.0)
    _values(element, optical_frame_id=f'{name}/camera_optical')


def _laser(link: Xml.Element, name: str, settings: LaserSettings) -> None:
    sensor = _sensor(link, 'gpu_lidar', f'/{name}/scan', settings.rate, _pose([0.0, 0.0, 0.0]))
    element = _add(sensor, 'lidar')
    turn = _add(_add(element, 'scan'), 'horizontal')
    last = 2.0 * math.pi * (1.0 - 1.0 / settings.beams)
    _values(turn, samples=settings.beams, resolution=1, min_angle=0.0, max_angle=f'{last:.9g}')
    spread = _add(element, 'range')
    _values(spread, min=settings.minimum_range, max=settings.maximum_range)
    noise = _add(element, 'noise')
    _values(noise, type='gaussian', mean=0.0, stddev=settings.noise)
