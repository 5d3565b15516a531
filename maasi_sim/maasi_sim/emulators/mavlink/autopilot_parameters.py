"""Firmwares that a fake autopilot stands for, and their parameters."""

from __future__ import annotations

from maasi_drivers.links.mavlink.firmware import ARDUCOPTER, ARDUSUB, PX4_COPTER, Firmware

FIRMWARES: dict[str, Firmware] = {
    'arducopter': ARDUCOPTER,
    'ardusub': ARDUSUB,
    'px4': PX4_COPTER,
}
# Defaults, but set up as docs/robots_mavlink.md asks: a failsafe for the link, and the system
# id of the driver as that of the ground station.
PARAMETERS: dict[str, dict[str, float]] = {
    'arducopter': {
        'FS_GCS_ENABLE': 5,
        'FS_GCS_TIMEOUT': 5,
        'FS_THR_ENABLE': 1,
        'FS_EKF_ACTION': 1,
        'BATT_FS_LOW_ACT': 1,
        'FENCE_ENABLE': 0,
        'SYSID_MYGCS': 240,
    },
    'ardusub': {
        'FS_GCS_ENABLE': 4,
        'FS_GCS_TIMEOUT': 5,
        'FS_EKF_ACTION': 0,
        'FS_LEAK_ENABLE': 1,
        'BATT_FS_LOW_ACT': 0,
        'SYSID_MYGCS': 240,
    },
    'px4': {
        'COM_OBL_RC_ACT': 4,
        'COM_OF_LOSS_T': 1,
        'NAV_DLL_ACT': 0,
        'COM_LOW_BAT_ACT': 2,
        'GF_ACTION': 2,
    },
}
# Integer parameters of PX4, whose bytes are sent in place of a float.
WHOLE_NUMBERS = frozenset({'COM_OBL_RC_ACT', 'NAV_DLL_ACT', 'COM_LOW_BAT_ACT', 'GF_ACTION'})
