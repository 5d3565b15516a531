"""A stand-in for bluepy, so that pyparrot's own Bluetooth connection reaches a fake Mambo.

What pyparrot uses of `bluepy.btle`: `Peripheral`, `UUID`, `DefaultDelegate`, `BTLEException`
(pyparrot 1.5.20, `networking/bleConnection.py`; services and characteristics are those that it
looks for there). Of events the drone sends flying state and battery alone: no speed, altitude,
orientation or position, which are \"wifi only\" or late (pyparrot, docs/minidronecommands.rst).
"""

import queue
import struct
import sys
import threading
import time
from functools import partial
from types import ModuleType, SimpleNamespace

from maasi_sim.simulation.emulators.mambo.fake_mambo import ALL_STATES, obey

_SERVICES = {
    'fa00': ('fa0a', 'fa0b', 'fa0c', 'fa1e'),
    'fb00': ('fb0e', 'fb0f', 'fb1b', 'fb1c'),
    'fd21': ('fd22', 'fd23', 'fd24'),
    'fd51': ('fd52', 'fd53', 'fd54'),
}
_HANDLES = {name: 10 + 3 * n for n, name in enumerate(sum(_SERVICES.values(), ()))}
_STEP = 0.02


def part(name, **methods):
    """Return a service or characteristic of the drone."""
    return SimpleNamespace(uuid=f'9a66{name}-0800-9191-11e4-012d1540cb8e', **methods)


class BluetoothMambo:
    """A fake Mambo in real time, with the radio that pyparrot reaches it by.

    While `lost` nothing gets through; a write without response then still succeeds. `heard` has
    channel and command of what came through.
    """

    address = 'e0:14:d0:63:3d:d0'

    def __init__(self, monkeypatch, firmware):
        # Without it, as it will be for the next test.
        from pyparrot import Minidrone

        self.firmware = firmware
        self.lost, self.heard = False, []
        self._waiting = queue.Queue()
        self._lock = threading.Lock()
        self._sequence = 0
        self._said = None
        self._ended = threading.Event()
        btle = ModuleType('bluepy.btle')
        btle.Peripheral, btle.UUID, btle.DefaultDelegate = None, str, object
        btle.BTLEException = type('BTLEException', (Exception,), {})
        monkeypatch.setitem(sys.modules, 'bluepy', ModuleType('bluepy'))
        monkeypatch.setitem(sys.modules, 'bluepy.btle', btle)
        from pyparrot.networking import bleConnection

        monkeypatch.setattr(bleConnection, 'Peripheral', lambda: self)
        monkeypatch.setattr(Minidrone, 'BLEAvailable', True)
        monkeypatch.setattr(Minidrone, 'BLEConnection', bleConnection.BLEConnection, raising=False)

    @property
    def state(self):
        return self.firmware.state

    def cut(self, cut=True):
        self.lost = cut

    # ---- what pyparrot calls -----------------------------------------------------------------

    def connect(self, address, kind):
        threading.Thread(target=self._live, daemon=True).start()

    def disconnect(self):
        self._ended.set()

    close = disconnect

    def getServices(self):
        return [
            part(name, getCharacteristics=lambda keys=keys: list(map(self._characteristic, keys)))
            for name, keys in _SERVICES.items()
        ]

    def _characteristic(self, name):
        handle = _HANDLES[name]
        return part(name, handle=handle, getHandle=lambda: handle, write=partial(self._hear, name))

    def writeCharacteristic(self, handle, data):
        pass

    def setDelegate(self, delegate):
        self._delegate = delegate

    def waitForNotifications(self, timeout):
        try:
            name, data = self._waiting.get(timeout=timeout)
        except queue.Empty:
            return False
        self._delegate.handleNotification(_HANDLES[name], data)
        return True

    # ---- the drone ---------------------------------------------------------------------------

    def _live(self):
        last = time.monotonic()
        while not self._ended.wait(_STEP):
            now = time.monotonic()
            with self._lock:
                self.firmware.advance(min(now - last, 0.5))
                self._tell()
            last = now

    def _tell(self, again=False):
        said = (int(self.firmware.flying_state), self.firmware.percent)
        if said != self._said or again:
            self._said = said
            self._notify('fb0e', struct.pack('<BBHI', 2, 3, 1, said[0]))
            self._notify('fb0e', struct.pack('<BBHB', 0, 5, 1, said[1]))

    def _notify(self, name, content):
        if not self.lost:
            self._sequence = (self._sequence + 1) % 256
            self._waiting.put((name, struct.pack('<BB', 4, self._sequence) + content))

    def _hear(self, name, data):
        if self.lost:
            return
        with self._lock:
            self.firmware.hear()
            if name not in ('fa0a', 'fa0b', 'fa0c'):
                return
            number = struct.unpack_from('<BBH', data, 2)
            self.heard.append((name, number))
            if number == ALL_STATES:
                self._tell(again=True)
            else:
                obey(self.firmware, number, data[6:])
            if name == 'fa0b':
                self._notify('fb1b', data[1:2])
