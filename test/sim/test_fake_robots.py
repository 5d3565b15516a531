"""The fakes on real sockets: a Mambo's wire under pyparrot as it is on PyPI, and both commands."""

import math
import signal
import socket
import struct
import subprocess
import sys
import time
from contextlib import contextmanager

import numpy as np
import pytest
from numpy.testing import assert_allclose
from waiting import wait_until

from maasi_drivers.links.mambo.link import MamboLink, MamboLinkError
from maasi_drivers.links.mavlink.link import open_connection
from maasi_filter.models.pose import Pose
from maasi_sim.scenario.loading import load_scenario
from maasi_sim.scenario.schema import BatterySettings
from maasi_sim.simulation.emulators.linked_robots import with_addresses
from maasi_sim.simulation.emulators.mambo import fake_mambo
from maasi_sim.simulation.emulators.mambo.fake_mambo import FakeMambo, free_address, free_port
from maasi_sim.simulation.emulators.mambo.firmware import (
    FirmwareSettings,
    FlyingState,
    MamboFirmware,
)
from maasi_sim.simulation.emulators.mavlink import fake_mavlink_vehicle

START = Pose.from_yaw([1.0, 2.0, 0.1], 0.5 * math.pi)


@pytest.fixture
def pair():
    """Return a fake in real time, and a link to it."""
    battery = BatterySettings(charge=0.5)
    fake = FakeMambo(MamboFirmware(START, FirmwareSettings(), battery), free_address())
    link = MamboLink('wifi', fake.address, free_port(), tilt=0.1)
    link.connect()
    wait_until(lambda: link.error or (link.connected and link.position is not None))
    assert not link.error
    yield fake, link
    link.close()
    fake.close()


def test_pyparrot_flies_it(pair):
    fake, link = pair
    wait_until(lambda: link.battery == 0.5 and link.flying_state == 'landed')
    assert_allclose(link.position.position, 0.0, atol=0.011)
    assert_allclose(fake.firmware.limits['tilt'], 0.1, rtol=1e-5)
    link.take_off()
    wait_until(lambda: link.flying_state == 'hovering')

    def steer():
        link.steer(0.5, 0.25, 0.0, 0.0)
        time.sleep(0.05)

    wait_until(lambda: link.position.position[0] > 0.2, steer)
    forward, left, up = link.position.position
    assert 0.02 < left < forward and up > 0.6
    # A landing is asked for again when commands are lost.
    fake.cut_up = True
    link.land()
    asked = link._asked_at
    wait_until(lambda: link._asked_at > asked)
    assert fake.firmware.flying_state in (FlyingState.HOVERING, FlyingState.FLYING)
    fake.cut_up = False
    wait_until(lambda: link.flying_state == 'landed')
    # Acknowledged commands are not repeated.
    assert fake.refused == 0 and fake.received[(2, 0, 1)] == 1
    wait_until(lambda: not fake._unacked)


def test_a_drone_that_lands_by_itself_is_not_sent_up_again(pair):
    fake, link = pair
    link.take_off()
    wait_until(lambda: link.flying_state == 'hovering')
    fake.firmware.land()
    wait_until(lambda: link.flying_state == 'landed')
    # Three times as long as from one request to the next.
    end = fake.firmware.time + 2.1
    wait_until(lambda: fake.firmware.time > end)
    assert fake.firmware.take_offs == 1 and link.flying_state == 'landed'


@pytest.mark.parametrize('last', ['true', 'none'])
def test_a_packet_that_is_repeated_is_not_believed(pair, last):
    """Also where the last new stamps came without their position."""
    fake, link = pair
    handle = link._drone.drone_connection.handle_data
    packets = []

    def keep(data):
        if data:
            packets.append(data)
        handle(data)

    link._drone.drone_connection.handle_data = keep
    wait_until(lambda: len(packets) > 20)
    fake.position_sent, before = last, link.received_at
    wait_until(lambda: link.received_at > before)
    fake.cut_down = True
    # Datagrams in transit have arrived once nothing is received for a while.
    wait_until(lambda: time.monotonic() - link.received_at > 1.0)
    before, received = link.received_at, link.position.received
    repeated = packets[-4:]
    if last == 'none':
        repeated = [packet for packet in packets if packet[7:11] == struct.pack('<BBH', 2, 18, 0)]
    for packet in repeated[-4:]:
        handle(packet)
    assert link.received_at == before and link.position.received == received
    # Its state is requested again once it is received again.
    fake.firmware.emergency()
    end = fake.firmware.time + 2.0
    wait_until(lambda: fake.firmware.time > end and not fake._unacked)
    fake.cut_down, fake.position_sent = False, 'true'
    wait_until(lambda: link.position.received > received)
    wait_until(lambda: link.flying_state == 'emergency')


BAD_FRAMES = [
    b'\x01',
    b'\x02\x7f\x00',
    struct.pack('<BBBI', 2, 127, 0, 0),
    struct.pack('<BBBI', 2, 127, 0, 3),
    struct.pack('<BBBI', 2, 127, 0, 4000),
    struct.pack('<BBBI', 9, 127, 0, 7),
    struct.pack('<BBBI', 1, 139, 0, 7),
    struct.pack('<BBBI', 2, 127, 0, 9) + b'\x02\x12',
]


def test_datagrams_that_are_not_the_drones_or_are_cut_short_do_not_end_the_link(pair):
    fake, link = pair
    # The link receives only on the address that faces the drone.
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(('127.0.0.9', link.port))
    dropped = link._drone.drone_connection.udp_receive_sock.dropped
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        stranger.bind((free_address(), 0))
        for data in BAD_FRAMES:
            stranger.sendto(data, ('127.0.0.1', link.port))
        wait_until(lambda: dropped['foreign sender'] == len(BAD_FRAMES))
    # The same from the drone's own address.
    for data in BAD_FRAMES:
        fake._air.sendto(data, ('127.0.0.1', link.port))
    wait_until(lambda: dropped['bad frame'] + dropped['bad content'] >= 7)
    received = link.position.received
    wait_until(lambda: link.position.received > received)
    assert link.connected and not link.error and link.dropped == dropped
    other = MamboLink('wifi', fake.address, link.port)
    with pytest.raises(MamboLinkError, match=f'UDP port {link.port}.*one Mambo per process'):
        other.connect()
    # Positions that are no numbers are left out.
    fake.position_sent = 'nan'
    wait_until(lambda: link.bad_events >= 2)
    assert np.isfinite(link.position.position).all()
    with pytest.raises(ValueError, match='finite'):
        link.steer(math.nan, 0.0, 0.0, 0.0)


def test_an_address_of_a_scenario_that_was_asked_for_stays():
    scenario = load_scenario('mambo_turtlebot_wifi')
    robot = scenario.robots['mambo']
    asked = robot.mambo.model_copy(update={'address': '127.0.0.9'})
    robots = scenario.robots | {'other': robot.model_copy(update={'mambo': asked})}
    robots = with_addresses(scenario.model_copy(update={'robots': robots})).robots
    assert robots['other'].mambo == asked
    assert robots['mambo'].mambo.address not in ('127.0.0.9', robot.mambo.address)


# ---- the commands ----------------------------------------------------------------------------


@contextmanager
def running(module, *options):
    """Run a fake's command; yield it, and check that it ends well when it is interrupted."""
    command = [sys.executable, '-m', module.__name__, *options]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            yield process
        finally:
            process.send_signal(signal.SIGINT)
    assert process.returncode == 0


def test_a_fake_mambo_is_found_by_a_link():
    address = free_address()
    with running(fake_mambo, '--address', address, '--charge', '0.4') as fake:
        assert address in fake.stdout.readline()
        link = MamboLink('wifi', address, free_port())
        link.connect()
        wait_until(lambda: link.battery == 0.4)
        link.close()
        assert 'landed' in fake.stdout.readline()


def test_a_fake_vehicle_sends_mavlink_2():
    url = f'127.0.0.1:{free_port()}'
    connection = open_connection(f'udpin:{url}', 255, 190)
    options = ('--system', '7', '--firmware', 'ardusub', '--url', f'udpout:{url}')
    with running(fake_mavlink_vehicle, *options) as fake:
        beat = connection.recv_match(type='HEARTBEAT', blocking=True, timeout=60.0)
        assert (beat.get_srcSystem(), beat.type) == (7, 12)
        # The first byte of MAVLink 2.
        assert beat.get_msgbuf()[0] == 0xFD
        assert 'not armed, at 0.00, 0.00, 0.00 m' in fake.stdout.readline()
    connection.close()


@pytest.mark.parametrize(
    ('fake', 'option', 'value', 'words'),
    [
        (fake_mambo, '--drag', '-1.0', '--drag: read -1.0'),
        (fake_mambo, '--delay', '-0.1', '--delay: read -0.1'),
        (fake_mambo, '--charge', '2.0', '--charge: read 2.0'),
        (fake_mavlink_vehicle, '--parameter', 'FS_GCS_ENABLE', 'allowed is NAME=NUMBER'),
        (fake_mavlink_vehicle, '--url', 'udpout:nowhere', 'host:port'),
        (fake_mavlink_vehicle, '--charge', '3', 'charge'),
    ],
)
def test_what_makes_no_sense_is_refused(capsys, fake, option, value, words):
    assert fake.main([option, value]) == 2
    assert words in capsys.readouterr().err
