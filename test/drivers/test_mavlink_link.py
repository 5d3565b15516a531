"""The thread of a MAVLink link: it continues after whatever happens in it."""

import pytest
from waiting import wait_until

from maasi_drivers.links.mavlink import link as link_module
from maasi_drivers.settings.vehicles import MavlinkSettings


class Wire:
    """A connection that gives a message each time."""

    def __init__(self):
        self.closed = False

    def select(self, period):
        pass

    def recv_msg(self):
        return object()

    def close(self):
        self.closed = True

    def write(self, data):
        pass


@pytest.mark.parametrize(
    ('error', 'words'),
    [
        (OSError('unplugged'), 'unplugged'),
        (ValueError('no number'), "ValueError('no number')"),
        (KeyError('field'), "KeyError('field')"),
        (ZeroDivisionError(), 'ZeroDivisionError()'),
    ],
)
def test_an_exception_in_its_thread_is_a_lost_link_that_is_opened_again(
    tmp_path, monkeypatch, error, words
):
    wires, failures = [], []
    monkeypatch.setattr(link_module, '_RETRY', 0.01)
    monkeypatch.setattr(
        link_module, 'open_connection', lambda *_: wires.append(Wire()) or wires[-1]
    )
    settings = MavlinkSettings(url='udpin:127.0.0.1:0')
    link = link_module.VehicleLink(settings, [0.0, 0.0, 1.0], tmp_path)

    def handle(message, now):
        if len(wires) < 3:
            raise error
        link._end.set()
        raise StopIteration

    monkeypatch.setattr(link.vehicle, 'handle', handle)
    shut = link._shut
    monkeypatch.setattr(link, '_shut', lambda: failures.append(link.failure) or shut())
    link.open()
    wait_until(lambda: not link._thread.is_alive())
    assert len(wires) == 3 and all(wire.closed for wire in wires)
    assert [words in failure for failure in failures[:2]] == [True, True]
    assert failures[0].startswith('mavlink.url: udpin:127.0.0.1:0: ')
    link.close()


def test_a_wire_that_cannot_be_closed_or_opened_again_does_not_end_its_thread(
    tmp_path, monkeypatch
):
    tries = []

    class Broken(Wire):
        def select(self, period):
            raise OSError('unplugged')

        def close(self):
            raise OSError('no such device')

    def open_connection(*_):
        tries.append(link.failure)
        if len(tries) == 2:
            raise RuntimeError('no driver')
        if len(tries) == 4:
            link._end.set()
        return Broken()

    monkeypatch.setattr(link_module, '_RETRY', 0.01)
    monkeypatch.setattr(link_module, 'open_connection', open_connection)
    settings = MavlinkSettings(url='udpin:127.0.0.1:0')
    link = link_module.VehicleLink(settings, [0.0, 0.0, 1.0], tmp_path)
    link.open()
    wait_until(lambda: not link._thread.is_alive())
    failures = [text.removeprefix('mavlink.url: udpin:127.0.0.1:0: ') for text in tries]
    assert failures == ['', 'unplugged', "RuntimeError('no driver')", 'unplugged']
    link.close()
