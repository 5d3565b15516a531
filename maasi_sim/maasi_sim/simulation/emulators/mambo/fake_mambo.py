"""A fake Parrot Mambo: the drone's side of its WiFi protocol, with a simulated firmware.

The protocol is that of pyparrot 1.5.20: a handshake in JSON over TCP, then frames over UDP,
`<BBBI` type, buffer, sequence, total size; and in commands and events `<BBH` project, class, id,
as in Parrot's minidrone.xml.
"""

import argparse
import contextlib
import json
import math
import secrets
import select
import signal
import socket
import struct
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from maasi_filter.models.pose import Pose
from maasi_planner.motion import RobotState
from maasi_sim.arguments import whole
from maasi_sim.scenario.layering import ScenarioError
from maasi_sim.scenario.loading import robot_type
from maasi_sim.simulation.emulators.mambo.firmware import (
    AIRBORNE,
    FirmwareSettings,
    FlyingState,
    MamboFirmware,
    Piloting,
)

ACK, DATA, DATA_WITH_ACK = 1, 2, 4
_HEADER = struct.Struct('<BBBI')


@dataclass(frozen=True)
class Frame:
    """One frame: its type, buffer and sequence number, and what is in it."""

    kind: int
    buffer: int
    sequence: int
    payload: bytes = b''

    def encode(self) -> bytes:
        """Return its bytes."""
        size = _HEADER.size + len(self.payload)
        return _HEADER.pack(self.kind, self.buffer, self.sequence, size) + self.payload


def frames(data: bytes) -> Iterator[Frame]:
    """Yield the frames of a datagram; `ValueError` for bytes that are none."""
    while data:
        if len(data) < _HEADER.size:
            raise ValueError(f'frame: got {len(data)} bytes, allowed are at least {_HEADER.size}')
        kind, buffer, sequence, size = _HEADER.unpack_from(data)
        if not _HEADER.size <= size <= len(data):
            raise ValueError(
                f'frame size: got {size}, allowed is {_HEADER.size} to the {len(data)} bytes there'
            )
        yield Frame(kind, buffer, sequence, data[_HEADER.size : size])
        data = data[size:]


ALL_STATES = (0, 4, 0)
_TAKE_OFF, _PILOTING, _LAND, _EMERGENCY = (2, 0, 1), (2, 0, 2), (2, 0, 3), (2, 0, 4)
_LIMITS = {(2, 8, 1): 'tilt', (2, 1, 0): 'climb', (2, 1, 1): 'turn'}  # commands that set a limit


def obey(firmware: MamboFirmware, number: tuple[int, int, int], content: bytes) -> None:
    """Execute a command on a firmware, ignore an unknown one; ValueError: its content is wrong."""
    try:
        if number == _PILOTING:
            flag, roll, pitch, yaw, climb, _ = struct.unpack('<BbbbbI', content)
            values = [max(-100, min(value, 100)) for value in (roll, pitch, yaw, climb)]
            if not flag:
                values[:2] = [0, 0]  # without the flag the drone keeps itself level
            firmware.pilot(Piloting(*values))
        elif number == _TAKE_OFF:
            firmware.take_off()
        elif number == _LAND:
            firmware.land()
        elif number == _EMERGENCY:
            firmware.emergency()
        elif number in _LIMITS:
            (value,) = struct.unpack('<f', content)
            if not math.isfinite(value):
                raise ValueError(f'command {number}: got {value}, allowed is a finite number')
            firmware.limit(_LIMITS[number], value)
    except struct.error as error:
        raise ValueError(f'command {number}: {error}') from error


HANDSHAKE_PORT = 44444  #: port of the handshake, fixed in pyparrot
COMMAND_PORT = 6000  #: port of commands, announced in the handshake

COMMANDS, ACKED_COMMANDS, EMERGENCY_COMMANDS = 10, 11, 12
EVENTS, ACKED_EVENTS = 126, 127
_ID = struct.Struct('<BBH')

_SENSOR_PERIOD = 0.5
# Period and number of retransmissions of a frame without acknowledgement.
_RETRY_PERIOD, _RETRIES = 0.15, 5
_STEP = 0.02
# Longest time simulated at once after the host was suspended, and wait for a handshake [s].
_CATCH_UP, _HANDSHAKE_TIME = 0.5, 2.0
_TRIES = 100


def free_address() -> str:
    """Return a loopback address where a fake can be reached for its handshake."""
    for _ in range(_TRIES):
        numbers = [secrets.randbelow(200) + 20 for _ in range(3)]
        address = '.'.join(map(str, [127, *numbers]))
        with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as test:
            try:
                test.bind((address, HANDSHAKE_PORT))
            except OSError:
                continue
        return address
    raise OSError(f'no address 127.x.y.z of this host with TCP port {HANDSHAKE_PORT} free')


def free_port() -> int:
    """Return a free UDP port, on which a driver can receive from its drone."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as test:
        test.bind(('0.0.0.0', 0))
        return int(test.getsockname()[1])


class FakeMambo:
    """A Mambo on this host, in real time, which a client such as pyparrot connects to.

    For tests: `position_sent` is 'true', 'none' or 'nan'; `cut_up` and `cut_down` lose
    datagrams; `refused` counts invalid ones, `received` counts commands by (project, class, id).
    """

    def __init__(
        self, firmware: MamboFirmware, address: str = '127.0.0.1', command_port: int = 0
    ) -> None:
        self.firmware, self.address = firmware, address
        self.position_sent = 'true'
        self.cut_up = self.cut_down = False
        self.refused = 0
        self.received: Counter[tuple[int, int, int]] = Counter()
        self._lock = threading.RLock()
        self._closing = threading.Event()
        self._controller: tuple[str, int] | None = None
        self._sequences: Counter[int] = Counter()
        # Frames that wait to be acknowledged: frame, tries left, time of the next try.
        self._unacked: dict[int, tuple[Frame, int, float]] = {}
        self._done: dict[int, int] = {}
        self._sensors_at = 0.0
        self._said: tuple[int, int] | None = None
        self._door = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        self._air = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._door.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            self._door.bind((address, HANDSHAKE_PORT))
            self._door.listen()
            self._air.bind((address, command_port))
        except OSError as error:
            self._door.close()
            self._air.close()
            raise OSError(
                f'fake Mambo at {address}: {error.strerror}; allowed is an address of this host '
                f'with TCP port {HANDSHAKE_PORT} and UDP port {command_port} free'
            ) from error
        self._door.setblocking(False)
        self._air.setblocking(False)
        self.command_port = int(self._air.getsockname()[1])
        self._thread = threading.Thread(target=self._live, name='fake Mambo', daemon=True)
        self._thread.start()

    @property
    def state(self) -> RobotState:
        """True state, in the map."""
        with self._lock:
            return self.firmware.state

    @property
    def obeys(self) -> bool:
        """Whether it is in the air and not landing."""
        flying_state = self.firmware.flying_state
        return flying_state in AIRBORNE and flying_state != FlyingState.LANDING

    def cut(self, cut: bool = True) -> None:
        """Cut the link, or restore it."""
        self.cut_up = self.cut_down = cut

    def close(self) -> None:
        """Leave the network."""
        self._closing.set()
        self._thread.join()
        self._door.close()
        self._air.close()

    def _live(self) -> None:
        last = time.monotonic()
        while not self._closing.is_set():
            wait = max(last + _STEP - time.monotonic(), 0.0)
            ready, _, _ = select.select([self._door, self._air], [], [], wait)
            with self._lock:
                # Losing the controller is no error of the simulated drone.
                with contextlib.suppress(OSError):
                    if self._door in ready:
                        self._answer_door()
                    if self._air in ready:
                        self._listen()
                now = time.monotonic()
                if now - last >= _STEP:
                    self._advance(min(now - last, _CATCH_UP))
                    last = now

    def _advance(self, dt: float) -> None:
        firmware = self.firmware
        firmware.advance(dt)
        self._tell_state()
        now = firmware.time
        if now - self._sensors_at >= _SENSOR_PERIOD - 1e-9:
            self._send_sensors(now - self._sensors_at)
            self._sensors_at = now
        for sequence, (frame, tries, due) in list(self._unacked.items()):
            if now >= due:
                self._unacked[sequence] = (frame, tries - 1, now + _RETRY_PERIOD)
                if tries <= 1:
                    del self._unacked[sequence]
                self._transmit(frame)

    def _transmit(self, frame: Frame) -> None:
        if self._controller is not None and not self.cut_down:
            with contextlib.suppress(OSError):
                self._air.sendto(frame.encode(), self._controller)

    def _send(self, kind: int, buffer: int, payload: bytes) -> Frame:
        frame = Frame(kind, buffer, self._sequences[buffer] % 256, payload)
        self._sequences[buffer] += 1
        self._transmit(frame)
        return frame

    def _event(self, number: tuple[int, int, int], payload: bytes) -> None:
        self._send(DATA, EVENTS, _ID.pack(*number) + payload)

    def _acked_event(self, number: tuple[int, int, int], payload: bytes) -> None:
        frame = self._send(DATA_WITH_ACK, ACKED_EVENTS, _ID.pack(*number) + payload)
        self._unacked[frame.sequence] = (frame, _RETRIES, self.firmware.time + _RETRY_PERIOD)

    def _tell_state(self) -> None:
        state = (int(self.firmware.flying_state), self.firmware.percent)
        before, self._said = self._said or (-1, -1), state
        if state[0] != before[0]:
            self._acked_event((2, 3, 1), struct.pack('<I', state[0]))
        if state[1] != before[1]:
            self._acked_event((0, 5, 1), struct.pack('<B', state[1]))

    def _send_sensors(self, elapsed: float) -> None:
        firmware, body = self.firmware, self.firmware.body
        estimate = firmware.estimate()
        stamp = round(1000.0 * firmware.time) % 65536
        forward, left = body.level_speed()
        # Down and right are positive here.
        self._event((2, 18, 1), struct.pack('<fffH', forward, -left, -body.velocity[2], stamp))
        self._event((2, 18, 2), struct.pack('<fH', firmware.height, stamp))
        # From north-east-down at the start to forward-right-down.
        turn = Pose.from_rpy(np.zeros(3), (body.roll, -body.pitch, -estimate.yaw))
        self._event((2, 18, 4), struct.pack('<ffffH', *turn.orientation, stamp))
        if self.position_sent == 'none':
            return
        x, y, z = (100.0 * estimate.position).tolist()
        if self.position_sent == 'nan':
            x = math.nan
        psi = round(math.degrees(-estimate.yaw))
        # Its stamp is the time since the one before, unlike that of the others.
        self._event((2, 18, 0), struct.pack('<ffhhh', x, y, round(z), psi, round(1000.0 * elapsed)))

    def _answer_door(self) -> None:
        visitor, (host, _) = self._door.accept()
        with visitor:
            visitor.settimeout(_HANDSHAKE_TIME)
            try:
                port = int(json.loads(visitor.recv(4096).rstrip(b'\0'))['d2c_port'])
            except (ValueError, KeyError, TypeError):
                self.refused += 1
                return
            self._controller = (host, port)
            self._unacked.clear()
            self._done.clear()
            self._sequences.clear()
            self._said = None
            self.firmware.note_message()
            answer = {'status': 0, 'c2d_port': self.command_port}
            visitor.sendall(json.dumps(answer).encode() + b'\0')

    def _listen(self) -> None:
        data, sender = self._air.recvfrom(65536)
        if self.cut_up or self._controller is None or sender[0] != self._controller[0]:
            return
        try:
            for frame in frames(data):
                self._handle(frame)
        except ValueError:
            self.refused += 1

    def _handle(self, frame: Frame) -> None:
        self.firmware.note_message()
        if frame.kind == ACK:
            if frame.payload and frame.buffer == ACKED_EVENTS + 128:
                self._unacked.pop(frame.payload[0], None)
            return
        if frame.kind == DATA_WITH_ACK:
            self._send(ACK, frame.buffer + 128, bytes([frame.sequence]))
            if self._done.get(frame.buffer) == frame.sequence:
                return  # retransmission after a lost acknowledgement
            self._done[frame.buffer] = frame.sequence
        if frame.buffer not in (COMMANDS, ACKED_COMMANDS, EMERGENCY_COMMANDS):
            return
        if len(frame.payload) < _ID.size:
            raise ValueError(f'command: got {len(frame.payload)} bytes, allowed are {_ID.size}')
        number = _ID.unpack_from(frame.payload)
        self.received[number] += 1
        if number == ALL_STATES:
            self._said = None
            self._tell_state()
            self._event((0, 5, 0), b'')
        else:
            obey(self.firmware, number, frame.payload[_ID.size :])


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(
        prog='fake_mambo',
        description='Simulate a Parrot Mambo on the network of this host, for a driver with '
        'link: mambo_wifi or any other program that uses pyparrot over WiFi. Ctrl-C ends it.',
    )
    settings = FirmwareSettings()

    def add(name: str, help: str, **options: Any) -> None:
        parser.add_argument(f'--{name}', help=f'{help} (default: %(default)s)', **options)

    add('address', 'listen on this address', default='127.0.0.1', metavar='ADDRESS')
    add('type', 'robot type, in config/robots', default='mambo', metavar='NAME')
    add('seed', 'random seed of the noise', type=whole, default=1, metavar='N')
    charge = 'charge of the battery at the start, from 0 to 1'
    add('charge', charge, type=float, default=1.0, metavar='X')
    add('drag', 'drag of the drone [1/s]', type=float, default=settings.drag, metavar='X')
    delay = 'delay from a command to its tilt [s]'
    add('delay', delay, type=float, default=settings.delay, metavar='S')
    silent = 'what the drone does when its controller is silent'
    add('lost-link', silent, choices=('hover', 'land'), default=settings.lost_link)
    return parser


def main(arguments: list[str] | None = None) -> int:
    """Run a fake Mambo until it is interrupted."""
    options = build_parser().parse_args(arguments)
    try:
        for name, low, high in (('charge', 0.0, 1.0), ('drag', 1e-3, 20.0), ('delay', 0.0, 2.0)):
            value = getattr(options, name)
            if not low <= value <= high:
                raise ScenarioError(f'--{name}: read {value}, allowed is {low:g} to {high:g}')
        robot = robot_type(options.type)
        firmware = MamboFirmware(
            Pose.from_yaw([0.0, 0.0, 0.0], 0.0),
            FirmwareSettings(delay=options.delay, lost_link=options.lost_link, drag=options.drag),
            battery=robot.battery.model_copy(update={'charge': options.charge}),
            odometry=robot.odometry,
            seed=options.seed,
        )
        fake = FakeMambo(firmware, options.address, COMMAND_PORT)
    except (ScenarioError, OSError) as error:
        print(f'error: {error}', file=sys.stderr)
        return 2
    ended = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: ended.set())
    print(f'fake Mambo at {options.address}, TCP {HANDSHAKE_PORT}, UDP {fake.command_port}')
    said = None
    while not ended.wait(0.1):
        flying, charge = firmware.flying_state, firmware.charge.charge
        if (flying, round(10 * charge)) != said:
            said = flying, round(10 * charge)
            place = ', '.join(f'{value:.2f}' for value in fake.state.pose.position)
            print(f'{flying.name.lower()} at {place} m, battery {100.0 * charge:.0f} %', flush=True)
    fake.close()
    return 0


if __name__ == '__main__':
    sys.exit(main())
