"""A robot in recordings of others: their kinds of poses, images and definitions."""

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.typesys import Stores, get_typestore

from maasi_drivers.calibration.recorded_robot import RecordedRobot
from maasi_drivers.settings.driver import DriverSettings
from maasi_filter.models.pose import Pose, compose, inverse
from maasi_sim.run.bag import BagWriter, load_types

START = [0.5, 0.2, 0.0]
VALUES = {
    'environment': {'bounds': [[-3.0, 3.0], [-3.0, 3.0]]},
    'start': START,
    'camera': {'width': 8, 'height': 8},
}
TIMES = range(0, 2_000_000_000, 100_000_000)
MAP_FROM_ODOM = Pose.from_yaw(np.array([0.5, -1.0, 0.0]), 0.7)


@pytest.fixture(scope='module')
def types():
    return load_types()


def truth(time):
    return Pose.from_yaw(np.array([1e-9 * time, 0.3, 0.0]), 0.4e-9 * time)


class Maker:
    """Makes messages of the types of a store."""

    def __init__(self, store):
        self.types = store.types

    def __call__(self, name, **values):
        return self.types[name](**values)

    def header(self, time, frame='map'):
        stamp = self('builtin_interfaces/msg/Time', sec=time // 10**9, nanosec=time % 10**9)
        more = {'seq': 0} if 'seq' in self.types['std_msgs/msg/Header'].__annotations__ else {}
        return self('std_msgs/msg/Header', stamp=stamp, frame_id=frame, **more)

    def pose(self, pose, names=('Pose', 'Point'), words=('position', 'orientation')):
        w, x, y, z = pose.orientation.tolist()
        point = dict(zip('xyz', pose.position.tolist()))
        place = self(f'geometry_msgs/msg/{names[1]}', **point)
        turn = self('geometry_msgs/msg/Quaternion', x=x, y=y, z=z, w=w)
        return self(f'geometry_msgs/msg/{names[0]}', **dict(zip(words, (place, turn))))

    def known(self, time):
        covariance = np.diag([0.04, 0.09, 1.0, 0.1, 0.1, 0.1]).ravel()
        both = self(
            'geometry_msgs/msg/PoseWithCovariance',
            pose=self.pose(truth(time)),
            covariance=covariance,
        )
        name = 'geometry_msgs/msg/PoseWithCovarianceStamped'
        return self(name, header=self.header(time), pose=both)

    def transform(self, time, pose, parent, child):
        moved = self.pose(pose, ('Transform', 'Vector3'), ('translation', 'rotation'))
        return self(
            'geometry_msgs/msg/TransformStamped',
            header=self.header(time, parent),
            child_frame_id=child,
            transform=moved,
        )

    def image(self, time, encoding='rgb8', size=3):
        return self(
            'sensor_msgs/msg/Image',
            header=self.header(time, 'camera'),
            height=8,
            width=8,
            encoding=encoding,
            is_bigendian=0,
            step=8 * size,
            data=np.zeros(64 * size, np.uint8),
        )


def written(types, folder, topics, messages):
    with BagWriter(folder / 'bag', types, images='raw') as writer:
        for topic, kind in {'/camera/image_raw': 'sensor_msgs/msg/Image', **topics}.items():
            writer.add_topic(topic, kind)
        for topic, time, message in messages:
            writer.write_message(topic, time, message)
    return folder / 'bag'


def images_of(bag, **options):
    robot = RecordedRobot(bag, DriverSettings.model_validate(VALUES), use='images', **options)
    return robot, list(robot.images())


def assert_poses(placed):
    assert len(placed) > 15
    for item, _ in placed:
        expected = truth(item.stamp)
        assert item.pose.position == pytest.approx(expected.position, abs=1e-6)
        assert item.pose.yaw == pytest.approx(expected.yaw, abs=1e-6)


@pytest.mark.parametrize('topic', ['/amcl_pose', '/pose', '/localisation/filtered'])
def test_poses_with_covariance_are_those_of_the_map(types, tmp_path, topic):
    make = Maker(types)
    kind = 'geometry_msgs/msg/PoseWithCovarianceStamped'
    messages = [(topic, time, make.known(time)) for time in TIMES]
    messages += [('/camera/image_raw', time, make.image(time)) for time in TIMES]
    bag = written(types, tmp_path, {topic: kind}, messages)
    remap = {topic: '/pose'} if '/' in topic[1:] else {}
    robot, placed = images_of(bag, remap=remap)
    assert_poses(placed)
    assert placed[3][0].covariance[0, 0] == pytest.approx(0.04)
    assert robot.poses == ('/pose' if remap else topic) and not robot.left_out


def transforms(types, base):
    """Return messages of a robot's frames: of its odometry, and of that in the map."""
    make = Maker(types)

    def message(topic, time, *items):
        return topic, time, make('tf2_msgs/msg/TFMessage', transforms=list(items))

    foot = Pose.from_yaw(np.array([0.0, 0.1, 0.0]), 0.2)
    yield message('/tf_static', 0, make.transform(0, foot, 'foot', base))
    for time in TIMES:
        # That in the map comes half as often, and moves.
        part = Pose.from_yaw(np.array([0.1e-9 * time, 0.0, 0.0]), 0.0)
        origin = compose(MAP_FROM_ODOM, part)
        if time % 200_000_000 == 0:
            yield message('/tf', time, make.transform(time, origin, 'map', 'odom'))
        moved = compose(inverse(origin), compose(truth(time), inverse(foot)))
        yield message('/tf', time + 1, make.transform(time, moved, 'odom', 'foot'))
        yield '/camera/image_raw', time + 2, make.image(time)


TF = {'/tf': 'tf2_msgs/msg/TFMessage', '/tf_static': 'tf2_msgs/msg/TFMessage'}


def test_poses_are_those_of_the_transforms(types, tmp_path):
    bag = written(types, tmp_path, TF, transforms(types, 'base_link'))
    robot, placed = images_of(bag)
    assert robot.poses == '/tf'
    # Between two of the map it is interpolated: its stamps are those that all parts have.
    near = [item for item in placed if item[0].stamp % 200_000_000 == 0]
    assert len(near) > 8
    for item, _ in near:
        assert item.pose.position == pytest.approx(truth(item.stamp).position, abs=1e-6)
        assert item.pose.yaw == pytest.approx(truth(item.stamp).yaw, abs=1e-6)


def test_transforms_without_the_frame_of_the_robot_are_named(types, tmp_path):
    bag = written(types, tmp_path, TF, transforms(types, 'base_footprint'))
    words = r"no transform of 'base_link' in 'map': .*base_footprint, foot, odom \(parameter"
    with pytest.raises(ValueError, match=words):
        images_of(bag)


@pytest.mark.parametrize(
    ('encoding', 'size', 'words'),
    [('mono8', 1, "got 'mono8'"), ('rgb16', 6, "got 'rgb16'"), ('32FC1', 4, "got '32FC1'")],
)
def test_an_encoding_that_cannot_be_used_is_named_and_counted(
    types, tmp_path, encoding, size, words
):
    make = Maker(types)
    messages = [('/amcl_pose', time, make.known(time)) for time in TIMES]
    messages += [('/camera/image_raw', t, make.image(t, encoding, size)) for t in TIMES]
    kind = 'geometry_msgs/msg/PoseWithCovarianceStamped'
    bag = written(types, tmp_path, {'/amcl_pose': kind}, messages)
    robot, placed = images_of(bag)
    assert not placed and words in robot.why and f'({len(TIMES)})' in robot.why
    with pytest.raises(ValueError, match=f'image encoding: {words}'):
        robot.observations()


def test_images_without_poses_at_their_stamps_are_counted(types, tmp_path):
    make = Maker(types)
    messages = [('/amcl_pose', time, make.known(time)) for time in TIMES[:10]]
    messages += [('/camera/image_raw', time, make.image(time)) for time in TIMES]
    kind = 'geometry_msgs/msg/PoseWithCovarianceStamped'
    robot, placed = images_of(written(types, tmp_path, {'/amcl_pose': kind}, messages))
    assert len(placed) == 10
    assert robot.why == '/amcl_pose has no pose before and after its stamp (10)'


def test_a_recording_of_ros_1_is_read_with_its_definitions(tmp_path):
    store = get_typestore(Stores.ROS1_NOETIC)
    make = Maker(store)
    region = make(
        'sensor_msgs/msg/RegionOfInterest',
        **dict.fromkeys(('x_offset', 'y_offset', 'height', 'width'), 0),
        do_rectify=False,
    )
    matrix = np.array([9.0, 0, 3.5, 0, 9.0, 3.5, 0, 0, 1.0])
    kinds = {
        '/camera/image_raw': ('sensor_msgs/msg/Image', make.image),
        '/amcl_pose': ('geometry_msgs/msg/PoseWithCovarianceStamped', make.known),
        '/camera/camera_info': (
            'sensor_msgs/msg/CameraInfo',
            lambda time: make(
                'sensor_msgs/msg/CameraInfo',
                header=make.header(time, 'camera'),
                height=8,
                width=8,
                distortion_model='plumb_bob',
                D=np.zeros(5),
                K=matrix,
                R=np.eye(3).ravel(),
                P=np.zeros(12),
                binning_x=0,
                binning_y=0,
                roi=region,
            ),
        ),
    }
    with Ros1Writer(tmp_path / 'other.bag') as writer:
        topics = {
            topic: writer.add_connection(topic, kind, typestore=store)
            for topic, (kind, _) in kinds.items()
        }
        for time in TIMES:
            for topic, (kind, maker) in kinds.items():
                data = store.serialize_ros1(maker(time + 10**9), kind)
                writer.write(topics[topic], time + 10**9, data)
    for bag in (tmp_path / 'other.bag', tmp_path):
        robot, placed = images_of(bag)
        assert_poses(placed)
        assert robot.detector().settings.focal_length == [9.0, 9.0]
