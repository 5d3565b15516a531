"""What sets the autopilots apart: their modes, how they start, and their failsafes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

# Of MAVLink's MAV_AUTOPILOT and MAV_TYPE.
ARDUPILOT, PX4 = 3, 12
SUBMARINE = 12
COPTERS = frozenset({2, 3, 4, 13, 14, 15, 29})


@dataclass(frozen=True)
class Failsafe:
    """A parameter of an autopilot that defines its reaction to a fault.

    Attributes
    ----------
    meaning : str
        When it acts.
    off : tuple of float
        Values with which it does nothing that helps.
    guards_link : bool
        Whether it acts on the loss of the driver's heartbeats.
    """

    meaning: str
    off: tuple[float, ...] = (0.0,)
    guards_link: bool = False


@dataclass(frozen=True)
class Firmware:
    """An autopilot's firmware.

    Attributes
    ----------
    name : str
        For people.
    autopilot : int
        Of MAVLink's MAV_AUTOPILOT.
    kind : str
        Of vehicle.
    modes : mapping
        Custom mode to its name.
    external : int
        Mode in which it follows setpoints.
    hold, land : int
        Modes in which it holds its position, and in which it lands or surfaces.
    rise : str
        How it leaves its place: by a take-off command, or by a setpoint at another height.
    streams_first : bool
        Whether setpoints must come before the mode does.
    returns : bool
        Whether a pilot can give the mode back.
    failsafes : mapping
        By the name of the parameter.
    ground_station : tuple of str
        Parameters, one of which holds the system id of the ground station it listens to.
    ground_station_high : str
        Parameter with the highest of these ids, where newer versions have a range.
    """

    name: str
    autopilot: int
    kind: Literal['copter', 'submarine']
    modes: Mapping[int, str]
    external: int
    hold: int
    land: int
    rise: Literal['command', 'setpoint']
    streams_first: bool
    returns: bool
    failsafes: Mapping[str, Failsafe]
    ground_station: tuple[str, ...] = ()
    ground_station_high: str = ''

    def mode_name(self, mode: int) -> str:
        """Return a mode's name."""
        return self.modes.get(mode, f'mode {mode}')


def px4_mode(main: int, sub: int = 0) -> int:
    """Return PX4's custom mode of its main and sub mode."""
    return main << 16 | sub << 24


ARDUCOPTER = Firmware(
    name='ArduCopter',
    autopilot=ARDUPILOT,
    kind='copter',
    modes={
        0: 'STABILIZE',
        1: 'ACRO',
        2: 'ALT_HOLD',
        3: 'AUTO',
        4: 'GUIDED',
        5: 'LOITER',
        6: 'RTL',
        7: 'CIRCLE',
        9: 'LAND',
        11: 'DRIFT',
        13: 'SPORT',
        16: 'POSHOLD',
        17: 'BRAKE',
        18: 'THROW',
        20: 'GUIDED_NOGPS',
        21: 'SMART_RTL',
    },
    external=4,
    hold=17,
    land=9,
    rise='command',
    streams_first=False,
    returns=True,
    failsafes={
        'FS_GCS_ENABLE': Failsafe('the heartbeats of the driver stop', guards_link=True),
        'FS_THR_ENABLE': Failsafe('the remote control is lost'),
        'FS_EKF_ACTION': Failsafe('the position estimate fails'),
        'BATT_FS_LOW_ACT': Failsafe('the battery is low'),
        'FENCE_ENABLE': Failsafe('it leaves the fence of the autopilot'),
    },
    ground_station=('SYSID_MYGCS', 'MAV_GCS_SYSID'),
    ground_station_high='MAV_GCS_SYSID_HI',
)

ARDUSUB = Firmware(
    name='ArduSub',
    autopilot=ARDUPILOT,
    kind='submarine',
    modes={
        0: 'STABILIZE',
        1: 'ACRO',
        2: 'ALT_HOLD',
        3: 'AUTO',
        4: 'GUIDED',
        7: 'CIRCLE',
        9: 'SURFACE',
        16: 'POSHOLD',
        19: 'MANUAL',
        20: 'MOTOR_DETECT',
        21: 'SURFTRAK',
    },
    external=4,
    hold=16,
    land=9,
    rise='setpoint',
    streams_first=False,
    returns=True,
    failsafes={
        # 1 only warns, 2 disarms: it drifts.
        'FS_GCS_ENABLE': Failsafe('the heartbeats of the driver stop', (0.0, 1.0, 2.0), True),
        'FS_EKF_ACTION': Failsafe('the position estimate fails'),
        'FS_LEAK_ENABLE': Failsafe('water comes in', (0.0, 1.0)),
        'BATT_FS_LOW_ACT': Failsafe('the battery is low'),
    },
    ground_station=('SYSID_MYGCS', 'MAV_GCS_SYSID'),
    ground_station_high='MAV_GCS_SYSID_HI',
)

PX4_COPTER = Firmware(
    name='PX4',
    autopilot=PX4,
    kind='copter',
    modes={
        px4_mode(1): 'MANUAL',
        px4_mode(2): 'ALTCTL',
        px4_mode(3): 'POSCTL',
        px4_mode(4, 1): 'AUTO.READY',
        px4_mode(4, 2): 'AUTO.TAKEOFF',
        px4_mode(4, 3): 'AUTO.LOITER',
        px4_mode(4, 4): 'AUTO.MISSION',
        px4_mode(4, 5): 'AUTO.RTL',
        px4_mode(4, 6): 'AUTO.LAND',
        px4_mode(5): 'ACRO',
        px4_mode(6): 'OFFBOARD',
        px4_mode(7): 'STABILIZED',
    },
    external=px4_mode(6),
    hold=px4_mode(4, 3),
    land=px4_mode(4, 6),
    rise='setpoint',
    streams_first=True,
    # OFFBOARD needs setpoints before it, and after the pilot took over none are sent.
    returns=False,
    failsafes={
        # Acts once the setpoints stop for COM_OF_LOSS_T; 6 terminates the flight, 7 disarms: it
        # falls (`Failsafe::fromOffboardLossActParam`).
        'COM_OBL_RC_ACT': Failsafe('the setpoints of the driver stop', (6.0, 7.0), True),
        'NAV_DLL_ACT': Failsafe('the heartbeats of the driver stop'),
        'COM_LOW_BAT_ACT': Failsafe('the battery is low'),
        'GF_ACTION': Failsafe('it leaves the fence of the autopilot'),
    },
)

FIRMWARES = (ARDUCOPTER, ARDUSUB, PX4_COPTER)


def identify(autopilot: int, vehicle_type: int) -> Firmware:
    """Return the firmware of a heartbeat.

    Raises
    ------
    ValueError
        If it is not supported.
    """
    kind = 'submarine' if vehicle_type == SUBMARINE else 'copter' if vehicle_type in COPTERS else ''
    for firmware in FIRMWARES:
        if firmware.autopilot == autopilot and firmware.kind == kind:
            return firmware
    known = ', '.join(item.name for item in FIRMWARES)
    raise ValueError(
        f'HEARTBEAT: read autopilot {autopilot}, type {vehicle_type}, allowed are copters and '
        f'submarines under {known}'
    )
