"""Settings of the link to a vehicle that speaks MAVLink."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from maasi_filter.settings import Finite, Settings

Ending = Literal['hold', 'land']
Interval = Annotated[list[Finite], Field(min_length=2, max_length=2)]


class MavlinkSettings(Settings):
    """How the driver reaches an autopilot, and what it may have it do."""

    url: str = Field(
        default='udpin:127.0.0.1:14550',
        min_length=1,
        description='As pymavlink has it: udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT or the '
        'name of a serial device; udpin:0.0.0.0:PORT is heard from the whole network',
    )
    baud: int = Field(default=57600, ge=1200, description='Of a serial device [1/s]')
    system: int = Field(default=1, ge=1, le=255, description='System id of the vehicle')
    own_system: int = Field(
        default=240,
        ge=1,
        le=255,
        description='System id of the driver, of nobody else (ground stations have 255); the '
        'autopilot must have it as its ground station (SYSID_MYGCS, MAV_GCS_SYSID)',
    )
    vehicle: Literal['copter', 'submarine'] = Field(
        default='copter', description='What it is; another one is left alone'
    )
    arm: bool = Field(
        default=False,
        description='Whether the driver may arm it and take off: each time the service arm is '
        'called, and never without',
    )
    arm_timeout: float = Field(
        default=60.0,
        gt=0.0,
        description='Time after the service arm in which it has to be armed; then it is to be '
        'called again [s]',
    )
    require_failsafe: bool = Field(
        default=True,
        description='Whether it is armed only if the autopilot acts by itself when the link is cut',
    )
    origin: Literal['local', 'here'] = Field(
        default='local',
        description='What stands at the start in the map: the origin of the local frame of the '
        'autopilot, or the vehicle when the driver first hears its position, which is kept until '
        'the autopilot is restarted',
    )
    ground: Finite = Field(
        default=0.0, description='Height of that place in the map: the ground, the surface [m]'
    )
    map_yaw: Finite = Field(
        default=0.0, description='Direction of the x axis of the map, from east to the left [rad]'
    )
    geofence: Annotated[list[Interval], Field(min_length=3, max_length=3)] | None = Field(
        default=None,
        description='Lowest and highest x, y and z that it is sent to; none: the environment with '
        'the radius around it, in 2D 1 m above and below its heights at the start; for what '
        'starts above the ground, not below that [m, map]',
    )
    lead: float = Field(
        default=1.0,
        gt=0.0,
        le=5.0,
        description='Setpoints are as far ahead as it flies in this time, so that it stops by '
        'itself where none follows [s]',
    )
    setpoint_rate: float = Field(
        default=20.0, ge=4.0, le=100.0, description='Setpoints; PX4 needs more than 2 [1/s]'
    )
    position_rate: float = Field(
        default=20.0, ge=5.0, le=100.0, description='Positions asked of the autopilot [1/s]'
    )
    link_timeout: float = Field(
        default=0.6, ge=0.3, le=10.0, description='Silence after which the link is lost [s]'
    )
    latency: float = Field(
        default=0.0, ge=0.0, le=1.0, description='Age of a position when it arrives [s]'
    )
    rise_timeout: float = Field(
        default=15.0,
        gt=0.0,
        description='Time without coming nearer to its height at the start after which it lands '
        '[s]',
    )
    battery: int = Field(
        default=-1,
        ge=-1,
        le=255,
        description='Id of the battery that counts (BATTERY_STATUS.id); -1: the emptiest of all',
    )
    at_end: Ending = Field(
        default='land',
        description='What it does when the driver ends: hold its position, or land; a submarine '
        'surfaces',
    )
    on_low_battery: Ending = Field(default='land', description='The same with a low battery')

    @model_validator(mode='after')
    def _consistent(self) -> MavlinkSettings:
        for interval in self.geofence or []:
            if interval[0] >= interval[1]:
                raise ValueError(
                    f'geofence: got {interval}, allowed is a lowest below a highest value'
                )
        if self.own_system == self.system:
            raise ValueError(
                f'own_system: got {self.own_system}, allowed is another one than of the vehicle'
            )
        return self
