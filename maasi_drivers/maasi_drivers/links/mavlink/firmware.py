"""Differences of autopilots: modes, start, and failsafe checks."""

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from maasi_drivers.links.mavlink.protocol import INFO, WARNING, ReportLog, mavlink, mavutil
from maasi_drivers.settings.vehicles import MavlinkSettings

# Of MAVLink's MAV_AUTOPILOT and MAV_TYPE.
ARDUPILOT, PX4 = 3, 12
SUBMARINE = 12
COPTERS = frozenset({2, 3, 4, 13, 14, 15, 29})


@dataclass(frozen=True)
class Failsafe:
    """A parameter of an autopilot that defines its reaction to a fault."""

    meaning: str  # condition of its action
    off: tuple[float, ...] = (0.0,)  # values without a useful action
    guards_link: bool = False  # whether it acts on the loss of the driver


@dataclass(frozen=True)
class Firmware:
    """An autopilot's firmware."""

    name: str
    autopilot: int  # of MAV_AUTOPILOT
    kind: Literal['copter', 'submarine']
    modes: Mapping[int, str]
    external: int  # mode for set-points
    hold: int  # modes for holding the position, and for landing or surfacing
    land: int
    rise: Literal['command', 'setpoint']  # how it starts
    failsafes: Mapping[str, Failsafe]  # by parameter
    # Limits of guided flight: parameter names (older and newer versions) by kind, and units [m, s].
    # With any, set-points lead by its braking distance, and its speed is set.
    limits: Mapping[str, Mapping[str, float]] = field(default_factory=dict)

    @property
    def px4(self) -> bool:
        """Whether it is PX4: its mode needs set-points first, and pilots do not return control."""
        return self.autopilot == PX4

    def mode_name(self, mode: int) -> str:
        """Return a mode's name."""
        return self.modes.get(mode, f'mode {mode}')


def px4_mode(main: int, sub: int = 0) -> int:
    """Return PX4's custom mode from its main and sub mode."""
    return main << 16 | sub << 24


ARDUCOPTER = Firmware(
    name='ArduCopter',
    autopilot=ARDUPILOT,
    kind='copter',
    modes=mavutil.mode_mapping_acm,
    external=4,
    hold=17,
    land=9,
    rise='command',
    failsafes={
        'FS_GCS_ENABLE': Failsafe('driver heartbeats stop', guards_link=True),
        'FS_THR_ENABLE': Failsafe('the remote control is lost'),
        'FS_EKF_ACTION': Failsafe('the position estimate fails'),
        'BATT_FS_LOW_ACT': Failsafe('the battery is low'),
        'FENCE_ENABLE': Failsafe('it leaves the fence of the autopilot'),
    },
    limits={
        'acceleration': {'WPNAV_ACCEL': 0.01, 'WP_ACC': 1.0},
        'jerk': {'PSC_JERK_XY': 1.0, 'PSC_JERK_NE': 1.0},
    },
)

ARDUSUB = Firmware(
    name='ArduSub',
    autopilot=ARDUPILOT,
    kind='submarine',
    modes=mavutil.mode_mapping_sub | {20: 'MOTOR_DETECT', 21: 'SURFTRAK'},
    external=4,
    hold=16,
    land=9,
    rise='setpoint',
    failsafes={
        # 1 only warns, 2 disarms, and it drifts.
        'FS_GCS_ENABLE': Failsafe('driver heartbeats stop', (0.0, 1.0, 2.0), True),
        'FS_EKF_ACTION': Failsafe('the position estimate fails'),
        'FS_LEAK_ENABLE': Failsafe('water leaks in', (0.0, 1.0)),
        'BATT_FS_LOW_ACT': Failsafe('the battery is low'),
    },
)

PX4_COPTER = Firmware(
    name='PX4',
    autopilot=PX4,
    kind='copter',
    modes={px4_mode(*mode): name for name, (_, *mode) in mavutil.px4_map.items()},
    external=px4_mode(6),
    hold=px4_mode(4, 3),
    land=px4_mode(4, 6),
    rise='setpoint',
    failsafes={
        # Acts COM_OF_LOSS_T after the last set-point; 6 terminates the flight, 7 disarms: it falls
        # (`Failsafe::fromOffboardLossActParam`).
        'COM_OBL_RC_ACT': Failsafe('driver set-points stop', (6.0, 7.0), True),
        'NAV_DLL_ACT': Failsafe('driver heartbeats stop'),
        'COM_LOW_BAT_ACT': Failsafe('the battery is low'),
        'GF_ACTION': Failsafe('it leaves the fence of the autopilot'),
    },
)

FIRMWARES = {'arducopter': ARDUCOPTER, 'ardusub': ARDUSUB, 'px4': PX4_COPTER}


def identify(autopilot: int, vehicle_type: int) -> Firmware:
    """Return the firmware of a heartbeat."""
    kind = 'submarine' if vehicle_type == SUBMARINE else 'copter' if vehicle_type in COPTERS else ''
    for firmware in FIRMWARES.values():
        if firmware.autopilot == autopilot and firmware.kind == kind:
            return firmware
    known = ', '.join(item.name for item in FIRMWARES.values())
    raise ValueError(
        f'HEARTBEAT: read autopilot {autopilot}, type {vehicle_type}, allowed are copters and '
        f'submarines under {known}'
    )


# Parameters of ArduPilot with the system id of its ground station, and the highest id of a range in
# newer versions.
_STATION, _HIGHEST = ('SYSID_MYGCS', 'MAV_GCS_SYSID'), 'MAV_GCS_SYSID_HI'
# Defaults if the autopilot does not answer: level acceleration and jerk [m, s].
_FACTORY = {'acceleration': 2.5, 'jerk': 5.0}
# Period and number of requests for an unanswered parameter [s, 1].
_ANSWER_TIMEOUT, _TRIES = 0.5, 5
_FOREIGN_AGE = 5.0  # a message with our system id counts for this time [s]


class FailsafeCheck:
    """Checks that a vehicle stops by itself when the driver is lost.

    ArduPilot checks only the system id (`GCS::sysid_is_gcs`): any program with it prevents
    that.
    """

    def __init__(
        self, firmware: Firmware, settings: MavlinkSettings, sender: Any, log: ReportLog
    ) -> None:
        #: Parameter values; None if the autopilot does not have it.
        self.values: dict[str, float | None] = {}
        self.complete = False
        self._firmware, self._settings, self._sender, self._log = firmware, settings, sender, log
        self._station = () if firmware.px4 else _STATION
        # Names of one parameter in older and newer versions.
        self._same = [self._station, *map(tuple, firmware.limits.values())]
        self._names = [*firmware.failsafes, *(name for names in self._same for name in names)]
        self._names += [_HIGHEST] if self._station else []
        self._asked: Counter[str] = Counter()
        self._asked_at = self._foreign_at = -math.inf

    def update(self, name: str, value: float) -> None:
        """Handle the value of a parameter."""
        if name in self._names:
            self.values[name] = value

    def receive_own_id(self, now: float) -> None:
        """Note a message of another program that has the driver's system id."""
        if not self._foreign(now):
            self._foreign_at = now
            self._log.add(WARNING, self._foreign(now))
        self._foreign_at = now

    def read(self, now: float) -> None:
        """Request missing values; to be called repeatedly."""
        if self.complete or now - self._asked_at < _ANSWER_TIMEOUT:
            return
        self._asked_at = now
        for names in self._same:
            if any(self.values.get(name) is not None for name in names):
                for name in names:
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
            for name, failsafe in self._firmware.failsafes.items():
                value = self.values[name]
                off = value is None or value in failsafe.off
                rest = ', which does not stop the vehicle' if value is not None and off else ''
                text = f'failsafe for when {failsafe.meaning}: {name} {_state(value)}{rest}'
                self._log.add(WARNING if off else INFO, text)
            if problem := self._station_problem():
                self._log.add(WARNING, problem)

    def limit(self, kind: str) -> float:
        """Return a limit of the autopilot's guided flight [m, s]."""
        for name, unit in self._firmware.limits[kind].items():
            if value := self.values.get(name):
                return unit * value
        return _FACTORY[kind]

    def problem(self, now: float) -> str:
        """Return why the vehicle must not be armed, or an empty text."""
        if not self._settings.require_failsafe:
            return ''
        for name, failsafe in self._firmware.failsafes.items():
            value = self.values.get(name)
            if failsafe.guards_link and (value is None or value in failsafe.off):
                return f'failsafe {name} {_state(value)}, and require_failsafe is true'
        return self._foreign(now) or self._station_problem()

    def _foreign(self, now: float) -> str:
        """Return the error that another program has the driver's system id, or nothing."""
        if now - self._foreign_at > _FOREIGN_AGE:
            return ''
        return (
            f'another program uses system id {self._settings.own_system}: the autopilot would '
            'not detect a lost driver; mavlink.own_system must be unique'
        )

    def _station_problem(self) -> str:
        known = [(name, self.values.get(name)) for name in self._station]
        name, low = next((item for item in known if item[1] is not None), ('', None))
        if low is None:
            names = ' or '.join(self._station)
            return f'{names} is unknown, and require_failsafe is true' if names else ''
        own, high = self._settings.own_system, self.values.get(_HIGHEST)
        if low != own:
            return (
                f'{name} is {low:g}, mavlink.own_system is {own}: the autopilot would not '
                f'detect a lost driver; set {name} to {own}'
            )
        if high is not None and high > low:
            return (
                f'{_HIGHEST} is {high:g}: any ground station with an id from {low:g} to {high:g} '
                'keeps the failsafe from acting; set it to 0'
            )
        return ''


def _state(value: float | None) -> str:
    return 'is unknown' if value is None else f'is {value:g}'
