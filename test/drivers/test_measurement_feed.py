"""The measurement feed: its layout, what is refused, and the reference sender over the network."""

import socket
import struct
import subprocess
import sys
import time
import zlib
from collections import Counter
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from waiting import PATIENCE, wait_until

from maasi_drivers.measurement_feed_sender import main
from maasi_drivers.vision.detector import Blobs
from maasi_drivers.vision.images import ImageSourceError, VideoSource
from maasi_drivers.vision.measurement_feed import (
    FeedError,
    FeedPacket,
    FeedPose,
    FeedReceiver,
    FeedState,
    decode,
    encode,
)


def blobs(number, seed=1):
    generator = np.random.default_rng(seed)
    roots = generator.normal(0.0, 0.3, (number, 2, 2))
    return Blobs(
        centroids=generator.uniform([0.0, 0.0], [159.0, 119.0], (number, 2)),
        areas=generator.uniform(10.0, 60.0, number),
        extents=generator.uniform(4.0, 9.0, (number, 2)),
        border_cut=generator.random(number) < 0.5,
        covariances=roots @ np.swapaxes(roots, 1, 2),
    )


def packet(number=3, sequence=7, age=0.012, pose=None, **changes):
    return FeedPacket(sequence, age, 160, 120, replace(blobs(number), **changes), pose)


def posed(**changes):
    """Return a packet with the pose of a drone, without blobs."""
    values = {'position': np.array([0.5, -0.25, 1.0]), 'yaw': 0.5, 'battery': 0.75} | changes
    return packet(0, pose=FeedPose(state=FeedState.AIR, **values))


def sealed(data):
    """Return bytes with the checksum that belongs to them instead of their last four."""
    return data[:-4] + struct.pack('<I', zlib.crc32(data[:-4]))


@pytest.mark.parametrize('number', [0, 1, 256])
def test_what_is_sent_is_what_is_read(number):
    sent = packet(number)
    read = decode(encode(sent))
    assert (read.sequence, read.width, read.height) == (7, 160, 120)
    assert_allclose(read.age, 0.012, atol=1e-6)
    for name in ('centroids', 'areas', 'extents', 'covariances', 'border_cut'):
        assert_allclose(getattr(read.blobs, name), getattr(sent.blobs, name), rtol=1e-6, atol=1e-6)


def test_the_bytes_are_those_of_the_document():
    one = Blobs(
        centroids=np.array([[80.5, 59.25]]),
        areas=np.array([33.0]),
        extents=np.array([[7.0, 6.0]]),
        border_cut=np.array([True]),
        covariances=np.array([[[0.25, 0.125], [0.125, 0.5]]]),
    )
    data = encode(FeedPacket(0x01020304, 0.005, 160, 120, one))
    numbers = struct.pack('<8f', 80.5, 59.25, 0.25, 0.125, 0.5, 33.0, 7.0, 6.0)
    start = bytes.fromhex('4d534d4601000100a00078000403020188130000')
    assert data == sealed(start + numbers + b'\1\0\0\0' + bytes(4))


def test_a_pose_is_read_as_it_is_written():
    data = encode(posed())
    assert data[5] == 1 and len(data) == 20 + 32 + 4
    assert struct.unpack_from('<7fI', data, 20) == (0.5, -0.25, 1.0, 0.0, 0.0, 0.5, 0.75, 1)
    pose = decode(data).pose
    assert pose.state is FeedState.AIR and pose.yaw == 0.5
    assert_allclose(pose.position, [0.5, -0.25, 1.0])


def test_no_damage_goes_unnoticed():
    data = encode(packet(2))
    bits = [(index, bit) for index in range(len(data)) for bit in (0, 3, 7)]
    damaged = [
        data[:index] + bytes([data[index] ^ (1 << bit)]) + data[index + 1 :] for index, bit in bits
    ]
    for content in (*damaged, *(data[:size] for size in range(len(data))), data + b'\0'):
        with pytest.raises(FeedError):
            decode(content)


@given(st.binary(max_size=200))
def test_anything_else_is_refused(data):
    for content in (data, b'MSMF' + data, sealed(b'MSMF\1\0' + data + b'1234')):
        try:
            read = decode(content)
        except FeedError:
            continue
        assert np.isfinite(read.blobs.centroids).all()


@pytest.mark.parametrize(
    ('offset', 'layout', 'value', 'said'),
    [
        (4, '<B', 2, 'version: read 2, allowed is 1'),
        (5, '<B', 2, 'flags: read 2'),
        (8, '<H', 0, 'width, height: read 0 x 120'),
        (16, '<I', 10_000_001, 'age: read 10000001 us'),
        (20, '<f', float('nan'), 'blob 0: .*finite'),
        (24, '<f', 119.6, 'inside 160 x 120 px'),
        (28, '<f', -1.0, 'semidefinite'),
        (32, '<f', 50.0, 'semidefinite'),
        (40, '<f', -1.0, 'area and extents from 0'),
        (44, '<f', float('inf'), 'blob 0: .*finite'),
        (52, '<I', 2, 'marks 0 or 1'),
    ],
)
def test_a_field_that_cannot_be_is_named(offset, layout, value, said):
    data = bytearray(encode(packet(1)))
    struct.pack_into(layout, data, offset, value)
    with pytest.raises(FeedError, match=said):
        decode(sealed(bytes(data)))


@pytest.mark.parametrize(
    ('sent', 'text'),
    [
        (packet(257), 'at most 256'),
        (packet(age=float('nan')), 'age'),
        (packet(1, centroids=np.array([[np.nan, 60.0]])), 'finite'),
        (posed(yaw=float('nan')), 'finite'),
        (posed(position=np.array([2000.0, 0.0, 0.0])), 'within 1000 m'),
        (posed(roll=1.6), 'roll and pitch'),
        (posed(battery=1.1), 'charge'),
    ],
)
def test_what_cannot_be_sent_is_refused(sent, text):
    with pytest.raises(FeedError, match=text):
        encode(sent)


def received(receiver, number):
    packets = []
    wait_until(lambda: packets.extend(receiver.receive()) or len(packets) >= number)
    return packets


@pytest.fixture
def feed():
    """Return a receiver, and what sends to it."""
    counts, texts = Counter(), []

    def drop(reason, text, number):
        counts[reason] += number
        texts.append(text)

    receiver = FeedReceiver(0, '127.0.0.1', on_drop=drop)
    receiver.counts, receiver.texts = counts, texts
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as output:
        yield receiver, lambda data: output.sendto(data, ('127.0.0.1', receiver.port))
    receiver.close()


def test_a_packet_over_the_network_has_the_time_of_its_image(feed):
    receiver, send = feed
    before = time.monotonic()
    send(encode(packet(age=0.5)))
    ((found, taken),) = received(receiver, 1)
    assert before - 0.5 - 1e-6 <= taken <= time.monotonic() - 0.5
    assert len(found.blobs) == 3
    with pytest.raises(ImageSourceError, match='in use'):
        FeedReceiver(receiver.port, '127.0.0.1')


def test_lost_old_and_damaged_packets_are_counted_and_a_restarted_sender_is_heard(feed):
    receiver, send = feed
    for sequence in (2**32 - 2, 2**32 - 1, 0, 0, 2**32 - 1, 3):
        send(encode(packet(sequence=sequence)))
    send(b'hello')
    for sequence in (5000, 1, 2):
        send(encode(packet(sequence=sequence)))
    packets = received(receiver, 7)
    assert [packet.sequence for packet, _ in packets] == [2**32 - 2, 2**32 - 1, 0, 3, 5000, 1, 2]
    assert receiver.counts == {'lost packet': 2, 'old packet': 2, 'bad packet': 1}
    assert any('length: read 5 bytes' in text for text in receiver.texts)


def test_only_the_sender_that_is_named_is_heard(feed):
    receiver, send = feed
    receiver.sender = '127.0.0.9'
    send(encode(packet(sequence=1)))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as robot:
        robot.bind(('127.0.0.9', 0))
        robot.sendto(encode(packet(sequence=2)), ('127.0.0.1', receiver.port))
        ((found, _),) = received(receiver, 1)
    assert found.sequence == 2 and receiver.counts['foreign sender'] == 1
    assert 'read 127.0.0.1, allowed is 127.0.0.9' in receiver.texts[-1]


# ---- videos ----------------------------------------------------------------------------------


@pytest.fixture(scope='module')
def video(tmp_path_factory):
    """Return a video of one second with a blue disc that moves to the right."""
    path = tmp_path_factory.mktemp('video') / 'flight.avi'
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*'MJPG'), 20.0, (160, 120))
    assert writer.isOpened()
    for step in range(20):
        image = np.full((120, 160, 3), 130, np.uint8)
        # B, G, R.
        cv2.circle(image, (30 + 5 * step, 60), 5, (200, 70, 50), -1, cv2.LINE_AA)
        writer.write(image)
    writer.release()
    return path


def test_a_video_is_played_at_its_rate(video):
    source, frames = VideoSource(str(video)), []

    def look():
        frame = source.pop_frame()
        frames.extend([] if frame is None else [frame])
        time.sleep(0.001)

    wait_until(lambda: source.ended, look)
    source.close()
    assert 5 <= len(frames) <= 20
    assert [frame.number for frame in frames] == sorted({frame.number for frame in frames})
    first = frames[0]
    for frame in frames:
        # Not before its time.
        assert frame.received - first.received >= (frame.number - first.number) / 20.0 - 0.2


def test_a_source_that_is_not_there_is_said_and_a_device_is_tried_again(tmp_path):
    for source, text in (
        (str(tmp_path / 'none.avi'), 'cannot be opened'),
        ('', 'allowed are'),
    ):
        with pytest.raises(ImageSourceError, match=text):
            VideoSource(source)
    device = VideoSource('/dev/video77')
    wait_until(lambda: device.error)
    assert 'cannot be opened' in device.error
    assert device.pop_frame() is None and not device.ended
    device.close()


def test_the_reference_sender_sends_what_it_sees(feed, video):
    receiver, _ = feed
    command = [sys.executable, '-m', 'maasi_drivers.measurement_feed_sender', str(video)]
    command += [f'127.0.0.1:{receiver.port}', '--rule', 'paper', '--exposure-age', '0.03']
    sender = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    # On a busy machine it skips images, as for a camera.
    packets = received(receiver, 1)
    output, _ = sender.communicate(timeout=PATIENCE)
    assert sender.returncode == 0 and 'images sent' in output
    packets += receiver.receive()
    for sent, _ in packets:
        assert sent.age >= 0.03
        column = 30.0 + 5.0 * (sent.sequence - 1)
        assert_allclose(sent.blobs.centroids, [[column, 60.0]], atol=0.5)


@pytest.mark.parametrize('to', ['127.0.0.1', 'host:0', ':99', '127.0.0.1:port'])
def test_a_wrong_address_is_said(video, to, capsys):
    assert main([str(video), to]) == 2
    assert 'allowed is HOST:PORT' in capsys.readouterr().err
