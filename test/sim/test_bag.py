"""Recordings: what is written can be read, whatever happened to the writer."""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from ament_index_python.packages import get_package_share_directory
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from waiting import wait_until

from maasi_drivers.calibration.bag_reader import BagReader
from maasi_sim.run.bag import Bag, BagError, BagWriter, load_types, topic_qos


@pytest.fixture(scope='module')
def types():
    return load_types()


def image(types, pixels, encoding, padding=0):
    height, width = pixels.shape[:2]
    rows = pixels.reshape(height, pixels[0].size if height else 48)
    rows = np.pad(rows, ((0, 0), (0, padding)))
    stamp = types.types['builtin_interfaces/msg/Time'](sec=1, nanosec=0)
    return types.types['sensor_msgs/msg/Image'](
        header=types.types['std_msgs/msg/Header'](stamp=stamp, frame_id='map'),
        height=height,
        width=width,
        encoding=encoding,
        is_bigendian=0,
        step=rows.shape[1],
        data=np.ascontiguousarray(rows).reshape(-1),
    )


def write_steps(writer, steps, size=0):
    """Write a message for each step, with text of a size that cannot be compressed."""
    text = np.random.default_rng(0).bytes(size).hex()
    string = load_types().types['std_msgs/msg/String']
    writer.add_topic('/text', 'std_msgs/msg/String')
    for step in steps:
        writer.write_message('/text', step // 10, string(data=f'{step} {text}'))


def read_steps(bag):
    return [int(item.message.data.split()[0]) for item in bag.messages()]


def test_messages_come_back_in_order_with_rising_times(types, tmp_path):
    # Each message is larger than what may wait.
    with BagWriter(tmp_path / 'bag', types, backlog=10) as writer:
        write_steps(writer, range(300))
    writer.close()
    with Bag(tmp_path) as bag:
        assert read_steps(bag) == list(range(300))
        times = [item.time for item in bag.messages()]
        assert times == sorted(set(times))
        assert bag.types == {'/text': 'std_msgs/msg/String'}
        assert bag.counts == {'/text': 300}


def stored(types, folder, kind, message):
    with BagWriter(folder / 'bag', types, images=kind) as writer:
        writer.add_topic('/image', 'sensor_msgs/msg/Image')
        writer.write_message('/image', 5, message)
    with Bag(folder) as bag:
        (item,) = bag.messages()
    return item


@pytest.mark.parametrize('encoding', ['bgr8', 'rgb8', 'mono8'])
@pytest.mark.parametrize(('kind', 'padding'), [('png', 0), ('png', 5), ('jpeg', 0)])
def test_images_come_back(types, tmp_path, encoding, kind, padding):
    pixels = np.full((24, 32, 3), 120, np.uint8)
    cv2.circle(pixels, (16, 12), 6, (220, 40, 30), -1)
    pixels = pixels[:, :, 0] if encoding == 'mono8' else pixels
    item = stored(types, tmp_path, kind, image(types, pixels, encoding, padding))
    assert item.topic == '/image/compressed'
    assert item.message.format.startswith(f'{encoding}; {kind}')
    assert item.message.header.stamp.sec == 1
    read = cv2.imdecode(item.message.data, cv2.IMREAD_UNCHANGED)
    expected = pixels[:, :, ::-1] if encoding == 'rgb8' else pixels
    assert np.abs(read.astype(int) - expected).mean() <= (0.0 if kind == 'png' else 3.0)


@pytest.mark.parametrize(
    'height, encoding', [(0, 'bgr8'), (12, 'bgr8'), (12, 'bayer_rggb8'), (12, '32FC1')]
)
def test_images_that_cannot_be_compressed_are_stored_as_they_are(types, tmp_path, height, encoding):
    message = image(types, np.zeros((height, 16), np.uint8), encoding)
    item = stored(types, tmp_path, 'png', message)
    assert (item.topic, item.message.encoding) == ('/image', encoding)


def test_what_cannot_be_written_is_named(types, tmp_path):
    with pytest.raises(BagError, match=str(tmp_path)):
        BagWriter(tmp_path, types)
    writer = BagWriter(tmp_path / 'bag', types)
    with pytest.raises(BagError, match='other_msgs/msg/Thing'):
        writer.add_topic('/thing', 'other_msgs/msg/Thing')
    with pytest.raises(BagError, match='/elsewhere'):
        writer.write('/elsewhere', 0, b'')
    # An error of the thread is raised, not swallowed.
    writer.add_topic('/image', 'sensor_msgs/msg/Image')
    writer.write('/image', 0, b'no message')
    wait_until(lambda: writer.failed)
    for end in (lambda: writer.write('/image', 1, b''), writer.close):
        with pytest.raises(BagError, match='failed'):
            end()
    with Bag(tmp_path / 'bag') as bag, pytest.raises(BagError, match='scenario'):
        bag.scenario()


@pytest.mark.parametrize('name', ['missing', 'file', 'empty'])
def test_what_is_no_recording_is_refused(tmp_path, name):
    (tmp_path / 'file').write_text('nothing')
    (tmp_path / 'empty').mkdir()
    with pytest.raises(BagError, match=name):
        Bag(tmp_path / name)


@pytest.fixture(scope='module')
def whole(types, tmp_path_factory):
    folder = tmp_path_factory.mktemp('whole') / 'bag'
    with BagWriter(folder, types) as writer:
        write_steps(writer, range(60), 30000)
    return folder


@pytest.mark.parametrize('metadata', [True, False])
def test_a_recording_cut_anywhere_gives_what_is_before_the_cut(whole, tmp_path, metadata):
    data = (whole / 'bag.mcap').read_bytes()
    folder = tmp_path / 'bag'
    shutil.copytree(whole, folder)
    if not metadata:
        (folder / 'metadata.yaml').unlink()
    lengths = [*range(0, 60, 7), *np.linspace(60, len(data) - 1, 25).astype(int)]
    counts = []
    for length in lengths:
        (folder / 'bag.mcap').write_bytes(data[:length])
        try:
            with Bag(folder) as bag:
                steps = read_steps(bag)
                assert bag.recovered
        except BagError as error:
            assert length < 60 and 'no complete record' in str(error)
            steps = []
        assert steps == list(range(len(steps)))
        counts.append(len(steps))
    assert counts == sorted(counts)
    # The last cuts are within the index.
    assert counts[0] == 0 and counts[-1] == 60 and len(set(counts)) >= 3
    damaged = bytearray(data)
    damaged[50000:51000] = bytes(1000)
    (folder / 'bag.mcap').write_bytes(damaged)
    with Bag(tmp_path) as bag, pytest.raises(BagError, match='is damaged'):
        list(bag.messages())


def _installed_hash(type_name):
    package, _, kind = type_name.split('/')
    file = Path(get_package_share_directory(package)) / 'msg' / f'{kind}.json'
    hashes = json.loads(file.read_text())['type_hashes']
    return next(item['hash_string'] for item in hashes if item['type_name'] == type_name)


def test_a_recording_holds_its_scenario_and_names_distribution_and_hashes_as_ros_does(
    types, tmp_path
):
    kinds = [f'maasi_msgs/msg/{name}' for name in ('FilterUpdate', 'AgentState', 'PlanDecision')]
    kinds += ['nav_msgs/msg/Odometry', 'sensor_msgs/msg/BatteryState', 'rosgraph_msgs/msg/Clock']
    with BagWriter(tmp_path / 'bag', types) as writer:
        for kind in kinds:
            writer.add_topic(f'/{kind.rpartition("/")[2]}', kind)
        writer.add_topic('/image', 'sensor_msgs/msg/Image')
        writer.add_topic('/found', 'std_msgs/msg/String', topic_qos(latched=True))
        writer.write_scenario('seed: 3\nnodes: {}\n', {'seed': '3'})
    with Bag(tmp_path / 'bag') as bag:
        assert bag.scenario() == {'seed': 3, 'nodes': {}}
    text = (tmp_path / 'bag' / 'metadata.yaml').read_text()
    for words in ("seed: '3'", 'durability: transient_local', 'reliability: reliable'):
        assert words in text
    content = yaml.safe_load(text)['rosbag2_bagfile_information']
    assert (content['version'], content['ros_distro']) == (9, 'jazzy')
    stored = {
        item['topic_metadata']['type']: item['topic_metadata']['type_description_hash']
        for item in content['topics_with_message_count']
    }
    kinds += ['sensor_msgs/msg/CompressedImage', 'std_msgs/msg/String']
    assert stored == {kind: _installed_hash(kind) for kind in kinds}
    # The reader of rosbag2 takes the distribution from the copy inside the file.
    assert b'ros_distro: jazzy' in (tmp_path / 'bag' / 'bag.mcap').read_bytes()


def written_by_rosbags(types, folder, plugin, mode=None, size=0):
    """Write a recording as `ros2 bag record` does, with its kinds of files."""
    writer = Writer(folder, version=9, storage_plugin=plugin)
    if mode is not None:
        writer.set_compression(mode, CompressionFormat.ZSTD)
    string = types.types['std_msgs/msg/String']
    with writer:
        connection = writer.add_connection('/text', 'std_msgs/msg/String', typestore=types)
        for step in range(20):
            text = f'{step} {np.random.default_rng(step).bytes(size).hex()}'
            data = types.serialize_cdr(string(data=text), 'std_msgs/msg/String')
            writer.write(connection, step, data)


@pytest.mark.parametrize('metadata', [True, False])
@pytest.mark.parametrize('mode', [None, CompressionMode.FILE, CompressionMode.MESSAGE])
@pytest.mark.parametrize('plugin', [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_recordings_of_others_are_read_also_without_metadata(
    types, tmp_path, plugin, mode, metadata
):
    folder = tmp_path / 'other'
    written_by_rosbags(types, folder, plugin, mode)
    if not metadata:
        (folder / 'metadata.yaml').unlink()
    (file,) = (path for path in folder.iterdir() if path.suffix != '.yaml')
    assert (file.suffix == '.zstd') == (mode == CompressionMode.FILE)
    for path in (folder, file):
        with Bag(path) as bag:
            assert read_steps(bag) == list(range(20))
            assert bool(bag.recovered) == (path == folder and not metadata)


def test_a_compressed_recording_that_is_cut_gives_what_is_before_the_cut(types, tmp_path):
    written_by_rosbags(types, tmp_path / 'bag', StoragePlugin.MCAP, CompressionMode.FILE, 150000)
    (packed,) = (tmp_path / 'bag').glob('*.zstd')
    data, file = packed.read_bytes(), tmp_path / 'cut.mcap.zstd'
    for share in (0.6, 0.9):
        file.write_bytes(data[: int(share * len(data))])
        with Bag(file) as bag:
            steps = read_steps(bag)
            assert bag.recovered and 0 < len(steps) < 20 and steps == list(range(len(steps)))


def test_topics_are_renamed(types, tmp_path):
    with BagWriter(tmp_path / 'bag', types) as writer:
        write_steps(writer, range(5))
        writer.add_topic('/other', 'std_msgs/msg/String')
    with BagReader(tmp_path, {'text': '/new/name/'}) as bag:
        assert bag.counts == {'/new/name': 5, '/other': 0}
        assert bag.types.keys() == bag.counts.keys()
        assert [item.topic for item in bag.messages(['/new/name'])] == ['/new/name'] * 5
        assert list(bag.messages(['/text'])) == []
    with BagReader(tmp_path, {'/text': '/other', '/other': '/text'}) as bag:
        assert bag.counts == {'/other': 5, '/text': 0}
    for old, new, words in (
        ('/none', '/new', '/none is not recorded; recorded are /other, /text'),
        ('/text', '/other', '/other is recorded too'),
    ):
        with pytest.raises(BagError, match=f'--remap {old}:={new}: {words}'):
            BagReader(tmp_path, {old: new})
