"""A simulated MAVLink vehicle on a real link, in real time."""

import argparse
import math
import signal
import sys
import threading
import time
from types import SimpleNamespace
from typing import Any

import numpy as np

from maasi_drivers.links.mavlink.firmware import FIRMWARES
from maasi_drivers.links.mavlink.link import open_connection
from maasi_drivers.links.mavlink.protocol import mavlink
from maasi_filter.models.pose import Pose
from maasi_planner.motion import RobotState
from maasi_sim.simulation.emulators.mavlink.autopilot_settings import AutopilotSettings
from maasi_sim.simulation.emulators.mavlink.fake_autopilot import FakeAutopilot

_PERIOD = 0.02
_LONGEST = 0.5  # longest time simulated at once after a delay [s]


class FakeVehicle:
    """A fake autopilot with a connection and a thread that runs it in real time."""

    def __init__(
        self, settings: AutopilotSettings, url: str, start: Pose, generator: np.random.Generator
    ) -> None:
        self._connection = open_connection(url, settings.system, mavlink.MAV_COMP_ID_AUTOPILOT1)
        self._origin = np.array(start.position)
        self._connection.mav.file = SimpleNamespace(write=self._send)
        self._cut = False
        self.autopilot = FakeAutopilot(settings, self._connection.mav, start.yaw, generator)
        self._lock = threading.Lock()
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run, name='fake vehicle', daemon=True)
        self._thread.start()

    @property
    def state(self) -> RobotState:
        """True state, in the map."""
        with self._lock:
            body = self.autopilot.body
            return RobotState(
                Pose.from_yaw(self._origin + body.position, body.yaw),
                body.velocity,
                np.array([0.0, 0.0, body.yaw_rate]),
            )

    @property
    def obeys(self) -> bool:
        """Whether it is armed and executes the commands of its driver."""
        with self._lock:
            autopilot = self.autopilot
            return autopilot.armed and autopilot.mode == autopilot.firmware.external

    def cut(self, cut: bool = True) -> None:
        """Cut the link in both directions, or restore it."""
        self._cut = cut

    def _send(self, data: bytes) -> None:
        if not self._cut:
            self._connection.write(data)

    def close(self) -> None:
        """Stop the thread, and close the connection."""
        self._end.set()
        self._thread.join(timeout=2.0)
        self._connection.close()

    def _run(self) -> None:
        before = time.monotonic()
        while not self._end.wait(_PERIOD):
            now = time.monotonic()
            late = min(now - before, _LONGEST)
            before = now
            with self._lock:
                while (message := self._connection.recv_msg()) is not None:
                    if not self._cut:
                        self.autopilot.handle(message)
                steps = max(1, math.ceil(late / _PERIOD - 0.5))
                for _ in range(steps):
                    self.autopilot.advance(late / steps)


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(
        prog='fake_mavlink_vehicle',
        description='Simulate a vehicle that speaks MAVLink 2, to try the driver without a real '
        'one. Ctrl-C ends it.',
    )

    def add(name: str, help: str, **options: Any) -> None:
        parser.add_argument(f'--{name}', help=help, **options)

    url, names = 'udpout:127.0.0.1:14550', sorted(FIRMWARES)
    to = 'connect to the driver at this address of pymavlink (default: %(default)s)'
    add('url', to, default=url)
    behaviour = 'behave as this autopilot (default: %(default)s)'
    add('firmware', behaviour, choices=names, default='arducopter')
    add('system', 'MAVLink system id (default: 1)', type=int, default=1, metavar='N')
    ready = 'time until the position estimate is ready [s] (default: 2)'
    add('estimator-time', ready, type=float, default=2.0, metavar='S')
    charge = 'charge of the battery at the start, from 0 to 1 (default: 1)'
    add('charge', charge, type=float, default=1.0, metavar='X')
    given = 'set a parameter of the autopilot, for example FS_GCS_ENABLE=0; can be repeated'
    add('parameter', given, action='append', default=[], metavar='NAME=VALUE')
    return parser


def main(arguments: list[str] | None = None) -> int:
    """Simulate a vehicle until a signal; a crash of the autopilot is exit code 3."""
    options = build_parser().parse_args(arguments)
    parameters = {}
    try:
        for item in options.parameter:
            name, _, value = item.partition('=')
            try:
                parameters[name] = float(value)
            except ValueError:
                raise ValueError(f'--parameter: read {item!r}, allowed is NAME=NUMBER') from None
        settings = AutopilotSettings(
            firmware=options.firmware,
            system=options.system,
            estimator_time=options.estimator_time,
            charge=options.charge,
            parameters=parameters,
        )
        vehicle = FakeVehicle(
            settings, options.url, Pose.from_yaw(np.zeros(3), 0.0), np.random.default_rng(1)
        )
    except ValueError as error:
        print(f'error: {error}', file=sys.stderr)
        return 2
    ended = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: ended.set())
    autopilot, shown = vehicle.autopilot, ''
    while not autopilot.crashed and not ended.wait(0.2):
        text = f'{autopilot.mode_name}, {"armed" if autopilot.armed else "not armed"}'
        if text != shown:
            shown = text
            position = ', '.join(f'{value:.2f}' for value in vehicle.state.pose.position)
            print(f'{text}, at {position} m', flush=True)
    vehicle.close()
    if autopilot.crashed:
        print(f'the autopilot crashed: {autopilot.crashed}', file=sys.stderr)
        return 3
    return 0


if __name__ == '__main__':
    sys.exit(main())
