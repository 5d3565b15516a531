"""A scenario as a world of Gazebo, against the specification of SDF and the camera of the driver.

`ALLOWED` is read in sdformat's sdf/1.9/*.sdf (2ace536, August 2026); the worlds of three scenarios
were also checked by these files as a whole. Gazebo itself did not run them.
"""

import json
import math
import re
import runpy
import shlex
import warnings
from importlib import import_module
from pathlib import Path
from xml.etree import ElementTree as Xml

import numpy as np
import pytest
import shapely
import yaml
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from maasi_drivers.settings.camera import CameraSettings
from maasi_drivers.vision.camera_model import Camera
from maasi_filter.geometry.polygons import InputWarning
from maasi_filter.models.pose import Pose, compose
from maasi_sim.run.run_scenario import main
from maasi_sim.scenario.gazebo_world import bridge_file, bridge_text, world_text
from maasi_sim.scenario.layering import ScenarioError
from maasi_sim.scenario.loading import load_scenario, scenario_from_values

CONCAVE = 'POLYGON ((1 6, 3 6, 3 9, 2 7, 1 9, 1 6))'
HOLED = 'POLYGON ((6 1, 9 1, 9 4, 6 4, 6 1), (7 2, 8 2, 8 3, 7 3, 7 2))'
BOX = 'POLYGON ((6 6, 7 7, 6 8, 5 7, 6 6))'
SCENARIO = {
    'version': 1,
    'environment': {
        'bounds': [[0.0, 10.0], [0.0, 10.0]],
        'origin': {'latitude': 46.6, 'longitude': 9.9},
        'obstacles': ['3 3 0.5', BOX, CONCAVE, HOLED],
    },
    'step': 0.1,
    'targets': {'count': 5, 'margin': 0.5},
    'robots': {
        'bot': {
            'type': 'turtlebot3_burger',
            'start': [0.5, 0.5, 0.0],
            'yaw': 0.5,
            'body': 'external',
            'camera': 'external',
        },
        'drone': {
            'type': 'mambo',
            'start': [5.0, 5.0, 1.0],
            'body': 'external',
            'camera': 'external',
        },
    },
    'stop': 'planner_done',
    'limits': {'time': 60.0},
}
# Elements that may be in each, and of these the ones that must be.
ALLOWED = {
    'sdf': ('world', ''),
    'world': (
        'physics gravity magnetic_field atmosphere plugin spherical_coordinates scene light model',
        'physics gravity magnetic_field atmosphere',
    ),
    'physics': ('max_step_size real_time_factor real_time_update_rate',) * 2,
    'spherical_coordinates': (
        'surface_model world_frame_orientation latitude_deg longitude_deg elevation heading_deg',
        'surface_model latitude_deg longitude_deg elevation heading_deg',
    ),
    'scene': ('ambient background shadows',) * 2,
    'light': ('cast_shadows pose diffuse specular direction', 'diffuse specular direction'),
    'model': ('static pose link plugin', ''),
    'link': ('visual collision sensor gravity', ''),
    'visual': ('geometry material', 'geometry'),
    'collision': ('geometry', 'geometry'),
    'material': ('ambient diffuse specular', ''),
    'geometry': ('box cylinder plane polyline sphere', ''),
    'box': ('size',) * 2,
    'cylinder': ('radius length',) * 2,
    'sphere': ('radius',) * 2,
    'plane': ('normal size',) * 2,
    'polyline': ('point height',) * 2,
    'sensor': ('pose topic update_rate always_on camera lidar', ''),
    'camera': (
        'camera_info_topic horizontal_fov image clip distortion lens optical_frame_id',
        'horizontal_fov image clip',
    ),
    'image': ('width height format', 'width height'),
    'clip': ('near far',) * 2,
    'distortion': ('k1 k2 k3 p1 p2', ''),
    'lens': ('type scale_to_hfov intrinsics', 'type scale_to_hfov'),
    'intrinsics': ('fx fy cx cy s',) * 2,
    'lidar': ('scan range noise', 'scan range'),
    'scan': ('horizontal', 'horizontal'),
    'horizontal': ('samples resolution min_angle max_angle', 'samples min_angle max_angle'),
    'range': ('min max',) * 2,
    'noise': ('type mean stddev', 'type'),
}
NAMED = ('world', 'physics', 'light', 'model', 'link', 'visual', 'collision', 'sensor', 'plugin')
SEVERAL = ('plugin', 'model', 'visual', 'collision', 'point', 'light', 'sensor')


def made(values):
    return scenario_from_values(values, 'made')


def check(element):
    """Check elements, their number, and attributes."""
    assert (element.tag in NAMED) == ('name' in element.attrib), element.tag
    tags = [child.tag for child in element]
    if element.tag in ALLOWED and element.tag != 'plugin':
        allowed, needed = (set(item.split()) for item in ALLOWED[element.tag])
        assert needed <= set(tags) <= allowed, (element.tag, tags)
        assert all(tags.count(tag) == 1 or tag in SEVERAL for tag in tags), (element.tag, tags)
    elif element.tag != 'plugin':
        assert not tags and (element.text or element.tag == 'atmosphere'), element.tag
    numbers = {'pose': 6, 'size': (2, 3), 'point': 2, 'ambient': (3, 4), 'direction': 3}
    if element.tag in numbers:
        assert len(element.text.split()) in np.atleast_1d(numbers[element.tag])
        assert np.isfinite([float(word) for word in element.text.split()]).all()
    for child in element:
        check(child)


def world_of(scenario):
    root = Xml.fromstring(world_text(scenario, 'arena'))
    check(root)
    names = [model.get('name') for model in root.iter('model')]
    assert len(names) == len(set(names))
    return root


def pose_of(element):
    *position, roll, pitch, yaw = (float(word) for word in element.findtext('pose').split())
    return Pose.from_rpy(position, [roll, pitch, yaw])


def footprint(model):
    """Return the outline of a model on the ground, and its height."""
    pose, geometry = pose_of(model), model.find('link/collision/geometry')
    if (line := geometry.find('polyline')) is not None:
        points = [[float(word) for word in point.text.split()] for point in line.iter('point')]
        return shapely.Polygon(points), float(line.findtext('height'))
    if (box := geometry.find('box')) is not None:
        x, y, z = (float(word) for word in box.findtext('size').split())
        flat = shapely.box(-x / 2, -y / 2, x / 2, y / 2)
        turned = shapely.affinity.rotate(flat, math.degrees(pose.yaw), origin=(0, 0))
        return shapely.affinity.translate(turned, *pose.position[:2]), z
    cylinder = geometry.find('cylinder')
    disc = shapely.Point(pose.position[:2]).buffer(float(cylinder.findtext('radius')), 256)
    return disc, float(cylinder.findtext('length'))


@pytest.fixture
def scenario():
    return made(SCENARIO)


def test_obstacles_and_targets_stand_where_the_scenario_has_them(scenario):
    models = {model.get('name'): model for model in world_of(scenario).iter('model')}
    parts = [footprint(model) for name, model in models.items() if name.startswith('obstacle')]
    assert {height for _, height in parts} == {2.0}
    wanted = [shapely.Point(3, 3).buffer(0.5, 256), *map(shapely.from_wkt, (BOX, CONCAVE, HOLED))]
    wanted = shapely.union_all(wanted)
    assert shapely.union_all([part for part, _ in parts]).symmetric_difference(wanted).area < 1e-4
    # A hole stays open.
    assert sum(part.area for part, _ in parts) == pytest.approx(wanted.area, abs=1e-4)
    truth = scenario.world(scenario.seed).targets_3d_at(0)
    seen = [pose_of(models[f'target_{number}']).position for number in range(1, 6)]
    assert_allclose(np.array(seen)[:, :2], truth[:, :2], atol=1e-6)
    for name, robot in scenario.robots.items():
        pose = pose_of(models[name])
        assert_allclose(pose.position, robot.start)
        assert pose.yaw == pytest.approx(robot.yaw)
        assert models[name].findtext('link/gravity') == 'false'


@pytest.mark.parametrize('name', ['field', 'mambo_turtlebot_obstacles', 'drone_rov'])
def test_worlds_of_scenarios_are_sdf(name):
    assert world_of(load_scenario(name)).find('world').get('name') == 'arena'


angles = st.floats(-3.0, 3.0)


@given(
    st.lists(angles, min_size=3, max_size=3),
    st.lists(st.floats(50.0, 900.0), min_size=2, max_size=2),
    st.lists(st.floats(-0.3, 0.3), min_size=2, max_size=2),
    st.floats(-8.0, 8.0),
)
def test_its_camera_sees_what_the_driver_assumes(rpy, focal, direction, shift):
    """Gazebo: x forward, z up, pixels from the corner of the image."""
    mount = {'position': [0.1, -0.2, 0.3], 'rpy': rpy}
    centre = [79.5 + shift, 59.5 - shift]
    settings = {'focal_length': focal, 'principal_point': centre, 'mount': mount}
    content = SCENARIO['robots']['drone'] | {'camera': settings, 'measurements': 'external'}
    scenario = made(SCENARIO | {'robots': {'drone': content}})
    (sensor,) = world_of(scenario).iter('sensor')
    values = {item.tag: float(item.text) for item in sensor.find('camera/lens/intrinsics')}
    side, up = direction
    ray = np.array([1.0, side, up])
    pixel = (
        values['fx'] * -side + values['cx'] - 0.5,
        values['fy'] * -up + values['cy'] - 0.5,
    )
    # The same point in the frame of the robot, as the driver projects it.
    sensor_pose = pose_of(sensor)
    point = compose(sensor_pose, Pose(2.0 * ray)).position
    camera = Camera.from_settings(CameraSettings.model_validate(settings))
    robot = Pose.from_rpy([0.0, 0.0, 0.0], [0.0, 0.0, 0.0])
    assert_allclose(camera.project([point], robot)[0], pixel, atol=1e-5)
    field = float(sensor.findtext('camera/horizontal_fov'))
    assert math.tan(0.5 * field) == pytest.approx(80.0 / values['fx'], rel=1e-6)


TOPIC_TAGS = ('topic', 'odom_topic', 'camera_info_topic')


def test_the_bridge_carries_what_the_drivers_use(scenario):
    root = world_of(scenario)
    topics = {item['ros_topic_name']: item for item in yaml.safe_load(bridge_text(scenario))}
    used = {item.text for tag in TOPIC_TAGS for item in root.iter(tag)}
    assert topics.keys() == used | {'/clock'}
    for name, item in topics.items():
        package, _, kind = item['ros_type_name'].split('/')
        assert hasattr(import_module(f'{package}.msg'), kind)
        assert item['gz_topic_name'] == name
        assert item['gz_type_name'].startswith('gz.msgs.')
        back = name.endswith('cmd_vel')
        assert item['direction'] == ('ROS_TO_GZ' if back else 'GZ_TO_ROS')


def test_the_command_writes_both_files_and_says_what_differs(tmp_path, capsys):
    world = tmp_path / 'worlds' / 'arena.sdf'
    assert main(['mambo_turtlebot', '--write-world', str(world)]) == 0
    said = capsys.readouterr().out
    assert "robots.mambo.body: read 'simulated'" in said
    assert f'gazebo.launch.py world:={world} scenario:=mambo_turtlebot' in said
    check(Xml.parse(world).getroot())
    assert yaml.safe_load(bridge_file(world).read_text())
    assert main(['buildings_one', '--write-world', str(world)]) == 2
    (tmp_path / 'file').touch()
    assert main(['field', '--write-world', str(tmp_path / 'file' / 'a.sdf')]) == 4
    with pytest.raises(SystemExit):
        main(['field', '--write-world', str(tmp_path / 'a.world')])


def test_any_name_of_a_world_is_one_of_gazebo_and_a_command_of_a_shell(tmp_path, capsys):
    """What the file of an area leaves out is printed as a line, without the line of our source."""
    area = {'type': 'Polygon', 'coordinates': [[[0, 0], [1e-4, 0], [1e-4, 1e-4], [0, 0]]]}
    line = {'type': 'LineString', 'coordinates': [[0, 0], [1, 1]]}
    rows = [{'type': 'Feature', 'properties': {}, 'geometry': shape} for shape in (area, line)]
    (tmp_path / 'a b.geojson').write_text(
        json.dumps({'type': 'FeatureCollection', 'features': rows})
    )
    values = {**SCENARIO, 'environment': {'area': 'a b.geojson'}}
    values['robots'] = {'bot': {**SCENARIO['robots']['bot'], 'start': [2.0, -2.0, 0.0]}}
    file, world = tmp_path / 'a & b.yaml', tmp_path / "it's <é> & more.sdf"
    file.write_text(yaml.safe_dump(values))
    before = warnings.formatwarning
    with pytest.warns(InputWarning, match='left out') as told:
        assert main([str(file), '--write-world', str(world)]) == 0
    first, again = (
        warnings.formatwarning(told[0].message, told[0].category, 'source.py', 1) for _ in range(2)
    )
    assert first == f'warning: {told[0].message}\n' and again == ''
    warnings.formatwarning = before
    said = capsys.readouterr()
    words = shlex.split(said.out.splitlines()[-1])
    assert words[-2:] == [f'world:={world}', f'scenario:={file}']
    assert re.fullmatch(r'[\w-]+', Xml.parse(world).getroot().find('world').get('name'), re.ASCII)


@pytest.mark.parametrize('name', ['ground', 'sun', 'target_1', 'obstacle_3'])
def test_a_robot_with_the_name_of_another_part_is_refused(name):
    robots = {name: SCENARIO['robots']['bot']}
    with pytest.raises(ScenarioError, match=rf'robots\.{name}: read a name that the world has'):
        world_text(made(SCENARIO | {'robots': robots}), 'arena')


def test_measurements_of_another_program(scenario):
    bot = scenario.robots['bot']
    # The camera of the type remains.
    assert bot.measurements == 'external' and bot.camera.width == 160
    assert made(scenario.content()).robots['bot'] == bot
    with pytest.raises(ScenarioError, match=r'robots\.bot\.measurements: read .external., which'):
        scenario.check_pace(True, None)
    for key, other in (('sensor', 'camera'), ('camera', 'sensor')):
        kind = 'mambo' if key == 'sensor' else 'ranging_drone'
        robot = {'type': kind, 'start': [5.0, 5.0, 1.0], key: 'external'}
        words = rf"robots\.one\.{key}: read 'external', but it measures by its {other}"
        with pytest.raises(ScenarioError, match=words):
            made(SCENARIO | {'robots': {'one': robot}})


def test_the_launch_file_starts_simulator_bridge_and_run(tmp_path, monkeypatch):
    """Where the wheels have launch, which is a part of ROS."""
    launch = pytest.importorskip('launch')
    pytest.importorskip('launch_ros')
    path = Path(__file__).parents[2] / 'maasi_sim' / 'launch' / 'gazebo.launch.py'
    made = runpy.run_path(str(path))
    context, world = launch.LaunchContext(), tmp_path / 'arena.sdf'
    context.launch_configurations.update({'world': str(world), 'gui': 'false'})
    with pytest.raises(RuntimeError, match=r'arena\.sdf is missing; run_scenario FILE --write'):
        made['start_world'](context)
    assert main(['mambo_turtlebot', '--write-world', str(world)]) == 0
    program = tmp_path / 'bin' / 'gz'
    monkeypatch.setenv('PATH', str(program.parent))
    with pytest.raises(RuntimeError, match='gz: not found in PATH; install Gazebo'):
        made['start_world'](context)
    program.parent.mkdir()
    program.touch(0o755)
    simulator, bridge = made['start_world'](context)
    words = [''.join(part.text for part in word) for word in simulator.cmd]
    assert words == [str(program), 'sim', '-r', '-s', str(world)]
    assert bridge.node_package == 'ros_gz_bridge'
    entities = made['generate_launch_description']().entities
    assert [item.name for item in entities[:2]] == ['world', 'gui']
