"""Connection to a vehicle, which one thread alone reads and writes."""

from __future__ import annotations

import random
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from maasi_drivers.links.mavlink.protocol import mavlink, mavutil
from maasi_drivers.links.mavlink.vehicle import Vehicle
from maasi_drivers.settings.vehicles import Ending, MavlinkSettings

# Longest time until the next check of what is due [s].
_PERIOD = 0.02
# Between two tries to open a device that is not there [s].
_RETRY = 1.0
# Component ids that MAVLink leaves to private networks: no ground station has one of them.
_COMPONENTS = range(mavlink.MAV_COMP_ID_USER1, mavlink.MAV_COMP_ID_USER43 + 1)


class LinkError(RuntimeError):
    """A connection that cannot be opened."""


def make_sender(system: int) -> Any:
    """Return what packs the messages of a driver, without a wire.

    Its component id is another one at each start: ArduPilot does not pass a heartbeat on to a link
    on which it knows the same system and component (`MAVLink_routing::handle_heartbeat`), so a
    program with both ids of the driver could not be heard.
    """
    return mavlink.MAVLink(None, system, random.choice(_COMPONENTS))


def open_connection(url: str, system: int, component: int, baud: int = 57600) -> Any:
    """Return pymavlink's connection, which speaks MAVLink 2."""
    if mavlink.WIRE_PROTOCOL_VERSION != '2.0':
        raise LinkError(
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
        raise LinkError(f'mavlink.url: read {url!r}: {error}') from error


class VehicleLink:
    """A vehicle on a wire.

    A wire that cannot be opened is retried; `failure` has the cause meanwhile.

    Units: start [m].
    """

    def __init__(self, settings: MavlinkSettings, start: list[float], memory: Path) -> None:
        self.settings = settings
        self.failure = ''
        self._connection: Any = None
        # It writes to the wire, once that is there.
        self._sender = make_sender(settings.own_system)
        self._vehicle = Vehicle(settings, start, self._sender, memory)
        self._lock = threading.Lock()
        self._end = threading.Event()
        self._open()
        self._thread = threading.Thread(target=self._run, name='mavlink', daemon=True)
        self._thread.start()

    @contextmanager
    def vehicle(self) -> Iterator[Vehicle]:
        """Give the vehicle to one thread at a time."""
        with self._lock:
            yield self._vehicle

    def finish(self, ending: Ending, patience: float) -> bool:
        """Have it hold or land; return whether it confirms within `patience` seconds.

        Where nothing flies there is nothing to wait for.
        """
        with self._lock:
            self._vehicle.finish(ending)
        deadline = time.monotonic() + patience
        while time.monotonic() < deadline:
            with self._lock:
                if self._vehicle.at_rest:
                    return True
            if not self._thread.is_alive():
                break
            time.sleep(_PERIOD)
        return False

    def close(self) -> None:
        """Stop sending, and close the wire."""
        self._end.set()
        self._thread.join(timeout=2.0)
        self._shut()

    def _open(self) -> None:
        try:
            self._connection = open_connection(
                self.settings.url,
                self.settings.own_system,
                self._sender.srcComponent,
                self.settings.baud,
            )
        except LinkError as error:
            self.failure = str(error)
            return
        self._sender.file = self._connection
        self.failure = ''

    def _shut(self) -> None:
        if self._connection is not None:
            self._connection.close()
            self._connection = None

    def _run(self) -> None:
        while not self._end.is_set():
            if self._connection is None:
                self._end.wait(_RETRY)
                self._open()
                continue
            try:
                self._turn()
            except OSError as error:
                # A device that was pulled out may come back.
                self.failure = f'mavlink.url: {self.settings.url}: {error}'
                self._shut()

    def _turn(self) -> None:
        connection = self._connection
        connection.select(_PERIOD)
        while (message := connection.recv_msg()) is not None:
            with self._lock:
                self._vehicle.handle(message, time.monotonic())
        with self._lock:
            self._vehicle.tick(time.monotonic())
