"""The state of a vehicle from its autopilot: pose, batteries, fix, landed or not."""

import json
import math
import os
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from maasi_drivers.links.mavlink.protocol import WARNING, ReportLog, mavlink
from maasi_drivers.settings.vehicles import MavlinkSettings
from maasi_filter.arrays import FloatArray
from maasi_filter.models.pose import quaternion_product
from maasi_filter.wording import point

_HALF = math.sqrt(0.5)
# Turns ENU into NED, and FRD into FLU; w first.
_NED_TO_ENU = np.array([0.0, _HALF, _HALF, 0.0])
_FLU_TO_FRD = np.array([0.0, 1.0, 0.0, 0.0])


def swap_enu_ned(vector: ArrayLike) -> FloatArray:
    """Return a vector (3,) of ENU in NED, or the reverse."""
    x, y, z = np.asarray(vector, dtype=float)
    return np.array([y, x, -z])


def swap_flu_frd(vector: ArrayLike) -> FloatArray:
    """Return a vector (3,) of a body's FLU axes in FRD, or the reverse."""
    x, y, z = np.asarray(vector, dtype=float)
    return np.array([x, -y, -z])


def swap_yaw(yaw: float) -> float:
    """Return a yaw [rad] (from east, anticlockwise) as from north, clockwise, or the reverse."""
    turned = 0.5 * math.pi - yaw
    return math.atan2(math.sin(turned), math.cos(turned))


def swap_orientation(quaternion: ArrayLike) -> FloatArray:
    """Return the orientation (4,) of FLU in ENU from FRD in NED, or the reverse; w first."""
    # Two half turns, each its own inverse up to the sign.
    given = np.asarray(quaternion, dtype=float)
    return quaternion_product(quaternion_product(_NED_TO_ENU, given), _FLU_TO_FRD)


# Boot times within this are of the same start of an autopilot [s].
_SAME_BOOT = 5.0


class FlightOrigin:
    """The map's start in the local frame, in a file that is valid until the autopilot restarts."""

    def __init__(
        self, settings: MavlinkSettings, start: list[float], path: Path | None, log: ReportLog
    ) -> None:
        self.problem = ''
        self._here = settings.origin == 'here'
        self._start = [*start[:2], settings.ground]
        self._path, self._log = path, log

    def find(self, position: FloatArray, booted: float, armed: bool) -> FloatArray | None:
        """Return the position (3,), ENU [m], if known; `booted`: boot time [s, steady clock]."""
        kept = self._load(booted)
        if kept is not None:
            x, y, z = (position - kept).tolist()
            self._log.add(
                WARNING,
                f'using the origin of the previous flight: the vehicle is {point((x, y, z))} m '
                'east, north and up of it; restart the autopilot for a new origin',
            )
            return kept
        if not self._here:
            return np.zeros(3)
        if armed or self.problem:
            self.problem = (
                'mavlink.origin is here, but it was armed before the driver connected: its '
                'position in the map is unknown; land it, place it at start, restart the driver'
            )
            return None
        self.keep(position, booted)
        return position

    def keep(self, origin: FloatArray, booted: float) -> None:
        """Write the position to the file; `booted` as in `find`."""
        if self._path is None:
            return
        item = {'boot': [_host_boot(), booted], 'map': self._start, 'place': origin.tolist()}
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            part = self._path.with_suffix('.part')
            part.write_text(json.dumps(item))
            os.replace(part, self._path)
        except OSError as error:
            self._log.add(WARNING, f'cannot store the origin of the flight: {error}')

    def _load(self, booted: float) -> FloatArray | None:
        try:
            item = json.loads(self._path.read_text()) if self._path is not None else {}
            host, before = item['boot']
            origin = np.array(item['place'], dtype=float)
            same = host == _host_boot() and math.isclose(before, booted, abs_tol=_SAME_BOOT)
        except (OSError, ValueError, KeyError, TypeError):
            return None
        fits = origin.shape == (3,) and np.isfinite(origin).all() and item.get('map') == self._start
        return origin if same and fits else None


def _host_boot() -> str:
    """Return an id of this boot of the host, which starts the steady clock."""
    return Path('/proc/sys/kernel/random/boot_id').read_text().strip()


_RESTART = 1000  # a larger decrease of the time since boot means a restart [ms]
_RESTARTS, _ALTERNATING = (
    3,
    3.0,
)  # more in this time are not one autopilot's: to boot takes longer [s]
_FIX_3D = 3  # smallest fix type of GPS_RAW_INT with a height
# Flags of EKF_STATUS_REPORT: relative or absolute position, and an assumed one.
_EKF_POSITION, _EKF_ASSUMED = 8 | 16, 128
# Validity of a status, which is requested twice per second [s].
_STATUS_AGE = 3.0
_EKF, _RECEIVERS = 'EKF_STATUS_REPORT', ('GPS_RAW_INT', 'GPS2_RAW')


@dataclass(frozen=True, eq=False)
class Telemetry:
    """Pose of a vehicle in its autopilot's local frame, converted to ENU."""

    arrival: float  # on the steady clock [s]
    position: FloatArray  # (3,) [m]
    velocity: FloatArray  # (3,) [m/s]
    orientation: FloatArray  # (4,) FLU in ENU, w first
    rates: FloatArray  # (3,) angular velocity in FLU [rad/s]


class Estimate:
    """The latest data of an autopilot."""

    def __init__(
        self, settings: MavlinkSettings, flight_origin: FlightOrigin, on_restart: Callable[[], None]
    ) -> None:
        self._settings, self._flight_origin = settings, flight_origin
        self._on_restart = on_restart
        self.dropped: Counter[str] = Counter()
        self.charge_reports = 0
        # Times of the last restarts, which those of several autopilots with one ID look like.
        self._restarts: deque[float] = deque(maxlen=_RESTARTS)
        self._clear()

    def _clear(self) -> None:
        self.telemetry: Telemetry | None = None
        self.received_at = -math.inf
        self.origin = np.zeros(3)
        self.booted = math.nan
        self.landed = mavlink.MAV_LANDED_STATE_UNDEFINED
        self._good: bool | None = None
        # Fix by receiver, and time of each message on estimate and fixes.
        self._fixes: dict[str, int] = {}
        self._status_at: dict[str, float] = {}
        self._now = -math.inf
        self._charges: dict[int, float] = {}
        self._from_batteries = False
        self._boot_time: int | None = None
        self._position: tuple[int, tuple[float, ...]] | None = None
        self._attitude = (np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(3))

    @property
    def several(self) -> bool:
        """Whether times since boot alternate, as those of several autopilots."""
        times = self._restarts
        return len(times) == _RESTARTS and times[-1] - times[0] < _ALTERNATING

    @property
    def has_fix(self) -> bool:
        """Whether a GNSS receiver has a fix."""
        return any(fix >= _FIX_3D and not self._silence(name) for name, fix in self._fixes.items())

    @property
    def silent_since(self) -> float:
        """Time since which an earlier message type is missing [s, steady clock]."""
        fixes = max((self._status_at[name] for name in self._fixes), default=math.inf)
        return min(self.received_at, self._status_at.get(_EKF, math.inf), fixes)

    def _silence(self, name: str) -> str:
        silent = self._now - self._status_at.get(name, math.inf) > _STATUS_AGE
        return f'{name} lost' if silent else ''

    @property
    def charge(self) -> float:
        """Battery charge, 0 to 1; -1 if unknown."""
        if self._settings.battery >= 0:
            return self._charges.get(self._settings.battery, -1.0)
        return min((value for value in self._charges.values() if value >= 0.0), default=-1.0)

    def problem(self, fix_needed: bool) -> str:
        """Return why the position is unreliable, or an empty text."""
        if self._good is False:
            return 'the autopilot has lost its position estimate'
        if silence := self._silence(_EKF):
            return silence
        if fix_needed and not self.has_fix:
            receivers = (
                self._silence(name) or f'{name}.fix_type {fix}' for name, fix in self._fixes.items()
            )
            return f'GNSS fix lost ({", ".join(receivers)})'
        return ''

    def update(self, message: Any, now: float, armed: bool) -> None:
        """Handle a message; other kinds are ignored."""
        kind = message.get_type()
        self._now = now
        if kind == 'LOCAL_POSITION_NED':
            self._update_position(message, now, armed)
        elif kind == 'ATTITUDE_QUATERNION':
            quaternion = np.array([message.q1, message.q2, message.q3, message.q4])
            rates = np.array([message.rollspeed, message.pitchspeed, message.yawspeed])
            norm = float(np.linalg.norm(quaternion))
            if not (np.isfinite(rates).all() and 0.9 < norm < 1.1):
                self.dropped['invalid ATTITUDE_QUATERNION'] += 1
                return
            self._note_time(message.time_boot_ms, now)
            self._attitude = (swap_orientation(quaternion / norm), swap_flu_frd(rates))
        elif kind == 'BATTERY_STATUS':
            self._from_batteries = True
            left = message.battery_remaining
            self._charges[int(message.id)] = left / 100.0 if 0 <= left <= 100 else -1.0
            self.charge_reports += self._settings.battery in (-1, message.id)
        elif kind == 'SYS_STATUS':
            # The first battery's charge, without BATTERY_STATUS.
            left = message.battery_remaining
            if 0 <= left <= 100 and not (self._from_batteries and 0 in self._charges):
                self._charges[0] = left / 100.0
                self.charge_reports += self._settings.battery in (-1, 0)
        elif kind == 'EXTENDED_SYS_STATE':
            self.landed = int(message.landed_state)
        elif kind in _RECEIVERS:
            self._fixes[kind], self._status_at[kind] = int(message.fix_type), now
        elif kind == _EKF:
            flags, self._status_at[kind] = message.flags, now
            self._good = bool(flags & _EKF_POSITION) and not flags & _EKF_ASSUMED

    def _note_time(self, milliseconds: int, now: float) -> None:
        """Detect a restart by a decrease of the time since boot."""
        if self._boot_time is not None and milliseconds < self._boot_time - _RESTART:
            self._clear()
            self._restarts.append(now)
            self._on_restart()
        else:
            self.received_at = now
        self._boot_time = max(milliseconds, self._boot_time or 0)

    def _update_position(self, message: Any, now: float, armed: bool) -> None:
        values = (message.x, message.y, message.z, message.vx, message.vy, message.vz)
        if not all(map(math.isfinite, values)):
            self.dropped['invalid LOCAL_POSITION_NED'] += 1
            return
        self._note_time(message.time_boot_ms, now)
        before = self._position
        if before is not None and message.time_boot_ms <= before[0]:
            return  # a duplicate
        self._position = (message.time_boot_ms, values)
        if before is not None and before[1] == values and armed:
            # A live estimate never repeats bit-identically.
            self.dropped['frozen LOCAL_POSITION_NED'] += 1
            return
        if self.telemetry is None:
            self.booted = now - 1e-3 * message.time_boot_ms
            origin = self._flight_origin.find(swap_enu_ned(values[:3]), self.booted, armed)
            if origin is None:
                return
            self.origin = origin
        position, velocity = swap_enu_ned(values[:3]), swap_enu_ned(values[3:])
        self.telemetry = Telemetry(now, position, velocity, *self._attitude)
