"""A recording of a robot's camera and poses, without decisions, is searched again."""

import numpy as np
import pytest
import yaml
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rclpy.serialization import serialize_message
from sensor_msgs.msg import CameraInfo, Image
from test_scenario import PLAIN

from maasi_filter.make_filter import make_filter
from maasi_filter.ros.conversions import pose_to_ros, stamp_to_ros
from maasi_sim import search as search_module
from maasi_sim.run import recorded_search
from maasi_sim.run.bag import Bag, BagWriter, load_types
from maasi_sim.run.run_scenario import main
from maasi_sim.scenario.loading import load_scenario

SEED = 900
# Stamps of a real robot are those of the wall clock [ns].
BEGIN = 1_760_000_000_000_000_000
# Recordings, by where their poses come from, and the namespaces of their topics.
SPACES = {'odom': '/mambo', 'pose': '', 'in_map': '/mambo'}
CANDIDATES = {'grid': [4, 4], 'spacing': 0.3, 'corner': [-0.15, -0.15]}
SCENARIO = PLAIN | {
    'seed': SEED,
    'environment': {'bounds': [[-0.3, 0.9], [-0.3, 0.9]]},
    'targets': {'count': 4, 'separation': 0.2, 'margin': 0.1},
    'robots': {'mambo': {'type': 'mambo', 'start': [0.0, 0.0, 1.0], 'candidates': CANDIDATES}},
    'filter': {
        'preset': 'paper_000',
        'found_radius': 0.02,
        'removal_distance': 0.05,
        'jitter_deviation': 0.003,
    },
    'stop': 'planner_done',
    'limits': {'time': 120.0},
}


def write(writer, topic, stamp, message):
    message.header.stamp = stamp_to_ros(stamp)
    writer.write(topic, stamp, serialize_message(message))


def image_message(image):
    height, width, _ = image.shape
    return Image(height=height, width=width, encoding='rgb8', step=3 * width, data=image.tobytes())


@pytest.fixture(scope='module')
def searched(tmp_path_factory):
    """Search in this process, and record what a real robot would; return folder and result."""
    folder = tmp_path_factory.mktemp('recorded')
    file = folder / 'field.yaml'
    file.write_text(yaml.safe_dump(SCENARIO))
    scenario = load_scenario(file)
    topics = {
        'camera/image_raw': 'sensor_msgs/msg/Image',
        'camera/camera_info': 'sensor_msgs/msg/CameraInfo',
        'odom': 'nav_msgs/msg/Odometry',
        'pose': 'geometry_msgs/msg/PoseStamped',
        'in_map': 'nav_msgs/msg/Odometry',
    }
    camera = scenario.robots['mambo'].camera
    info = CameraInfo(width=camera.width, height=camera.height, distortion_model='plumb_bob')
    fx, fy = camera.focal_length
    info.k = [fx, 0.0, (camera.width - 1) / 2, 0.0, fy, (camera.height - 1) / 2, 0.0, 0.0, 1.0]

    class RecordedRobot(search_module._Robot):
        """Publishes as a real robot does, at each step."""

        def observe(self, stamp):
            super().observe(stamp)
            step = round(stamp * 1e-9 / scenario.step)
            odometry, place = Odometry(), PoseStamped()
            odometry.pose.pose = pose_to_ros(self.body.odometry.pose)
            place.pose = pose_to_ros(self.pose.pose)
            write(bags['odom'], '/mambo/odom', BEGIN + stamp, odometry)
            odometry.header.frame_id, odometry.pose.pose = 'map', place.pose
            write(bags['in_map'], '/mambo/odom', BEGIN + stamp, odometry)
            # Of the other one all topics are in the root.
            write(bags['pose'], '/pose', BEGIN + stamp, place)
            if step % round(1.0 / camera.rate / scenario.step) == 0:
                image = image_message(self.body.image(step, stamp * 1e-9))
                for kind, space in SPACES.items():
                    write(bags[kind], f'{space}/camera/image_raw', BEGIN + stamp, image)
                    write(bags[kind], f'{space}/camera/camera_info', BEGIN + stamp, info)

    bags = {kind: BagWriter(folder / kind, load_types()) for kind in SPACES}
    for kind, space in SPACES.items():
        for topic, name in topics.items():
            if topic not in SPACES or topic == kind:
                topic = 'odom' if topic == 'in_map' else topic
                bags[kind].add_topic(f'{space}/{topic}', name)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(search_module, '_Robot', RecordedRobot)
        result = search_module.search(scenario, SEED)
    for bag in bags.values():
        bag.close()
    assert len(result.found_targets) == 4
    assert result.complete
    return folder, result


@pytest.mark.parametrize('kind', SPACES)
def test_the_same_targets_are_found_again(searched, tmp_path, capsys, kind):
    folder, result = searched
    words = [str(folder / 'field.yaml'), '--replay', str(folder / kind), '--out', str(tmp_path)]
    assert main(words) == 0
    rows = np.genfromtxt(tmp_path / 'found_targets.csv', delimiter=',', names=True, dtype=None)
    again = np.stack([rows['x'], rows['y']], axis=1)
    before = np.array([target.position for target in result.found_targets])
    assert len(again) == len(before)
    distances = np.linalg.norm(again[:, None] - before, axis=2)
    # Half the radius of a marker; other images are used than in the search.
    assert distances.min(axis=1).max() < 0.015
    assert sorted(distances.argmin(axis=1)) == list(range(len(before)))
    assert (tmp_path / 'replay.html').exists()
    said = capsys.readouterr().out
    topic = {
        'odom': '/mambo/odom,',
        'pose': '/pose,',
        'in_map': '/mambo/odom (in the map: start and yaw are not added),',
    }[kind]
    assert f'poses of {topic}' in said and '4 targets found' in said


def without(folder, target, lacking):
    """Copy a recording without the messages of some topics."""
    with Bag(folder) as bag, BagWriter(target, load_types(), images='raw') as writer:
        for topic, name in bag.types.items():
            writer.add_topic(topic, name)
        for topic, _, time, data in bag.raw():
            if not topic.startswith(lacking):
                writer.write(topic, time, data)
    return target


@pytest.mark.parametrize(
    ('lacking', 'words'),
    [
        ('/mambo/camera/image_raw', ['robot: found none with camera/image_raw', 'recorded are']),
        ('/mambo/odom', ['/mambo/odom is not recorded', '/mambo/state, /mambo/pose, /mambo/odom']),
    ],
)
def test_a_topic_that_lacks_is_named(searched, tmp_path, capsys, lacking, words):
    folder, _ = searched
    bag = without(folder / 'odom', tmp_path / 'bag', lacking)
    assert main([str(folder / 'field.yaml'), '--replay', str(bag)]) == 2
    said = capsys.readouterr().err
    assert all(word in said for word in words), said


@pytest.mark.parametrize(
    ('words', 'said'),
    [
        (['--remap', '/none:=/pose'], '/none is not recorded; recorded are /mambo/camera'),
        (['--remap', '/mambo/odom:=/mambo/track'], '/mambo/odom is not recorded, allowed are'),
        (['--remap', '/mambo/odom'], "read '/mambo/odom', allowed is FROM:=TO"),
    ],
)
def test_topics_are_renamed_or_the_wrong_one_is_named(searched, capsys, words, said):
    folder, _ = searched
    try:
        code = main([str(folder / 'field.yaml'), '--replay', str(folder / 'odom'), *words])
    except SystemExit as error:
        code = error.code
    assert code == 2
    assert said in capsys.readouterr().err


def test_a_robot_without_camera_is_refused(searched, capsys):
    folder, _ = searched
    assert main(['ranging_drone_3d', '--replay', str(folder / 'odom')]) == 2
    assert 'robots.drone.camera: read nothing' in capsys.readouterr().err


def test_area_keep_outs_and_expected_targets_hold(searched, tmp_path, capsys, monkeypatch):
    folder, result = searched
    first, *others = (target.position for target in result.found_targets)
    environment = {
        **SCENARIO['environment'],
        'area': [[-0.3, -0.3], [0.9, -0.3], [0.9, 0.9], [-0.3, 0.9]],
        'keep_outs': [f'{first[0]} {first[1]} 0.06'],
        'expected_targets': 3.0,
    }
    file = tmp_path / 'other.yaml'
    file.write_text(yaml.safe_dump({**SCENARIO, 'environment': environment}))
    areas = []
    monkeypatch.setattr(
        recorded_search,
        'make_filter',
        lambda settings, area, generator: (
            areas.append(area) or make_filter(settings, area, generator)
        ),
    )
    assert main([str(file), '--replay', str(folder / 'odom'), '--out', str(tmp_path / 'out')]) == 0
    assert areas[0].settings == load_scenario(file).environment
    assert areas[0].expected_targets == 3.0
    rows = np.genfromtxt(tmp_path / 'out/found_targets.csv', delimiter=',', names=True, dtype=None)
    again = np.stack([rows['x'], rows['y']], axis=1)
    assert np.linalg.norm(again - first, axis=1).min() > 0.06
    assert all(np.linalg.norm(again - other, axis=1).min() < 0.015 for other in others)
