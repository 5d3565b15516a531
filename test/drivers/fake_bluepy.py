"""A Mambo behind pyparrot's own Bluetooth connection, in place of bluepy and a radio."""

import queue
import sys
from functools import partial
from types import ModuleType, SimpleNamespace

from maasi_sim.simulation.emulators.mambo.fake_mambo import (
    ACK,
    ACKED_COMMANDS,
    ACKED_EVENTS,
    COMMANDS,
    EMERGENCY_COMMANDS,
    FakeMambo,
    Frame,
    free_address,
)

# Characteristics that pyparrot 1.5.20 writes to, `networking/bleConnection.py`.
_BUFFERS = {
    '0a': COMMANDS,
    '0b': ACKED_COMMANDS,
    '0c': EMERGENCY_COMMANDS,
    '1e': ACKED_EVENTS + 128,
}


class BluetoothMambo(FakeMambo):
    """A fake Mambo with the radio that pyparrot reaches it by, in place of its network."""

    def __init__(self, monkeypatch, firmware):
        # Without it, as it will be for the next test.
        from pyparrot import Minidrone

        btle = ModuleType('bluepy.btle')
        btle.Peripheral, btle.UUID, btle.DefaultDelegate = None, str, object
        btle.BTLEException = type('BTLEException', (Exception,), {})
        monkeypatch.setitem(sys.modules, 'bluepy', ModuleType('bluepy'))
        monkeypatch.setitem(sys.modules, 'bluepy.btle', btle)
        from pyparrot.networking import bleConnection

        def connect(connection):
            connection.send_characteristics = {
                role: SimpleNamespace(write=partial(self._write, _BUFFERS[name]))
                for name, role in connection.characteristic_send_uuids.items()
            }
            handles = {name: name for name in connection.characteristic_receive_uuids}
            delegate = bleConnection.MinidroneDelegate(handles, connection.minidrone, connection)
            self._notified = delegate.handleNotification

        monkeypatch.setattr(bleConnection, 'Peripheral', lambda: self)
        monkeypatch.setattr(bleConnection.BLEConnection, '_connect', connect)
        monkeypatch.setattr(Minidrone, 'BLEAvailable', True)
        monkeypatch.setattr(Minidrone, 'BLEConnection', bleConnection.BLEConnection, raising=False)
        self._waiting = queue.Queue()
        super().__init__(firmware, free_address())
        self.address = 'e0:14:d0:63:3d:d0'

    def disconnect(self):
        """As pyparrot calls it; the drone lives on."""

    def waitForNotifications(self, timeout):
        try:
            self._notified(*self._waiting.get(timeout=timeout))
        except queue.Empty:
            return False
        return True

    def _send_sensors(self, elapsed):
        pass  # they are "wifi only" or late (pyparrot, docs/minidronecommands.rst)

    def _transmit(self, frame):
        if not self.cut_down:
            name = '1b' if frame.kind == ACK else '0e'
            self._waiting.put((name, bytes([frame.kind, frame.sequence]) + frame.payload))

    def _write(self, buffer, data):
        # One without response succeeds all the same.
        if not self.cut_up:
            with self._lock:
                self._handle(Frame(data[0], buffer, data[1], data[2:]))
