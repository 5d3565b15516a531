"""Connection to a vehicle; a single thread reads and writes."""

import random
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

from maasi_drivers.links.mavlink.protocol import mavlink, mavutil
from maasi_drivers.links.mavlink.vehicle import Vehicle
from maasi_drivers.settings.vehicles import Ending, MavlinkSettings

_PERIOD = 0.02  # longest time between two checks [s]
_RETRY = 1.0  # time between attempts to open a missing device [s]
# Component ids reserved for private networks, which no ground station uses.
_COMPONENTS = range(mavlink.MAV_COMP_ID_USER1, mavlink.MAV_COMP_ID_USER43 + 1)


def make_sender(system: int) -> Any:
    """Return the message packer of a driver, with another component id at each start.

    ArduPilot forwards no heartbeat to a link with the same system and component
    (`MAVLink_routing::handle_heartbeat`), so a program with both ids of the driver would be
    invisible.
    """
    return mavlink.MAVLink(None, system, random.choice(_COMPONENTS))


def open_connection(url: str, system: int, component: int, baud: int = 57600) -> Any:
    """Return pymavlink's connection, with MAVLink 2."""
    if mavlink.WIRE_PROTOCOL_VERSION != '2.0':
        raise ValueError(
            'pymavlink was imported before maasi_drivers.links.mavlink and speaks MAVLink 1: set '
            'MAVLINK20=1'
        )
    try:
        return mavutil.mavlink_connection(
            url,
            baud=baud,
            source_system=system,
            source_component=component,
            autoreconnect=True,
            robust_parsing=True,
        )
    except (OSError, ValueError, IndexError) as error:
        raise ValueError(f'mavlink.url: read {url!r}: {error}') from error


class VehicleLink:
    """A connected vehicle; reopens the connection after a `failure`; `lock` guards `vehicle`."""

    def __init__(self, settings: MavlinkSettings, start: list[float], memory: Path) -> None:
        self.settings = settings
        self.failure = ''
        self._connection: Any = None
        # Writes when the connection is open.
        self._sender = make_sender(settings.own_system)
        self.vehicle = Vehicle(settings, start, self._sender, memory)
        self.lock = threading.Lock()
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run, name='mavlink', daemon=True)

    def open(self) -> None:
        """Open the connection and start the thread."""
        self._open()
        self._thread.start()

    def finish(self, ending: Ending, patience: float) -> bool:
        """Let it hold or land; return whether it confirms within `patience` [s] or is down."""
        with self.lock:
            self.vehicle.finish(ending)
        deadline = time.monotonic() + patience
        while time.monotonic() < deadline:
            with self.lock:
                if self.vehicle.at_rest or not self._thread.is_alive():
                    return self.vehicle.at_rest
            time.sleep(_PERIOD)
        return False

    def close(self) -> None:
        """Stop sending and close the connection."""
        self._end.set()
        if self._thread.is_alive():
            self._thread.join(timeout=2.0)
        self._shut()

    def _open(self) -> None:
        settings, component = self.settings, self._sender.srcComponent
        try:
            connection = open_connection(
                settings.url, settings.own_system, component, settings.baud
            )
        except ValueError as error:
            self.failure = str(error)
            return
        self._connection = self._sender.file = connection
        self.failure = ''

    def _shut(self) -> None:
        connection, self._connection = self._connection, None
        # Errors while closing a broken connection add nothing.
        with suppress(Exception):
            if connection is not None:
                connection.close()

    def _run(self) -> None:
        while not self._end.is_set():
            try:
                if self._connection is None:
                    self._end.wait(_RETRY)
                    self._open()
                    continue
                self._connection.select(_PERIOD)
                with self.lock:
                    while (message := self._connection.recv_msg()) is not None:
                        self.vehicle.handle(message, time.monotonic())
                    self.vehicle.tick(time.monotonic())
            except Exception as error:
                # A removed device may return; an invalid message must not end the thread: the link
                # is lost meanwhile.
                words = str(error) if isinstance(error, OSError) else repr(error)
                self.failure = f'mavlink.url: {self.settings.url}: {words}'
                self._shut()
