"""The autopilot's failsafe parameters: read, reported, and judged before arming."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from typing import Any

from maasi_drivers.links.mavlink.firmware import Firmware
from maasi_drivers.links.mavlink.protocol import mavlink
from maasi_drivers.links.mavlink.report_log import INFO, WARNING
from maasi_drivers.links.mavlink.settings import MavlinkSettings

# Period and number of requests for a parameter that is not answered [s, 1].
_ANSWER_TIMEOUT, _TRIES = 0.5, 5
# A message with our system id counts for this time [s].
_FOREIGN_AGE = 5.0


class FailsafeCheck:
    """Whether a vehicle stops by itself when the driver is gone.

    ArduPilot's ground station failsafe checks the system id of heartbeats alone
    (`GCS::sysid_is_gcs`): any program with the driver's id keeps it from acting.

    Parameters
    ----------
    firmware : Firmware
        Of the vehicle.
    settings : MavlinkSettings
        Of the link.
    sender : MAVLink
        Writes to the wire.
    report : callable
        Takes the severity as in MAVLink, and a text.

    Attributes
    ----------
    values : dict
        Parameters as read; None where the autopilot does not have one.
    complete : bool
        Whether all were answered, or requested in vain.
    """

    def __init__(
        self,
        firmware: Firmware,
        settings: MavlinkSettings,
        sender: Any,
        report: Callable[[int, str], None],
    ) -> None:
        self.values: dict[str, float | None] = {}
        self.complete = False
        self._firmware = firmware
        self._settings = settings
        self._sender = sender
        self._report = report
        self._names = [*firmware.failsafes, *firmware.ground_station]
        if firmware.ground_station_high:
            self._names.append(firmware.ground_station_high)
        self._asked: Counter[str] = Counter()
        self._asked_at = -math.inf
        self._foreign_at = -math.inf

    def take(self, name: str, value: float) -> None:
        """Take the value of a parameter."""
        if name in self._names:
            self.values[name] = value

    def hear_own_id(self, now: float) -> None:
        """Note a message of another program that has the driver's system id."""
        if now - self._foreign_at > _FOREIGN_AGE:
            self._report(WARNING, self._foreign_text())
        self._foreign_at = now

    def read(self, now: float) -> None:
        """Request what is missing; call it repeatedly."""
        if self.complete or now - self._asked_at < _ANSWER_TIMEOUT:
            return
        self._asked_at = now
        if self._station() is not None:
            # Older and newer versions have other names for it.
            for name in self._firmware.ground_station:
                self.values.setdefault(name, None)
        for name in self._names:
            if name in self.values:
                continue
            if self._asked[name] == _TRIES:
                self.values[name] = None
                continue
            self._asked[name] += 1
            self._sender.param_request_read_send(
                self._settings.system, mavlink.MAV_COMP_ID_AUTOPILOT1, name.encode(), -1
            )
        if len(self.values) == len(self._names):
            self.complete = True
            self._report_all()

    def problem(self, now: float) -> str:
        """Return why the vehicle must not be armed; empty where nothing speaks against it."""
        if not self._settings.require_failsafe:
            return ''
        for name, failsafe in self._firmware.failsafes.items():
            value = self.values.get(name)
            if failsafe.guards_link and (value is None or value in failsafe.off):
                text = 'is not known' if value is None else f'is {value:g}'
                return f'failsafe {name} {text}, and require_failsafe is true'
        return self.foreign(now) or self._station_problem()

    def foreign(self, now: float) -> str:
        """Return that another program has the driver's system id, or nothing."""
        return self._foreign_text() if now - self._foreign_at <= _FOREIGN_AGE else ''

    def _foreign_text(self) -> str:
        return (
            f'another program sends with system id {self._settings.own_system}: the '
            'autopilot would not miss the driver; mavlink.own_system must be its alone'
        )

    def _station(self) -> tuple[str, float] | None:
        """Return the parameter that names the ground station, and its value."""
        for name in self._firmware.ground_station:
            value = self.values.get(name)
            if value is not None:
                return name, value
        return None

    def _station_problem(self) -> str:
        """Return why the autopilot would not miss the driver alone, or nothing."""
        names = self._firmware.ground_station
        if not names:
            return ''
        station, own = self._station(), self._settings.own_system
        if station is None:
            return f'{" or ".join(names)} is not known, and require_failsafe is true'
        name, low = station
        if low != own:
            return (
                f'{name} is {low:g}, mavlink.own_system is {own}: the autopilot would not miss '
                f'the driver; set {name} to {own}'
            )
        high_name = self._firmware.ground_station_high
        high = self.values.get(high_name)
        if high is not None and high > low:
            return (
                f'{high_name} is {high:g}: any ground station with an id from {low:g} to {high:g} '
                'keeps the failsafe from acting; set it to 0'
            )
        return ''

    def _report_all(self) -> None:
        for name, failsafe in self._firmware.failsafes.items():
            value = self.values[name]
            off = value is None or value in failsafe.off
            state = 'is not known' if value is None else f'is {value:g}'
            state += ', which does not help' if value is not None and off else ''
            self._report(
                WARNING if off else INFO, f'failsafe for when {failsafe.meaning}: {name} {state}'
            )
        problem = self._station_problem()
        if problem:
            self._report(WARNING, problem)
