"""Settings and parameters of a fake autopilot, without MAVLink: scenarios have them."""

from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from maasi_filter.settings import Finite, NotNegative, Positive, Settings


class AutopilotSettings(Settings):
    """Settings of a fake autopilot; `external`: another program is the autopilot."""

    external: bool = Field(
        False,
        description='Whether the autopilot is not simulated here, but a simulator of ArduPilot or '
        'PX4, or a real vehicle; in a scenario, autopilot: external',
    )
    firmware: Literal['arducopter', 'ardusub', 'px4'] = Field(
        'arducopter', description='Autopilot that is emulated'
    )
    system: int = Field(1, ge=1, le=255, description='MAVLink system id')
    depth: NotNegative = Field(0.0, description='Depth of a submarine at its start [m]')
    estimator_time: NotNegative = Field(2.0, description='Time without position estimate [s]')
    second_gnss: bool = Field(False, description='Whether it has a second GNSS receiver')
    noise: NotNegative = Field(0.005, description='Standard deviation of the reported position [m]')
    barometer_drift: Finite = Field(
        0.0, description='Drift of the estimated height until it is armed [m/s]'
    )
    more_batteries: list[Annotated[float, Field(ge=0.0, le=1.0)]] = Field(
        default_factory=list,
        description='Charges of further batteries, which do not change',
    )
    endurance: Positive = Field(
        1200.0, description='Time for which a full battery lasts in the air [s]'
    )
    charge: float = Field(1.0, ge=0.0, le=1.0, description='Charge at the start, 0 to 1')
    speed: Positive = Field(2.0, description='Largest horizontal speed [m/s]')
    acceleration: Positive = Field(1.0, description='Largest acceleration [m/s^2]')
    parameters: dict[str, float] = Field(
        default_factory=dict, description='Parameters that differ from the defaults'
    )

    def all_parameters(self) -> dict[str, float]:
        """Return the parameters of the autopilot; its speed limits are those of the vehicle."""
        limits = {'WPNAV_SPEED': 100.0 * self.speed, 'WPNAV_ACCEL': 100.0 * self.acceleration}
        own = limits if self.firmware == 'arducopter' else {}
        return {**PARAMETERS[self.firmware], **own, **self.parameters}

    @model_validator(mode='before')
    @classmethod
    def _from_word(cls, value: Any) -> Any:
        return {'external': True} if value == 'external' else value


# Defaults, but set up as docs/robots_mavlink.md asks: a failsafe for the link, and the system
# id of the driver as that of the ground station.
PARAMETERS: dict[str, dict[str, float]] = {
    'arducopter': {
        'GUID_TIMEOUT': 3,
        'PSC_JERK_XY': 5,
        'PSC_JERK_Z': 5,
        'WPNAV_ACCEL_Z': 100,
        'FENCE_TYPE': 7,
        'FENCE_ACTION': 1,
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
