"""Cursor-on-Target events by UDP: each found target, again when it moved, and never an error."""

import argparse
import errno
import math
import socket
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest

from maasi_filter.geometry.geodesy import OriginSettings, geodetic
from maasi_filter.records import FoundTarget, Label
from maasi_sim.run.cot import CotAddress, CotSender, cot_address

ORIGIN = OriginSettings(latitude=46.0, longitude=23.5, altitude=350.0)


@pytest.fixture
def receiver():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as made:
        made.bind(('127.0.0.1', 0))
        made.settimeout(5.0)
        yield made


@pytest.fixture
def warnings():
    return []


@pytest.fixture
def sender(receiver, warnings):
    address = CotAddress(*receiver.getsockname())
    made = CotSender('field', address, ORIGIN, warnings.append)
    yield made
    made.close()


def received(receiver):
    """Return the events that have arrived; on loopback they are there once they are sent."""
    receiver.setblocking(False)
    events = []
    while True:
        try:
            events.append(ElementTree.fromstring(receiver.recv(65536)))
        except BlockingIOError:
            return events


def found(number, x=1.0, y=2.0, **more):
    position, spread = np.array([x, y]), np.diag([0.04, 0.09])
    return replace(FoundTarget(number, position, spread, 'drone', 1, 3.0), **more)


def test_a_target_is_sent_when_new_moved_and_after_a_while(sender, receiver):
    def numbers(now, *targets):
        sender.update(targets, now)
        return [int(event.get('uid').rpartition('.')[2]) for event in received(receiver)]

    assert numbers(100.0, found(1)) == [1]
    assert numbers(101.0, found(1), found(2)) == [2]
    assert numbers(101.5, found(1, 1.5), found(2)) == []  # not more often than every 2 s
    assert numbers(102.0, found(1, 1.5), found(2)) == [1]
    assert numbers(120.0, found(1, 1.5), found(2)) == []
    assert numbers(132.0, found(1, 1.5), found(2)) == [1, 2]
    assert (
        sender.finish([found(1, 1.5), found(2)])
        == f'7 Cursor-on-Target events sent to {sender.address}'
    )


def test_an_event_is_where_the_target_is(sender, receiver):
    sender.update([found(7, 30.0, -40.0)], 0.0)
    (event,) = received(receiver)
    point, contact = event.find('point'), event.find('detail/contact')
    wanted = geodetic(np.array([[30.0, -40.0]]), ORIGIN)[0]
    place = [float(point.get(key)) for key in ('lat', 'lon', 'hae')]
    assert np.allclose(place[:2], wanted[:2], atol=1e-8, rtol=0.0)
    assert place[2] == pytest.approx(wanted[2], abs=1e-3)
    assert float(point.get('ce')) == pytest.approx(0.3) and event.get('uid') == 'maasi.field.7'
    assert event.get('time') < event.get('stale') and contact.get('callsign') == 'Target 7'


def test_a_target_that_is_no_longer_found_is_removed(sender, receiver):
    sender.update([found(1), found(2)], 0.0)
    received(receiver)
    sender.update([found(2)], 1.0)
    (event,) = received(receiver)
    assert event.get('type') == 't-x-d-d' and event.find('detail/__forcedelete') is not None
    assert event.find('detail/link').get('uid') == 'maasi.field.1'
    sender.update([found(2)], 1.5)
    assert received(receiver) == []


def test_errors_of_the_socket_are_counted_and_reported_once(sender, receiver, warnings):
    # Longer than any datagram.
    long = found(1, label=Label('x' * 70_000, 0.5, ''))
    for now in (0.0, 100.0, 200.0):
        sender.update([long, found(2)], now)
    assert (sender.failed, sender.sent) == (3, 3) and len(received(receiver)) == 3
    assert len(warnings) == 1 and str(sender.address) in warnings[0]
    assert sender.finish([long]).endswith(', 4 failed')


def test_a_full_buffer_does_not_block(sender, warnings):
    """The kernel refuses a datagram if its buffer is full; the socket itself never waits."""

    class Full:
        def __init__(self, real):
            self.timeout = real.gettimeout()

        def sendto(self, *_):
            assert self.timeout == 0.0
            raise BlockingIOError(errno.EAGAIN, 'Resource temporarily unavailable')

        def close(self):
            pass

    real, sender._socket = sender._socket, Full(sender._socket)
    real.close()
    sender.update([found(1), found(2)], 0.0)
    assert sender.failed == 2 and len(warnings) == 1


@pytest.mark.parametrize('seed', range(10))
def test_any_found_target_is_an_event_of_valid_xml(sender, receiver, seed):
    generator = np.random.default_rng(seed)
    signs = [*'<>&"\'$ ', '\x00', '\x1b', '\n', '\ufffe', '\u4e2d', '\ud800']
    for number in range(20):
        spread = generator.normal(0.0, 10.0 ** generator.integers(-9, 9), (2, 2))
        spread[0, 0] = generator.choice([np.nan, np.inf, -1.0, 0.0])
        words = [''.join(generator.choice(signs, generator.integers(0, 30))) for _ in range(2)]
        target = found(number, *generator.uniform(-1e5, 1e5, 2), covariance=spread)
        sender.update([replace(target, label=Label(words[0], 0.5, words[1]))], float(number))
    events = [event for event in received(receiver) if event.get('type') == 'b-m-p-s-m']
    assert sender.failed == 0 and len(events) == 20
    for event in events:
        assert all(
            math.isfinite(float(event.find('point').get(key))) for key in ('lat', 'ce', 'le')
        )


def test_a_multicast_group_receives(warnings):
    """Where the machine has no route to the group, that is a warning."""
    group, sent = '239.2.3.1', CotSender('field', cot_address('239.2.3.1:6969'), ORIGIN, print)
    assert str(sent.address) == 'udp://239.2.3.1:6969'
    sent.close()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as member:
        member.bind(('', 0))
        loopback = socket.inet_aton('127.0.0.1')
        join = socket.inet_aton(group) + loopback
        member.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, join)
        address = CotAddress(group, member.getsockname()[1])
        sender = CotSender('field', address, ORIGIN, warnings.append)
        sender._socket.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, loopback)
        sender.update([found(1)], 0.0)
        sender.close()
        assert len(received(member)) == 1 and not warnings


@pytest.mark.parametrize(
    'text',
    [
        '',
        'udp://',
        'host',
        'udp://host',
        'udp://host:0',
        'udp://host:70000',
        'udp://host:x',
        'tcp://host:1',
        'udp://host:1/path',
        'udp://host:1?a',
        'udp://a@host:1',
        'udp://[::1:5',
        'udp://:6969',
    ],
)
def test_another_address_is_refused(text):
    with pytest.raises(argparse.ArgumentTypeError, match='allowed is udp://HOST:PORT'):
        cot_address(text)


def test_addresses():
    for text, shown in (
        ('udp://127.0.0.1:8087', 'udp://127.0.0.1:8087'),
        ('tak.example:8087', 'udp://tak.example:8087'),
        ('udp://[::1]:6969', 'udp://[::1]:6969'),
    ):
        assert str(cot_address(text)) == shown


def test_an_unknown_host_is_refused_before_the_run():
    for host in ('no-such-host.invalid', 'x' * 300, 'a..b'):
        with pytest.raises(ValueError, match=r'^--cot: read udp://'):
            CotSender('field', CotAddress(host, 6969), ORIGIN, print)
