"""Where the map lies in the local frame of an autopilot, kept for a driver that is restarted."""

from __future__ import annotations

import json
import math
import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from maasi_drivers.links.mavlink.report_log import WARNING, ReportLog
from maasi_drivers.links.mavlink.settings import MavlinkSettings

# Autopilots that were switched on within this time of each other are the same one [s].
_SAME_BOOT = 5.0
_HOST_BOOT = Path('/proc/sys/kernel/random/boot_id')


class FlightOrigin:
    """The place in the local frame that stands at the start in the map.

    A local frame lasts as long as its autopilot is on: a file has the place for a driver that is
    started again meanwhile, in the air or after a landing elsewhere.

    Parameters
    ----------
    settings : MavlinkSettings
        Of the link.
    start : list of float
        In the map, x, y, z [m].
    path : Path or None
        Of the file; None: nothing is kept.
    log : ReportLog
        Takes reports.

    Attributes
    ----------
    problem : str
        Why the place is not known; empty where it is.
    """

    def __init__(
        self, settings: MavlinkSettings, start: list[float], path: Path | None, log: ReportLog
    ) -> None:
        self.problem = ''
        self._here = settings.origin == 'here'
        self._place = [*start[:2], settings.ground]
        self._path = path
        self._log = log

    def find(
        self, position: NDArray[np.float64], booted: float, armed: bool
    ) -> NDArray[np.float64] | None:
        """Return the place (3,), ENU [m], or None where it cannot be known.

        Parameters
        ----------
        position : ndarray, shape (3,)
            First one of the vehicle that the driver hears, ENU [m].
        booted : float
            When the autopilot was switched on, on the steady clock [s].
        armed : bool
            Whether its motors are.
        """
        kept = self._load(booted)
        if kept is not None:
            x, y, z = (position - kept).tolist()
            self._log.add(
                WARNING,
                f'the origin of the flight before is kept: the vehicle is ({x:.1f}, {y:.1f}, '
                f'{z:.1f}) m east, north and up of it; for a new one restart the autopilot',
            )
            return kept
        if not self._here:
            return np.zeros(3)
        if armed or self.problem:
            self.problem = (
                'mavlink.origin is here, and it was armed when the driver first heard it: its '
                'place in the map is not known; land it, put it at start, start the driver again'
            )
            return None
        self.keep(position, booted)
        return position

    def keep(self, place: NDArray[np.float64], booted: float) -> None:
        """Write the place to the file; `booted` as in `find`."""
        if self._path is None:
            return
        item = {'boot': [_host_boot(), booted], 'map': self._place, 'place': place.tolist()}
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            part = self._path.with_suffix('.part')
            part.write_text(json.dumps(item))
            os.replace(part, self._path)
        except OSError as error:
            self._log.add(WARNING, f'the origin of the flight cannot be kept: {error}')

    def _load(self, booted: float) -> NDArray[np.float64] | None:
        """Return what was kept of this autopilot since it is on, for this place in the map."""
        try:
            item = json.loads(self._path.read_text()) if self._path is not None else {}
            host, before = item['boot']
            place = np.array(item['place'], dtype=float)
            same = host == _host_boot() and math.isclose(before, booted, abs_tol=_SAME_BOOT)
        except (OSError, ValueError, KeyError, TypeError):
            return None
        fits = place.shape == (3,) and np.isfinite(place).all() and item.get('map') == self._place
        return place if same and fits else None


def _host_boot() -> str:
    """Return what tells one start of this computer from another: the steady clock begins there."""
    return _HOST_BOOT.read_text().strip()
