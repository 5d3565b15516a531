"""Recordings: what is written can be read, whatever happened to the writer."""

import multiprocessing
import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from maasi_sim.bag import Bag, BagError, BagWriter, TopicQos, load_types


@pytest.fixture(scope='module')
def types():
    return load_types()


def header(types, time):
    stamp = types.types['builtin_interfaces/msg/Time'](sec=time, nanosec=0)
    return types.types['std_msgs/msg/Header'](stamp=stamp, frame_id='map')


def image(types, pixels, encoding, padding=0):
    height, width = pixels.shape[:2]
    rows = pixels.reshape(height, pixels[0].size if height else 48)
    rows = np.pad(rows, ((0, 0), (0, padding)))
    return types.types['sensor_msgs/msg/Image'](
        header=header(types, 1),
        height=height,
        width=width,
        encoding=encoding,
        is_bigendian=0,
        step=rows.shape[1],
        data=np.ascontiguousarray(rows).reshape(-1),
    )


def done(types, step):
    return types.types['maasi_msgs/msg/LockstepDone'](node='/filter_node', step=step)


def test_messages_come_back_in_order_with_rising_times(types, tmp_path):
    with BagWriter(tmp_path / 'bag', types) as writer:
        writer.add_topic('/done', 'maasi_msgs/msg/LockstepDone')
        for step in range(300):
            writer.write_message('/done', 1000 * (step // 10), done(types, step))
    with Bag(tmp_path) as bag:
        read = list(bag.messages())
        assert [item.message.step for item in read] == list(range(300))
        times = [item.time for item in read]
        assert times == sorted(set(times))
        assert bag.types == {'/done': 'maasi_msgs/msg/LockstepDone'}
        assert bag.counts == {'/done': 300}


def test_scenario_is_found_again(types, tmp_path):
    with BagWriter(tmp_path / 'bag', types) as writer:
        writer.write_scenario('seed: 3\nnodes: {}\n', {'seed': '3'})
    with Bag(tmp_path / 'bag') as bag:
        assert bag.scenario() == {'seed': 3, 'nodes': {}}
    assert "seed: '3'" in (tmp_path / 'bag' / 'metadata.yaml').read_text()


def test_no_scenario_is_said(types, tmp_path):
    BagWriter(tmp_path / 'bag', types).close()
    with Bag(tmp_path) as bag, pytest.raises(BagError, match='holds no scenario'):
        bag.scenario()


@pytest.mark.parametrize('encoding', ['bgr8', 'rgb8', 'mono8'])
@pytest.mark.parametrize('padding', [0, 5])
def test_png_images_come_back_to_the_bit(types, tmp_path, encoding, padding):
    shape = (12, 16) if encoding == 'mono8' else (12, 16, 3)
    pixels = np.random.default_rng(1).integers(0, 256, shape, dtype=np.uint8)
    with BagWriter(tmp_path / 'bag', types, images='png') as writer:
        writer.add_topic('/mambo/camera/image_raw', 'sensor_msgs/msg/Image')
        writer.write_message('/mambo/camera/image_raw', 5, image(types, pixels, encoding, padding))
    with Bag(tmp_path) as bag:
        (item,) = bag.messages()
    assert item.topic == '/mambo/camera/image_raw/compressed'
    assert item.message.format.startswith(f'{encoding}; png')
    assert item.message.header.stamp.sec == 1
    read = cv2.imdecode(item.message.data, cv2.IMREAD_UNCHANGED)
    expected = pixels[:, :, ::-1] if encoding == 'rgb8' else pixels
    np.testing.assert_array_equal(read, expected)


def test_jpeg_images_come_back_nearly(types, tmp_path):
    pixels = np.full((24, 32, 3), 120, np.uint8)
    cv2.circle(pixels, (16, 12), 6, (220, 40, 30), -1)
    with BagWriter(tmp_path / 'bag', types) as writer:
        writer.add_topic('/image', 'sensor_msgs/msg/Image')
        writer.write_message('/image', 5, image(types, pixels, 'bgr8'))
    with Bag(tmp_path) as bag:
        (item,) = bag.messages()
    read = cv2.imdecode(item.message.data, cv2.IMREAD_COLOR)
    assert np.abs(read.astype(int) - pixels).mean() < 3.0


@pytest.mark.parametrize('height, encoding', [(0, 'bgr8'), (12, 'bayer_rggb8'), (12, '32FC1')])
def test_images_that_cannot_be_compressed_are_stored_as_they_are(types, tmp_path, height, encoding):
    message = image(types, np.zeros((height, 16), np.uint8), encoding)
    with BagWriter(tmp_path / 'bag', types, images='png') as writer:
        writer.add_topic('/image', 'sensor_msgs/msg/Image')
        writer.write_message('/image', 5, message)
    with Bag(tmp_path) as bag:
        (item,) = bag.messages()
    assert item.topic == '/image'
    assert item.message.encoding == encoding


def test_quality_of_service_is_kept(types, tmp_path):
    with BagWriter(tmp_path / 'bag', types) as writer:
        writer.add_topic('/found', 'std_msgs/msg/String', TopicQos(latched=True))
    text = (tmp_path / 'bag' / 'metadata.yaml').read_text()
    assert 'durability: transient_local' in text
    assert 'reliability: reliable' in text


def test_closing_twice_does_nothing(types, tmp_path):
    writer = BagWriter(tmp_path / 'bag', types)
    writer.close()
    writer.close()


def test_wait_returns_when_all_is_written(types, tmp_path):
    with BagWriter(tmp_path / 'bag', types, backlog=100) as writer:
        writer.add_topic('/done', 'maasi_msgs/msg/LockstepDone')
        for step in range(200):
            writer.write_message('/done', step, done(types, step))
        writer.wait()
        assert writer.counts == {'/done': 200}


def test_an_existing_folder_is_not_overwritten(types, tmp_path):
    with pytest.raises(BagError, match='exists already'):
        BagWriter(tmp_path, types)


def test_unknown_type_and_topic_are_named(types, tmp_path):
    with BagWriter(tmp_path / 'bag', types) as writer:
        with pytest.raises(BagError, match='unknown message type other_msgs/msg/Thing'):
            writer.add_topic('/thing', 'other_msgs/msg/Thing')
        with pytest.raises(BagError, match='/elsewhere: not announced'):
            writer.write('/elsewhere', 0, b'')


def test_a_write_error_is_raised_not_swallowed(types, tmp_path):
    writer = BagWriter(tmp_path / 'bag', types)
    writer.add_topic('/image', 'sensor_msgs/msg/Image')
    writer.write('/image', 0, b'no message')
    with pytest.raises(BagError, match='writing failed'):
        writer.wait()
    with pytest.raises(BagError, match='writing failed'):
        writer.close()


@pytest.mark.parametrize('name', ['missing', 'file', 'empty'])
def test_what_is_no_recording_is_refused(tmp_path, name):
    (tmp_path / 'file').write_text('nothing')
    (tmp_path / 'empty').mkdir()
    with pytest.raises(BagError, match=name):
        Bag(tmp_path / name)


def _write_and_die(path):
    types = load_types()
    writer = BagWriter(Path(path), types)
    writer.add_topic('/text', 'std_msgs/msg/String')
    text = np.random.default_rng(0).bytes(30000).hex()
    for step in range(60):
        string = types.types['std_msgs/msg/String'](data=f'{step} {text}')
        writer.write_message('/text', step, string)
    writer.wait()
    os._exit(9)


def test_what_a_killed_writer_left_can_be_read(tmp_path):
    process = multiprocessing.get_context('fork').Process(
        target=_write_and_die, args=(str(tmp_path / 'bag'),)
    )
    process.start()
    process.join(60)
    assert process.exitcode == 9
    with Bag(tmp_path) as bag:
        steps = [int(item.message.data.split()[0]) for item in bag.messages()]
    assert steps == list(range(len(steps)))
    assert len(steps) > 15
