"""Connection to a Parrot Mambo by pyparrot (WiFi or Bluetooth), in one thread. Without ROS.

Over WiFi pyparrot repeats its last packet after a link loss: a position event is new only with a
new stamp of speed, altitude or orientation. Over Bluetooth each notification counts, and so does
the acknowledgement of a command, sent when nothing else arrives.
"""

import errno
import importlib
import math
import re
import threading
import time
from collections import Counter
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from maasi_drivers.links.mambo.pyparrot import DroneSocket, ask_for_answer, guard, mend
from maasi_filter.arrays import FloatArray

HANDSHAKE_PORT = 44444
AIRBORNE = ('takingoff', 'hovering', 'flying', 'landing')

_STAMPS = ('DroneSpeed_ts', 'DroneAltitude_ts', 'DroneQuaternion_ts')
_ROUND = 0.05  # loop period of the thread [s]; requests wake it
CALLER_TIMEOUT = 0.5  # silence of the caller after which the drone hovers [s]
_REPEAT = 0.7  # period of take-off or landing commands until the drone obeys [s]
# Longest delay between a new stamp and its position; a later position is a repetition [s].
_TOGETHER = 0.4
_OUTDATED = 1.0  # a reported landing does not count after this silence [s]
# Over Bluetooth: silence after which a command with acknowledgement is sent [s].
_PROBE_PERIOD = 0.3
# Period of connection attempts [s].
_RECONNECT = 1.0
_BLUETOOTH = re.compile(r'([0-9a-fA-F]{2}:){5}[0-9a-fA-F]{2}')
_FARTHEST = 1000.0  # largest distance from the take-off point [m]


class MamboLinkError(RuntimeError):
    """No connection to the drone; the text contains cause and remedy."""


@dataclass(frozen=True)
class PositionEvent:
    """The drone's position estimate, in the axes of its heading at take-off."""

    position: FloatArray  # from the take-off point: forward, left, up [m]
    yaw: float  # from the heading at take-off, anticlockwise [rad]
    received: float  # monotonic clock [s]


@dataclass(eq=False)
class MamboLink:
    """A connection to one Mambo with its own thread for pyparrot: no call waits.

    The thread is also a dead man's switch: `CALLER_TIMEOUT` after the last `keep_alive` the
    drone hovers, and `land_after` later it lands.
    """

    kind: Literal['wifi', 'ble'] = 'wifi'
    address: str = '192.168.99.3'
    port: int = 43210
    tilt: float = math.radians(10.0)  # set in the drone [rad]
    climb: float = 0.5  # set in the drone [m/s]
    land_after: float = 3.0  # [s]

    def __post_init__(self) -> None:
        self.error = ''  #: fault of the link, which keeps trying to connect
        self.connected = False  #: whether the drone has answered
        #: State of the drone, in pyparrot's words: landed, takingoff, hovering, flying, ...
        self.flying_state = ''
        self.battery = -1.0  #: charge, 0 to 1; negative: not received yet
        #: Time of the last new data or acknowledgement, monotonic clock [s].
        self.received_at = -math.inf
        self.position: PositionEvent | None = None  #: the last position event
        #: Number of unusable position events.
        self.bad_events = 0
        self._drone: Any = None
        self._stamps: dict[str, Any] = {}
        self._fresh_until = -math.inf
        self._lock = threading.Lock()
        self._wake = threading.Event()
        self._closing = threading.Event()
        # Roll, pitch, yaw, climb of the next command.
        self._steering: list[int] | None = None
        self._wanted: Literal['', 'take_off', 'land'] = ''
        self._asked_at = -math.inf
        self._called_at = math.inf
        self._probed_at = -math.inf
        self._was_silent = False
        self._thread: threading.Thread | None = None

    def connect(self) -> None:
        """Begin to connect."""
        make = self._make_drone()
        # pyparrot's thread inherits that this one does not keep the process alive.
        self._thread = threading.Thread(
            target=self._work, args=(make,), name='Mambo link', daemon=True
        )
        self._thread.start()

    @property
    def airborne(self) -> bool:
        """Whether the drone reports that it is in the air, including landing."""
        return self.flying_state in AIRBORNE

    @property
    def dropped(self) -> Counter[str]:
        """Number of dropped datagrams by reason."""
        receiver = getattr(self._drone, 'drone_connection', None)
        return Counter(getattr(getattr(receiver, 'udp_receive_sock', None), 'dropped', {}))

    def take_off(self) -> None:
        """Take off; repeated until it obeys or until another request."""
        self._want('take_off')

    def land(self) -> None:
        """Land; repeated until it obeys, also without reception."""
        self._want('land')

    def steer(self, forward: float, left: float, up: float, turn: float) -> None:
        """Send a piloting command: shares of the largest, -1 to 1; turn anticlockwise."""
        values = (-left, forward, -turn, up)
        if not all(map(math.isfinite, values)):
            raise ValueError(
                f'steer: got {(forward, left, up, turn)}, allowed are finite numbers from -1 to 1'
            )
        with self._lock:
            self._steering = [round(100.0 * max(-1.0, min(value, 1.0))) for value in values]
        self._wake.set()

    def keep_alive(self) -> None:
        """Note that the caller is alive; the first call arms the dead man's switch."""
        self._called_at = time.monotonic()

    def close(self, patience: float = 3.0) -> None:
        """Close the link, waiting for at most `patience` seconds; the firmware takes over."""
        self._closing.set()
        self._wake.set()
        if self._thread is not None:
            self._thread.join(patience)

    def _want(self, what: Literal['take_off', 'land']) -> None:
        with self._lock:
            if self._wanted != what:
                self._wanted = what
                self._asked_at = -math.inf
                self._steering = None
        self._wake.set()

    def check(self) -> Any:
        """Return pyparrot's module for such drones, or raise an error."""
        try:
            # Only a driver of such a robot needs it.
            minidrone = importlib.import_module('pyparrot.Minidrone')
        except ImportError as error:
            raise MamboLinkError(
                f'link to a Mambo: {error}; pyparrot and zeroconf are needed '
                '(pip install pyparrot zeroconf)'
            ) from error
        if self.kind == 'ble' and not minidrone.BLEAvailable:
            raise MamboLinkError(
                'link to a Mambo by Bluetooth: bluepy is not installed (pip install bluepy; it '
                "needs GLib's headers, libglib2.0-dev, to build), or use WiFi"
            )
        if self.kind == 'ble' and not _BLUETOOTH.fullmatch(self.address):
            raise MamboLinkError(
                f'address of a Mambo by Bluetooth: read {self.address!r}, allowed is one such as '
                "e0:14:d0:63:3d:d0 (pyparrot's findMinidrone shows it)"
            )
        if self.kind == 'wifi':
            try:
                DroneSocket(self.address, self.port).close()
            except OSError as error:
                # Without a route to the drone its network may come up later.
                if error.errno == errno.EADDRINUSE:
                    raise MamboLinkError(
                        f'UDP port {self.port}: {error.strerror}; allowed is a free port (one '
                        'Mambo per process and host)'
                    ) from error
        return minidrone

    def _make_drone(self) -> Any:
        minidrone = self.check()
        link = self

        class Sensors(minidrone.MinidroneSensors):  # type: ignore[name-defined, misc]
            """pyparrot's sensors, which also report each update."""

            def update(self, name: str, value: Any, sensor_enum: Any) -> None:
                super().update(name, value, sensor_enum)
                link._receive(name, value, self)

        drone = minidrone.Mambo(address=self.address, use_wifi=self.kind == 'wifi')
        drone.sensors = Sensors()
        received = drone.drone_connection._set_command_received

        def handle_answer(channel: str, value: bool, *sequence: int) -> None:
            received(channel, value, *sequence)
            if value:
                link.received_at = time.monotonic()

        drone.drone_connection._set_command_received = handle_answer
        if self.kind == 'wifi':
            connection = drone.drone_connection
            # With its own name for the type it would accept only the address 192.168.99.3.
            connection.drone_type = 'Minidrone'
            connection.ip_address = self.address
            connection.udp_receive_port = self.port
            guard(connection, self.address, self.port)
        else:
            mend(drone.drone_connection)
        return drone

    def _work(self, drone: Any) -> None:
        where = self.address if self.kind == 'ble' else f'{self.address}, TCP {HANDSHAKE_PORT}'
        while why := self._try_to_connect(drone):
            self.error = f'no Mambo at {where}: {why}'
            if self._closing.wait(_RECONNECT):
                return
        self.error = ''
        self._drone = drone
        try:
            drone.set_max_tilt(math.degrees(self.tilt))
            drone.set_max_vertical_speed(self.climb)
            drone.ask_for_state_update()
            self.connected = True
            while not self._closing.is_set():
                self._watch_caller()
                self._ask_again()
                self._do_wanted()
                self._send_steering()
                if self.kind == 'ble':
                    now = time.monotonic()
                    if now - max(self.received_at, self._probed_at) >= _PROBE_PERIOD:
                        self._probed_at = now
                        ask_for_answer(drone.drone_connection, self.tilt)
                    drone.smart_sleep(_ROUND)
                else:
                    self._wake.wait(_ROUND)
                self._wake.clear()
        except Exception as error:
            self.error = f'link to the Mambo lost: {error}'
        finally:
            self.connected = False
            connection = drone.drone_connection
            if self.kind == 'ble':
                drone.disconnect()
            else:
                connection.is_listening = False
                connection.listener_thread.join(2.0)  # its listener closes the sockets

    def _watch_caller(self) -> None:
        late = time.monotonic() - self._called_at - CALLER_TIMEOUT
        if late <= 0.0 or not self.airborne:
            return
        if late > self.land_after:
            self.land()
        else:
            with self._lock:
                self._steering = [0, 0, 0, 0]

    def _ask_again(self) -> None:
        silent = math.isfinite(self.received_at) and time.monotonic() - self.received_at > _OUTDATED
        if self._was_silent and not silent:
            self._drone.ask_for_state_update()
        self._was_silent = silent

    def _try_to_connect(self, drone: Any) -> str:
        try:
            return '' if drone.connect(num_retries=3) else 'connection refused'
        except Exception as error:
            # pyparrot raises exceptions of all kinds.
            return str(error) or type(error).__name__

    def _do_wanted(self) -> None:
        now = time.monotonic()
        with self._lock:
            wanted, state = self._wanted, self.flying_state
            if wanted == 'take_off':
                obeyed = state in AIRBORNE
                if obeyed:
                    # Requested once: a drone that lands by itself stays down.
                    self._wanted = ''
            else:
                # Its last report may be outdated.
                known = state == 'landed' or now - self.received_at <= _OUTDATED
                obeyed = known and state in ('landed', 'landing', 'emergency')
            if not wanted or obeyed or now - self._asked_at < _REPEAT:
                return
            self._asked_at = now
        if wanted == 'take_off':
            self._drone.takeoff()
        else:
            self._drone.land()

    def _send_steering(self) -> None:
        with self._lock:
            steering, self._steering = self._steering, None
        if steering is not None:
            self._drone.fly_direct(*steering)

    def _receive(self, name: str, value: Any, sensors: Any) -> None:
        if self.kind == 'ble':
            self.received_at = time.monotonic()
            self._fresh_until = self.received_at + _TOGETHER
        if name in _STAMPS and self._stamps.get(name) != value:
            self._stamps[name] = value
            self.received_at = time.monotonic()
            self._fresh_until = self.received_at + _TOGETHER
        elif name == 'FlyingStateChanged_state':
            self.flying_state = str(sensors.flying_state)
        elif name == 'BatteryStateChanged_battery_percent':
            self.battery = min(max(0.01 * float(value), 0.0), 1.0)
        elif name == 'DronePosition_ts' and time.monotonic() <= self._fresh_until:
            # The last number of its event.
            self._fresh_until = -math.inf
            read = sensors.sensors_dict
            keys = ('posx', 'posy', 'posz', 'psi')
            *centimetres, psi = (float(read[f'DronePosition_{key}']) for key in keys)
            position = 0.01 * np.array(centimetres)
            # False also for nan.
            if np.abs(position).max() <= _FARTHEST and math.isfinite(psi):
                self.position = PositionEvent(position, -math.radians(psi), time.monotonic())
            else:
                self.bad_events += 1
